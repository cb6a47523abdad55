"""Fit poses, errors of mapped elements and one cause together to all that some frames measured.

A bundle adjustment to detections, priors and odometry, with the map as prior. Errors of mapped
positions are unknowns, so frames that see one element again are no further evidence of them.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from semviz_core.base.frame import Odometry, Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.diagnosis.reference import FrameReference, pairs_to_fit
from semviz_core.localization.prior_residuals import MOST_ROWS, prior_rows
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.tracking.association import pair_rows

MOST_CHI2 = 25.0
"""Squared residuals of one detection (sigmas) count up to this."""
_GATES, _LATER_GATES = (64.0, 32.0, 16.0, 16.0, 16.0), (64.0, 16.0, 16.0)
"""Squared residuals of a detection beyond which it is down-weighted, per iteration: of the first
fit, and of one that starts from another."""
LEAST_M2 = 1e-10
"""Keeps the covariance of a map that is said to be perfect invertible."""
LOOSE = 1e-9
"""Information of what nothing determines."""


@dataclass(frozen=True, eq=False)
class Measured:
    """What n frames measured, and the pairs of their detections."""

    cases: tuple[FrameReference, ...]
    problems: tuple[PoseProblem, ...]
    priors: tuple[Prior, ...]
    steps: tuple[tuple[int, Odometry], ...]
    """Numbers of frames, and the motion from each to the next one."""
    pairs: tuple[IntArray, ...]
    """(k, 2) of each frame: rows of observed and nearby elements."""
    element: IntArray
    """(d,) number of the element of each pair, in the order of frames."""
    elements: int
    """Number of paired elements."""
    sigma_scale: float = 1.0

    @classmethod
    def of(cls, cases: Sequence[FrameReference], steps: Sequence[Odometry | None]) -> "Measured":
        """Return the measurements of frames with poses; ``steps`` leads from each to the next."""
        pairs = tuple(
            pairs_to_fit(case, case.problem, case.reference)
            for case in cases
            if case.reference is not None
        )
        of_frames = [case.nearby.id[own[:, 1]] for case, own in zip(cases, pairs, strict=True)]
        ids, element = np.unique(
            np.concatenate([np.zeros(0, np.int64), *of_frames]), return_inverse=True
        )
        return cls(
            tuple(cases),
            tuple(case.problem for case in cases),
            tuple(case.prior for case in cases),
            tuple((k, step) for k, step in enumerate(steps) if step is not None),
            pairs,
            element,
            len(ids),
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """The likeliest poses, errors of elements, and parameters of a cause."""

    poses: tuple[Pose, ...]
    errors: FloatArray
    """(e, 6) in sigmas of the map."""
    value: FloatArray
    """(p,)"""
    cost: FloatArray
    """(1 + e,) nats: of priors and odometry, then of each element with its detections."""


Change = Callable[[Measured, FloatArray], Measured]
"""Returns what would have been measured without a cause of parameters (p,)."""


def fitted(
    measured: Measured,
    start: Solution | None = None,
    change: Change = lambda measured, value: measured,
    step: FloatArray | None = None,
) -> Solution:
    """Fit poses, elements and a cause, from those of ``start`` or of the frames.

    ``step`` (p,) has steps of the parameters, for derivatives; None without a cause.
    """
    steps = [] if step is None else list(np.diag(step))
    if start is None:
        poses = tuple(case.reference for case in measured.cases if case.reference is not None)
        errors = np.zeros((measured.elements, 6))
    else:
        poses, errors = start.poses, start.errors
    value, of_poses = np.zeros(len(steps)), 6 * len(poses)
    last = of_poses + errors.size
    for gate in _GATES if start is None else _LATER_GATES:
        now = change(measured, value)
        blocks = _blocks(now, poses, errors)
        others = [
            _changed(blocks, now, change(measured, value + by), poses, errors) for by in steps
        ]
        information = LOOSE * np.eye(last + len(value))
        gradient = np.zeros(last + len(value))
        for k, block in enumerate(blocks):
            by_value = [
                (other[k].residual - block.residual) / by.sum()
                for other, by in zip(others, steps, strict=True)
            ]
            whole = block.with_cause(last, by_value)
            (whole.weighted(gate) if k == 0 else whole).add_to(information, gradient)
        moved = -np.linalg.solve(information, gradient)
        twists = moved[:of_poses].reshape(-1, 6)
        poses = tuple(Pose.exp(twist) @ pose for twist, pose in zip(twists, poses, strict=True))
        errors, value = errors + moved[of_poses:last].reshape(-1, 6), value + moved[last:]
    blocks = _blocks(change(measured, value), poses, errors)
    return Solution(poses, errors, value, _costs(measured, blocks))


class _Block(NamedTuple):
    """b measurements of one sort: r residuals in sigmas each, which w unknowns change."""

    residual: FloatArray
    """(b, r)"""
    jacobian: FloatArray
    """(b, r, w)"""
    columns: IntArray
    """(b, w) of the unknowns."""

    def with_cause(self, first: int, by_value: Sequence[FloatArray]) -> "_Block":
        """Return the block with the parameters of a cause, whose columns begin at ``first``."""
        own = np.tile(first + np.arange(len(by_value)), (len(self.residual), 1))
        jacobian = np.concatenate([self.jacobian, *(each[..., None] for each in by_value)], axis=2)
        return self._replace(jacobian=jacobian, columns=np.hstack([self.columns, own]))

    def weighted(self, gate: float) -> "_Block":
        """Return the block with measurements down-weighted that are far off (Geman-McClure)."""
        root = 1.0 / (1.0 + (self.residual**2).sum(axis=1) / gate)
        return self._replace(
            residual=root[:, None] * self.residual, jacobian=root[:, None, None] * self.jacobian
        )

    def add_to(self, information: FloatArray, gradient: FloatArray) -> None:
        """Add the block to the normal equations (m, m) and (m,)."""
        size = len(gradient)
        turned = np.swapaxes(self.jacobian, 1, 2)
        places = self.columns[:, :, None] * size + self.columns[:, None, :]
        products = (turned @ self.jacobian).ravel()
        information += np.bincount(places.ravel(), products, size**2).reshape(size, size)
        sums = _applied(turned, self.residual).ravel()
        gradient += np.bincount(self.columns.ravel(), sums, size)


def _blocks(measured: Measured, poses: Sequence[Pose], errors: FloatArray) -> list[_Block]:
    """Return the residuals of detections, elements, priors and odometry."""
    count = len(errors)
    columns = 6 * len(poses) + 6 * np.arange(count)[:, None] + np.arange(6)
    own = np.broadcast_to(np.eye(6), (count, 6, 6))
    return [
        _detections(measured, poses, errors),
        _Block(errors, own, columns),
        _priors(measured, poses),
        _odometry(measured, poses),
    ]


def _changed(
    blocks: Sequence[_Block],
    measured: Measured,
    other: Measured,
    poses: Sequence[Pose],
    errors: FloatArray,
) -> list[_Block]:
    """Return the blocks of ``other``: those of ``measured`` but for what it measured otherwise."""
    seen, elements, priors, odometry = blocks
    if other.problems is not measured.problems:
        seen = _detections(other, poses, errors)
    if other.priors is not measured.priors:
        priors = _priors(other, poses)
    if other.steps is not measured.steps:
        odometry = _odometry(other, poses)
    return [seen, elements, priors, odometry]


def _detections(measured: Measured, poses: Sequence[Pose], errors: FloatArray) -> _Block:
    parts = list(_pair_parts(measured, poses))
    residual, by_pose, by_error = (np.concatenate(part) for part in zip(*parts, strict=True))
    residual = residual + _applied(by_error, errors[measured.element])
    frame = np.repeat(np.arange(len(poses)), [len(pairs) for pairs in measured.pairs])
    first = np.stack([6 * frame, 6 * len(poses) + 6 * measured.element], axis=1)
    columns = (first[:, :, None] + np.arange(6)).reshape(-1, 12)
    return _Block(residual, np.concatenate([by_pose, by_error], axis=2), columns)


def _pair_parts(
    measured: Measured, poses: Sequence[Pose]
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Yield, of each frame, residuals (k, 4) in sigmas, and their derivatives (k, 4, 6) by the
    pose, and by errors of elements in sigmas of the map. Rows that do not count are 0."""
    for pose, problem, pairs in zip(poses, measured.problems, measured.pairs, strict=True):
        rows = pair_rows(problem, pose, pairs)
        counted = rows.used & ~rows.is_bottom
        weight = counted / (measured.sigma_scale * np.sqrt(rows.variance_px2))
        covariance = problem.mapped["covariance_m2"][pairs[:, 1]]
        by_error = rows.by_element @ np.linalg.cholesky(covariance + LEAST_M2 * np.eye(6))
        wide = weight[..., None]
        yield weight * rows.residual_px, wide * rows.by_pose, wide * by_error


