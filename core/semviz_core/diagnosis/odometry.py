"""Test the odometry of a run against its true poses.

Over stretches of several steps, the odometry's motion is compared with that between the poses at
both ends. An error of the scale or of the yaw rate is common to all stretches; else the stated
noise may be too small. The strongest is named.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_core.base.frame import Odometry, adjoint
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.diagnosis.assumptions import solve_with_prior
from semviz_core.diagnosis.fault import EvidenceItem, RunFault
from semviz_core.diagnosis.reference import FrameReference, is_healthy

NEEDED_STRETCHES = 3
NEEDED_FOR_NOISE = 5
"""Stretches from which the size of their errors is told."""
MOST_STEPS = 10
"""Of a stretch; long ones show a drift better than the noise of poses hides it."""
TRUE_POSE_SIGMA: FloatArray = np.repeat([0.02, float(np.deg2rad(0.02))], 3)
"""Accuracy of true poses over a stretch: metres, then radians."""
LEAST_NATS, LEAST_NATS_WITHOUT_BEST = 12.0, 6.0
"""Log-likelihood that a drift must add, in all and without any one of the poses: one wrong pose is
no drift."""
LOOSE = 1e4
"""Variance of a pose that is left out (m2, rad2)."""
LEAST_SIGMAS = 1.0
"""Smallest drift that is a fault, in stated sigmas of one step."""
LEAST_NOISE = 3.0
"""Smallest factor between true and stated noise that is a fault."""
MEDIAN_CHI2 = 5.348
"""Of six degrees of freedom."""
OFF_CHI2 = 27.9
"""Chance exceeds it once in 10,000 stretches."""
TRACKED = "track"
DRIFTS = (("length", "%", 100.0), ("yaw", "deg per step", float(np.rad2deg(1.0))))
"""Name, unit, and the factor from share and radians."""


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Odometry over some steps, and how it differs from the poses at its ends."""

    first: int
    last: int
    """Positions in the run."""
    innovation: FloatArray
    """(6,) log of the odometry's motion times the inverse of the true one."""
    covariance: FloatArray
    """(6, 6) of ``innovation`` if the odometry is right."""
    drifts: FloatArray
    """(6, 2) change of ``innovation`` with the length and with the yaw of all steps."""
    by_start: FloatArray
    """(6, 6) change of ``innovation`` with the pose at its start; -1 with that at its end."""
    start_covariance: FloatArray
    """(6, 6) of the pose at its start."""
    step_sigmas: FloatArray
    """(2,) stated sigmas of one step: share of its length, and radians."""

    @property
    def chi2(self) -> float:
        return float(self.innovation @ np.linalg.solve(self.covariance, self.innovation))


def odometry_fault(
    cases: Sequence[FrameReference], odometry: Sequence[Odometry | None]
) -> RunFault | None:
    """Return the fault of the odometry; None without one, or if too little of it is known.

    ``odometry`` has the motion of each frame from the one before.
    """
    stretches = _stretches(cases, odometry)
    if len(stretches) < NEEDED_STRETCHES:
        return None
    drift = _drift(stretches)
    noise = float(np.sqrt(np.median([stretch.chi2 for stretch in stretches]) / MEDIAN_CHI2))
    if drift is None and (noise < LEAST_NOISE or len(stretches) < NEEDED_FOR_NOISE):
        return None
    sentence, evidence = drift or (
        f"its errors are {noise:.1f} times larger than it states",
        EvidenceItem("true over stated noise", noise),
    )
    off = [stretch for stretch in stretches if stretch.chi2 > OFF_CHI2] or stretches
    frames = {row for stretch in off for row in range(stretch.first, stretch.last + 1)}
    return RunFault(
        "wrong odometry",
        f"Over {len(stretches)} stretches, the odometry disagrees with the true poses: {sentence}.",
        (EvidenceItem("stretches", len(stretches)), evidence),
        frames=tuple(row for row in sorted(frames) if _is_explained(cases[row])),
    )


def _drift(stretches: Sequence[_Stretch]) -> tuple[str, EvidenceItem] | None:
    """Return the drift that all stretches have in common, as a sentence and as a number."""
    covariance = _joint_covariance(stretches)
    innovation = np.concatenate([stretch.innovation for stretch in stretches])
    best: tuple[float, str, EvidenceItem] | None = None
    for k, (name, unit, factor) in enumerate(DRIFTS):
        by_drift = np.concatenate([stretch.drifts[:, k] for stretch in stretches])
        value, nats = _fitted(by_drift, innovation, covariance)
        step_sigma = float(np.median([stretch.step_sigmas[k] for stretch in stretches]))
        if nats < LEAST_NATS or abs(value) < LEAST_SIGMAS * step_sigma:
            continue
        loose = (
            covariance + LOOSE * _by_pose(stretches, pose) for pose in range(len(stretches) + 1)
        )
        if any(
            _fitted(by_drift, innovation, other)[1] < LEAST_NATS_WITHOUT_BEST for other in loose
        ):
            continue
        if best is None or nats > best[0]:
            item = EvidenceItem(name, value * factor, unit)
            best = nats, drift_sentence(k, value * factor), item
    return None if best is None else best[1:]


