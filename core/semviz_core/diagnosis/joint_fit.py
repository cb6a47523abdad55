"""Find the one cause that a run without true poses supports, by a fit of all that it measured.

Poses of all frames, errors of mapped elements and a cause are fitted together to detections, priors
and odometry (a bundle adjustment with the map as prior). A cause is as likely as what it adds to
the log-likelihood once all poses and elements may follow it. Errors of mapped positions are
unknowns, so frames that see one element again are no further evidence of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.frame import Odometry, Prior, adjoint
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.diagnosis.common_causes import CALIBRATIONS
from semviz_core.diagnosis.fault import FaultKind
from semviz_core.diagnosis.reference import FrameReference
from semviz_core.localization.association import associate
from semviz_core.localization.prior_residuals import MOST_ROWS, prior_rows
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.search import REFINED_COVARIANCE
from semviz_core.tracking.association import pair_rows

MOST_FRAMES = 30
"""Frames of a stretch that are fitted together."""
NEEDED_FRAMES, NEEDED_PAIRS = 3, 8
LEAST_NATS = 8.0
"""Log-likelihood that a cause must add, beyond its parameters and without its best element."""
MOST_CHI2 = 25.0
"""Squared residuals of one detection (sigmas) count up to this, and as much without a pair."""
_GATES = (64.0, 32.0, 16.0, 16.0, 16.0, 16.0)
"""Squared residuals of a detection beyond which it is down-weighted, per iteration."""
LEAST_M2 = 1e-10
"""Keeps the covariance of a map that is said to be perfect invertible."""
SIGMA_SCALES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)


@dataclass(frozen=True)
class JointCause:
    """A cause with p parameters: of odometry, of the camera, or the scale of sigmas."""

    kind: FaultKind
    name: str
    parameters: int
    change: Callable[["_Measured", FloatArray], "_Measured"]
    step: float = 1e-4
    unit: str = ""
    in_unit: float = 1.0
    least: float = 0.0
    """Smallest fault in ``unit``."""


@dataclass(frozen=True, eq=False)
class _Measured:
    """What the frames of a stretch measured, and the pairs of their detections."""

    cases: tuple[FrameReference, ...]
    problems: tuple[PoseProblem, ...]
    priors: tuple[Prior, ...]
    steps: tuple[Odometry, ...]
    """From each frame to the next."""
    pairs: tuple[IntArray, ...]
    """(k, 2) of each frame: rows of observed and nearby elements."""
    element: tuple[IntArray, ...]
    """(k,) of each frame: numbers of the elements of its pairs."""
    elements: int
    """Number of paired elements."""
    sigma_scale: float = 1.0


@dataclass(frozen=True, eq=False)
class JointFit:
    """A cause, its likeliest parameters, and what it adds to the log-likelihood (nats)."""

    cause: JointCause
    value: FloatArray
    """(p,)"""
    nats: float
    nats_without_best: float

    @property
    def is_fault(self) -> bool:
        size = float(np.abs(self.value).max()) * self.cause.in_unit
        return self.nats_without_best > LEAST_NATS and size > self.cause.least


def _longer(measured: _Measured, value: FloatArray) -> _Measured:
    return _moved(measured, 1.0 / (1.0 + value[0]), 0.0)


def _turned(measured: _Measured, value: FloatArray) -> _Measured:
    return _moved(measured, 1.0, -float(value[0]))


def _moved(measured: _Measured, factor: float, turn_rad: float) -> _Measured:
    turn = Pose.from_rotvec(np.array([0.0, turn_rad, 0.0]), np.zeros(3))
    steps = []
    for step in measured.steps:
        motion = step.T_now_before
        motion = turn @ Pose(motion.rotation, factor * motion.translation)
        steps.append(Odometry(motion, step.covariance))
    return replace(measured, steps=tuple(steps))


def _seen_through(number: int) -> Callable[[_Measured, FloatArray], _Measured]:
    camera = CALIBRATIONS[number].camera
    assert camera is not None

    def change(measured: _Measured, value: FloatArray) -> _Measured:
        problems = tuple(
            PoseProblem.of(
                camera(case.localization.camera, value), case.localization.observed,
                case.nearby, case.detector,
            )
            for case in measured.cases
        )  # fmt: skip
        return replace(measured, problems=problems)

    return change


def _rolled(measured: _Measured, value: FloatArray) -> _Measured:
    turn = so3_exp(np.array([0.0, 0.0, value[0]]))
    priors = tuple(
        prior if prior.up_camera is None else replace(prior, up_camera=turn @ prior.up_camera)
        for prior in measured.priors
    )
    return replace(measured, priors=priors)


JOINT_CAUSES = (
    JointCause("wrong odometry", "length", 1, _longer, unit="%", in_unit=100.0, least=1.0),
    JointCause(
        "wrong odometry", "yaw", 1, _turned,
        unit="deg per step", in_unit=float(np.rad2deg(1.0)), least=0.1,
    ),
    JointCause(
        "wrong calibration", "focal length", 1, _seen_through(0),
        unit="%", in_unit=100.0, least=0.5,
    ),
    JointCause(
        "wrong calibration", "principal point or mounting", 2, _seen_through(1),
        step=0.1, unit="px", least=2.0,
    ),
    JointCause(
        "wrong gravity prior", "roll", 1, _rolled,
        unit="deg", in_unit=float(np.rad2deg(1.0)), least=0.3,
    ),
)  # fmt: skip
SIGMA = JointCause("wrong detection sigma", "true over stated sigma", 1, lambda m, v: m, least=1.8)


def joint_fits(
    cases: Sequence[FrameReference], odometry: Sequence[Odometry | None]
) -> list[JointFit]:
    """Return all causes, fitted, the likeliest first; none if too little is known.

    ``cases`` have the poses from which the fit starts, ``odometry`` the motion of each from the
    one before.
    """
    rows = fitted_rows(cases, odometry)
    measured = _measured([cases[row] for row in rows], [odometry[row] for row in rows[1:]])
    count = sum(map(len, measured.pairs))
    if len(rows) < NEEDED_FRAMES or count < NEEDED_PAIRS:
        return []
    nothing = _fitted(measured, None)
    found = [_rated(cause, _fitted(measured, cause), nothing, count) for cause in JOINT_CAUSES]
    scaled = [
        (scale, _fitted(replace(measured, sigma_scale=scale), None)) for scale in SIGMA_SCALES[1:]
    ]
    scale, best = min(scaled, key=lambda one: float(one[1].cost.sum()))
    best = replace(best, value=np.array([scale]))
    found.append(_rated(SIGMA, best, nothing, count))
    return sorted(found, key=lambda fit: -fit.nats)


def _rated(cause: JointCause, fit: "_Solution", nothing: "_Solution", count: int) -> JointFit:
    gain = nothing.cost - fit.cost
    nats = float(gain.sum()) - 0.5 * cause.parameters * float(np.log(count))
    return JointFit(cause, fit.value, nats, nats - float(gain[1:].max(initial=0.0)))


def fitted_rows(cases: Sequence[FrameReference], odometry: Sequence[Odometry | None]) -> range:
    """Return the frames that are fitted: of those with poses that odometry joins, MOST_FRAMES one
    after the other with the most detections."""
    usable = [case.localization.status == "ok" for case in cases]
    seen = np.cumsum([0, *(len(case.localization.observed) for case in cases)])
    best, start = range(0), 0
    for row, is_usable in enumerate(usable):
        if not is_usable or odometry[row] is None:
            start = row if is_usable else row + 1
        start = max(start, row + 1 - MOST_FRAMES)
        if seen[row + 1] - seen[start] > seen[best.stop] - seen[best.start]:
            best = range(start, row + 1)
    return best


def _measured(cases: Sequence[FrameReference], steps: Sequence[Odometry | None]) -> _Measured:
    pairs = tuple(_pairs(case) for case in cases)
    of_frames = [case.nearby.id[own[:, 1]] for case, own in zip(cases, pairs, strict=True)]
    ids = np.unique(np.concatenate([np.zeros(0, np.int64), *of_frames]))
    return _Measured(
        tuple(cases),
        tuple(case.problem for case in cases),
        tuple(case.prior for case in cases),
        tuple(step for step in steps if step is not None),
        pairs,
        tuple(np.searchsorted(ids, own) for own in of_frames),
        len(ids),
    )


def _pairs(case: FrameReference) -> IntArray:
    assert case.reference is not None
    match, _ = associate(case.problem, *case.reference.writable(), REFINED_COVARIANCE.copy())
    rows = np.flatnonzero(match >= 0)
    return np.column_stack([rows, match[rows]])


@dataclass(frozen=True, eq=False)
class _Solution:
    value: FloatArray
    """(p,)"""
    cost: FloatArray
    """(1 + e,) nats: of priors, odometry and unpaired detections, then of each element."""


@dataclass(frozen=True, eq=False)
class _Rows:
    """Residual rows in sigmas."""

    residual: FloatArray
    """(r,)"""
    jacobian: FloatArray
    """(r, 6n + 6e) by poses and element errors."""
    detection: IntArray
    """(r,) number of the pair; -1 for priors and odometry."""
    element: IntArray
    """(d,) of each pair, its row in ``elements``."""


def _fitted(measured: _Measured, cause: JointCause | None) -> _Solution:
    poses = [case.reference for case in measured.cases if case.reference is not None]
    errors = np.zeros(6 * measured.elements)
    value = np.zeros(0 if cause is None else cause.parameters)
    first, last = 6 * len(poses), 6 * len(poses) + len(errors)
    index = np.arange(first, last)
    for gate in _GATES:
        rows, by_value = _linear(measured, cause, poses, errors, value)
        root = np.ones(len(rows.residual))
        mine = rows.detection >= 0
        root[mine] = 1.0 / (1.0 + _chi2(rows) / gate)[rows.detection[mine]]  # Geman-McClure
        A = root[:, None] * np.concatenate([rows.jacobian, by_value], axis=1)
        information = A.T @ A + 1e-9 * np.eye(A.shape[1])
        information[index, index] += 1.0
        gradient = A.T @ (root * rows.residual)
        gradient[index] += errors
        step = -np.linalg.solve(information, gradient)
        poses = [Pose.exp(step[6 * k : 6 * k + 6]) @ pose for k, pose in enumerate(poses)]
        errors, value = errors + step[first:last], value + step[last:]
    rows, _ = _linear(measured, cause, poses, errors, value)
    return _Solution(value, _costs(measured, rows, errors))


def _chi2(rows: _Rows) -> FloatArray:
    mine = rows.detection >= 0
    squares = rows.residual[mine] ** 2
    return np.asarray(
        np.bincount(rows.detection[mine], squares, minlength=len(rows.element)), float
    )


def _costs(measured: _Measured, rows: _Rows, errors: FloatArray) -> FloatArray:
    mine = rows.detection >= 0
    counted = np.bincount(rows.detection[mine], minlength=len(rows.element))
    own = 0.5 * _chi2(rows) + counted * np.log(measured.sigma_scale)
    own = np.minimum(own, 0.5 * MOST_CHI2)
    cost = np.zeros(1 + measured.elements)
    np.add.at(cost, 1 + rows.element, own)
    cost[1:] += 0.5 * (errors.reshape(-1, 6) ** 2).sum(axis=1)
    cost[0] = 0.5 * float((rows.residual[~mine] ** 2).sum())
    return cost


def _linear(
    measured: _Measured,
    cause: JointCause | None,
    poses: Sequence[Pose],
    errors: FloatArray,
    value: FloatArray,
) -> tuple[_Rows, FloatArray]:
    """Return the rows, and their derivative (r, p) by the cause."""
    if cause is None:
        rows = _rows(measured, poses, errors)
        return rows, np.zeros((len(rows.residual), 0))
    rows = _rows(cause.change(measured, value), poses, errors)
    by_value = [
        (_rows(cause.change(measured, value + step), poses, errors).residual - rows.residual)
        / cause.step
        for step in cause.step * np.eye(len(value))
    ]
    return rows, np.column_stack(by_value)


class _Gathered:
    """Rows that are gathered part by part, each of one or two poses."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._parts: list[tuple[FloatArray, FloatArray, IntArray]] = []

    def add(self, residual: FloatArray, detection: int, *blocks: tuple[int, FloatArray]) -> None:
        """Append residuals (r,) of a pair, or of none (-1), with derivatives from columns on."""
        wide = np.zeros((len(residual), self._width))
        for column, block in blocks:
            wide[:, column : column + 6] = block
        self._parts.append((residual, wide, np.full(len(residual), detection)))

    def rows(self, element: IntArray) -> _Rows:
        """Return all rows; ``element`` (d,) is that of each pair."""
        residual, jacobian, detection = zip(*self._parts, strict=True)
        return _Rows(
            np.concatenate(residual), np.concatenate(jacobian), np.concatenate(detection), element
        )


