"""Prior-guided upright search: from classes and a rough position to poses that explain the image.

Class-consistent pairs of matches give upright candidates (``hypotheses``); azimuths and slopes rate
them quickly (``rating``); the best distinct ones are paired one-to-one and fitted together, with
gates that narrow as they settle; what remains are the modes, best first.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.frame import Prior
from semviz_core.solving.association import SURE, Doubt, associate, log_likelihood
from semviz_core.solving.hypotheses import Hypotheses, upright_hypotheses
from semviz_core.solving.least_squares import fit
from semviz_core.solving.rating import rate
from semviz_core.solving.residuals import Scene
from semviz_core.solving.upright import UprightView, upright_view

STARTED, FINISHED = 32, 10
"""Candidates that are paired and fitted once, and those of them that are fitted to the end."""
MOST_COMPARED = 1000
"""Candidates, by rating, among which distinct ones are looked for."""
APART_M, APART_RAD = 1.0, float(np.deg2rad(2.0))
"""Poses further apart than either are different answers."""
NARROWING = (Doubt(0.5, float(np.deg2rad(1.5))), Doubt(0.15, float(np.deg2rad(0.3))), SURE, SURE)


@dataclass(frozen=True, eq=False)
class Modes:
    """b distinct poses, best first, with their pairs."""

    tried: int
    passed: int
    """Hypotheses within the gates of the prior."""
    rotation: FloatArray  # (b, 3, 3)
    translation: FloatArray  # (b, 3)
    score: FloatArray  # (b,) nats
    match: IntArray  # (b, m)
    gain: FloatArray  # (b, m, n)


def search(scene: Scene, camera: Camera, prior: Prior, rng: np.random.Generator) -> Modes:
    """The modes of the pose, best first; none where no hypothesis passes the gates."""
    view = upright_view(scene, prior)
    hypotheses, tried = upright_hypotheses(scene, view, prior, rng)
    best = _distinct_best(hypotheses, rate(scene, view, prior, hypotheses))
    rotation, translation = camera_poses(view, best)
    if len(best):
        rotation, translation = polish(scene, camera, prior, rotation, translation)
    return _modes(scene, camera, prior, rotation, translation, tried, len(hypotheses))


def camera_poses(view: UprightView, hypotheses: Hypotheses) -> tuple[FloatArray, FloatArray]:
    """T_camera_map of upright poses: rotations (h, 3, 3), translations (h, 3)."""
    c, s = np.cos(hypotheses.heading_rad), np.sin(hypotheses.heading_rad)
    level = np.zeros((len(hypotheses), 3, 3))
    level[:, 0, 0], level[:, 0, 1], level[:, 1, 0], level[:, 1, 1] = c, s, -s, c
    level[:, 2, 2] = 1.0
    rotation = view.R_level_camera.T @ level
    return rotation, -(rotation @ hypotheses.position_m[..., None])[..., 0]


def polish(
    scene: Scene, camera: Camera, prior: Prior, rotation: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pair and fit in turns while the gates narrow.

    After the first turn candidates that ran together are merged, so that rivals of a good pose
    are not crowded out by its own copies.
    """
    for turn, doubt in enumerate(NARROWING):
        match, gain, _ = associate(scene, camera, rotation, translation, doubt)
        settled = fit(scene, prior, rotation, translation, match, iterations=4)
        rotation, translation = settled.rotation, settled.translation
        if turn == 0:
            kept = _distinct(rotation, translation, gain.sum(axis=1))[:FINISHED]
            rotation, translation = rotation[kept], translation[kept]
    return rotation, translation


def apart(
    rotation: FloatArray, translation: FloatArray, other_rotation: FloatArray, other: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distances of camera centres (b,) and angles (b,) in radians from one pose to b others."""
    center = -rotation.T @ translation
    centers = -np.einsum("bji,bj->bi", other_rotation, other)
    trace = np.einsum("ij,bij->b", rotation, other_rotation)
    angle = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    return np.linalg.norm(centers - center, axis=1), angle


def _distinct_best(hypotheses: Hypotheses, rating: FloatArray) -> Hypotheses:
    """The best STARTED candidates of which no two are close."""
    order = np.argsort(-rating, kind="stable")[:MOST_COMPARED]
    position, heading = hypotheses.position_m[order], hypotheses.heading_rad[order]
    kept: list[int] = []
    free = np.ones(len(order), dtype=bool)
    while len(kept) < STARTED and free.any():
        row = int(free.argmax())
        kept.append(row)
        near = np.linalg.norm(position[:, :2] - position[row, :2], axis=1) < APART_M
        turned = np.abs(np.angle(np.exp(1j * (heading - heading[row]))))
        free &= ~(near & (turned < 2.0 * APART_RAD))
    return Hypotheses(position[kept], heading[kept])


def _modes(
    scene: Scene,
    camera: Camera,
    prior: Prior,
    rotation: FloatArray,
    translation: FloatArray,
    tried: int,
    passed: int,
) -> Modes:
    """Poses scored, sorted, and those that ran into a better one left out."""
    match, chosen, gain = associate(scene, camera, rotation, translation)
    score = log_likelihood(scene, camera, prior, rotation, translation, match, chosen)
    kept = _distinct(rotation, translation, score)
    return Modes(
        tried, passed, rotation[kept], translation[kept], score[kept], match[kept], gain[kept]
    )


def _distinct(rotation: FloatArray, translation: FloatArray, score: FloatArray) -> list[int]:
    """Rows of poses, best first, without those close to a better one."""
    left = [int(row) for row in np.argsort(-score, kind="stable")]
    kept: list[int] = []
    while left:
        row = left.pop(0)
        kept.append(row)
        away, angle = apart(rotation[row], translation[row], rotation[left], translation[left])
        differs = (away > APART_M) | (angle > APART_RAD)
        left = [one for one, different in zip(left, differs, strict=True) if different]
    return kept
