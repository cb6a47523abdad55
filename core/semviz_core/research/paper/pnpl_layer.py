"""Weighted PnPL (eq. 6-7) as a torch layer: poses of a batch from P, with their gradients.

Unlike the paper's L-BFGS, the optimum is found to second order (`weighted_pnpl`), at the same
cost. The gradient is implicit (Gould et al. 2021), one 6x6 solve a frame, and not clipped. A
frame without an optimum is flagged and has no gradient. Start poses come from the paper's
P3P-RANSAC over the likeliest pairs of P (section V-A).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.localization.matched.p3p_ransac import SAMPLE, Points, most_inliers
from semviz_core.research.paper import weighted_pnpl
from semviz_core.research.training.batch import Batch


@dataclass(frozen=True, eq=False)
class StartPoses:
    """Start poses T_camera_local of a batch."""

    rotation: FloatArray
    """(b, 3, 3)"""
    translation: FloatArray
    """(b, 3) metres."""
    ok: BoolArray
    """(b,) False, with the identity as pose, if fewer than four points are known among the most
    probable pairs, or if no pose brings as many within the threshold."""


def start_poses(probability: Tensor, batch: Batch, seed: int) -> StartPoses:
    """Return start poses from P (b, m, n); item k draws its samples with ``seed + k``."""
    b = len(batch)
    starts = StartPoses(np.tile(np.eye(3), (b, 1, 1)), np.zeros((b, 3)), np.zeros(b, dtype=bool))
    P = probability.detach().double().cpu().numpy()
    rays = _unit(np.stack([_as_array(batch.ray), _as_array(batch.bottom_ray)]))
    points = np.stack([_as_array(batch.point_m), _as_array(batch.bottom_m)])
    seen_known, mapped_known = batch.seen_known.cpu().numpy(), batch.mapped_known.cpu().numpy()
    counts = batch.seen.sum(dim=1).tolist()
    for k in range(b):
        i, j = weighted_pnpl.most_probable_pairs(P[k], counts[k]).T
        known = seen_known[k, i] & mapped_known[k, j]
        if known.sum() < SAMPLE:
            continue
        likeliest = Points.of(i, known, rays[:, k, i], points[:, k, j])
        rotation, translation, inliers, _ = most_inliers(likeliest, seed + k)
        if inliers >= SAMPLE:
            starts.rotation[k], starts.translation[k], starts.ok[k] = rotation, translation, True
    return starts


def _as_array(tensor: Tensor) -> FloatArray:
    array: FloatArray = tensor.detach().double().cpu().numpy()
    return array


def _unit(vectors: FloatArray) -> FloatArray:
    """Normalize again, since float32 has six digits: 0.003 rad are 4e-6 of a cosine."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


MOST_SHIFT_M = 20.0
"""Optima further from their start are rejected. Uniform priors put most of P on wrong pairs; eq. 6
can then have an optimum 100 m away, whose loss would dominate eq. 9."""


def differentiable_pnpl(
    probability: Tensor, batch: Batch, start: StartPoses
) -> tuple[Tensor, Tensor, Tensor]:
    """Return rotation (b, 3, 3) and translation (b, 3) of T_camera_local, float64, and ok (b,).

    ``probability`` is the P (b, m, n) of eq. 7: f_p sums over pairs whose peaks (or centers) are
    known on both sides, f_l over pairs of lines. A pose that is not ok had no start, did not
    converge nearby, or is not fixed by P. It equals its start and has no gradient.
    """
    is_point, is_line = (pair.to(torch.float64) for pair in _pairs(batch))
    weights = probability.double() * is_point, probability.double() * is_line
    sums = _sums(batch), start
    optimum = _PnplFunction.apply(*weights, *sums)  # type: ignore[no-untyped-call]
    return optimum[0], optimum[1], optimum[2]


