"""Assess frames: how well labels fit, how much is proposed, where the detector disagrees."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from semviz.annotator.element_positions import ElementPositions
from semviz.annotator.proposals.detector_proposals import Disagreement
from semviz.annotator.proposals.proposal_selection import ProposalSelection
from semviz_annotation.labels.labels import (
    Dismissal,
    LabelElement,
    Labels,
    Observation,
    ReviewDecision,
)
from semviz_annotation.labels.views import PosedView
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_annotation.storage.store import Operation
from semviz_core.base.frame import Side
from semviz_core.metrics.detection import across_px

AROUND = 60
"""A mapped element changes the proposals of this many frames before and after its own."""


@dataclass(frozen=True)
class FrameFacts:
    """Quality of one frame's labels."""

    worst_px: float
    """Largest distance of a label from the projection of its element; 0 if nothing is mapped."""
    worst_id: str | None
    """The element of that label."""
    proposed: int
    """Number of mapped elements expected in the frame's images and of detections, neither labelled
    nor rejected. From geometry alone, without image search."""
    expected: tuple[tuple[str, Side], ...]
    """Mapped elements expected in the frame's images, neither labelled nor rejected there."""
    disagreement: Disagreement | None
    """None if no detector processed the frame."""


class FrameQuality:
    """Keeps the quality of all frames up to date, a few frames at a time. One thread at a time."""

    def __init__(
        self, order: Sequence[int], positions: ElementPositions, selection: ProposalSelection
    ) -> None:
        self._order = order
        self._rank = {index: rank for rank, index in enumerate(order)}
        self._positions = positions
        self._selection = selection
        self._facts: dict[int, FrameFacts] = {}
        self._stale: dict[int, None] = dict.fromkeys(order)
        self._assessed: set[int] = set()
        """Frames that were assessed since the last ``take_assessed``."""

    def of(self, frame_index: int) -> FrameFacts | None:
        """Return the facts of a frame; None if they are not known yet."""
        return self._facts.get(frame_index)

    def forget(self, operation: Operation, labels: Labels) -> None:
        """Mark the frames that an operation affects as stale."""
        rows = [row for change in operation.changes for row in (change.before, change.after)]
        elements = {row.element_id for row in rows if isinstance(row, Observation)}
        elements |= {row.id for row in rows if isinstance(row, LabelElement)}
        elements |= {row.element_id for row in rows if isinstance(row, ReviewDecision)}
        observations = [row for element_id in elements for row in labels.of_element(element_id)]
        observations += [row for row in rows if isinstance(row, Observation)]
        frames = {row.frame_index for row in observations}
        frames |= {row.frame_index for row in rows if isinstance(row, Dismissal)}
        for index in sorted(frames):
            rank = self._rank.get(index)
            if rank is not None:
                around = self._order[max(0, rank - AROUND) : rank + AROUND + 1]
                self._stale.update(dict.fromkeys(around))

    def is_near(self, index: int, changed: Iterable[int]) -> bool:
        """Return whether labels in some of the frames may change the proposals of another."""
        rank = self._rank[index]
        return any(abs(self._rank.get(other, rank) - rank) <= AROUND for other in changed)

    def forget_all(self) -> Sequence[int]:
        """Mark all frames as stale and return them."""
        self._stale = dict.fromkeys(self._order)
        return self._order

    def update(self, labels: Labels, seconds: float) -> bool:
        """Assess stale frames for that long. Return whether all are up to date."""
        end = time.monotonic() + seconds
        while self._stale and time.monotonic() < end:
            index = next(iter(self._stale))
            del self._stale[index]
            self._facts[index] = self._assess(index, labels)
            self._assessed.add(index)
        return not self._stale

    def take_assessed(self) -> list[int]:
        """Return the frames that were assessed since the last call."""
        frames, self._assessed = sorted(self._assessed), set()
        return frames

    def _assess(self, frame_index: int, labels: Labels) -> FrameFacts:
        rows = labels.in_frame(frame_index)
        kept = [row for row in rows if not labels.is_left_out(row.element_id)]
        residuals = list(self._residuals_px(kept, labels))
        worst_px, worst_id = max(residuals, default=(0.0, None), key=lambda residual: residual[0])
        return FrameFacts(worst_px, worst_id, *self._selection.survey(frame_index, labels))

    def _residuals_px(
        self, rows: Iterable[Observation], labels: Labels
    ) -> Iterable[tuple[float, str]]:
        for row in rows:
            position = self._positions.of_element(labels, row.element_id)
            if not isinstance(position, Triangulated):
                continue
            yield residual_px(self._positions.view(row), row, position), row.element_id


def residual_px(view: PosedView, row: Observation, position: Triangulated) -> float:
    """Return how far a label is from the projection of its element: of a pole, across its line."""
    if row.end_px is None:
        projected = view.project(position.anchor_m[None])[0]
        return float(np.linalg.norm(projected - row.anchor_px))
    line = view.project(np.stack([position.anchor_m, position.end_m]))
    return float(np.abs(across_px(line, np.array([row.anchor_px, row.end_px]))).max())
