"""Propose observations: stereo correspondences, mapped elements, and detections.

Geometry gives an expected position at once. The exact position and its probability follow from
the images alone. So a proposal carries a request that the image worker processes later.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from semviz.annotator.element_positions import REACH_M, ProjectedElement
from semviz.annotator.panes import Cameras, Pane
from semviz_annotation.assist.marked_image import SURE, Mark, ProposedMark, clip_to_image
from semviz_annotation.assist.score import growth, look_again, view_to_follow, views_beside
from semviz_annotation.labels.labels import Labels, Observation, proposal_id
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.camera import Camera
from semviz_core.base.frame import Side

if TYPE_CHECKING:
    from semviz.annotator.tracks.detection_tracks import DetectionTrack

Origin: TypeAlias = Literal["map", "match", "detector"]

DETECTED_PX = 6.0
"""A detection this close to a labelled or expected element is taken to be that element."""
CACHED_QUERIES = 20_000
"""About 20 MB: of ten elements in each of a thousand frames around the pages."""


@dataclass(frozen=True)
class Expected:
    """A known element, projected into an image in which it is not labelled."""

    pane: Pane
    projection: ProjectedElement
    position: Triangulated | None
    """None if the rays fix a direction only."""


@dataclass(frozen=True)
class CorrespondenceQuery:
    """Find the element marked in image ``here`` in image ``there``."""

    class_id: int
    here: Pane
    mark: Mark
    there: Pane
    element: Triangulated | None = None
    """Position of the marked element, if it is known."""


@dataclass(frozen=True)
class SearchImage:
    """An image to search, ``there``, and an image in which the element is marked, ``here``."""

    there: Pane
    here: Pane
    mark: Mark


@dataclass(frozen=True)
class LabelledPane:
    """An image in which an element is labelled."""

    pane: Pane
    mark: Mark


@dataclass(frozen=True)
class PropagationQuery:
    """Find a mapped element in images taken at one time."""

    class_id: int
    element: Triangulated
    images: tuple[SearchImage, ...]
    beside: tuple[LabelledPane, ...] = ()
    """Other images in which it is labelled."""
    growth: float = 1.0
    """By how much larger it is than when somebody looked at it last."""


@dataclass(frozen=True)
class Detected:
    """One detection in an image."""

    pane: Pane
    mark: Mark
    score: float
    sigma_px: float
    sigma_along_px: float | None


@dataclass(frozen=True)
class RefinementQuery:
    """Verify and refine the detections of one landmark in one image or two."""

    class_id: int
    detections: tuple[Detected, ...]
    other: Pane | None
    """Another image in which the detector missed the landmark."""


ImageQuery: TypeAlias = CorrespondenceQuery | PropagationQuery | RefinementQuery


@dataclass(frozen=True)
class ImageSearchResult:
    """What a query found in one image; ``best`` is None if it found nothing."""

    best: ProposedMark | None
    runner_up: ProposedMark | None = None
    depth_m: float | None = None
    """Depth of a detection; infinite if the images do not determine it."""


@dataclass(frozen=True)
class LabelProposal:
    """An observation proposed for one image."""

    id: str
    """A dismissal names the proposal by this id."""
    pane: Pane
    class_id: int
    origin: Origin
    element_id: str
    """For a detection: the id that the new element gets if the proposal is accepted."""
    mark: Mark | None
    """None until the image has been searched."""
    score: float | None = None
    """Probability that the mark is within 2 px; for a detection, that all its marks are. None until
    the image has been searched."""
    runner_up: ProposedMark | None = None
    depth_m: float | None = None
    query: ImageQuery | None = None
    is_rejected: bool = False
    """Rejected in this image: not shown, and detections in the same position are dropped too."""
    rejected_elsewhere: bool = False
    """Rejected in another frame: shown, but never confident."""
    track: "DetectionTrack | None" = None
    """The open track of the detection: it is accepted or rejected in all its images."""

    @property
    def is_detected(self) -> bool:
        return self.origin == "detector"

    @property
    def is_confident(self) -> bool:
        """Whether one key may accept it with others."""
        if self.track is not None:
            return self.track.is_sure
        too_far = self.is_detected and (self.depth_m or 0.0) > REACH_M
        excluded = too_far or self.rejected_elsewhere
        return self.score is not None and self.score >= SURE and not excluded

    def with_result(self, result: ImageSearchResult) -> "LabelProposal":
        """Return the proposal after the image search. If it found nothing, the expected mark stays
        with score 0."""
        if result.best is None:
            return replace(self, score=0.0, query=None)
        return replace(
            self,
            mark=result.best.mark,
            score=result.best.score,
            runner_up=result.runner_up,
            depth_m=self.depth_m if result.depth_m is None else result.depth_m,
            query=None,
        )


def label_proposals(
    panes: Mapping[Side, Pane],
    expected: Iterable[Expected],
    labels: Labels,
    queries: "PropagationQueries",
) -> list[LabelProposal]:
    """Return all proposals of known elements for ``panes``, before any image search."""
    rejected = {
        dismissal.id
        for pane in panes.values()
        for dismissal in labels.dismissed_in(pane.frame_index)
    }
    expected = list(expected)
    mapped = {proposal.id: proposal for proposal in _map_proposals(expected, labels, queries)}
    positions = {element.projection.element_id: element.position for element in expected}
    matches = {match.id: match for match in _match_proposals(panes, labels, positions)}
    for id_ in (
        mapped.keys() & matches.keys()
    ):  # the other image of the same time is better evidence
        matches[id_] = replace(matches[id_], mark=mapped[id_].mark)
    return [
        replace(proposal, is_rejected=proposal.id in rejected)
        for proposal in (mapped | matches).values()
    ]


def _match_proposals(
    panes: Mapping[Side, Pane], labels: Labels, positions: Mapping[str, Triangulated | None]
) -> list[LabelProposal]:
    """Propose each element labelled in one of two images for the other."""
    if len(panes) < 2:
        return []
    proposals = []
    for here, there in ((panes["left"], panes["right"]), (panes["right"], panes["left"])):
        for row in labels.in_frame(here.frame_index, here.side):
            if labels.is_left_out(row.element_id):
                continue
            if labels.find(row.element_id, there.frame_index, there.side) is None:
                class_id = labels.element(row.element_id).class_id
                position = positions.get(row.element_id)
                proposal = LabelProposal(
                    id=proposal_id(row.element_id, there.frame_index, there.side),
                    pane=there,
                    class_id=class_id,
                    origin="match",
                    element_id=row.element_id,
                    mark=None,
                    query=CorrespondenceQuery(class_id, here, Mark.of(row), there, position),
                )
                proposals.append(proposal)
    return proposals


def _map_proposals(
    expected: Sequence[Expected], labels: Labels, queries: "PropagationQueries"
) -> list[LabelProposal]:
    """Propose each expected element; those with a known position are searched for in the images."""
    proposals = []
    for element in expected:
        pane, projection = element.pane, element.projection
        class_id = labels.element(projection.element_id).class_id
        proposal = LabelProposal(
            id=proposal_id(projection.element_id, pane.frame_index, pane.side),
            pane=pane,
            class_id=class_id,
            origin="map",
            element_id=projection.element_id,
            mark=Mark(projection.anchor_px, projection.end_px),
            depth_m=projection.depth_m if np.isfinite(projection.depth_m) else None,
        )
        if element.position is None:  # a direction is too vague to search for
            proposal = replace(proposal, score=0.0)
        else:
            panes = [
                other.pane
                for other in expected
                if other.projection.element_id == projection.element_id
                and other.pane.frame_index == pane.frame_index
            ]
            proposal = replace(proposal, query=queries.of(class_id, element, panes, labels))
        proposals.append(proposal)
    return proposals


class PropagationQueries:
    """Queries that search for elements by their labels in other images, cached.

    A position is the same object until its element's labels change, so that labelling one element
    computes nothing anew of the others around. One thread at a time.
    """

    def __init__(self, cameras: Cameras) -> None:
        self.cameras = cameras
        self._queries: dict[tuple[int, Triangulated, tuple[Pane, ...]], PropagationQuery] = {}

    def of(
        self, class_id: int, element: Expected, panes: Sequence[Pane], labels: Labels
    ) -> PropagationQuery:
        """Return the search of ``panes`` of one time for an element of known position."""
        assert element.position is not None
        key = class_id, element.position, tuple(panes)
        if key not in self._queries:
            if len(self._queries) >= CACHED_QUERIES:
                self._queries.clear()
            rows = [
                row
                for row in labels.of_element(element.projection.element_id)
                if row.frame_index in self.cameras.rank
            ]
            self._queries[key] = self._query(class_id, element.position, panes, rows)
        return self._queries[key]

    def _query(
        self,
        class_id: int,
        position: Triangulated,
        panes: Sequence[Pane],
        rows: Sequence[Observation],
    ) -> PropagationQuery:
        there = [Pane(row.frame_index, row.side) for row in rows]
        ranks = self.cameras.rank
        moments = np.array([ranks[pane.frame_index] for pane in there])
        moments = np.abs(moments - ranks[panes[0].frame_index])
        sizes, now = np.split(self.cameras.sizes_px(position, [*there, *panes]), [len(there)])
        followed = []
        for pane, size in zip(panes, now, strict=True):
            other_camera = np.array([source.side != pane.side for source in there])
            followed.append(view_to_follow(sizes, moments, other_camera, float(size)))
        images = tuple(
            SearchImage(pane, there[row], Mark.of(rows[row]))
            for pane, row in zip(panes, followed, strict=True)
        )
        beside = tuple(
            LabelledPane(there[row], Mark.of(rows[row])) for row in views_beside(moments, followed)
        )
        grown = growth(sizes, float(now.max()), look_again(position))
        return PropagationQuery(class_id, position, images, beside, grown)


def inside(mark: Mark, camera: Camera) -> Mark | None:
    """Return the part of a mark that lies in the image; None if nothing does."""
    part = clip_to_image(mark, mark.ends_px, camera)
    return part if camera.contains(part.ends_px).all() else None
