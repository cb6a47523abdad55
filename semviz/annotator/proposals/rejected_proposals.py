"""Recognize detections that a person has rejected, or that wait for the decision on a track.

A rejected detection is recognized in other frames too, so it is rejected once. So is one at an
element that was left out of maps.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from semviz.annotator.panes import Cameras, Pane
from semviz.annotator.proposals import detector_proposals
from semviz.annotator.proposals.detector_proposals import DetectorMatch
from semviz.annotator.proposals.label_proposals import DETECTED_PX, Expected
from semviz.annotator.tracks.detection_tracks import mark_of
from semviz_annotation.assist.expected_position import expected_px
from semviz_annotation.assist.marked_image import Mark, both_ends_px, gaps_px, pixel
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.mapping.placement import triangulation
from semviz_core.common.arrays import FloatArray

NEAR_M = 40.0
"""A rejection applies to cameras this close: from further away its position is too uncertain."""


class RejectedProposals:
    """Rejected detections and their positions. One thread at a time."""

    def __init__(
        self,
        cameras: Cameras,
        matches_in: Callable[[int], tuple[DetectorMatch, ...]],
    ) -> None:
        """``matches_in`` returns the detector matches of a frame."""
        self._cameras = cameras
        self._matches_in = matches_in
        self._positions: dict[str, triangulation.Triangulated | None] = {}
        """By the id of a match's first detection."""
        self._labels = Labels()
        self._rejected_ids: dict[int, set[str]] = {}
        """Rejected proposals in these labels, by frame."""
        self._rejected: dict[int, tuple[DetectorMatch, ...]] = {}
        """Rejected and unlabelled matches, by frame; filled on request."""

    def rejected_elsewhere(
        self, frame_index: int, matches: Iterable[DetectorMatch], labels: Labels
    ) -> set[str]:
        """Return the element ids of the frame's ``matches`` that were rejected in another frame.

        Such a match lies on the projection of the rejected position in all of its images.
        """
        near = self._near(frame_index, labels)
        candidates = [
            self._position(match) for other in near for match in self._rejected_in(other, labels)
        ]
        positions = [position for position in candidates if position is not None]
        return {
            match.element_id
            for match in matches
            if any(
                all(self._is_at(detection, position) for detection in match.proposals)
                for position in positions
            )
        }

    def _near(self, frame_index: int, labels: Labels) -> list[int]:
        """Other frames with rejections whose cameras are within ``NEAR_M``."""
        if labels is not self._labels:
            self._labels, self._rejected_ids = labels, _rejected_ids(labels)
            self._rejected.clear()
        poses = self._cameras.T_map_camera
        here = poses[frame_index]
        if here is None:
            return []
        return [
            other
            for other in self._rejected_ids
            if other != frame_index
            and (there := poses.get(other)) is not None
            and np.linalg.norm(there.translation - here.translation) < NEAR_M
        ]

    def _rejected_in(self, frame_index: int, labels: Labels) -> tuple[DetectorMatch, ...]:
        """The rejected matches of a frame that nobody has labelled instead."""
        if frame_index not in self._rejected:
            rejected = self._rejected_ids[frame_index]
            self._rejected[frame_index] = tuple(
                match
                for match in self._matches_in(frame_index)
                if any(detection.id in rejected for detection in match.proposals)
                and not detector_proposals.labelled_ids(match.proposals, labels)
            )
        return self._rejected[frame_index]

    def _position(self, match: DetectorMatch) -> triangulation.Triangulated | None:
        """Position in the map frame; None for a detection in a single image."""
        first = match.proposals[0].id
        if first not in self._positions:
            self._positions[first] = self._triangulated(match.proposals)
        return self._positions[first]

    def _triangulated(self, detections: tuple[Proposal, ...]) -> triangulation.Triangulated | None:
        if len(detections) < 2:
            return None
        views = [self._cameras.view(row.frame_index, row.side) for row in detections]
        rows = [mark_of(row).at(row.frame_index, row.side) for row in detections]
        position = triangulation.triangulate(views, rows, min_angle_rad=0.0)
        return None if isinstance(position, triangulation.TriangulationFailure) else position

    def _is_at(self, detection: Proposal, position: triangulation.Triangulated) -> bool:
        if (detection.end_px is not None) != position.is_line:
            return False
        ends = expected_px(position, self._cameras.view(detection.frame_index, detection.side))
        if ends is None:
            return False
        expected = Mark(pixel(ends[0]), pixel(ends[1]) if position.is_line else None)
        return expected.gap_px(mark_of(detection)) < DETECTED_PX


def _rejected_ids(labels: Labels) -> dict[int, set[str]]:
    """Ids of rejected detections, by frame; an occluded element is not rejected."""
    ids: dict[int, set[str]] = defaultdict(set)
    for dismissal in labels.dismissals.values():
        if dismissal.element_id is None and dismissal.why != "occluded":
            ids[dismissal.frame_index].add(dismissal.id)
    return ids


def is_left_out(match: DetectorMatch, left_out: Sequence[Expected]) -> bool:
    """Whether all detections of a match lie on elements that are left out of maps."""

    def is_at(detection: Proposal, expected: Expected) -> bool:
        mark = Mark(expected.projection.anchor_px, expected.projection.end_px)
        pane = Pane(detection.frame_index, detection.side)
        near = mark.gap_px(mark_of(detection)) < DETECTED_PX
        return expected.pane == pane and near

    return all(
        any(is_at(detection, expected) for expected in left_out) for detection in match.proposals
    )


def is_on_tracks(match: DetectorMatch, tracks_px: Mapping[Pane, FloatArray]) -> bool:
    """Whether all detections of a match lie on open tracks that they do not belong to: what becomes
    of the track is decided first."""
    for row in match.proposals:
        pane = Pane(row.frame_index, row.side)
        gaps = gaps_px(both_ends_px([mark_of(row)]), tracks_px[pane])
        if not (gaps < DETECTED_PX).any():
            return False
    return True
