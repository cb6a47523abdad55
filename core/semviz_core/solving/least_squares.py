"""Robust point-line least squares with priors: Levenberg-Marquardt over a batch of poses."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.frame import Prior
from semviz_core.solving.residuals import Scene, prior_rows, residual_rows, whitening

HUBER_SIGMAS = 3.0
"""Pairs count quadratically up to here (root of chi2), linearly beyond (Huber 1964)."""
STEP_TOLERANCE = 1e-6
"""Converged when no part of a step (m or rad) is larger."""


@dataclass(frozen=True, eq=False)
class Fit:
    """b poses at their optimum."""

    rotation: FloatArray  # (b, 3, 3)
    translation: FloatArray  # (b, 3)
    information: FloatArray  # (b, 6, 6) of the left perturbation, pairs and prior
    cost_trace: FloatArray  # (iterations + 1, b)


@dataclass(frozen=True, eq=False)
class _Linear:
    cost: FloatArray  # (b,)
    gradient: FloatArray  # (b, 6)
    information: FloatArray  # (b, 6, 6)


def fit(
    scene: Scene,
    prior: Prior,
    rotation: FloatArray,
    translation: FloatArray,
    match: IntArray,
    iterations: int = 10,
) -> Fit:
    """Fit b poses to their pairs: ``match`` (b, m) holds mapped rows, -1 for none.

    The covariance of residuals is that of the start and kept, so the cost can only fall.
    """
    seen, mapped, weight = _compact(match)
    rows = residual_rows(scene, rotation, translation, seen, mapped)
    white = whitening(scene, rotation, rows, seen, mapped) * weight[..., None, None]

    def linear(turn: FloatArray, move: FloatArray) -> _Linear:
        return _linearize(scene, prior, turn, move, seen, mapped, white)

    here = linear(rotation, translation)
    damping = np.full(len(rotation), 1e-4)
    trace = [here.cost]
    for _ in range(iterations):
        step = _step(here, damping)
        new_rotation, new_translation = perturbed(rotation, translation, step)
        there = linear(new_rotation, new_translation)
        better = there.cost <= here.cost
        rotation = np.where(better[:, None, None], new_rotation, rotation)
        translation = np.where(better[:, None], new_translation, translation)
        here = _Linear(
            np.where(better, there.cost, here.cost),
            np.where(better[:, None], there.gradient, here.gradient),
            np.where(better[:, None, None], there.information, here.information),
        )
        damping = np.clip(np.where(better, damping * 0.1, damping * 10.0), 1e-9, 1e6)
        trace.append(here.cost)
        if np.abs(step[better]).max(initial=0.0) < STEP_TOLERANCE:
            break
    return Fit(rotation, translation, here.information, np.array(trace))


def perturbed(
    rotation: FloatArray, translation: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """b poses moved by left perturbations (b, 6), to first order in the translation."""
    turn = _rotations(step[:, 3:])
    return turn @ rotation, (turn @ translation[..., None])[..., 0] + step[:, :3]


def _compact(match: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs (b, k) with the used ones first, k the most that any pose has; weight 0 pads."""
    order = np.argsort(match < 0, axis=1, kind="stable")
    most = max(int((match >= 0).sum(axis=1).max(initial=0)), 1)
    seen = order[:, :most]
    mapped = np.take_along_axis(match, seen, axis=1)
    return seen, np.maximum(mapped, 0), (mapped >= 0).astype(np.float64)


def _linearize(
    scene: Scene,
    prior: Prior,
    rotation: FloatArray,
    translation: FloatArray,
    seen: IntArray,
    mapped: IntArray,
    white: FloatArray,
) -> _Linear:
    rows = residual_rows(scene, rotation, translation, seen, mapped)
    residual: FloatArray = (white @ rows.residual[..., None])[..., 0]
    chi2 = (residual**2).sum(axis=-1)
    far = np.maximum(np.sqrt(chi2), HUBER_SIGMAS)
    weight = HUBER_SIGMAS / far
    jacobian = (white @ rows.jacobian()) * np.sqrt(weight)[..., None, None]
    residual *= np.sqrt(weight)[..., None]
    flat = jacobian.reshape(len(rotation), -1, 6)
    prior_residual, prior_jacobian = prior_rows(prior, rotation, translation)
    stacked = np.concatenate([flat, prior_jacobian], axis=1)
    residuals = np.concatenate([residual.reshape(len(rotation), -1), prior_residual], axis=1)
    turned = np.swapaxes(stacked, -1, -2)
    huber = np.where(chi2 <= HUBER_SIGMAS**2, chi2, 2.0 * HUBER_SIGMAS * far - HUBER_SIGMAS**2)
    cost = huber.sum(axis=1) + (prior_residual**2).sum(axis=1)
    return _Linear(cost, (turned @ residuals[..., None])[..., 0], turned @ stacked)


def _step(linear: _Linear, damping: FloatArray) -> FloatArray:
    index = np.arange(6)
    damped = linear.information.copy()
    diagonal = damped[:, index, index]
    damped[:, index, index] = diagonal * (1.0 + damping[:, None]) + 1e-9
    step = np.linalg.solve(damped, -linear.gradient[..., None])[..., 0]
    return np.asarray(step, dtype=np.float64)


def _rotations(rotvec: FloatArray) -> FloatArray:
    """(b, 3, 3) Rodrigues' formula, batched."""
    angle = np.maximum(np.linalg.norm(rotvec, axis=1), 1e-12)[:, None, None]
    K = np.zeros((len(rotvec), 3, 3))
    x, y, z = rotvec.T
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -z, y, -x
    K -= np.swapaxes(K, -1, -2)
    a, b = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    rotations: FloatArray = np.eye(3) + a * K + b * (K @ K)
    return rotations
