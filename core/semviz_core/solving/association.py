"""Which observed element is which mapped one under a pose, and how well that explains the image.

A log-likelihood in nats: each pair against a false detection, each mapped element in view without a
pair against a missed one, and the prior. One-to-one: two detections never share a mapped element.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.frame import Prior
from semviz_core.solving.residuals import (
    INLIER_CHI2,
    Rows,
    Scene,
    pair_chi2,
    prior_rows,
    residual_rows,
    whitening,
)

FALSE_DETECTIONS = 1.5
"""Expected number in an image of detections that are nothing in the map."""
RECALL_NEAR, RECALL_FAR = 0.6, 0.1
"""Chance that a mapped element in view is detected, up to NEAR_M and beyond FAR_M. Lower than
detectors reach, because buildings, hedges and cars hide what the map cannot know of."""
NEAR_M, FAR_M = 20.0, 45.0
CLUTTER_LEAN = 0.1
"""False poles lean evenly up to this slope to either side."""
_NONE = -np.inf


@dataclass(frozen=True)
class Doubt:
    """How far a pose may be off when elements are paired: widens the gates of near elements."""

    position_m: float = 0.0
    rotation_rad: float = 0.0


SURE = Doubt()


def associate(
    scene: Scene, camera: Camera, rotation: FloatArray, translation: FloatArray, doubt: Doubt = SURE
) -> tuple[IntArray, FloatArray, FloatArray]:
    """One-to-one pairs under b poses: mapped row of each observed element (b, m), -1 for none;
    the gain of each pair (b, m) in nats, 0 for none; and all gains (b, m, n), -inf beyond the gate.
    """
    gain = pair_gains(scene, camera, rotation, translation, doubt)
    match, chosen = one_to_one(gain)
    return match, chosen, gain


def pair_gains(
    scene: Scene, camera: Camera, rotation: FloatArray, translation: FloatArray, doubt: Doubt = SURE
) -> FloatArray:
    """(b, m, n) log-likelihood of each pair over that of a false detection; -inf where it fails
    the inlier test."""
    b, m, n = _near(scene, rotation, translation, doubt)
    gains = np.full((len(rotation), *scene.compatible.shape), _NONE)
    if not len(b):
        return gains
    seen, mapped = m[:, None], n[:, None]
    turn, move = rotation[b], translation[b]
    rows = residual_rows(scene, turn, move, seen, mapped)
    if doubt != SURE:
        white = _doubtful_whitening(scene, turn, rows, seen, mapped, doubt)
    else:
        white = whitening(scene, turn, rows, seen, mapped)
    chi2 = pair_chi2(rows, white)[:, 0]
    used = rows.used[:, 0]
    density = np.log(np.diagonal(white[:, 0], axis1=-2, axis2=-1)) - 0.5 * np.log(2.0 * np.pi)
    clutter = _clutter_log_density(scene, camera)[m]
    gain = -0.5 * chi2 + ((density - clutter) * used).sum(axis=1) - np.log(FALSE_DETECTIONS)
    gains[b, m, n] = np.where(chi2 <= INLIER_CHI2[used.sum(axis=1)], gain, _NONE)
    return gains


def one_to_one(gain: FloatArray) -> tuple[IntArray, FloatArray]:
    """Greedy pairs by positive gain (b, m, n): the mapped row (b, m) or -1, and the gain or 0."""
    b, m, n = gain.shape
    left = gain.copy()
    match = np.full((b, m), -1, dtype=np.int64)
    chosen = np.zeros((b, m))
    if not gain.size:
        return match, chosen
    batch = np.arange(b)
    for _ in range(m):
        best = left.reshape(b, -1).argmax(axis=1)
        i, j = best // n, best % n
        value = left[batch, i, j]
        take = value > 0.0
        if not take.any():
            break
        match[batch[take], i[take]] = j[take]
        chosen[batch[take], i[take]] = value[take]
        left[batch, i, :] = _NONE
        left[batch, :, j] = _NONE
    return match, chosen


def log_likelihood(
    scene: Scene,
    camera: Camera,
    prior: Prior,
    rotation: FloatArray,
    translation: FloatArray,
    match: IntArray,
    gain: FloatArray,
) -> FloatArray:
    """(b,) nats of poses with their pairs: gains, misses and the prior."""
    recall = _recall(scene, camera, rotation, translation)
    paired = np.zeros((len(match), scene.compatible.shape[1] + 1), dtype=bool)
    np.put_along_axis(paired, match, True, axis=1)  # -1 lands in the last column
    found = paired[:, :-1]
    # a pair beyond the stated reach of detection is unlikely, not impossible
    seen = np.log(np.maximum(recall, RECALL_FAR))
    misses = np.where(found, seen, np.log1p(-recall)).sum(axis=1)
    residual, _ = prior_rows(prior, rotation, translation)
    total: FloatArray = gain.sum(axis=1) + misses - 0.5 * (residual**2).sum(axis=1)
    return total


def _near(
    scene: Scene, rotation: FloatArray, translation: FloatArray, doubt: Doubt
) -> tuple[IntArray, IntArray, IntArray]:
    """Batch, observed and mapped rows of pairs close enough in angle to be worth a residual."""
    focal = scene.K[0, 0]
    anchor_c = scene.anchor_m @ np.swapaxes(rotation, -1, -2) + translation[:, None, :]
    reach = np.linalg.norm(anchor_c, axis=-1)
    toward = anchor_c / np.maximum(reach, 1e-6)[..., None]
    inverse = np.linalg.inv(scene.K).T
    ones = np.ones((len(scene.anchor_px), 1))
    first = np.concatenate([scene.anchor_px, ones], axis=1) @ inverse
    second = np.concatenate([scene.end_px, ones], axis=1) @ inverse
    plane = np.cross(first, second)
    plane /= np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-9)
    ray = first / np.linalg.norm(first, axis=1, keepdims=True)
    aside = np.abs(plane @ np.swapaxes(toward, -1, -2))  # (b, m, n)
    cosine = ray @ np.swapaxes(toward, -1, -2)
    off = np.sqrt(np.maximum(2.0 - 2.0 * cosine, 0.0))
    angle = np.where(scene.is_line[:, None], aside, off)
    mapped = np.trace(scene.covariance_m2, axis1=1, axis2=2) + doubt.position_m**2
    seen = scene.variance_px2.max(axis=1) / focal**2 + doubt.rotation_rad**2
    variance = seen[None, :, None] + (mapped / np.maximum(reach, 1.0) ** 2)[:, None, :]
    gate = 1.5 * np.sqrt(INLIER_CHI2[-1] * variance)  # wider than the test that follows
    near = scene.compatible & (angle < gate) & (cosine > 0.5)
    b, m, n = np.nonzero(near)
    return b, m, n


def _doubtful_whitening(
    scene: Scene,
    rotation: FloatArray,
    rows: Rows,
    seen: IntArray,
    mapped: IntArray,
    doubt: Doubt,
) -> FloatArray:
    white = whitening(scene, rotation, rows, seen, mapped)
    sigma = np.repeat([doubt.position_m, doubt.rotation_rad], 3)
    spread = white @ rows.jacobian() * sigma
    inflated = np.eye(4) + spread @ np.swapaxes(spread, -1, -2)
    widened: FloatArray = np.linalg.inv(np.linalg.cholesky(inflated)) @ white
    return widened


def _clutter_log_density(scene: Scene, camera: Camera) -> FloatArray:
    """(m, 4) log density (per px) of each residual row for a false detection."""
    wide, high = np.log(camera.width), np.log(camera.height)
    length = np.linalg.norm(scene.end_px - scene.anchor_px, axis=1)
    lean = np.log(np.maximum(2.0 * CLUTTER_LEAN * length, 1.0))
    second = np.where(scene.is_line, lean, high)
    first = np.full_like(second, wide)
    along = np.full_like(second, high)
    return -np.stack([first, second, along, along], axis=1)


def _recall(
    scene: Scene, camera: Camera, rotation: FloatArray, translation: FloatArray
) -> FloatArray:
    """(b, n) chance that each mapped element is detected; 0 out of view."""
    middle = 0.5 * (scene.anchor_m + scene.end_m)
    middle_c = middle @ np.swapaxes(rotation, -1, -2) + translation[:, None, :]
    depth = np.maximum(middle_c[..., 2], 1e-3)
    pixel = (middle_c / depth[..., None]) @ scene.K.T
    inside = (
        (middle_c[..., 2] > 3.0)
        & (np.abs(pixel[..., 0] - 0.5 * camera.width) < 0.5 * camera.width)
        & (np.abs(pixel[..., 1] - 0.5 * camera.height) < 0.5 * camera.height)
    )
    share = np.clip((depth - NEAR_M) / (FAR_M - NEAR_M), 0.0, 1.0)
    return np.where(inside, RECALL_NEAR + share * (RECALL_FAR - RECALL_NEAR), 0.0)
