"""Find a wrong camera calibration in residuals that follow one pattern in all frames.

Focal length, principal point and roll are estimated jointly and linearly from all pairs of a run.
If the true pose is unknown, each frame's pose is estimated too, with its prior, and marginalized
(Schur complement). Only errors that no pose explains remain.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.diagnosis.fault import EvidenceItem, Fault
from semviz_core.diagnosis.reference import (
    FrameReference,
    ProgressCallback,
    no_progress,
    whitened_rows,
)
from semviz_core.localization.association import associate
from semviz_core.localization.prior_residuals import MOST_ROWS, prior_rows
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.search import REFINED_COVARIANCE
from semviz_core.localization.upright import assumed_upright

PATTERNS = ("focal length", "principal point, across", "principal point, up or down", "roll")
UNITS = ("%", "px", "px", "deg")
IN_UNITS: FloatArray = np.array([100.0, 1.0, 1.0, np.rad2deg(1.0)])
"""Factors from the estimated quantities (share, px, px, rad) to ``UNITS``."""
LEAST: FloatArray = np.array([0.5, 2.0, 2.0, 0.3])
"""Smallest faults, in ``UNITS``: less is within the accuracy of calibrations."""
LEAST_SIGMAS = 6.0
NEEDED_PAIRS = 12
OFF_SIGMAS = 4.0
EXPLAINED, EXPLAINED_BLIND = 0.4, 0.1
"""Share of all squared residuals that a pattern must explain, with and without the true poses: a
moved element looks like a pattern too. Estimated poses absorb most of the pattern."""
_SCALES = (30.0, 15.0, 8.0, 4.0, 4.0)
"""Sigmas beyond which rows are down-weighted, per iteration."""
_STEP = np.array([1e-4, 0.1, 0.1])


class WrongCalibration(NamedTuple):
    """An error of the calibration, and what is left with it."""

    fault: Fault
    cost: float
    """As ``residual_cost``."""


def residual_cost(cases: Sequence[FrameReference]) -> float:
    """Return the sum of squared residuals in sigmas, each at most ``OFF_SIGMAS`` squared."""
    return _cost([block for case in cases for block in _blocks(case)], np.zeros(len(PATTERNS)))


def find_calibration(
    cases: Sequence[FrameReference], watch: ProgressCallback = no_progress
) -> WrongCalibration | None:
    """Return the fault of the strongest pattern; None without one."""
    watched = watch(cases, "checking the calibration", len(cases))
    blocks = [block for case in watched for block in _blocks(case)]
    if sum(len(residual) // 2 for residual, _, _ in blocks) < NEEDED_PAIRS:
        return None
    value, sigma = _estimate(blocks)
    measured, strength = value * IN_UNITS, np.abs(value) / sigma
    significant = (strength > LEAST_SIGMAS) & (np.abs(measured) > LEAST)
    cost = _cost(blocks, value)
    explained = 1.0 - cost / _cost(blocks, np.zeros(len(PATTERNS)))
    least = EXPLAINED_BLIND if any(case.truth is None for case in cases) else EXPLAINED
    if not significant.any() or explained < least:
        return None
    k = int(np.argmax(np.where(significant, strength, 0.0)))
    also = " or mounting" if k else ""
    name = "roll of the mounting" if k == 3 else PATTERNS[k].split(",")[0] + also
    fault = Fault(
        "wrong calibration",
        f"The residuals of all frames fit an error of {measured[k]:+.1f} {UNITS[k]} in {name}.",
        (
            EvidenceItem(PATTERNS[k], float(measured[k]), UNITS[k]),
            EvidenceItem("strength", strength[k], "sigma"),
        ),
    )
    return WrongCalibration(fault, cost)


Block = tuple[FloatArray, FloatArray, FloatArray]
"""Whitened residuals (r,), their Jacobians for the calibration (r, 4) and the pose (r, 0 or 6)."""


def _blocks(case: FrameReference) -> Iterator[Block]:
    """Yield one block for a frame with pairs."""
    pairs = _pairs(case)
    if not len(pairs) or case.reference is None:
        return
    residual, by_pose, _ = whitened_rows(case.problem, case.reference, pairs)
    by_camera = np.empty((len(residual), 4))
    for k in range(3):
        by_camera[:, k] = (
            whitened_rows(_changed(case, k), case.reference, pairs).residual - residual
        ) / _STEP[k]
    by_camera[:, 3] = by_pose[:, 5]
    if case.truth is not None:
        yield residual, by_camera, np.empty((len(residual), 0))
        return
    prior, slope = _prior_rows(case)
    yield (
        np.append(residual, prior),
        np.concatenate([by_camera, np.zeros((len(prior), 4))]),
        np.concatenate([by_pose, slope]),
    )


def _pairs(case: FrameReference) -> IntArray:
    """Return (k, 2) true pairs if known, else the nearest within a wide gate."""
    if case.ids is not None or case.reference is None:
        return case.same_class
    match, _ = associate(case.problem, *case.reference.writable(), REFINED_COVARIANCE)
    rows = np.flatnonzero(match >= 0)
    return np.column_stack([rows, match[rows]])


def _changed(case: FrameReference, k: int) -> PoseProblem:
    """Return the problem with one camera parameter of ``PATTERNS`` a step larger."""
    result = case.localization
    K = result.camera.K.copy()
    if k == 0:
        K[[0, 1], [0, 1]] *= 1.0 + _STEP[0]
    else:
        K[k - 1, 2] += _STEP[k]
    return PoseProblem.of(replace(result.camera, K=K), result.observed, case.nearby, case.detector)


def _prior_rows(case: FrameReference) -> tuple[FloatArray, FloatArray]:
    assert case.reference is not None
    residual, slope = np.zeros(MOST_ROWS), np.zeros((MOST_ROWS, 6))
    known = PriorRecord.of(assumed_upright(case.prior))
    count = prior_rows(known, *case.reference.writable(), residual, slope)
    return residual[:count], slope[:count]


def _estimate(blocks: Sequence[Block]) -> tuple[FloatArray, FloatArray]:
    """Return (4,) values and sigmas; rows that fit no calibration end with almost no weight."""
    value: FloatArray = np.zeros(4)
    information = np.eye(4)
    for scale in _SCALES:
        information, gradient = 1e-6 * np.eye(4), np.zeros(4)
        for residual, by_camera, by_pose in blocks:
            remaining = residual + by_camera @ value
            root = 1.0 / (1.0 + (remaining / scale) ** 2)  # root of the Geman-McClure weight
            A, r = _without_pose(
                root[:, None] * by_camera, root[:, None] * by_pose, root * residual
            )
            information += A.T @ A
            gradient -= A.T @ r
        value = np.asarray(np.linalg.solve(information, gradient), dtype=np.float64)
    return value, np.sqrt(np.diag(np.linalg.inv(information)))


def _cost(blocks: Sequence[Block], value: FloatArray) -> float:
    """Return the sum of squares, each row at most ``OFF_SIGMAS`` squared."""
    remaining = (r + A @ value for A, r in (_without_pose(A, J, r) for r, A, J in blocks))
    return sum(float(np.minimum(rows**2, OFF_SIGMAS**2).sum()) for rows in remaining)


def _without_pose(
    by_camera: FloatArray, by_pose: FloatArray, residual: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return Jacobian and residual projected orthogonally to the pose Jacobian."""
    if not by_pose.shape[1]:
        return by_camera, residual
    Q, _ = np.linalg.qr(by_pose)
    return by_camera - Q @ (Q.T @ by_camera), residual - Q @ (Q.T @ residual)