def _priors(measured: Measured, poses: Sequence[Pose]) -> _Block:
    count = len(poses)
    residual, jacobian = np.zeros((count, MOST_ROWS)), np.zeros((count, MOST_ROWS, 6))
    for k, (prior, pose) in enumerate(zip(measured.priors, poses, strict=True)):
        used = prior_rows(PriorRecord.of(prior), *pose.writable(), residual[k], jacobian[k])
        residual[k, used:], jacobian[k, used:] = 0.0, 0.0
    return _Block(residual, jacobian, 6 * np.arange(count)[:, None] + np.arange(6))


def _odometry(measured: Measured, poses: Sequence[Pose]) -> _Block:
    if not measured.steps:
        return _Block(np.zeros((0, 6)), np.zeros((0, 6, 12)), np.zeros((0, 12), dtype=np.int64))
    numbers, steps = zip(*measured.steps, strict=True)
    row = np.array(numbers)
    R, t = _stacked(poses)
    R_step, t_step = _stacked([step.T_now_before for step in steps])
    turn = R[row + 1] @ np.swapaxes(R[row], 1, 2)
    motion = t[row + 1] - _applied(turn, t[row])
    off = R_step @ np.swapaxes(turn, 1, 2)
    rotvec, shift = Rotation.from_matrix(off).as_rotvec(), t_step - _applied(off, motion)
    across = np.cross(rotvec, shift)
    shift = shift - 0.5 * across + np.cross(rotvec, across) / 12.0  # logarithm, of small angles
    by_before = np.zeros((len(row), 6, 6))  # adjoint
    by_before[:, :3, :3] = by_before[:, 3:, 3:] = turn
    by_before[:, :3, 3:] = np.cross(motion[:, None], np.swapaxes(turn, 1, 2)).swapaxes(1, 2)
    white = np.linalg.inv(np.linalg.cholesky(np.stack([step.covariance for step in steps])))
    residual = _applied(white, np.hstack([shift, rotvec]))
    columns = 6 * row[:, None] + np.arange(12)
    return _Block(residual, np.concatenate([white @ by_before, -white], axis=2), columns)


def _stacked(poses: Sequence[Pose]) -> tuple[FloatArray, FloatArray]:
    """Return rotations (n, 3, 3) and translations (n, 3)."""
    return np.stack([pose.rotation for pose in poses]), np.stack([p.translation for p in poses])


def _applied(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the products (n, r) of matrices (n, r, c) and vectors (n, c)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _costs(measured: Measured, blocks: Sequence[_Block]) -> FloatArray:
    """Return (1 + e,) as in ``Solution``."""
    seen, elements, *others = ((block.residual**2).sum(axis=1) for block in blocks)
    rows = blocks[0].jacobian.any(axis=2).sum(axis=1)
    own = np.minimum(0.5 * seen + rows * np.log(measured.sigma_scale), 0.5 * MOST_CHI2)
    paired = np.bincount(measured.element, own, measured.elements)
    return np.append(0.5 * sum(float(part.sum()) for part in others), paired + 0.5 * elements)
