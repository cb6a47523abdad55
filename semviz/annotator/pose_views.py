"""Describe the poses of a drive, and what is wrong with them, for the page."""

import numpy as np

from semviz.annotator.pose_stretches import TURNS, StretchView, stretch_view
from semviz.web.protocol import Part
from semviz.workspace.pose_labels import FrameAgreement
from semviz.workspace.pose_review import PoseReview, PoseStretch
from semviz_annotation.labels.labels import Pixel
from semviz_core.common.arrays import FloatArray

AHEAD_M = 20.0
"""The shift of a frame in the image is that of a point so far ahead."""
MIN_TOGETHER = 3
"""Elements that a frame needs so that their common shift is shown."""


class PosesView(Part):
    """All frames of a drive, and its faults."""

    frames: list[int]
    shift_px: list[float | None]
    """How far the image of each frame is shifted against its neighbours; None: no pose used."""
    turn_deg: list[float | None]
    refined_deg: list[float | None]
    """The same for refined poses; None where none are used."""
    turn_words: tuple[str, str]
    """Where positive and negative turns lead."""
    alone_px: list[float | None]
    """Median error of an element beyond what all do together; None: too few labels."""
    stretches: list[StretchView]
    """Open ones first, worst first."""
    open: int
    sentence: str


class PoseMark(Part):
    """An element in the left image: the label, and the map under the given and the refined pose."""

    id: str
    name: str
    class_id: int
    label: tuple[Pixel, Pixel | None]
    before: tuple[Pixel, Pixel | None] | None
    after: tuple[Pixel, Pixel | None] | None
    before_px: float | None
    after_px: float | None


def poses_view(review: PoseReview) -> PosesView:
    """Return the page's view of a review; builds maps, so it takes seconds."""
    check, agreements = review.check, review.findings.agreements
    turn, shift = _deviations(review)
    axis = int(np.nanargmax(np.abs(turn).max(axis=0))) if len(turn) else 1
    sign = -1.0 if axis == 1 else 1.0  # left is positive, as a heading
    used = {
        frame.index: frame.T_map_camera is not None and frame.T_map_camera is same.T_map_camera
        for frame, same in zip(review.used, check.frames, strict=True)
    }
    left_out = {frame.index for frame in review.used if frame.T_map_camera is None}
    shift_px = _image_shift_px(review, turn, shift)
    numbers = [frame.index for frame in check.frames]
    return PosesView(
        frames=numbers,
        shift_px=[
            None if index in left_out else round(float(size), 2) if used[index] else 0.0
            for index, size in zip(numbers, shift_px, strict=True)
        ],
        turn_deg=[
            None if index in left_out else round(sign * float(angle), 4)
            for index, angle in zip(numbers, np.rad2deg(turn[:, axis]), strict=True)
        ],
        refined_deg=[None if used[index] or index in left_out else 0.0 for index in numbers],
        turn_words=(TURNS[axis][0 if sign < 0 else 1], TURNS[axis][1 if sign < 0 else 0]),
        alone_px=[_alone_px(agreements.get(index)) for index in numbers],
        stretches=[stretch_view(one, review, agreements) for one in review.stretches],
        open=len(review.open),
        sentence=_sentence(review, shift_px),
    )


def _alone_px(agreement: FrameAgreement | None) -> float | None:
    if agreement is None or agreement.elements < MIN_TOGETHER:
        return None
    return round(agreement.alone_px, 2)


def _deviations(review: PoseReview) -> tuple[FloatArray, FloatArray]:
    """Return (n, 3) turn and (n, 3) shift of the given poses beyond refined ones."""
    refinement = review.check.refinement
    return refinement.turn_rad, refinement.shift_m


def _image_shift_px(review: PoseReview, turn: FloatArray, shift: FloatArray) -> FloatArray:
    """Return (n,) the shift in the image of a point ``AHEAD_M`` ahead."""
    K = review.workspace.given_source.rig.left.K
    u = K[0, 0] * (turn[:, 1] + shift[:, 0] / AHEAD_M)
    v = K[1, 1] * (-turn[:, 0] + shift[:, 1] / AHEAD_M)
    return np.asarray(np.hypot(u, v))


def _sentence(review: PoseReview, shift_px: FloatArray) -> str:
    if review.open:
        count = len(review.open)
        return f"{count} {'stretch wants' if count == 1 else 'stretches want'} a look"
    answered = len(review.stretches)
    frames = len(review.check.frames)
    if answered:
        return f"Nothing is open: {answered} answered in {frames} frames."
    return f"Poses and images agree: {np.median(shift_px):.1f} px in {frames} frames."


def pose_marks(stretch: PoseStretch, frame: int) -> list[PoseMark]:
    """Return the elements of a frame's left image under the given and the refined pose."""
    seen = stretch.seen
    if seen is None:
        return []
    marks = []
    for row in stretch.labels.in_frame(frame):
        if row.side != "left":
            continue
        element = stretch.labels.element(row.element_id)
        marks.append(
            PoseMark(
                id=element.id,
                name=stretch.workspace.classes.element_name(element.class_id, element.number),
                class_id=element.class_id,
                label=(row.anchor_px, row.end_px),
                before=_ends(seen.given.ends_px(row)),
                after=_ends(seen.refined.ends_px(row)),
                before_px=seen.given.error_px(row),
                after_px=seen.refined.error_px(row),
            )
        )
    return marks


def _ends(ends: FloatArray | None) -> tuple[Pixel, Pixel | None] | None:
    if ends is None:
        return None
    (u, v), (end_u, end_v) = ends.tolist()
    return (u, v), None if np.isnan(end_u) else (end_u, end_v)
