"""Decide which element a new drawing belongs to, and list elements to continue nearby.

It is the selected element if that is free in the image and its rays agree, or if a person chose it:
poses may lie, so the disagreement is only told. Else it is an element expected there, else one
whose proposal there was rejected, else a new one. A selection far from the drawing is dropped.

Elements labelled a few frames away are listed if their position here is unknown: too far to be
expected, or seen only once.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semviz.annotator import element_positions
from semviz.annotator.panes import Cameras
from semviz.annotator.proposals.label_proposals import LabelProposal
from semviz_annotation.assist.marked_image import Mark, pixel
from semviz_annotation.labels.labels import Labels, Observation
from semviz_annotation.labels.views import PosedView
from semviz_core.base.frame import Side
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError

NEARBY_FRAMES = 5
"""An element is listed this many frames before and after one in which it is labelled."""


@dataclass(frozen=True)
class NearbyElement:
    """An element to continue: too far away to be expected, or seen only once so far."""

    element_id: str
    labelled_in: int
    """The nearest frame in which it is labelled."""
    projections: tuple[element_positions.ProjectedElement, ...]
    """Vague, from nearly parallel rays. Empty if the element has one view, or a pose is missing."""


def nearby_elements(
    frame_index: int,
    order: Sequence[int],
    expected: Iterable[str],
    labels: Labels,
    cameras: Cameras,
    positions: element_positions.ElementPositions,
) -> tuple[NearbyElement, ...]:
    """Return elements labelled in near frames that are neither ``expected`` nor labelled here.

    ``order`` holds all frames in order of time. Elements that project outside both images are left
    out.
    """
    known = set(expected)
    sides = cameras.sides
    views = {side: cameras.view(frame_index, side) for side in sides}
    is_posed = cameras.T_map_camera[frame_index] is not None
    nearby = []
    for element_id, labelled_in in _labelled_near(frame_index, order, labels).items():
        missing = [side for side in sides if not labels.find(element_id, frame_index, side)]
        if element_id in known or not missing:
            continue
        ends = positions.best_ends(labels, element_id) if is_posed else None
        projections = () if ends is None else _projections(element_id, missing, views, ends)
        if projections or (ends is None and labelled_in != frame_index):
            nearby.append(NearbyElement(element_id, labelled_in, projections))
    return tuple(nearby)


def _labelled_near(frame_index: int, order: Sequence[int], labels: Labels) -> dict[str, int]:
    """The nearest frame in which each element around here is labelled; nearest elements first."""
    here = order.index(frame_index)
    ranks = range(max(0, here - NEARBY_FRAMES), min(len(order), here + NEARBY_FRAMES + 1))
    nearest: dict[str, int] = {}
    for rank in sorted(ranks, key=lambda rank: abs(rank - here)):
        for row in labels.in_frame(order[rank]):
            if labels.is_left_out(row.element_id):
                continue
            nearest.setdefault(row.element_id, order[rank])
    return nearest


def _projections(
    element_id: str, sides: Iterable[Side], views: Mapping[Side, PosedView], ends: FloatArray
) -> tuple[element_positions.ProjectedElement, ...]:
    """The projections of an element with homogeneous ``ends`` (2, 4) that lie in the images."""
    projections = [_projection(element_id, side, views[side], ends) for side in sides]
    return tuple(projection for projection in projections if projection is not None)


def _projection(
    element_id: str, side: Side, view: PosedView, ends: FloatArray
) -> element_positions.ProjectedElement | None:
    pixels = element_positions.project_homogeneous(view, ends)
    is_line = not np.isnan(ends[1]).any()
    behind = np.isnan(pixels[: 1 + is_line]).any()
    if behind or not view.camera.contains(pixels).any():
        return None
    anchor, end = (pixel(point) for point in pixels)
    return element_positions.ProjectedElement(
        element_id, side, anchor, end if is_line else None, depth_m=float("inf")
    )


CONSISTENT_PX = 3.0
"""Largest reprojection error (rms over the views) for a drawing to join the selected element."""
STALE_PX = 12.0
"""Largest distance of a drawing from a selection that stayed from the drawing before, to join it: 1
deg for a usual camera."""
FAR_PX = 60.0
"""The same for an element that a person chose in this frame."""
NEAR_EXPECTED_PX = 12.0
"""Largest distance of a drawing's ends from an element's expected ends for it to join that."""
NEAR_CONFIDENT_PX = 3.0
"""The same for a confident proposal: a drawing further away is another element."""
SAME_PLACE_PX = 3.0
"""A drawing this close to a label in the same image may show the same thing."""


@dataclass(frozen=True)
class SelectedElement:
    """The selected element, and whether a person chose it in this frame."""

    id: str
    is_chosen: bool = False

    @classmethod
    def of(cls, element_id: str | None, is_chosen: bool) -> "SelectedElement | None":
        return None if element_id is None else cls(element_id, is_chosen)


@dataclass(frozen=True)
class DraftAssociation:
    """The element that a drawing joins; None starts a new one. ``note`` is shown to the user."""

    element_id: str | None
    note: str = ""
    off: str = ""
    """How badly a drawing fits the selected element that it joins nevertheless."""


def associate_draft(
    drawing: Observation,
    class_id: int,
    selected: SelectedElement | None,
    proposals: Iterable[LabelProposal],
    labels: Labels,
    positions: element_positions.ElementPositions,
) -> DraftAssociation:
    """Return the element that a drawing joins; see the module.

    ``proposals`` are those for the image of the drawing.
    """
    expected = _expected(drawing, class_id, proposals)
    if selected is None or not _is_free(selected.id, drawing, class_id, labels):
        return _unselected(expected, drawing, class_id, labels, positions)
    error_px = _fit_error_px([*labels.of_element(selected.id), drawing], positions)
    if error_px <= CONSISTENT_PX:
        return DraftAssociation(selected.id)
    name = _name(selected.id, labels)
    off_px = _distance_from_px(selected.id, drawing, error_px, labels, positions)
    is_measured = off_px is not None and np.isfinite(off_px)
    off = f"{off_px:.1f} px off {name}" if is_measured else f"Does not fit {name}"
    if selected.is_chosen and (off_px is None or off_px <= FAR_PX):
        note = f"{off}, and kept as {name}, which you selected. U makes it a new element."
        return DraftAssociation(selected.id, note, off)
    if expected is not None:
        return DraftAssociation(expected)
    if off_px is not None and off_px <= STALE_PX:
        note = f"{off}, and kept as {name}, which is selected. U makes it a new element."
        return DraftAssociation(selected.id, note, off)
    other = _unselected(None, drawing, class_id, labels, positions)
    if other.element_id is not None:
        return other
    return DraftAssociation(
        None, f"{off}, so this is a new element. To link: Ctrl click both, then P."
    )


def _unselected(
    expected: str | None,
    drawing: Observation,
    class_id: int,
    labels: Labels,
    positions: element_positions.ElementPositions,
) -> DraftAssociation:
    """Return the expected element, else one near whose rejected proposal the drawing lies: the mark
    was wrong, so it is drawn."""
    if expected is not None:
        return DraftAssociation(expected)
    near = []
    for dismissal in labels.dismissed_in(drawing.frame_index):
        element_id = dismissal.element_id
        if element_id is None or (dismissal.side, dismissal.why) != (drawing.side, "rejected"):
            continue
        if _is_free(element_id, drawing, class_id, labels):
            off_px = _distance_from_px(element_id, drawing, float("inf"), labels, positions)
            if off_px is not None and off_px <= NEAR_EXPECTED_PX:
                near.append((off_px, element_id))
    if not near:
        return DraftAssociation(None)
    element_id = min(near)[1]
    name = _name(element_id, labels)
    return DraftAssociation(
        element_id, f"Continues {name}, which was rejected here. U makes it a new element."
    )


def _distance_from_px(
    element_id: str,
    drawing: Observation,
    error_px: float,
    labels: Labels,
    positions: element_positions.ElementPositions,
) -> float | None:
    """Distance of a drawing from where its element is expected; infinite if that is outside the
    image, None if it is unknown.

    With one other view this is about twice ``error_px``, their reprojection error.
    """
    ends = positions.best_ends(labels, element_id) if positions.posed([drawing]) else None
    if ends is None:
        return 2.0 * error_px if np.isfinite(error_px) else None
    view = positions.view(drawing)
    expected = _projection(element_id, drawing.side, view, ends)
    if expected is None:
        return float("inf")
    mark = Mark(expected.anchor_px, expected.end_px)
    return _distance_px(mark, drawing)


def _expected(
    drawing: Observation, class_id: int, proposals: Iterable[LabelProposal]
) -> str | None:
    """Return the nearest element of the class that is expected at the drawing; None if none is."""
    near = []
    for proposal in proposals:
        if proposal.mark is None or proposal.is_detected or proposal.class_id != class_id:
            continue
        distance_px = _distance_px(proposal.mark, drawing)
        if distance_px <= (NEAR_CONFIDENT_PX if proposal.is_confident else NEAR_EXPECTED_PX):
            near.append((distance_px, proposal.element_id))
    return min(near)[1] if near else None


@dataclass(frozen=True)
class LabelBelow:
    """A label at the place of a drawing, in the same image."""

    row: Observation
    name: str
    distance_px: float

    @property
    def text(self) -> str:
        return f"Lies on {self.name}, {self.distance_px:.1f} px away"


class SamePlaceError(SemvizError):
    """A drawing lies on a label; a person decides whether it is the same element."""

    def __init__(self, drawn: Observation, below: LabelBelow) -> None:
        super().__init__(f"{below.text}. Is it the same?")
        self.drawn = drawn
        self.below = below


def label_below(drawing: Observation, is_line: bool, labels: Labels) -> LabelBelow | None:
    """Return the label that a drawing lies on, the nearest if several; None if there is none.

    Poles lie on poles, signs on signs of any class: two signs at one place are one sign twice.
    """
    found = []
    for row in labels.in_frame(drawing.frame_index, drawing.side):
        if (row.end_px is not None) != is_line or labels.is_left_out(row.element_id):
            continue
        distance_px = _distance_px(Mark.of(row), drawing)
        if distance_px <= SAME_PLACE_PX:
            found.append(LabelBelow(row, _name(row.element_id, labels), distance_px))
    return min(found, key=lambda below: below.distance_px, default=None)


def _name(element_id: str, labels: Labels) -> str:
    element = labels.element(element_id)
    return labels.classes.element_name(element.class_id, element.number)


def _fit_error_px(
    observations: Sequence[Observation], positions: element_positions.ElementPositions
) -> float:
    """Reprojection error of a drawing (the last observation) with the others of its element;
    infinite without any other."""
    drawing = observations[-1]
    if not positions.posed([drawing]):
        observations = [
            observation
            for observation in observations
            if observation.frame_index == drawing.frame_index
        ]
    else:
        observations = positions.posed(observations)
    if len(observations) < 2:
        return float("inf")
    return element_positions.reprojection_error_px(
        [positions.view(observation) for observation in observations], observations
    )


def _is_free(element_id: str, drawing: Observation, class_id: int, labels: Labels) -> bool:
    """Whether an element of the class exists and is not labelled in the drawing's image."""
    element = labels.elements.get(element_id)
    return (
        element is not None
        and element.class_id == class_id
        and labels.find(element_id, drawing.frame_index, drawing.side) is None
    )


def _distance_px(expected: Mark, drawing: Observation) -> float:
    """Distance of sign centers. Poles: across the expected line, and along it at the better end.

    Either end of a pole may be hidden in one of the frames, so one end that agrees is enough.
    """
    gaps = [np.subtract(drawing.anchor_px, expected.anchor_px)]
    if expected.end_px is None or drawing.end_px is None:
        return float(np.hypot(*gaps[0]))
    gaps.append(np.subtract(drawing.end_px, expected.end_px))
    u, v = np.subtract(expected.end_px, expected.anchor_px)
    along = np.array([u, v]) / max(np.hypot(u, v), 1e-9)
    across = np.array([-along[1], along[0]])
    return float(max(*(abs(gap @ across) for gap in gaps), min(abs(gap @ along) for gap in gaps)))
