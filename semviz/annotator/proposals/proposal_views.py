"""Describe proposals for the page: by element, with their marks in the images on the page.

Doubtful ones come first, then the nearest.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from semviz.annotator.panes import Pane
from semviz.annotator.proposals.label_proposals import LabelProposal, Origin, inside
from semviz.annotator.tracks.detection_tracks import DetectionTrack
from semviz.annotator.views import ElementRef, element_ref
from semviz.web.protocol import Part
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.labels.labels import Labels, Pixel
from semviz_annotation.labels.views import camera_of
from semviz_core.base.camera import Rig
from semviz_core.base.classes import ClassSet
from semviz_core.base.frame import Side


class MarkView(Part):
    """A mark in an image."""

    anchor: Pixel
    end: Pixel | None
    anchor_known: bool
    end_known: bool


class RunnerUp(MarkView):
    """The second best mark."""

    score: float


class ProposalMark(MarkView):
    """The proposed mark of an element in one image."""

    id: str
    frame: int
    side: Side
    score: float | None
    """None until the image has been searched."""
    runner_up: RunnerUp | None


class TrackView(Part):
    """A track of detections, which is accepted or rejected as a whole."""

    frames: int
    """Number of frames with its detections."""
    first: int
    last: int
    """The first and last of these frames."""
    residual_px: float
    existence: str
    """The probability that it exists: ``98.2 %``, ``> 99.9 %`` or ``unknown``."""
    doubt: str
    """Why a person should look at it first, in two or three words; empty: it is sure."""


class ProposalView(ElementRef):
    """The proposal of one element, with its marks in the images on the page.

    Doubtful ones come first, then the nearest.
    """

    origin: Origin
    depth_m: float | None
    rejected_elsewhere: bool
    """Rejected in another frame."""
    is_confident: bool
    """Whether all marks are confident."""
    score: float | None
    """Score of the worst mark; None until the images have been searched. Of a track: the
    probability that it exists."""
    track: TrackView | None
    marks: dict[Side, ProposalMark]


def proposal_views(
    proposals: Iterable[LabelProposal],
    panes: Mapping[Side, Pane],
    labels: Labels,
    rig: Rig,
    classes: ClassSet,
) -> list[ProposalView]:
    """Return proposals by element with their visible marks; doubtful ones first, then by depth."""
    shown_as = {pane: side for side, pane in panes.items()}
    by_element: dict[str, list[tuple[LabelProposal, Mark]]] = {}
    for proposal in proposals:
        if proposal.mark is None or proposal.pane not in shown_as:
            continue
        mark = inside(proposal.mark, camera_of(rig, proposal.pane.side)[0])
        if mark is not None:
            by_element.setdefault(proposal.element_id, []).append((proposal, mark))
    views = [_proposal_view(marked, shown_as, labels, classes) for marked in by_element.values()]
    return sorted(views, key=lambda view: (view.is_confident, view.depth_m or 0.0))


def _proposal_view(
    marked: list[tuple[LabelProposal, Mark]],
    shown_as: Mapping[Pane, Side],
    labels: Labels,
    classes: ClassSet,
) -> ProposalView:
    """The view of one element's proposals with their marks, one per image."""
    first = marked[0][0]
    element = _proposed_element(first, labels, classes)
    scores = [proposal.score for proposal, _ in marked if proposal.score is not None]
    return ProposalView(
        id=element.id,
        name=element.name,
        class_id=element.class_id,
        origin=first.origin,
        depth_m=first.depth_m if np.isfinite(first.depth_m or np.inf) else None,
        rejected_elsewhere=first.rejected_elsewhere,
        is_confident=all(proposal.is_confident for proposal, _ in marked),
        score=min(scores) if len(scores) == len(marked) else None,
        track=None if first.track is None else track_view(first.track),
        marks={
            shown_as[proposal.pane]: _proposal_mark(proposal, mark) for proposal, mark in marked
        },
    )


def track_view(track: DetectionTrack) -> TrackView:
    """Return how many frames a track has, and how well its detections agree."""
    frames = track.frames
    return TrackView(
        frames=len(frames),
        first=frames[0],
        last=frames[-1],
        residual_px=track.residual_px,
        existence=track.existence,
        doubt=track.doubt,
    )


def _proposed_element(proposal: LabelProposal, labels: Labels, classes: ClassSet) -> ElementRef:
    """The proposed element: a new one if a detector proposes it."""
    if not proposal.is_detected:
        return element_ref(labels.element(proposal.element_id), classes)
    track = proposal.track
    name = f"new {classes[proposal.class_id].name}" if track is None else track.name
    return ElementRef(id=proposal.element_id, name=name, class_id=proposal.class_id)


def _proposal_mark(proposal: LabelProposal, mark: Mark) -> ProposalMark:
    second = proposal.runner_up
    return ProposalMark(
        **mark_fields(mark),
        id=proposal.id,
        frame=proposal.pane.frame_index,
        side=proposal.pane.side,
        score=proposal.score,
        runner_up=None
        if second is None
        else RunnerUp(**mark_fields(second.mark), score=second.score),
    )


def mark_fields(mark: Mark) -> dict[str, Any]:
    """The fields of a ``MarkView``."""
    return {
        "anchor": mark.anchor_px,
        "end": mark.end_px,
        "anchor_known": mark.anchor_known,
        "end_known": mark.end_known,
    }