def _rows(measured: _Measured, poses: Sequence[Pose], errors: FloatArray) -> _Rows:
    gathered = _Gathered(6 * len(poses) + len(errors))
    _add_detections(gathered, measured, poses, errors.reshape(-1, 6))
    for k, (prior, pose) in enumerate(zip(measured.priors, poses, strict=True)):
        residual, slope = np.zeros(MOST_ROWS), np.zeros((MOST_ROWS, 6))
        count = prior_rows(PriorRecord.of(prior), *pose.writable(), residual, slope)
        gathered.add(residual[:count], -1, (6 * k, slope[:count]))
    for k, step in enumerate(measured.steps):
        motion = poses[k + 1] @ poses[k].inverse()
        white = np.linalg.inv(np.linalg.cholesky(step.covariance))
        innovation = (step.T_now_before @ motion.inverse()).log()
        blocks = (6 * k, white @ adjoint(motion)), (6 * k + 6, -white)
        gathered.add(white @ innovation, -1, *blocks)
    return gathered.rows(np.concatenate(measured.element))


def _add_detections(
    gathered: _Gathered, measured: _Measured, poses: Sequence[Pose], errors: FloatArray
) -> None:
    """Append the rows of all pairs, with errors (e, 6) of elements in sigmas of the map."""
    number = 0
    for k, pose in enumerate(poses):
        problem, pairs = measured.problems[k], measured.pairs[k]
        found = pair_rows(problem, pose, pairs)
        counted = found.used & ~found.is_bottom
        sigma = measured.sigma_scale * np.sqrt(found.variance_px2)
        covariance = problem.mapped["covariance_m2"][pairs[:, 1]]
        by_error = found.by_element @ np.linalg.cholesky(covariance + LEAST_M2 * np.eye(6))
        for row, element in enumerate(measured.element[k]):
            used, size = counted[row], sigma[row][counted[row]]
            by_own = by_error[row][used] / size[:, None]
            residual = found.residual_px[row][used] / size + by_own @ errors[element]
            by_pose = found.by_pose[row][used] / size[:, None]
            blocks = (6 * k, by_pose), (6 * (len(poses) + element), by_own)
            gathered.add(residual, number, *blocks)
            number += 1
