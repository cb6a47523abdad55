"""Group detections of one landmark into proposals, and compare them with the labels.

A group covers both images, so one key accepts it in both. Disagreement between detector and
labels is reported per frame; images that the detector did not process are left out.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from semviz.annotator.element_positions import ProjectedElement
from semviz.annotator.panes import Cameras, Pane
from semviz.annotator.proposals.label_proposals import (
    DETECTED_PX,
    Detected,
    LabelProposal,
    RefinementQuery,
)
from semviz.annotator.tracks.detection_tracks import DetectionTrack, DetectionTracks, mark_of
from semviz_annotation.assist.marked_image import Mark, both_ends_px, gaps_px
from semviz_annotation.assist.stereo_matching import stereo_pairs
from semviz_annotation.labels.labels import Labels, proposal_id
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.labels.rows import REVIEWED, derived_id
from semviz_core.base.frame import Side


@dataclass(frozen=True)
class DetectorMatch:
    """The detections of one landmark."""

    proposals: tuple[Proposal, ...]
    """One detection, or one in each image on the page."""
    track: DetectionTrack | None = None
    """The track of the last map that they belong to."""

    @property
    def element_id(self) -> str:
        """Id that the element gets if the match is accepted."""
        if self.track is not None:
            return self.track.id
        return derived_id(f"thing {self.proposals[0].id}")  # stored in labels: never reword

    @property
    def score(self) -> float:
        """Detector score of the better image."""
        return max(proposal.score for proposal in self.proposals)

    def is_rejected(self, labels: Labels) -> bool:
        return any(proposal.id in labels.dismissals for proposal in self.proposals)


def detector_matches(
    panes: Mapping[Side, Pane], detected: Proposals, cameras: Cameras, tracks: DetectionTracks
) -> tuple[DetectorMatch, ...]:
    """Return all detections in the images on the page, those of one track or stereo correspondence
    joined."""
    of_track: dict[str, list[Proposal]] = defaultdict(list)
    by_pane: list[list[Proposal]] = []
    for pane in panes.values():
        by_pane.append([])
        for detection in detected.in_frame(pane.frame_index, pane.side):
            track = tracks.of_detection.get(detection.id)
            (by_pane[-1] if track is None else of_track[track.id]).append(detection)
    tracked = [DetectorMatch(tuple(rows), tracks.by_id[id_]) for id_, rows in of_track.items()]
    return (*tracked, *_stereo_matches(panes, by_pane, cameras))


def _stereo_matches(
    panes: Mapping[Side, Pane], by_pane: Sequence[Sequence[Proposal]], cameras: Cameras
) -> tuple[DetectorMatch, ...]:
    if len(by_pane) < 2:
        return tuple(DetectorMatch((proposal,)) for proposals in by_pane for proposal in proposals)
    here, there = (cameras.view(pane.frame_index, pane.side) for pane in panes.values())
    first, second = by_pane
    pairs = dict(stereo_pairs(here, there, first, second))
    matched = {second[column].id for column in pairs.values()}
    matches = [
        DetectorMatch((proposal, second[pairs[row]]) if row in pairs else (proposal,))
        for row, proposal in enumerate(first)
    ]
    alone = (DetectorMatch((proposal,)) for proposal in second if proposal.id not in matched)
    return (*matches, *alone)


def match_proposals(
    matches: Iterable[DetectorMatch], panes: Mapping[Side, Pane], labels: Labels, rejected: Set[str]
) -> list[LabelProposal]:
    """Propose the matches that are not labelled yet, before any image search.

    A detection in one image is proposed for the other too, if the images show a correspondence.
    ``rejected`` holds the element ids of matches that were rejected in another frame.
    """
    matches = list(matches)
    detections = [proposal for match in matches for proposal in match.proposals]
    used = labelled_ids(detections, labels)
    return [
        replace(proposal, rejected_elsewhere=match.element_id in rejected)
        for match in matches
        if not any(detection.id in used for detection in match.proposals)
        for proposal in _proposals_of(match, panes.values(), match.is_rejected(labels))
    ]


def labelled_ids(detections: Sequence[Proposal], labels: Labels) -> set[str]:
    """Return the ids of detections that were accepted, or that lie on a label of their kind."""
    ids = {detection.id for detection in detections if detection.id in labels.observations}
    for pane in {_pane_of(detection) for detection in detections}:
        here = [detection for detection in detections if _pane_of(detection) == pane]
        rows = labels.in_frame(pane.frame_index, pane.side)
        ends, labelled = both_ends_px(map(mark_of, here)), both_ends_px(map(Mark.of, rows))
        near = np.argwhere(gaps_px(ends, labelled) < DETECTED_PX)
        ids |= {here[row].id for row, _ in near.tolist()}
    return ids


def _proposals_of(
    match: DetectorMatch, panes: Iterable[Pane], is_rejected: bool
) -> Sequence[LabelProposal]:
    """Propose a match in each image; all its proposals share one query.

    A track is proposed as it was detected: its other images are not searched either.
    """
    if match.track is not None:
        return [_of_track(match.track, detection, is_rejected) for detection in match.proposals]
    detections = {_pane_of(detection): detection for detection in match.proposals}
    others = [pane for pane in panes if pane not in detections]
    class_id = match.proposals[0].class_id
    detected = tuple(
        Detected(
            pane,
            mark_of(detection),
            detection.score,
            detection.sigma_px,
            detection.sigma_along_px,
        )
        for pane, detection in detections.items()
    )
    query = RefinementQuery(class_id, detected, others[0] if others else None)

    marks: list[tuple[Pane, str, Mark | None]] = [
        (pane, detection.id, mark_of(detection)) for pane, detection in detections.items()
    ]
    marks += [
        (other, proposal_id(match.element_id, other.frame_index, other.side), None)
        for other in others
    ]
    return [
        LabelProposal(
            id=name,
            pane=pane,
            class_id=class_id,
            origin="detector",
            element_id=match.element_id,
            mark=mark,
            query=query,
            is_rejected=is_rejected,
        )
        for pane, name, mark in marks
    ]


def _of_track(track: DetectionTrack, detection: Proposal, is_rejected: bool) -> LabelProposal:
    return LabelProposal(
        id=detection.id,
        pane=_pane_of(detection),
        class_id=track.class_id,
        origin="detector",
        element_id=track.id,
        mark=mark_of(detection),
        score=track.probability,
        is_rejected=is_rejected,
        track=track,
    )


def _pane_of(detection: Proposal) -> Pane:
    return Pane(detection.frame_index, detection.side)


CONFIDENT_SCORE = 0.5
"""Detections with at least this score count as disagreement if nothing is labelled there."""
NEAR_PX = 8.0
"""A detection and a label of the same kind this close are the same landmark."""
REACH_M = 40.0
"""A detector is not expected to see elements further away."""
MAPPED, LABELLED = 0.5, 1.0
"""Weight of a missed element: mapped and in view, but perhaps occluded; labelled in the image."""


@dataclass(frozen=True)
class Disagreement:
    """How far a detector and the labels of one frame disagree."""

    new: int
    """Confident detections where nothing is labelled, mapped or rejected."""
    missed: int
    """Elements labelled here, or mapped and in view, that no image of the frame has a detection
    of."""
    weight: float
    """The larger, the worse: scores of the new ones, and ``MAPPED`` or ``LABELLED`` per missed
    element."""
    worst_id: str | None
    """The element with the largest weight; for a detection, the element it would become."""


@dataclass(frozen=True)
class LabelledContent:
    """A labelled or mapped element in an image."""

    element_id: str
    pane: Pane
    mark: Mark
    weight: float
    """Weight if it is missed; 0 if it is far away, or a person said that it is not visible."""


def processed_panes(panes: Iterable[Pane], detected: Proposals) -> list[Pane]:
    """Return the panes that the detector processed; if that is not recorded, those with
    detections."""
    if detected.processed is not None:
        return [
            pane for pane in panes if (pane.frame_index, pane.side) in detected.processed.images
        ]
    return [pane for pane in panes if detected.in_frame(pane.frame_index, pane.side)]


def disagreement(
    panes: Sequence[Pane],
    matches: Iterable[DetectorMatch],
    contents: Iterable[LabelledContent],
    labels: Labels,
) -> Disagreement:
    """Compare the ``matches`` in processed ``panes`` with the elements known to be in them."""
    contents_in: dict[Pane, list[LabelledContent]] = defaultdict(list)
    for content in contents:
        contents_in[content.pane].append(content)
    marks_in: dict[Pane, list[tuple[DetectorMatch, Mark]]] = defaultdict(list)
    for match in matches:
        for detection in match.proposals:
            marks_in[_pane_of(detection)].append((match, mark_of(detection)))
    known: set[str] = set()
    detected: set[str] = set()
    for pane in panes:
        near = gaps_px(
            both_ends_px([mark for _, mark in marks_in[pane]]),
            both_ends_px([content.mark for content in contents_in[pane]]),
        )
        for row, column in np.argwhere(near < NEAR_PX).tolist():
            known.add(marks_in[pane][row][0].element_id)
            detected.add(contents_in[pane][column].element_id)
    here = {match.element_id: match for pane in panes for match, _ in marks_in[pane]}
    new = [match for name, match in here.items() if name not in known]
    missed = [
        content
        for pane in panes
        for content in contents_in[pane]
        if content.element_id not in detected
    ]
    return _summarize(new, missed, labels)


def _summarize(
    new: Iterable[DetectorMatch], missed: Iterable[LabelledContent], labels: Labels
) -> Disagreement:
    """Weigh detections without a known element, and known elements without a detection."""
    scores = {
        match.element_id: match.score
        for match in new
        if match.score >= CONFIDENT_SCORE and not match.is_rejected(labels)
    }
    missed_weights: dict[str, float] = {}
    for content in missed:
        if content.weight > 0.0:
            missed_weights[content.element_id] = max(
                content.weight, missed_weights.get(content.element_id, 0.0)
            )
    weights = scores | missed_weights
    worst = max(weights, key=lambda name: weights[name], default=None)
    return Disagreement(len(scores), len(missed_weights), sum(weights.values()), worst)


def labelled_content(
    panes: Iterable[Pane],
    projections: Iterable[ProjectedElement],
    labels: Labels,
    depth_m: Callable[[str], float],
) -> list[LabelledContent]:
    """Return what is labelled in images, and the ``projections`` of unlabelled mapped elements.

    ``depth_m`` returns the depth of an element by its id.
    """
    contents = []
    for pane in panes:
        for row in labels.in_frame(pane.frame_index, pane.side):
            near = depth_m(row.element_id) <= REACH_M and not labels.is_left_out(row.element_id)
            weight = LABELLED if near else 0.0
            contents.append(LabelledContent(row.element_id, pane, Mark.of(row), weight))
        reviewed = labels.review(pane.frame_index) in REVIEWED
        for projection in projections:
            if projection.side == pane.side:
                name = proposal_id(projection.element_id, pane.frame_index, pane.side)
                left_out = labels.is_left_out(projection.element_id)
                decided = reviewed or left_out or name in labels.dismissals
                weight = 0.0 if decided or projection.depth_m > REACH_M else MAPPED
                mark = Mark(projection.anchor_px, projection.end_px)
                contents.append(LabelledContent(projection.element_id, pane, mark, weight))
    return contents
