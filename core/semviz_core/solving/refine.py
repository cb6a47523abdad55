"""From a pose close by to the best one, with its covariance and its pairs, or why there is none."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.frame import Prior
from semviz_core.localization import Refinement
from semviz_core.pose import Pose, nearest_rotation
from semviz_core.solving.association import Doubt, associate
from semviz_core.solving.least_squares import Fit, fit
from semviz_core.solving.residuals import Scene, scene_residuals

NEEDED_PAIRS = 3
"""Two pairs fix an upright pose; a third is the first that can contradict them."""
MOST_SIGMA_M = 2.0
"""A pose less certain than this along any direction is no answer."""
MOST_SIGMA_RAD = float(np.deg2rad(5.0))
START_DOUBT = Doubt(0.15, float(np.deg2rad(0.3)))
"""How far off the pose may be that refinement starts from."""
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
    camera: Camera,
    prior: Prior,
    T_camera_map: Pose,
    pairs: IntArray | None = None,
) -> Refined | Failure:
    """Robust least squares over pairs and prior, from ``T_camera_map``.

    With ``pairs`` (k, 2) those are kept (the paper's eq. 8 with a Boolean P); without, pairs are
    chosen one-to-one again after each fit until they stay the same.
    """
    start = T_camera_map.rotation[None], T_camera_map.translation[None]
    if pairs is None:
        match = _settled_match(scene, camera, prior, *start)
    else:
        match = np.full((1, len(scene.anchor_px)), -1, dtype=np.int64)
        match[0, pairs[:, 0]] = pairs[:, 1]
    if (count := int((match >= 0).sum())) < NEEDED_PAIRS:
        seen = len(scene.anchor_px)
        return Failure(f"{count} of {seen} elements fit one pose, {NEEDED_PAIRS} needed.")
    best = fit(scene, prior, *start, match, _ITERATIONS)
    # covariances of residuals change with the pose: once more with those of the optimum
    final = fit(scene, prior, best.rotation, best.translation, match, _ITERATIONS)
    covariance = np.linalg.inv(final.information[0])
    if reason := _too_uncertain(covariance):
        return Failure(reason)
    return _refined(scene, final, match, covariance, best.cost_trace[:, 0])


def _settled_match(
    scene: Scene, camera: Camera, prior: Prior, rotation: FloatArray, translation: FloatArray
) -> IntArray:
    """(1, m) one-to-one pairs that don't change when the pose is fitted to them."""
    match, _, _ = associate(scene, camera, rotation, translation, START_DOUBT)
    for _ in range(_ROUNDS):
        nearer = fit(scene, prior, rotation, translation, match, _ITERATIONS)
        rotation, translation = nearer.rotation, nearer.translation
        before = match
        match, _, _ = associate(scene, camera, rotation, translation)
        if np.array_equal(match, before):
            break
    return match


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


def _refined(
    scene: Scene, final: Fit, match: IntArray, covariance: FloatArray, cost_trace: FloatArray
) -> Refined:
    pose = Pose(nearest_rotation(final.rotation[0]), final.translation[0])
    seen = np.flatnonzero(match[0] >= 0)
    pairs = np.column_stack([seen, match[0, seen]])
    residuals = scene_residuals(scene, pose, pairs)
    refinement = Refinement(
        pairs, residuals.residual_px, residuals.chi2, residuals.inlier, cost_trace
    )
    return Refined(pose, covariance, refinement)
