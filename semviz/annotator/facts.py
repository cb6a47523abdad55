"""What is worth a visit: how well each frame's labels fit, and how much is proposed in it."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from semviz.annotator.disagreement import Disagreement
from semviz.annotator.places import Places
from semviz.annotator.proposing import Proposing
from semviz_annotation.labels import Dismissal, LabelElement, Labels, Observation
from semviz_annotation.storing.store import Operation
from semviz_annotation.triangulate import Triangulated
from semviz_core.evaluation.image_errors import across_px

AROUND = 60
"""A mapped element changes what is proposed in so many frames before and after its own."""


@dataclass(frozen=True)
class FrameFacts:
    """About one frame."""

    worst_px: float
    """Largest distance of a label from the projection of its element; 0 where nothing is mapped."""
    worst_id: str | None
    """Its element."""
    proposed: int
    """Mapped elements that are expected in its images and neither labelled nor turned down there,
    and what a detector found. Geometry alone: nobody has looked."""
    disagreement: Disagreement | None
    """None where no detector looked."""


class Facts:
    """Keeps the facts of all frames up to date, a few frames at a time."""

    def __init__(self, order: Sequence[int], places: Places, proposing: Proposing) -> None:
        self._order = order
        self._place_in_time = {index: place for place, index in enumerate(order)}
        self._places = places
        self._proposing = proposing
        self._facts: dict[int, FrameFacts] = {}
        self._stale: dict[int, None] = dict.fromkeys(order)

    def of(self, frame_index: int) -> FrameFacts | None:
        """None where it is not known yet."""
        return self._facts.get(frame_index)

    def forget(self, operation: Operation, labels: Labels) -> None:
        """``operation`` has been done: what it bears on is to be learnt anew."""
        rows = [row for one in operation.changes for row in (one.before, one.after)]
        elements = {row.element_id for row in rows if isinstance(row, Observation)}
        elements |= {row.id for row in rows if isinstance(row, LabelElement)}
        seen = [one for element_id in elements for one in labels.of_element(element_id)]
        seen += [row for row in rows if isinstance(row, Observation)]
        frames = {one.frame_index for one in seen}
        frames |= {row.frame_index for row in rows if isinstance(row, Dismissal)}
        for index in sorted(frames):
            place = self._place_in_time.get(index)
            if place is not None:
                around = self._order[max(0, place - AROUND) : place + AROUND + 1]
                self._stale.update(dict.fromkeys(around))

    def forget_all(self) -> Sequence[int]:
        """All is to be learnt anew; the frames."""
        self._stale = dict.fromkeys(self._order)
        return self._order

    def learn(self, labels: Labels, seconds: float) -> tuple[list[int], bool]:
        """Frames that are known after so long and were not, or not rightly; whether all are."""
        frames: list[int] = []
        end = time.monotonic() + seconds
        while self._stale and time.monotonic() < end:
            index = next(iter(self._stale))
            del self._stale[index]
            self._facts[index] = self._learnt(index, labels)
            frames.append(index)
        return frames, not self._stale

    def _learnt(self, frame_index: int, labels: Labels) -> FrameFacts:
        residuals = list(self._residuals_px(labels.in_frame(frame_index), labels))
        worst_px, worst_id = max(residuals, default=(0.0, None), key=lambda one: one[0])
        return FrameFacts(worst_px, worst_id, *self._proposing.survey(frame_index, labels))

    def _residuals_px(
        self, rows: Iterable[Observation], labels: Labels
    ) -> Iterable[tuple[float, str]]:
        for row in rows:
            place = self._places.of_element(labels, row.element_id)
            if not isinstance(place, Triangulated):
                continue
            view = self._places.view(row)
            if row.end_px is None:
                seen = view.project(place.anchor_m[None])[0]
                yield float(np.linalg.norm(seen - row.anchor_px)), row.element_id
            else:
                line = view.project(np.stack([place.anchor_m, place.end_m]))
                across = across_px(line, np.array([row.anchor_px, row.end_px]))
                yield float(np.abs(across).max()), row.element_id
