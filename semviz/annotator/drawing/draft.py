"""The element being drawn: its guides, the edges it snaps to, and the numbers of its card.

The card shows depth and height with sigmas (m), ray angle (deg), rms and epipolar error (px).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, TypeAlias

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from semviz.annotator.element_positions import ElementPositions
from semviz.annotator.panes import Cameras, Pane, Panes
from semviz.annotator.proposals.proposal_views import MarkView, ProposalView, mark_fields
from semviz.annotator.views import ElementView, NearbyView, PaneView
from semviz.web.protocol import Part
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.labels.labels import STRICT, Id, Index, Labels, Observation, Pixel
from semviz_annotation.labels.views import PosedView, epipolar_segment, other_side
from semviz_annotation.mapping.placement.triangulation import Triangulated, TriangulationFailure
from semviz_core.base.frame import Side
from semviz_core.common.arrays import FloatArray

PageCoordinate: TypeAlias = Annotated[float, Field(ge=-1e5, le=1e5)]
PagePixel: TypeAlias = tuple[PageCoordinate, PageCoordinate]
"""A pixel in an image or beside it: squares of those far away would be beyond floats."""
ANYWHERE_M = (0.1, float("inf"))
SMALLER = 1.1
"""A view in which an element is larger by less tells nothing new about its other labels."""
THIN_DEG = 1.0
"""Below this ray angle depth is uncertain; the card warns."""


class Card(Part):
    """The numbers of one element; None for unknown ones."""

    views: int
    """Number of observations."""
    reason: str | None = None
    """Why it has no position; None if it has one."""
    depth_m: float | None = None
    depth_sigma_m: float | None = None
    angle_deg: float | None = None
    """Largest angle between two rays."""
    is_thin: bool = False
    rms_px: float | None = None
    height_m: float | None = None
    height_sigma_m: float | None = None
    length_px: dict[Side, float]
    """Length of a line in each image on the page."""
    epipolar_px: float | None
    smaller_views: int = 0
    """Labels in other images that could be aligned to this one: the element is smaller there."""


def card(
    position: Triangulated | TriangulationFailure,
    view: PosedView,
    views: int,
    length_px: Mapping[Side, float],
    epipolar_px: float | None,
) -> Card:
    """Return the card of an element. ``view`` is the left camera of the frame on screen, in the
    coordinates of ``position``; ``views`` counts observations."""
    if isinstance(position, TriangulationFailure):
        return Card(
            views=views, reason=position.reason, length_px=dict(length_px), epipolar_px=epipolar_px
        )
    axis = view.T_camera_map.rotation[2]
    height, height_sigma = _height_m(position) if position.is_line else (None, None)
    return Card(
        views=views,
        depth_m=float(view.depth_m(position.anchor_m[None])[0]),
        depth_sigma_m=_sigma(position, np.append(axis, np.zeros(3))),
        angle_deg=float(np.rad2deg(position.angle_rad)),
        is_thin=bool(np.rad2deg(position.angle_rad) < THIN_DEG),
        rms_px=position.rms_px,
        height_m=height,
        height_sigma_m=height_sigma,
        length_px=dict(length_px),
        epipolar_px=epipolar_px,
    )


def _height_m(position: Triangulated) -> tuple[float, float]:
    """Length of a line, and its sigma."""
    along = position.anchor_m - position.end_m
    height = float(np.linalg.norm(along))
    direction = along / height
    return height, _sigma(position, np.append(direction, -direction))


def epipolar_error_px(pair: Sequence[tuple[PosedView, Observation]]) -> float | None:
    """Return the largest distance of a known end from the epipolar line of its correspondence, px.

    ``pair`` holds one element in two images. None if there are not two, no end is known in both, or
    the epipolar line does not cross the second image.
    """
    if len(pair) != 2:
        return None
    (here, first), (there, second) = pair
    ends = [(first.anchor_px, second.anchor_px)] * (first.anchor_known and second.anchor_known)
    if first.end_px is not None and second.end_px is not None:
        ends += [(first.end_px, second.end_px)] * (first.end_known and second.end_known)
    distances = [
        _distance(epipolar_segment(here, there, from_px, ANYWHERE_M), np.array(to_px))
        for from_px, to_px in ends
    ]
    return max((gap for gap in distances if np.isfinite(gap)), default=None)


def _sigma(position: Triangulated, gradient: FloatArray) -> float:
    return float(np.sqrt(gradient @ position.covariance_m2 @ gradient))


def _distance(line_px: FloatArray, point_px: FloatArray) -> float:
    """Distance of a point from a polyline; infinite without segments."""
    if len(line_px) < 2:
        return float("inf")
    start, step = line_px[:-1], np.diff(line_px, axis=0)
    along = ((point_px - start) * step).sum(axis=1) / (step**2).sum(axis=1)
    nearest = start + np.clip(along, 0.0, 1.0)[:, None] * step
    return float(np.linalg.norm(point_px - nearest, axis=1).min())


WHOLE_LINE_M = (0.5, float("inf"))


@dataclass(frozen=True, config=STRICT)
class ElementDraft:
    """An unsaved drawing."""

    side: Side
    """Side on the page: with one camera, right is another frame."""
    class_id: Index
    anchor_px: PagePixel
    end_px: PagePixel | None
    anchor_known: bool = True
    end_known: bool = True
    snap: bool = False
    asks_bottom: bool = False
    """Whether the server may mark the bottom as hidden."""
    whole: bool = False
    """Whether it is a point under which the whole pole is sought."""

    @property
    def has_shape(self) -> bool:
        """False for a pole whose ends still coincide."""
        return self.end_px != self.anchor_px

    @property
    def mark(self) -> Mark:
        return Mark(self.anchor_px, self.end_px, self.anchor_known, self.end_known)

    def moved_to(self, mark: Mark) -> "ElementDraft":
        """Return the drawing at ``mark``; an end that either does not know stays unknown."""
        return replace(
            self,
            anchor_px=mark.anchor_px,
            end_px=mark.end_px,
            anchor_known=self.anchor_known and mark.anchor_known,
            end_known=self.end_known and mark.end_known,
        )


@dataclass(frozen=True, config=STRICT)
class DraftState:
    """The selected or drawn element, for which the page requests guides and numbers."""

    frame_index: Index
    selected_id: Id | None = None
    is_chosen: bool = False
    """Whether a person chose the selected element in this frame."""
    side: Side = "left"
    """Side of the selected observation."""
    second: int | None = None
    """Frame of the second image as shown; None: the frame's own right one."""
    drawing: ElementDraft | None = None
    moved: dict[Id, tuple[PagePixel, PagePixel | None]] = Field(default_factory=dict)
    """Ends of the observations that are being dragged."""


