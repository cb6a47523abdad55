"""Start poses for a batch: the paper's P3P-RANSAC over the surest pairs of P (section V-A)."""

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.learning.batch import Batch
from semviz_core.solving.matched.p3p import SAMPLE, Points, most_inliers
from semviz_core.solving.matched.soft import surest_pairs


@dataclass(frozen=True, eq=False)
class StartPoses:
    """Of T_camera_local."""

    rotation: FloatArray
    """(b, 3, 3)"""
    translation: FloatArray
    """(b, 3) metres."""
    ok: BoolArray
    """(b,) False where fewer than four points are known among the surest pairs, or no pose brings
    as many within the threshold; the pose is the identity then."""


def start_poses(probability: Tensor, batch: Batch, seed: int) -> StartPoses:
    """Poses from P (b, m, n); item k draws its samples with ``seed + k``."""
    b = len(batch)
    found = StartPoses(np.tile(np.eye(3), (b, 1, 1)), np.zeros((b, 3)), np.zeros(b, dtype=bool))
    P = probability.detach().double().cpu().numpy()
    rays = _unit(np.stack([_numbers(batch.ray), _numbers(batch.bottom_ray)]))
    points = np.stack([_numbers(batch.point_m), _numbers(batch.bottom_m)])
    seen_known, mapped_known = batch.seen_known.cpu().numpy(), batch.mapped_known.cpu().numpy()
    counts = batch.seen.sum(dim=1).tolist()
    for k in range(b):
        i, j = surest_pairs(P[k], counts[k]).T
        known = seen_known[k, i] & mapped_known[k, j]
        if known.sum() < SAMPLE:
            continue
        surest = Points.of(i, known, rays[:, k, i], points[:, k, j])
        rotation, translation, inliers, _ = most_inliers(surest, seed + k)
        if inliers >= SAMPLE:
            found.rotation[k], found.translation[k], found.ok[k] = rotation, translation, True
    return found


def _numbers(tensor: Tensor) -> FloatArray:
    array: FloatArray = tensor.detach().double().cpu().numpy()
    return array


def _unit(vectors: FloatArray) -> FloatArray:
    """Again of length 1, which float32 is only to six digits: 0.003 rad are 4e-6 of a cosine."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
