"""Define what may be wrong in all frames of a run alike, and how residuals change with it.

A shifted map moves all poses in the map's axes, another mounting in the camera's, another time
along the motion. A wrong calibration changes where the camera projects.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.frame import adjoint
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.diagnosis.fault import FaultKind
from semviz_core.diagnosis.reference import FrameReference, pair_errors, pairs_to_fit
from semviz_core.localization.problem import PoseProblem

MOST_FRAMES = 60
"""Frames that are fitted, evenly spread over a longer run."""


MOST_LATE = 10.0
"""Frames; a fit that goes further has diverged."""


class FittedFrames:
    """The frames of a run, all with a reference pose, and those that causes are fitted to."""

    def __init__(self, cases: Sequence[FrameReference]) -> None:
        self.cases = cases
        step = max(1, -(-len(cases) // MOST_FRAMES))
        rows = range(0, len(cases), step)
        self.fitted = [row for row in rows if len(cases[row].localization.observed)]

    @cached_property
    def middle_m(self) -> FloatArray:
        """(3,) mean of the camera centres."""
        centers = [self.pose(row).inverse().translation for row in range(len(self.cases))]
        return np.asarray(np.mean(centers, axis=0))

    def pose(self, row: int) -> Pose:
        """Return the reference T_camera_map of a frame."""
        reference = self.cases[row].reference
        assert reference is not None
        return reference


class Offset(NamedTuple):
    """What is put before the reference T_camera_map."""

    T_true_reference: Pose
    by_value: FloatArray
    """(6, p) derivative of its left perturbation."""


@dataclass(frozen=True)
class CommonCause:
    """A cause with p parameters: an offset of poses, or another camera."""

    kind: FaultKind
    name: str
    parameters: int
    offset: Callable[[FittedFrames, int, FloatArray], Offset] | None = None
    camera: Callable[[Camera, FloatArray], Camera] | None = None
    step: float = 1.0
    """Of a parameter of the camera, for derivatives."""
    starts: tuple[float, ...] = (0.0,)
    """Values of the first parameter from which the fit starts."""
    unit: str = ""
    """In which people read the parameters of a calibration."""
    in_unit: float = 1.0
    least: float = 0.0
    """Smallest fault in ``unit``: less is within the accuracy of calibrations."""


def _by_map(frames: FittedFrames, row: int, value: FloatArray) -> Offset:
    """A map that moves along x, y, z or turns about z, in the middle of the run.

    The middle makes turn and shift independent.
    """
    twists = adjoint(frames.pose(row) @ Pose(np.eye(3), frames.middle_m))
    basis = np.asarray(twists[:, [0, 1, 2, 5]])
    return Offset(Pose.exp(basis @ value), basis)


def _by_mounting(frames: FittedFrames, row: int, value: FloatArray) -> Offset:
    """A camera mounted elsewhere: translation, then rotation if it has six parameters."""
    basis = np.eye(6)[:, : len(value)]
    return Offset(Pose.exp(basis @ value), basis)


def _by_time(frames: FittedFrames, row: int, value: FloatArray) -> Offset:
    """The motion over a number of frames; beyond the ends, that of the last step."""
    at = row + float(np.clip(value[0], -MOST_LATE, MOST_LATE))
    first = int(np.clip(np.floor(at), 0, max(len(frames.cases) - 2, 0)))
    start, end = frames.pose(first), frames.pose(min(first + 1, len(frames.cases) - 1))
    motion = (end @ start.inverse()).log()
    moved = Pose.exp((at - first) * motion) @ start
    return Offset(moved @ frames.pose(row).inverse(), motion[:, None])


def _by_roll(frames: FittedFrames, row: int, value: FloatArray) -> Offset:
    basis = np.eye(6)[:, 5:]
    return Offset(Pose.exp(basis @ value), basis)


def _longer(camera: Camera, value: FloatArray) -> Camera:
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1.0 + value[0]
    return replace(camera, K=K)


def _off_center(camera: Camera, value: FloatArray) -> Camera:
    K = camera.K.copy()
    K[:2, 2] += value
    return replace(camera, K=K)


SHIFTED = "the map is shifted or turned"
ELSEWHERE = "the camera is mounted elsewhere"
OTHER_TIMES = "images and poses have different times"
MISALIGNMENTS = (
    CommonCause("misaligned map", SHIFTED, 4, _by_map),
    CommonCause("wrong extrinsic", ELSEWHERE, 3, _by_mounting),
    CommonCause("wrong extrinsic", ELSEWHERE, 6, _by_mounting),
    CommonCause(
        "time offset", OTHER_TIMES, 1, _by_time,
        starts=(-2.0, -1.0, 0.0, 1.0, 2.0),
    ),
)  # fmt: skip
CALIBRATIONS = (
    CommonCause(
        "wrong calibration", "focal length", 1,
        camera=_longer, step=1e-4, unit="%", in_unit=100.0, least=0.5,
    ),
    CommonCause(
        "wrong calibration", "principal point or mounting", 2,
        camera=_off_center, step=0.1, unit="px", least=2.0,
    ),
    CommonCause(
        "wrong calibration", "roll of the mounting", 1,
        _by_roll, unit="deg", in_unit=float(np.rad2deg(1.0)), least=0.3,
    ),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class CauseRows:
    """The residuals of one frame in sigmas, with a cause."""

    residual: FloatArray
    """(r,)"""
    jacobian: FloatArray
    """(r, p) by the parameters of the cause."""
    detection: IntArray
    """(r,) observed row."""
    element: IntArray
    """(m,) id of the element that is paired with each detection; -1 for none."""


def cause_rows(frames: FittedFrames, row: int, cause: CommonCause, value: FloatArray) -> CauseRows:
    """Return the residuals of a frame with parameters (p,) of a cause.

    Pairs are the true ones if known, else those that fit.
    """
    case, reference = frames.cases[row], frames.pose(row)
    offset = None if cause.offset is None else cause.offset(frames, row, value)
    pose = reference if offset is None else offset.T_true_reference @ reference
    problem = _problem(case, cause, value)
    pairs = pairs_to_fit(case, problem, pose)
    residual, by_pose, detection = _whitened(problem, pose, pairs)
    if offset is not None:
        by_value = by_pose @ offset.by_value
    else:
        by_value = np.column_stack([
            (_whitened(_problem(case, cause, value + step), pose, pairs)[0] - residual) / cause.step
            for step in cause.step * np.eye(cause.parameters)
        ])  # fmt: skip
    element = np.full(len(case.localization.observed), -1)
    element[pairs[:, 0]] = case.nearby.id[pairs[:, 1]]
    return CauseRows(residual, by_value, detection, element)


def _problem(case: FrameReference, cause: CommonCause, value: FloatArray) -> PoseProblem:
    if cause.camera is None:
        return case.problem
    camera = cause.camera(case.localization.camera, value)
    return PoseProblem.of(camera, case.localization.observed, case.nearby, case.detector)


def _whitened(
    problem: PoseProblem, pose: Pose, pairs: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return residuals (r,) in sigmas, derivatives (r, 6) by the pose, and observed rows (r,)."""
    errors = pair_errors(problem, pose, pairs)
    factor = np.linalg.cholesky(errors.covariance_px2)
    residual = np.linalg.solve(factor, errors.residual_px[..., None])[..., 0]
    jacobian = np.linalg.solve(factor, errors.by_pose)
    detection = np.broadcast_to(pairs[:, :1], errors.counted.shape)
    return residual[errors.counted], jacobian[errors.counted], detection[errors.counted]