class Guide(Part):
    """An epipolar line as a polyline: in the whole image, and at plausible depths only."""

    line: list[Pixel]
    plausible: list[Pixel]


Guides: TypeAlias = dict[Side, list[Guide]]


class DraftEditor:
    """Computes guides and card of a draft. One thread at a time."""

    def __init__(self, cameras: Cameras, panes: Panes, positions: ElementPositions) -> None:
        self._cameras = cameras
        self._panes = panes
        self._positions = positions

    def describe(
        self, draft: DraftState, element_id: str | None, labels: Labels
    ) -> tuple[Guides, Card | None]:
        """Return guides and card; ``element_id`` is the selected element or the one the drawing
        joins."""
        observations = self._observations(draft, element_id, labels)
        shown = self._shown(draft.frame_index, observations)
        card = self._card(draft.frame_index, observations, shown) if observations else None
        return self._guides(draft, shown), card

    def _observations(
        self, draft: DraftState, element_id: str | None, labels: Labels
    ) -> tuple[Observation, ...]:
        """The element's observations as they would be if the draft were saved now."""
        observations = [] if element_id is None else list(labels.of_element(element_id))
        for index, row in enumerate(observations):
            if row.id in draft.moved:
                anchor, end = draft.moved[row.id]
                observations[index] = replace(row, anchor_px=anchor, end_px=end)
        if draft.drawing is not None and draft.drawing.has_shape:
            observations.append(self.observation(draft.drawing, draft.frame_index))
        return tuple(observations)

    def observation(self, drawing: ElementDraft, frame_index: int) -> Observation:
        """Return a drawing as the observation that it would become."""
        pane = self._panes.pane(frame_index, drawing.side)
        return drawing.mark.at(pane.frame_index, pane.side)

    def _shown(
        self, frame_index: int, observations: Sequence[Observation]
    ) -> dict[Side, tuple[PosedView, Observation]]:
        """The ``observations`` on screen, with their cameras."""
        panes = self._panes.of(frame_index)
        return {
            side: (self._view(pane), observation)
            for side, pane in panes.items()
            for observation in observations
            if (observation.frame_index, observation.side) == (pane.frame_index, pane.side)
        }

    def _view(self, pane: Pane) -> PosedView:
        return self._cameras.view(pane.frame_index, pane.side)

    def _guides(
        self, draft: DraftState, shown: dict[Side, tuple[PosedView, Observation]]
    ) -> Guides:
        """Epipolar lines of the draft's ends in the other image."""
        guides: Guides = {"left": [], "right": []}
        panes = self._panes.of(draft.frame_index)
        side = draft.side if draft.drawing is None else draft.drawing.side
        if side not in shown or other_side(side) not in panes:
            return guides
        here, row = shown[side]
        there = self._view(panes[other_side(side)])
        ends = [row.anchor_px]
        if row.end_px is not None and row.end_px != row.anchor_px:
            ends.append(row.end_px)
        guides[other_side(side)] = [_guide(here, there, end) for end in ends]
        return guides

    def _card(
        self,
        frame_index: int,
        observations: Sequence[Observation],
        shown: dict[Side, tuple[PosedView, Observation]],
    ) -> Card:
        here = [row for _, row in shown.values()]
        if self._cameras.T_map_camera[frame_index] is None:
            position, count = self._positions.of_pair(here), len(here)
        else:
            position, count = self._positions.of_observations(observations), len(observations)
        lengths = {
            side: _length_px(row.anchor_px, row.end_px)
            for side, (_, row) in shown.items()
            if row.end_px is not None
        }
        view = self._cameras.view(frame_index, "left")
        epipolar_px = epipolar_error_px([shown[side] for side in sorted(shown)])
        numbers = card(position, view, count, lengths, epipolar_px)
        smaller = self._smaller(position, observations, here)
        return numbers.model_copy(update={"smaller_views": smaller})

    def _smaller(
        self,
        position: Triangulated | TriangulationFailure,
        observations: Sequence[Observation],
        here: Sequence[Observation],
    ) -> int:
        """Return in how many other images an element is smaller; 0 if it is larger in one."""
        posed = self._positions.posed(observations)
        if not isinstance(position, Triangulated) or not here or not posed:
            return 0
        sizes = self._cameras.sizes_px(position, [Pane(row.frame_index, row.side) for row in posed])
        shown = np.array([row in here for row in posed])
        now = sizes[shown].max(initial=0.0)
        larger = sizes[~shown].max(initial=0.0) > SMALLER * now
        return 0 if larger else int((SMALLER * sizes < now).sum())


