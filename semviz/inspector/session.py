"""What one opened page shows: a frozen state, and the verbs that give the next one."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

from semviz.recording.run import Run
from semviz.web.colors import Theme
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

View = Literal["behind", "above", "camera", "free"]
MapColors = Literal["class", "residual", "times"]
ImageMode = Literal["estimate", "truth", "pairs", "error"]


@dataclass(frozen=True)
class Selection:
    """An observed row, a map element's id, or a pair of them."""

    observed: int | None = None
    element: int | None = None


@dataclass(frozen=True)
class State:
    """Frames are counted by their position in the run; ``run`` is a name, empty at first."""

    run: str = ""
    position: int = 0
    selection: Selection = Selection()
    view: View = "behind"
    theme: Theme = "dark"
    alternatives: bool = True
    forecast: bool = False
    colors: MapColors = "class"
    """What the colours of the map in 3D say."""
    ellipsoids: bool = False
    """Whether the submap's covariances are drawn."""
    base: str = ""
    """The run to compare with, by name; empty for none."""
    comparing: bool = False
    """Whether both runs are shown side by side."""
    mode: ImageMode = "estimate"
    """What is drawn on the image."""
    side: Side = "left"
    neighbours: bool = False
    """Whether the images before and after are shown."""

    def opened(self, name: str, run: Run, frame: int | None) -> "State":
        """At the frame numbered ``frame`` of another run; at its first frame where it has none."""
        numbers = [record.frame.index for record in run.frames]
        if not numbers:
            raise SemvizError(f"{name}: no frame in it; localize again")
        at = numbers.index(frame) if frame in numbers else 0
        side = self.side if run.info.rig.right is not None else "left"
        there = replace(self, run=name, position=at, selection=Selection(), side=side)
        return there.against("", False) if name == self.base else there

    def at(self, position: int, run: Run) -> "State":
        """At another position, cut to the run; a selected map element stays selected."""
        last = len(run.frames) - 1
        there = replace(self, position=min(max(position, 0), last), selection=Selection())
        return there.selecting(None, self.selection.element, run)

    def selecting(self, observed: int | None, element: int | None, run: Run) -> "State":
        """With an observed row, an element or a pair selected; of one alone, its partner too."""
        record = run.frames[self.position]
        rows = len(record.localization.observed)
        if observed is not None and not 0 <= observed < rows:
            raise SemvizError(f"observation {observed} does not exist; this frame has {rows}")
        if element is not None and element not in run.semantic_map.elements.id:
            raise SemvizError(f"the map of this run has no element {element}; choose another")
        partners = matched_elements(run, self.position)
        if observed is not None and element is None:
            element = partners.get(observed)
        elif observed is None and element is not None:
            observed = next((i for i, one in partners.items() if one == element), None)
        return replace(self, selection=Selection(observed, element))

    def looking(self, view: str) -> "State":
        """From another viewpoint."""
        known: dict[str, View] = {one: one for one in get_args(View)}
        if view not in known:
            raise SemvizError(f"no viewpoint '{view}'; there are {', '.join(known)}")
        return replace(self, view=known[view])

    def coloring(self, colors: str, ellipsoids: bool) -> "State":
        """With other colours of the map in 3D, with or without ellipsoids."""
        known: dict[str, MapColors] = {one: one for one in get_args(MapColors)}
        if colors not in known:
            raise SemvizError(f"the map has no colours by '{colors}'; by {', '.join(known)}")
        return replace(self, colors=known[colors], ellipsoids=ellipsoids)

    def picturing(self, mode: str, side: str, neighbours: bool) -> "State":
        """With something else drawn on the image, or on another image."""
        modes: dict[str, ImageMode] = {one: one for one in get_args(ImageMode)}
        sides: dict[str, Side] = {one: one for one in get_args(Side)}
        if mode not in modes:
            raise SemvizError(f"images do not show '{mode}'; they show {', '.join(modes)}")
        if side not in sides:
            raise SemvizError(f"no {side} image; there are {', '.join(sides)}")
        return replace(self, mode=modes[mode], side=sides[side], neighbours=neighbours)

    def against(self, base: str, comparing: bool) -> "State":
        """Compared with another run, side by side or not."""
        return replace(self, base=base, comparing=comparing and bool(base))

    def themed(self, theme: str) -> "State":
        """Dark or light."""
        return replace(self, theme="light" if theme == "light" else "dark")

    def showing_alternatives(self, shown: bool) -> "State":
        """With or without the other poses that fit."""
        return replace(self, alternatives=shown)

    def showing_forecast(self, shown: bool) -> "State":
        """With or without what the map lets a camera know along the route."""
        return replace(self, forecast=shown)


def matched_elements(run: Run, position: int) -> dict[int, int]:
    """Map element's id by observed row, of the pairs that the answer rests on."""
    localization = run.frames[position].localization
    if localization.refinement is None:
        return {}
    pairs = localization.refinement.pairs
    ids = localization.submap.id[pairs[:, 1]]
    return dict(zip(pairs[:, 0].tolist(), ids.tolist(), strict=True))
