"""The state of one open page, frozen, with methods that return the next state.

A frame is given by its position in the run, from 0.
"""

from dataclasses import dataclass, replace
from typing import Literal

from semviz.runs.frame_table import frame_table
from semviz.runs.run import Run
from semviz.runs.story import worst_position
from semviz.web.protocol import RefusedError
from semviz.web.shapes import Theme
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

View = Literal["behind", "above", "camera", "free"]
MapColors = Literal["class", "residual", "times"]
ImageMode = Literal["estimate", "truth", "pairs", "error"]


@dataclass(frozen=True)
class Selection:
    """The row of a detection, the id of a map element, or a pair of them."""

    observed: int | None = None
    element: int | None = None


@dataclass(frozen=True)
class State:
    """What one page shows, and how. ``run`` is a name, empty at first."""

    run: str = ""
    position: int = 0
    selection: Selection = Selection()
    view: View = "behind"
    theme: Theme = "dark"
    alternatives: bool = True
    forecast: bool = False
    colors: MapColors = "class"
    """Meaning of the colours of the 3D map."""
    ellipsoids: bool = False
    """Whether the submap's covariances are drawn."""
    backdrop: bool = True
    """Whether the drive's backdrop is drawn, if it has one."""
    base: str = ""
    """Name of the run to compare with; empty for none."""
    comparing: bool = False
    """Whether both runs are shown side by side."""
    mode: ImageMode = "estimate"
    """What is drawn on the image."""
    side: Side = "left"
    neighbours: bool = False
    """Whether the images before and after are shown."""

    def opened(self, name: str, run: Run, frame: int | None) -> "State":
        """Open a run at the frame with number ``frame``, or else at its worst frame."""
        if not len(run.frames):
            raise SemvizError(f"{name} has no frames; localize again")
        position = None if frame is None else frame_table(run).position_of(frame)
        position = worst_position(run) if position is None else position
        side = self.side if run.info.rig.right is not None else "left"
        state = replace(self, run=name, position=position, selection=Selection(), side=side)
        return state.with_base("", False) if name == self.base else state

    def at(self, position: int, run: Run) -> "State":
        """Go to a position, clipped to the run. A selected map element stays selected."""
        last = len(run.frames) - 1
        state = replace(self, position=min(max(position, 0), last), selection=Selection())
        return state.with_selection(None, self.selection.element, run)

    def with_selection(self, observed: int | None, element: int | None, run: Run) -> "State":
        """Select a detection, an element or a pair; one alone selects its match, too.

        Raise RefusedError if the frame has no such detection, or the map no such element.
        """
        record = run.frames[self.position]
        rows = len(record.localization.observed)
        if observed is not None and not 0 <= observed < rows:
            text = f"detection {observed} does not exist; this frame has {rows}"
            raise RefusedError("not_found", text)
        if element is not None and element not in run.semantic_map:
            text = f"the map of this run has no element {element}; choose another"
            raise RefusedError("not_found", text)
        matched = matched_elements(run, self.position)
        if observed is not None and element is None:
            element = matched.get(observed)
        elif observed is None and element is not None:
            observed = next((row for row, id in matched.items() if id == element), None)
        return replace(self, selection=Selection(observed, element))

    def with_view(self, view: View) -> "State":
        """Look from another viewpoint."""
        return replace(self, view=view)

    def with_map_colors(self, colors: MapColors, ellipsoids: bool) -> "State":
        """Colour the 3D map by ``colors``, with or without ellipsoids."""
        return replace(self, colors=colors, ellipsoids=ellipsoids)

    def with_image(self, mode: ImageMode, side: Side, neighbours: bool) -> "State":
        """Show the left or right image, and what is drawn on it."""
        return replace(self, mode=mode, side=side, neighbours=neighbours)

    def with_base(self, base: str, comparing: bool) -> "State":
        """Compare with the run ``base``, side by side or not."""
        return replace(self, base=base, comparing=comparing and bool(base))

    def with_theme(self, theme: Theme) -> "State":
        """Switch between dark and light."""
        return replace(self, theme=theme)

    def with_alternatives(self, shown: bool) -> "State":
        """Show or hide the alternative poses."""
        return replace(self, alternatives=shown)

    def with_backdrop(self, shown: bool) -> "State":
        """Show or hide the backdrop of the drive."""
        return replace(self, backdrop=shown)

    def with_forecast(self, shown: bool) -> "State":
        """Show or hide the expected error along the route."""
        return replace(self, forecast=shown)


def matched_elements(run: Run, position: int) -> dict[int, int]:
    """Return the map element's id by the row of the detection, for the pairs of the estimate."""
    localization = run.frames[position].localization
    if localization.refinement is None:
        return {}
    pairs = localization.refinement.pairs
    ids = localization.submap.id[pairs[:, 1]]
    return dict(zip(pairs[:, 0].tolist(), ids.tolist(), strict=True))
