"""Select the proposals of a frame: confirmed by the images, distinct, not rejected before.

A proposal in the position of a label or of another proposal is doubtful. A detection there is
left out, because more is known of the element.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from semviz.annotator import element_positions
from semviz.annotator.drawing.association import NearbyElement, nearby_elements
from semviz.annotator.panes import Cameras, Pane, Panes
from semviz.annotator.proposals import detector_proposals
from semviz.annotator.proposals.detector_proposals import DetectorMatch
from semviz.annotator.proposals.image_worker import ImageWorker
from semviz.annotator.proposals.label_proposals import (
    DETECTED_PX,
    CorrespondenceQuery,
    Expected,
    ImageQuery,
    LabelProposal,
    PropagationQueries,
    PropagationQuery,
)
from semviz.annotator.proposals.label_proposals import label_proposals as element_proposals
from semviz.annotator.proposals.rejected_proposals import (
    RejectedProposals,
    is_left_out,
    is_on_tracks,
)
from semviz.annotator.tracks.detection_tracks import DetectionTracks, OpenTracks
from semviz_annotation.assist.marked_image import Mark, both_ends_px, gaps_px
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposals import Proposals
from semviz_core.base.frame import Side

TAKEN_PX = 1.5
"""A proposal this close to a label of its class duplicates that label. Poles in line with the
camera may be a little further apart."""
_ON_LINE_PX = 1.0
"""A detected pole this close to the line of a proposed pole is the same pole."""


def select_distinct(proposals: Sequence[LabelProposal], labels: Labels) -> list[LabelProposal]:
    """Return searched proposals; score 0 for those on a label or on a better proposal.

    A detection on a known element is left out, but may give that element its position or its peak.
    Rejected proposals are left out, with all detections in the same position.
    """
    known = _distinct_known(
        [proposal for proposal in proposals if not proposal.is_rejected], labels
    )
    rejected = [proposal for proposal in proposals if proposal.is_rejected]
    detected: dict[str, list[LabelProposal]] = defaultdict(list)
    for proposal in proposals:
        if proposal.is_detected and not proposal.is_rejected:
            detected[proposal.element_id].append(proposal)
    new: list[LabelProposal] = []
    for marks in sorted(detected.values(), key=_rank_of_detected):
        same = {n for n, other in enumerate(known) if any(_is_at(mark, other) for mark in marks)}
        for n in same:
            known[n] = _at_detection(known[n], marks)
        known = _with_detected_peaks(known, marks)
        labelled = any(_is_labelled(mark, labels) for mark in marks)
        blocked = any(_is_at(mark, other) for mark in marks for other in [*rejected, *new])
        if not (same or labelled or blocked):
            new += marks
    return [*known, *new]


def _rank_of_detected(marks: Sequence[LabelProposal]) -> tuple[bool, float]:
    """Tracks come first, because the detections of many frames support them."""
    return marks[0].track is None, -(marks[0].score or 0.0)


def _distinct_known(proposals: Sequence[LabelProposal], labels: Labels) -> list[LabelProposal]:
    """Return the proposals of known elements, best first; score 0 for those in a taken position."""
    known = [proposal for proposal in proposals if not proposal.is_detected]
    known.sort(key=lambda proposal: -(proposal.score or 0.0))
    taken = _taken(known, labels)
    return [
        replace(proposal, score=0.0) if place in taken else proposal
        for place, proposal in enumerate(known)
    ]


def _taken(known: Sequence[LabelProposal], labels: Labels) -> set[int]:
    """The places of proposals on a label of their class, or on an earlier proposal of it."""
    alike: dict[tuple[Pane, int], list[tuple[int, Mark]]] = defaultdict(list)
    for place, proposal in enumerate(known):
        if proposal.mark is not None:
            alike[proposal.pane, proposal.class_id].append((place, proposal.mark))
    taken: set[int] = set()
    for (pane, class_id), marked in alike.items():  # all pairs at once: each edit needs them
        places = [place for place, _ in marked]
        ends_px = both_ends_px(mark for _, mark in marked)
        labelled_px = both_ends_px(
            Mark.of(row)
            for row in labels.in_frame(pane.frame_index, pane.side)
            if labels.element(row.element_id).class_id == class_id
        )
        is_labelled = (gaps_px(ends_px, labelled_px) < TAKEN_PX).any(axis=1)
        is_searched = np.array([known[place].score is not None for place in places])
        is_near = (gaps_px(ends_px, ends_px) < TAKEN_PX) & is_searched
        is_near[~(is_searched | is_labelled)] = False
        is_duplicate = np.triu(is_near, k=1).any(axis=0)
        taken.update(np.array(places)[is_labelled | is_duplicate].tolist())
    return taken


def _at_detection(known: LabelProposal, detection: Sequence[LabelProposal]) -> LabelProposal:
    """Move a doubtful proposal to a confident detection of its class in the same position."""
    for mark in detection:
        if (
            not known.is_confident
            and mark.is_confident
            and mark.class_id == known.class_id
            and _is_at(mark, known)
        ):
            return replace(known, mark=mark.mark, score=mark.score, runner_up=None)
    return known


def _with_detected_peaks(
    known: list[LabelProposal], detection: Sequence[LabelProposal]
) -> list[LabelProposal]:
    """Give confident poles the peaks that only a detector sees.

    The detection must lie on the pole's line in all images, and in more than one: in a single
    image, another pole may stand behind.
    """
    on_line = {
        n: mark
        for n, other in enumerate(known)
        for mark in detection
        if other.is_confident and mark.is_confident and mark.class_id == other.class_id
        if mark.pane == other.pane and _is_on_line(mark.mark, other.mark)
    }
    images = Counter(known[n].element_id for n in on_line)
    return [
        replace(proposal, mark=_with_peak(proposal.mark, on_line[n].mark))
        if n in on_line and images[proposal.element_id] == len(detection) > 1
        else proposal
        for n, proposal in enumerate(known)
    ]


def _is_on_line(first: Mark | None, second: Mark | None) -> bool:
    return first is not None and second is not None and first.gap_px(second) <= _ON_LINE_PX


def _with_peak(mark: Mark | None, detected: Mark | None) -> Mark | None:
    """Return a pole's mark with its peak, if only ``detected`` knows it. Bottoms are not adopted:
    the edge of an occluder often looks like the end of a pole."""
    if mark is None or detected is None or mark.end_px is None:
        return mark
    if detected.anchor_known and not mark.anchor_known:
        return replace(mark, anchor_px=detected.anchor_px, anchor_known=True)
    return mark


def _is_labelled(proposal: LabelProposal, labels: Labels) -> bool:
    """Whether a label of any class lies on a detection."""
    return proposal.mark is not None and any(
        proposal.mark.gap_px(Mark.of(row)) < DETECTED_PX
        for row in labels.in_frame(proposal.pane.frame_index, proposal.pane.side)
    )


def _is_at(detection: LabelProposal, other: LabelProposal) -> bool:
    """Whether a detection and another proposal share a position, whatever their classes."""
    if detection.mark is None or other.mark is None or detection.pane != other.pane:
        return False
    return detection.mark.gap_px(other.mark) < DETECTED_PX


def _is_expected(proposal: LabelProposal) -> bool:
    """Whether the position of an element says where an image shows it."""
    return isinstance(proposal.query, PropagationQuery | CorrespondenceQuery)


NO_TRACKS = OpenTracks(DetectionTracks())
CACHED_FRAMES = 256
"""Frames whose detector matches are cached."""


@dataclass(frozen=True)
class _Geometry:
    """The proposals of a frame before any image search."""

    proposals: tuple[LabelProposal, ...]
    projections: tuple[element_positions.ProjectedElement, ...]
    """Mapped elements that are not labelled, those left out of maps too."""
    nearby: tuple[NearbyElement, ...]


class ProposalSelection:
    """Proposes observations for the images of a frame. One thread at a time."""

    def __init__(
        self,
        cameras: Cameras,
        panes: Panes,
        positions: element_positions.ElementPositions,
        image_worker: ImageWorker,
        detected: Proposals,
        tracks: Callable[[], OpenTracks] = lambda: NO_TRACKS,
    ) -> None:
        """``tracks`` returns the tracks of the last map; the same object until the map changes."""
        self._cameras = cameras
        self._panes = panes
        self._positions = positions
        self._image_worker = image_worker
        self._order = tuple(cameras.T_map_camera)
        self._detected = detected
        self._labels = Labels()
        self._geometries: dict[tuple[Pane, ...], _Geometry] = {}
        """By the images on the page, for these labels."""
        self._queries = PropagationQueries(cameras)
        self._last_tracks = tracks
        self._tracks = NO_TRACKS
        self._matches_of = lru_cache(CACHED_FRAMES)(self._matches_in)
        self._rejected = RejectedProposals(cameras, self._matches)

    def proposals(self, frame_index: int, labels: Labels) -> list[LabelProposal]:
        """Return the frame's proposals, as far as the images have been searched."""
        proposals = self._geometry(frame_index, labels).proposals
        return select_distinct(self._image_worker.with_results(proposals), labels)

    def pending_queries(self, frame_index: int, labels: Labels) -> list[ImageQuery]:
        """Return the frame's queries that the image worker has not processed."""
        return self._image_worker.pending(self._geometry(frame_index, labels).proposals)

    def queries_of(self, element_id: str, frame_index: int, labels: Labels) -> list[ImageQuery]:
        """Return those of the frame's queries that are about one element."""
        proposals = self._geometry(frame_index, labels).proposals
        return self._image_worker.pending(
            proposal for proposal in proposals if proposal.element_id == element_id
        )

    def nearby(self, frame_index: int, labels: Labels) -> tuple[NearbyElement, ...]:
        """Return elements that are labelled in near frames, but have no position yet."""
        return self._geometry(frame_index, labels).nearby

    def survey(
        self, frame_index: int, labels: Labels
    ) -> tuple[int, tuple[tuple[str, Side], ...], detector_proposals.Disagreement | None]:
        """Return the number of elements proposed by geometry or detector, those of known position
        by id and image, and the disagreement of detector and labels; None if no detector processed
        the frame."""
        self._follow_map()
        geometry = self._computed(frame_index, labels)
        proposals = [proposal for proposal in geometry.proposals if not proposal.is_rejected]
        count = len({proposal.element_id for proposal in proposals if proposal.origin != "match"})
        expected = tuple(
            (proposal.element_id, proposal.pane.side)
            for proposal in proposals
            if proposal.pane.frame_index == frame_index and _is_expected(proposal)
        )
        shown = [
            pane for pane in self._panes.of(frame_index).values() if pane.frame_index == frame_index
        ]
        processed = detector_proposals.processed_panes(shown, self._detected)
        if not processed:
            return count, expected, None
        contents = detector_proposals.labelled_content(
            processed, geometry.projections, labels, self._depth_m(frame_index, labels)
        )
        matches = self._open_matches(frame_index, labels)
        disagreement = detector_proposals.disagreement(processed, matches, contents, labels)
        return count, expected, disagreement

    def _depth_m(self, frame_index: int, labels: Labels) -> Callable[[str], float]:
        """The depth of mapped elements in a frame's left camera; 0 if it is unknown."""
        T_camera_map = self._cameras.T_camera_map(frame_index)
        near = self._positions.near(labels, frame_index)

        def depth_m(element_id: str) -> float:
            position = near.get(element_id)
            if position is None or T_camera_map is None:
                return 0.0
            return float(T_camera_map.apply(position.anchor_m[None])[0, 2])

        return depth_m

    def projections(self, pane: Pane, labels: Labels) -> list[element_positions.ProjectedElement]:
        """Return mapped elements that should be visible in an image and are not labelled there."""
        T_camera_map = self._cameras.T_camera_map(pane.frame_index)
        if T_camera_map is None:
            return []
        near = self._positions.near(labels, pane.frame_index)
        return list(
            element_positions.projected_elements(
                pane.frame_index, pane.side, T_camera_map, self._cameras.rig, labels, near
            )
        )

    def _matches(self, frame_index: int) -> tuple[DetectorMatch, ...]:
        return self._matches_of(tuple(self._panes.of(frame_index).items()))

    def _matches_in(self, panes: tuple[tuple[Side, Pane], ...]) -> tuple[DetectorMatch, ...]:
        return detector_proposals.detector_matches(
            dict(panes), self._detected, self._cameras, self._tracks.tracks
        )

    def _follow_map(self) -> None:
        """Forget what was derived from the tracks of an earlier map."""
        tracks = self._last_tracks()
        if tracks is not self._tracks:
            self._tracks = tracks
            self._geometries.clear()
            self._matches_of.cache_clear()
            self._rejected = RejectedProposals(self._cameras, self._matches)

    def _open_matches(self, frame_index: int, labels: Labels) -> tuple[DetectorMatch, ...]:
        """The matches of a frame; those of a track that is not open belong to none."""
        return tuple(
            match
            if match.track is None or self._tracks.is_open(match.track, labels)
            else replace(match, track=None)
            for match in self._matches(frame_index)
        )

    def _geometry(self, frame_index: int, labels: Labels) -> _Geometry:
        """As ``_computed``, cached: each edit asks for it several times."""
        self._follow_map()
        if labels is not self._labels:
            self._labels = labels
            self._geometries.clear()
        panes = tuple(self._panes.of(frame_index).values())
        if panes not in self._geometries:
            self._geometries[panes] = self._computed(frame_index, labels)
        return self._geometries[panes]

    def _computed(self, frame_index: int, labels: Labels) -> _Geometry:
        panes = self._panes.of(frame_index)
        expected = [
            Expected(
                pane,
                projection,
                self._positions.near(labels, pane.frame_index)[projection.element_id],
            )
            for pane in panes.values()
            for projection in self.projections(pane, labels)
        ]
        projections = tuple(element.projection for element in expected)
        left_out = [
            element for element in expected if labels.is_left_out(element.projection.element_id)
        ]
        expected = [element for element in expected if element not in left_out]
        known = {projection.element_id for projection in projections}
        nearby = nearby_elements(
            frame_index, self._order, known, labels, self._cameras, self._positions
        )
        expected += [
            Expected(Pane(frame_index, projection.side), projection, None)
            for element in nearby
            for projection in element.projections
        ]
        proposals = element_proposals(panes, expected, labels, self._queries)
        tracks_px = {
            pane: self._tracks.project(self._cameras.view(pane.frame_index, pane.side), labels)
            for pane in panes.values()
        }
        matches = [
            match
            for match in self._open_matches(frame_index, labels)
            if match.track is not None
            or not (is_left_out(match, left_out) or is_on_tracks(match, tracks_px))
        ]
        rejected = self._rejected.rejected_elsewhere(frame_index, matches, labels)
        proposals += detector_proposals.match_proposals(matches, panes, labels, rejected)
        return _Geometry(tuple(proposals), projections, nearby)
