"""What a person turned down in one frame, known again in others: nobody has to say it twice."""

from collections import defaultdict
from collections.abc import Callable, Iterable

import numpy as np

from semviz.annotator.cameras import Cameras
from semviz.annotator.finds import Find, labelled, mark_of
from semviz.annotator.offers import DETECTED_PX
from semviz_annotation.assist.expect import expected_px
from semviz_annotation.assist.shot import Mark, pixel
from semviz_annotation.labels import Labels
from semviz_annotation.proposals import Proposal
from semviz_annotation.triangulate import Failed, Triangulated, triangulate

NEAR_M = 40.0
"""What was turned down by cameras further away is asked about again: its place is not that sure."""


class Refusals:
    """Finds that were said to be nothing, with their places. One thread at a time."""

    def __init__(self, cameras: Cameras, finds_in: Callable[[int], tuple[Find, ...]]) -> None:
        """``finds_in`` tells what a detector found in a frame."""
        self._cameras = cameras
        self._finds_in = finds_in
        self._places: dict[str, Triangulated | None] = {}
        self._labels = Labels()
        self._down: dict[int, set[str]] = {}
        """Proposals that were turned down, by frame, in these labels."""
        self._refused: dict[int, tuple[Find, ...]] = {}
        """What nobody has drawn there either, of the frames that were asked about."""

    def again(self, frame_index: int, finds: Iterable[Find], labels: Labels) -> set[str]:
        """Element ids of those of a frame's ``finds`` that were turned down in another frame.

        They lie where that should be, in all of their images.
        """
        near = self._near(frame_index, labels)
        found = [self._place(find) for other in near for find in self._refused_in(other, labels)]
        places = [place for place in found if place is not None]
        return {
            find.element_id
            for find in finds
            if any(all(self._is_at(one, place) for one in find.proposals) for place in places)
        }

    def _near(self, frame_index: int, labels: Labels) -> list[int]:
        """Other frames of cameras near by in which something was turned down."""
        if labels is not self._labels:
            self._labels, self._down = labels, _turned_down(labels)
            self._refused.clear()
        poses = self._cameras.T_map_camera
        here = poses[frame_index]
        if here is None:
            return []
        return [
            other
            for other in self._down
            if other != frame_index
            and (there := poses.get(other)) is not None
            and np.linalg.norm(there.translation - here.translation) < NEAR_M
        ]

    def _refused_in(self, frame_index: int, labels: Labels) -> tuple[Find, ...]:
        """What was turned down as nothing: nobody has drawn there what was meant."""
        if frame_index not in self._refused:
            down = self._down[frame_index]
            self._refused[frame_index] = tuple(
                find
                for find in self._finds_in(frame_index)
                if any(one.id in down for one in find.proposals)
                and not labelled(find.proposals, labels)
            )
        return self._refused[frame_index]

    def _place(self, find: Find) -> Triangulated | None:
        """In the map frame; None for what was found in one image."""
        if find.element_id not in self._places:
            self._places[find.element_id] = self._placed(find.proposals)
        return self._places[find.element_id]

    def _placed(self, seen: tuple[Proposal, ...]) -> Triangulated | None:
        if len(seen) < 2:
            return None
        views = [self._cameras.view(one.frame_index, one.side) for one in seen]
        rows = [mark_of(one).at(one.frame_index, one.side) for one in seen]
        place = triangulate(views, rows, min_angle_rad=0.0)
        return None if isinstance(place, Failed) else place

    def _is_at(self, one: Proposal, place: Triangulated) -> bool:
        if (one.end_px is not None) != place.is_line:
            return False
        ends = expected_px(place, self._cameras.view(one.frame_index, one.side))
        if ends is None:
            return False
        expected = Mark(pixel(ends[0]), pixel(ends[1]) if place.is_line else None)
        return expected.gap_px(mark_of(one)) < DETECTED_PX


def _turned_down(labels: Labels) -> dict[int, set[str]]:
    """Ids of a detector's proposals, by frame; what is only hidden is there."""
    down: dict[int, set[str]] = defaultdict(set)
    for one in labels.dismissals.values():
        if one.element_id is None and one.why != "occluded":
            down[one.frame_index].add(one.id)
    return down