class _PnplFunction(torch.autograd.Function):
    """PnPL as a function of the weights (b, m, n) of points and of lines."""

    @staticmethod
    def forward(
        ctx: Any,
        point_weight: Tensor,
        line_weight: Tensor,
        fixed: weighted_pnpl.Weighted,
        start: StartPoses,
    ) -> tuple[Tensor, Tensor, Tensor]:
        has_start = start.ok[:, None, None]
        weights = (
            np.where(has_start, _contiguous_array(array), 0.0)
            for array in (point_weight, line_weight)
        )
        ctx.of = fixed._replace(point_weight=next(weights), line_weight=next(weights))
        ctx.found = _near(
            start, weighted_pnpl.minimize_weighted(ctx.of, start.rotation, start.translation)
        )
        rotation, translation, _, ok, _ = (
            torch.from_numpy(array).to(point_weight.device) for array in ctx.found
        )
        ctx.mark_non_differentiable(ok)
        return rotation, translation, ok

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_rotation: Tensor, by_translation: Tensor, _: Tensor
    ) -> tuple[Tensor, Tensor, None, None]:
        pose = ctx.found.rotation, ctx.found.translation
        by_pose = by_perturbation(
            *pose, _contiguous_array(by_rotation), _contiguous_array(by_translation)
        )
        by_point, by_line = (
            torch.from_numpy(array).to(by_rotation.device)
            for array in weighted_pnpl.weight_gradient(ctx.of, ctx.found, by_pose)
        )
        return by_point, by_line, None, None


def _near(start: StartPoses, optimum: weighted_pnpl.Optimum) -> weighted_pnpl.Optimum:
    """Return the optima; those further than MOST_SHIFT_M from their start are not ok."""
    start_m = _centre(start.rotation, start.translation)
    shift_m = np.linalg.norm(_centre(optimum.rotation, optimum.translation) - start_m, axis=1)
    ok = optimum.ok & (shift_m < MOST_SHIFT_M)
    rotation = np.where(ok[:, None, None], optimum.rotation, start.rotation)
    translation = np.where(ok[:, None], optimum.translation, start.translation)
    return optimum._replace(rotation=rotation, translation=translation, ok=ok)


def _centre(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the camera centres (b, 3) in local coordinates."""
    return np.asarray(-np.einsum("bji,bj->bi", rotation, translation))


def by_perturbation(
    rotation: FloatArray,
    translation: FloatArray,
    by_rotation: FloatArray,
    by_translation: FloatArray,
) -> FloatArray:
    """Return the gradient (b, 6) by the left perturbation exp(xi) T, translation first, given those
    by the rotations (b, 3, 3) and translations (b, 3)."""
    turned = by_rotation @ rotation.swapaxes(1, 2)
    twist = turned - turned.swapaxes(1, 2)
    by_turn = np.stack([twist[:, 2, 1], twist[:, 0, 2], twist[:, 1, 0]], axis=1)
    by_turn += np.cross(translation, by_translation)
    return np.concatenate([by_translation, by_turn], axis=1)


def _pairs(batch: Batch) -> tuple[Tensor, Tensor]:
    """Return (b, m, n) whether pairs count as points, and whether as lines."""
    known = batch.seen_known.cpu().numpy(), batch.mapped_known.cpu().numpy()
    points, lines = weighted_pnpl.points_and_lines(*_ends(batch), *known)
    device = batch.ray.device
    return torch.from_numpy(points).to(device), torch.from_numpy(lines).to(device)


def _sums(batch: Batch) -> weighted_pnpl.Weighted:
    """Return the terms of eq. 7 without weights."""
    ray, bottom_ray, point_m, bottom_m = _ends(batch)
    return weighted_pnpl.weighted_sums(_unit(ray), _unit(bottom_ray), point_m, bottom_m)


def _ends(batch: Batch) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    ends = batch.ray, batch.bottom_ray, batch.point_m, batch.bottom_m
    ray, bottom_ray, point_m, bottom_m = (_contiguous_array(end) for end in ends)
    return ray, bottom_ray, point_m, bottom_m


def _contiguous_array(tensor: Tensor) -> FloatArray:
    array: FloatArray = np.ascontiguousarray(tensor.detach().double().cpu().numpy())
    return array
