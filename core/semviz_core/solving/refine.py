"""From a pose close by to the best one, with its covariance and its pairs, or why there is none."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.frame import Prior
from semviz_core.localization import Refinement
from semviz_core.pose import Pose
from semviz_core.solving.association import associate
from semviz_core.solving.least_squares import as_match, fit, fit_known
from semviz_core.solving.residuals import SURE, scene_residuals
from semviz_core.solving.scene import Known, Scene
from semviz_core.solving.shape import why_degenerate
from semviz_core.solving.support import support_of_pairs

FIXING_PAIRS = 2
"""Two pairs fix an upright pose,"""
NEEDED_PAIRS = 3
"""and a third is the first that can contradict them."""
MOST_SIGMA_M = 3.0
"""A pose less certain than this along any direction is no answer."""
MOST_SIGMA_RAD = float(np.deg2rad(5.0))
START_DOUBT: FloatArray = np.diag([0.15**2] * 3 + [np.deg2rad(0.3) ** 2] * 3)
"""Covariance of the pose that refinement starts from."""
_ROUNDS = 6
_ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class Refined:
    """The optimum near a pose."""

    T_camera_map: Pose
    covariance: FloatArray
    """(6, 6) of the left perturbation, pairs and prior together."""
    refinement: Refinement


@dataclass(frozen=True)
class Failure:
    """No answer, and why, in one sentence."""

    reason: str


def refine(
    scene: Scene,
    prior: Prior,
    T_camera_map: Pose,
    pairs: IntArray | None = None,
    needed_pairs: int = NEEDED_PAIRS,
) -> Refined | Failure:
    """Robust least squares over pairs and prior, from ``T_camera_map``.

    With ``pairs`` (k, 2) those are kept (the paper's eq. 8 with a Boolean P); without, pairs are
    chosen one-to-one again after each fit until they stay the same.
    """
    known = Known.of(prior)
    if pairs is None:
        pairs = _settled_pairs(scene, known, T_camera_map)
    if len(pairs) < needed_pairs:
        seen = len(scene.seen)
        return Failure(f"{len(pairs)} of {seen} elements fit one pose, {needed_pairs} needed.")
    best = fit_known(scene, known, T_camera_map, pairs, _ITERATIONS)
    covariance = np.asarray(np.linalg.inv(best.information), dtype=np.float64)
    if reason := _too_uncertain(covariance):
        return Failure(_why_degenerate(scene, pairs) or reason)
    residuals = scene_residuals(scene, best.T_camera_map, pairs)
    support, open_m = support_of_pairs(
        scene, known, best.T_camera_map.rotation, best.T_camera_map.translation,
        as_match(scene, pairs),
    )  # fmt: skip
    refinement = Refinement(
        pairs, residuals.residual_px, residuals.chi2, residuals.inlier, best.trace[:, 0],
        support[pairs[:, 0]], open_m[pairs[:, 0]], best.trace[1:, 1:],
    )  # fmt: skip
    return Refined(best.T_camera_map, covariance, refinement)


def _settled_pairs(scene: Scene, known: Known, T_camera_map: Pose) -> IntArray:
    """(k, 2) one-to-one pairs that don't change when the pose is fitted to them."""
    R, t = T_camera_map.rotation, T_camera_map.translation
    match, _ = associate(scene, R, t, START_DOUBT)
    for _ in range(_ROUNDS):
        R, t, _, _ = fit(scene, known, R, t, match, _ITERATIONS)
        before = match
        match, _ = associate(scene, R, t, SURE)
        if np.array_equal(match, before):
            break
    seen = np.flatnonzero(match >= 0)
    return np.column_stack([seen, match[seen]])


def _why_degenerate(scene: Scene, pairs: IntArray) -> str:
    seen, mapped = scene.seen[pairs[:, 0]], scene.mapped[pairs[:, 1]]
    known = (seen["known"] & mapped["known"]).astype(bool)
    return why_degenerate(mapped["anchor_m"], mapped["end_m"], known)


def _too_uncertain(covariance: FloatArray) -> str:
    """Why a pose with this covariance is no answer; empty where it is one."""
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    sigma_rad = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    if sigma_m > MOST_SIGMA_M:
        return f"The pairs fix the position only to {sigma_m:.1f} m, {MOST_SIGMA_M:.0f} m needed."
    if sigma_rad > MOST_SIGMA_RAD:
        found, most = np.rad2deg([sigma_rad, MOST_SIGMA_RAD])
        return f"The pairs fix the rotation only to {found:.1f} deg, {most:.0f} deg needed."
    return ""