def _fitted(
    by_drift: FloatArray, innovation: FloatArray, covariance: FloatArray
) -> tuple[float, float]:
    """Return the drift (least squares), and what it adds to the log-likelihood."""
    weighted = np.linalg.solve(covariance, by_drift)
    information = max(float(weighted @ by_drift), 1e-12)
    score = float(weighted @ innovation)
    return score / information, 0.5 * score**2 / information


def _by_pose(stretches: Sequence[_Stretch], pose: int) -> FloatArray:
    """Return the joint covariance that errors of a pose have, with unit variances: of the one at
    the start of stretch number ``pose``, or at the end of the one before."""
    change = np.zeros((len(stretches), 6, 6))
    if pose < len(stretches):
        change[pose] = stretches[pose].by_start
    if pose and (pose == len(stretches) or stretches[pose - 1].last == stretches[pose].first):
        change[pose - 1] = -np.eye(6)
    flat = change.reshape(-1, 6)
    return np.asarray(flat @ flat.T)


def _joint_covariance(stretches: Sequence[_Stretch]) -> FloatArray:
    """Return (6 k, 6 k) of all innovations: that of a pose is in the stretches on both sides, and
    what it adds to one it takes from the other."""
    joint = np.zeros((len(stretches), 6, len(stretches), 6))
    for row, stretch in enumerate(stretches):
        joint[row, :, row] = stretch.covariance
        if row and stretches[row - 1].last == stretch.first:
            shared = stretch.by_start @ stretch.start_covariance
            joint[row, :, row - 1] = -shared
            joint[row - 1, :, row] = -shared.T
    return joint.reshape(6 * len(stretches), 6 * len(stretches))


def drift_sentence(k: int, size: float) -> str:
    """Return the size of a drift of ``DRIFTS`` as people read it."""
    if k == 0:
        return f"it is {abs(size):.1f} % too {'long' if size > 0.0 else 'short'}"
    return f"it turns {abs(size):.2f} deg per step too far {'right' if size > 0.0 else 'left'}"


def _stretches(
    cases: Sequence[FrameReference], odometry: Sequence[Odometry | None]
) -> list[_Stretch]:
    """Return stretches one after the other, between frames with a true pose."""
    steps = int(np.clip((len(cases) - 1) // (2 * NEEDED_FOR_NOISE), 1, MOST_STEPS))
    stretches: list[_Stretch] = []
    start: tuple[int, Pose, FloatArray] | None = None
    motion: list[Odometry] = []
    for row, (case, step) in enumerate(zip(cases, odometry, strict=True)):
        if step is None:
            start, motion = None, []
        else:
            motion.append(step)
        if start is not None and row - start[0] < steps:
            continue
        if case.truth is None:
            continue
        end = case.truth, np.diag(TRUE_POSE_SIGMA**2)
        if start is not None:
            stretches.append(_stretch(start, (row, *end), motion))
        start, motion = (row, *end), []
    return stretches


def _stretch(
    start: tuple[int, Pose, FloatArray],
    end: tuple[int, Pose, FloatArray],
    motion: Sequence[Odometry],
) -> _Stretch:
    measured = motion[0]
    for step in motion[1:]:
        measured = measured.followed_by(step)
    true = end[1] @ start[1].inverse()
    by_start = adjoint(true)
    covariance = measured.covariance + end[2] + by_start @ start[2] @ by_start.T
    drifts, T_end_now = np.zeros((6, 2)), Pose.identity()
    for step in reversed(motion):
        A, translation = adjoint(T_end_now), step.T_now_before.translation
        drifts[:, 0] += A[:, :3] @ translation
        drifts[:, 1] += A[:, 4]  # about the camera's y, which points down
        T_end_now = T_end_now @ step.T_now_before
    innovation = (measured.T_now_before @ true.inverse()).log()
    sigmas = _step_sigmas(motion)
    return _Stretch(start[0], end[0], innovation, covariance, drifts, by_start, start[2], sigmas)


def _step_sigmas(motion: Sequence[Odometry]) -> FloatArray:
    """Return the stated sigmas (2,) of a step: share of its length, and rotation about y."""
    length_m = sum(float(np.linalg.norm(step.T_now_before.translation)) for step in motion)
    variance = np.mean([np.diag(step.covariance) for step in motion], axis=0)
    share = float(np.sqrt(variance[:3].mean())) * len(motion) / max(length_m, 1e-3)
    return np.array([share, float(np.sqrt(variance[4]))])


def _is_explained(case: FrameReference) -> bool:
    """Whether a frame is healthy, or would be without its odometry: solved alone."""
    if is_healthy(case.localization, case.truth):
        return True
    prior = case.localization.prior
    return (
        case.localization.method == TRACKED
        and prior is not None
        and is_healthy(solve_with_prior(case, prior), case.truth)
    )
