"""What is in hand: guides in the images, the edges it snaps to, and the numbers of its card."""

import json
from collections.abc import Sequence
from dataclasses import replace

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from semviz.annotator.cameras import Cameras
from semviz.annotator.cards import card, epipolar_error_px
from semviz.annotator.panes import Pane, Panes
from semviz.annotator.places import Places
from semviz.annotator.views import Json
from semviz_annotation.assist.shot import Mark
from semviz_annotation.edits import first_fault
from semviz_annotation.labels import STRICT, Id, Index, Labels, Observation, Pixel
from semviz_annotation.stereo import epipolar_segment
from semviz_annotation.view import View, other
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

WHOLE_LINE_M = (0.5, float("inf"))


@dataclass(frozen=True, config=STRICT)
class Drawing:
    """What is under the pen: not saved yet."""

    side: Side
    """Of the page: with one camera, right is another frame."""
    class_id: Index
    anchor_px: Pixel
    end_px: Pixel | None
    anchor_known: bool = True
    end_known: bool = True
    snap: bool = False
    asks_bottom: bool = False
    """Whether the tool may say that the bottom is hidden."""

    @property
    def has_shape(self) -> bool:
        """False for a pole whose second point is still on its first."""
        return self.end_px != self.anchor_px

    @property
    def mark(self) -> Mark:
        return Mark(self.anchor_px, self.end_px, self.anchor_known, self.end_known)


@dataclass(frozen=True, config=STRICT)
class Seen:
    """An observation as the page showed it when somebody changed it."""

    element: Id
    frame: Index
    side: Side
    anchor: Pixel
    end: Pixel | None
    anchor_known: bool
    end_known: bool

    def as_row(self, observation_id: str) -> Observation:
        return Observation(
            id=observation_id,
            element_id=self.element,
            frame_index=self.frame,
            side=self.side,
            anchor_px=self.anchor,
            end_px=self.end,
            anchor_known=self.anchor_known,
            end_known=self.end_known,
        )


@dataclass(frozen=True, config=STRICT)
class Look:
    """What the page has in hand, for which it wants guides and numbers."""

    frame_index: Index
    selected_id: Id | None = None
    side: Side = "left"
    """Of the selected observation."""
    drawing: Drawing | None = None
    moved: dict[Id, tuple[Pixel, Pixel | None]] = Field(default_factory=dict)
    """Observations that are being dragged, with where they are now."""


class Hand:
    """Says what is known of what is in hand."""

    def __init__(self, cameras: Cameras, panes: Panes, places: Places) -> None:
        self._cameras = cameras
        self._panes = panes
        self._places = places

    def about(self, look: Look, element_id: str | None, labels: Labels) -> Json:
        """Guides and card; ``element_id`` is what is selected, or what the drawing will join."""
        observations = self._in_hand(look, element_id, labels)
        shown = self._shown(look.frame_index, observations)
        return {
            "guides": self._guides(look, shown),
            "card": self._card(look.frame_index, observations, shown) if observations else None,
        }

    def _in_hand(
        self, look: Look, element_id: str | None, labels: Labels
    ) -> tuple[Observation, ...]:
        """The element's observations as they would be if the pen were lifted now."""
        observations = [] if element_id is None else list(labels.of_element(element_id))
        for place, one in enumerate(observations):
            if one.id in look.moved:
                anchor, end = look.moved[one.id]
                observations[place] = replace(one, anchor_px=anchor, end_px=end)
        if look.drawing is not None and look.drawing.has_shape:
            observations.append(self.observation(look.drawing, look.frame_index))
        return tuple(observations)

    def observation(self, drawing: Drawing, frame_index: int) -> Observation:
        """A drawing as the observation that it would become."""
        pane = self._panes.pane(frame_index, drawing.side)
        return drawing.mark.at(pane.frame_index, pane.side)

    def _shown(
        self, frame_index: int, observations: Sequence[Observation]
    ) -> dict[Side, tuple[View, Observation]]:
        """Those of ``observations`` that are on screen."""
        panes = self._panes.of(frame_index)
        return {
            side: (self._view(pane), one)
            for side, pane in panes.items()
            for one in observations
            if (one.frame_index, one.side) == (pane.frame_index, pane.side)
        }

    def _view(self, pane: Pane) -> View:
        return self._cameras.view(pane.frame_index, pane.side)

    def _guides(
        self, look: Look, shown: dict[Side, tuple[View, Observation]]
    ) -> dict[str, list[Json]]:
        """Epipolar lines of what is in hand, in the images across from it."""
        guides: dict[str, list[Json]] = {"left": [], "right": []}
        panes = self._panes.of(look.frame_index)
        in_hand = look.side if look.drawing is None else look.drawing.side
        if in_hand not in shown or other(in_hand) not in panes:
            return guides
        here, one = shown[in_hand]
        there = self._view(panes[other(in_hand)])
        ends = [one.anchor_px]
        if one.end_px is not None and one.end_px != one.anchor_px:
            ends.append(one.end_px)
        guides[other(in_hand)] = [_guide(here, there, end) for end in ends]
        return guides

    def _card(
        self,
        frame_index: int,
        observations: Sequence[Observation],
        shown: dict[Side, tuple[View, Observation]],
    ) -> Json:
        here = [one for _, one in shown.values()]
        if self._cameras.T_map_camera[frame_index] is None:
            place, count = self._places.of_pair(here), len(here)
        else:
            place, count = self._places.of_observations(observations), len(observations)
        lengths = {
            side: _length_px(one.anchor_px, one.end_px)
            for side, (_, one) in shown.items()
            if one.end_px is not None
        }
        view = self._cameras.view(frame_index, "left")
        return card(place, view, count) | {
            "length_px": lengths,
            "epipolar_px": epipolar_error_px([shown[side] for side in sorted(shown)]),
        }


def _guide(here: View, there: View, pixel: Pixel) -> Json:
    return {
        "line": epipolar_segment(here, there, pixel, WHOLE_LINE_M).tolist(),
        "plausible": epipolar_segment(here, there, pixel).tolist(),
    }


def _length_px(anchor: Pixel, end: Pixel) -> float:
    return float(((anchor[0] - end[0]) ** 2 + (anchor[1] - end[1]) ** 2) ** 0.5)


_SEEN: TypeAdapter[Seen] = TypeAdapter(Seen)


def seen_from_json(data: object) -> Seen:
    """SemvizError where ``data`` is not an observation as the page has it."""
    try:
        return _SEEN.validate_json(json.dumps(data))
    except ValidationError as error:
        raise SemvizError(f"not an observation: {first_fault(error)}") from None
