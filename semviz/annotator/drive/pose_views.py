"""The poses of a drive on the page: their check, what is wrong with them, and the messages.

Measuring takes a third of a second a frame, so it runs in a thread of its own when a page asks for
it; what was measured before is shown at once. The messages are parts of ``messages``.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Annotated, Literal, TypeAlias

import numpy as np
from pydantic import Field

from semviz.annotator.drive.pose_stretches import TURNS, StretchView, stretch_view
from semviz.reports.pose_check import unchecked_text
from semviz.web import protocol
from semviz.web.protocol import Part
from semviz.workspace.poses.pose_choices import Choice, Subject
from semviz.workspace.poses.pose_labels import FrameAgreement
from semviz.workspace.poses.pose_review import (
    PoseFindings,
    PoseReview,
    PoseStretch,
    check_poses,
    known_check,
)
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import Id, Index, Labels, Pixel
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.rig_cameras import frames_of_camera
from semviz_core.pose_checks.faults import PoseCheck

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
    unchecked: str
    """Where the images show too little to check poses; empty if they do everywhere."""


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
        unchecked=unchecked_text(check),
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
                name=stretch.labels.classes.element_name(element.class_id, element.number),
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


PoseState: TypeAlias = Literal["unknown", "working", "ready", "failed"]


@dataclass(frozen=True)
class PoseProgress:
    """How far the comparison is."""

    state: PoseState = "unknown"
    done: int = 0
    total: int = 0
    seconds: float = 0.0
    failure: str = ""


class PoseWork:
    """Checks poses in a thread. Any thread may read the results: they are replaced whole."""

    def __init__(self, workspace: Workspace, labels: Callable[[], Labels]) -> None:
        self._workspace = workspace
        self._labels = labels
        self._pool = ThreadPoolExecutor(1, "semviz-poses")
        self._stopping = False
        self._began = 0.0
        self._check: PoseCheck | None = None
        self.progress = PoseProgress()
        self.review: PoseReview | None = None
        self.view: PosesView | None = None
        """Of ``review``."""
        self.version = 0
        """Changes whenever one of these changes."""

    def look_up(self) -> None:
        """Show what was measured before, if anything, with the choices of now; measure nothing."""
        self._pool.submit(self._run, lambda: self._check or known_check(self._workspace))

    def start(self) -> None:
        """Measure, unless that is done or under way; with changed labels, look again."""
        if self.progress.state == "working":
            return
        is_same = self.review is not None and self.review.labels == self._labels()
        if self.progress.state == "ready" and is_same:
            return
        self._began = time.monotonic()
        self._set(replace(self.progress, state="working", done=0, total=0, failure=""))
        self._pool.submit(self._run, self._measured)

    def close(self) -> None:
        """Stop soon, and wait for the thread."""
        self._stopping = True
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _set(self, progress: PoseProgress) -> None:
        self.progress = progress
        self.version += 1

    def _measured(self) -> PoseCheck:
        if self._check is None:
            frames = frames_of_camera(self._workspace.given_source, None)
            self._check = check_poses(self._workspace, frames, self._on_progress)
        return self._check

    def _run(self, find: Callable[[], PoseCheck | None]) -> None:
        try:
            self._check = find()
            if self._check is None:
                self._set(PoseProgress())
                return
            review = PoseReview(self._findings(self._check), self._workspace.pose_choices())
            view = poses_view(review)
            self.review, self.view = review, view
            self._set(PoseProgress("ready"))
        except SemvizError as error:
            self._set(PoseProgress("failed", failure=str(error)))
        except Exception as error:  # nothing else reports errors of this thread
            self._set(PoseProgress("failed", failure=f"poses: {error!r}; please report this"))

    def _findings(self, check: PoseCheck) -> PoseFindings:
        """Return what images and labels say; the same as before if the labels are the same."""
        labels = self._labels()
        before = None if self.review is None else self.review.findings
        if before is not None and before.check is check and before.labels == labels:
            return before
        return PoseFindings(self._workspace, check, labels)

    def _on_progress(self, what: str, done: int, total: int) -> None:
        if self._stopping:
            raise SemvizError("Stopped: nothing was changed.")
        self._set(PoseProgress("working", done, total, time.monotonic() - self._began))


class ShowPosesRequest(protocol.Request):
    """Compare the poses with the images, unless that is done; ``poses`` events follow."""

    type: Literal["show_poses"] = "show_poses"


class ShowPoseFrameRequest(protocol.Request):
    """Request the elements of a frame under the given and the refined pose."""

    type: Literal["show_pose_frame"] = "show_pose_frame"
    frame: int
    stretch: Annotated[int, Field(ge=0)]
    """Its place in the list of stretches."""


class ChoosePosesRequest(protocol.Request):
    """Choose what to do with the poses of a stretch; its ``id`` is stored, so a request that is
    sent twice is applied once."""

    type: Literal["choose_poses"] = "choose_poses"
    id: Id
    choice: Choice
    first: Index
    last: Index
    subject: Subject


class PosesEvent(protocol.Event):
    """How the poses compare with the images, as far as that is known."""

    type: Literal["poses"] = "poses"
    state: PoseState
    done: int
    total: int
    """Pairs of frames that are measured, and that there are."""
    seconds: float
    failure: str
    poses: PosesView | None
    """None until they have been compared."""


class PoseFrameEvent(protocol.Event):
    """The elements of a frame under the given and the refined pose."""

    type: Literal["pose_frame"] = "pose_frame"
    frame: int
    stretch: int
    marks: list[PoseMark]


class PosesChosenEvent(protocol.Event):
    """A choice for poses is on disk; the workspace is sent again with the chosen poses."""

    type: Literal["poses_chosen"] = "poses_chosen"
    text: str