def _guide(here: PosedView, there: PosedView, pixel: Pixel) -> Guide:
    return Guide(
        line=epipolar_segment(here, there, pixel, WHOLE_LINE_M).tolist(),
        plausible=epipolar_segment(here, there, pixel).tolist(),
    )


def _length_px(anchor: Pixel, end: Pixel) -> float:
    return float(((anchor[0] - end[0]) ** 2 + (anchor[1] - end[1]) ** 2) ** 0.5)


class SnappedMark(MarkView):
    """A drawing snapped to edges; its ends move by ``by_px`` at most."""

    by_px: float


class DraftPreview(Part):
    """Guides and numbers of a draft."""

    guides: Guides
    card: Card | None
    snapped: SnappedMark | None
    """The mark that will be saved; None if the drawing stays as it is."""
    joins: str | None
    """Name of the element that a drawing joins; None for a new one."""
    warning: str
    """What to look at before the drawing is saved; empty for most."""


class LabelledFrameView(Part):
    """The labels and proposals of one frame, and the elements that may continue in it."""

    index: int
    operation: int
    """Number of the last operation in these labels."""
    hash: str
    """Of that operation; empty in former states, which cannot be edited."""
    panes: dict[Side, PaneView]
    at_that_time: dict[str, int]
    """Of a rig: the frames that its other cameras took nearest in time, by name."""
    elements: list[ElementView]
    proposals: list[ProposalView]
    nearby: list[NearbyView]
    is_searching: bool
    """Whether images are still to be searched."""


def snapped_view(before: ElementDraft, after: ElementDraft) -> SnappedMark:
    """Return the snapped drawing, and by how many pixels its ends move at most."""
    moves = [np.subtract(after.anchor_px, before.anchor_px)]
    if before.end_px is not None and after.end_px is not None:
        moves.append(np.subtract(after.end_px, before.end_px))
    by_px = max(float(np.hypot(*move)) for move in moves)
    return SnappedMark(**mark_fields(after.mark), by_px=by_px)
