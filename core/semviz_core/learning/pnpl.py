"""Weighted PnPL (eq. 6-7) as a layer: poses of a batch from P, with the gradient of the optimum.

Unlike the paper's L-BFGS the optimum is found to second order (``solving.matched.weighted``), to
the same cost. The gradient is implicit (Gould et al. 2021), one 6x6 solve for each frame, and not
clipped: frames whose optimum is none are told and have no gradient instead.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from semviz_core.arrays import FloatArray
from semviz_core.learning.batch import Batch
from semviz_core.learning.coarse import StartPoses
from semviz_core.solving.matched.soft import points_and_lines, weighted_sums
from semviz_core.solving.matched.weighted import Optimum, Weighted, weight_gradient, weighted_pnpl

MOST_SHIFT_M = 20.0
"""An optimum that is further from its start refines nothing: with uniform priors, which put most of
P on wrong pairs, eq. 6 has one 100 m away, whose loss would drown eq. 9."""


def differentiable_pnpl(
    probability: Tensor, batch: Batch, start: StartPoses
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation (b, 3, 3), translation (b, 3) of T_camera_local, float64, and which are ok (b,).

    ``probability`` is the P (b, m, n) of eq. 7: f_p sums over pairs whose peaks (or middles) are
    known on both sides, f_l over pairs of lines. What is not ok had no start, did not converge to
    a minimum nearby, or to one that P does not fix: it is its start, and has no gradient.
    """
    is_point, is_line = (one.to(torch.float64) for one in _pairs(batch))
    weights = probability.double() * is_point, probability.double() * is_line
    sums = _sums(batch), start
    found = _Pnpl.apply(*weights, *sums)  # type: ignore[no-untyped-call]
    return found[0], found[1], found[2]


class _Pnpl(torch.autograd.Function):
    """From weights (b, m, n) of points and of lines."""

    @staticmethod
    def forward(
        ctx: Any, point_weight: Tensor, line_weight: Tensor, fixed: Weighted, start: StartPoses
    ) -> tuple[Tensor, Tensor, Tensor]:
        at = start.ok[:, None, None]
        weights = (np.where(at, _numbers(one), 0.0) for one in (point_weight, line_weight))
        ctx.of = fixed._replace(point_weight=next(weights), line_weight=next(weights))
        ctx.found = _near(start, weighted_pnpl(ctx.of, start.rotation, start.translation))
        rotation, translation, _, ok, _ = (
            torch.from_numpy(one).to(point_weight.device) for one in ctx.found
        )
        ctx.mark_non_differentiable(ok)
        return rotation, translation, ok

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_rotation: Tensor, by_translation: Tensor, _: Tensor
    ) -> tuple[Tensor, Tensor, None, None]:
        by_pose = _by_perturbation(ctx.found, _numbers(by_rotation), _numbers(by_translation))
        by_point, by_line = (
            torch.from_numpy(one).to(by_rotation.device)
            for one in weight_gradient(ctx.of, ctx.found, by_pose)
        )
        return by_point, by_line, None, None


def _near(start: StartPoses, found: Optimum) -> Optimum:
    """Those further than MOST_SHIFT_M from their start are not ok."""
    before = _centre(start.rotation, start.translation)
    shift_m = np.linalg.norm(_centre(found.rotation, found.translation) - before, axis=1)
    ok = found.ok & (shift_m < MOST_SHIFT_M)
    rotation = np.where(ok[:, None, None], found.rotation, start.rotation)
    translation = np.where(ok[:, None], found.translation, start.translation)
    return found._replace(rotation=rotation, translation=translation, ok=ok)


def _centre(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """(b, 3) of the cameras, local coordinates."""
    return np.asarray(-np.einsum("bji,bj->bi", rotation, translation))


def _by_perturbation(
    found: Optimum, by_rotation: FloatArray, by_translation: FloatArray
) -> FloatArray:
    """(b, 6) slope by the left perturbation exp(xi) T, translation before rotation."""
    turned = by_rotation @ found.rotation.swapaxes(1, 2)
    twist = turned - turned.swapaxes(1, 2)
    by_turn = np.stack([twist[:, 2, 1], twist[:, 0, 2], twist[:, 1, 0]], axis=1)
    by_turn += np.cross(found.translation, by_translation)
    return np.concatenate([by_translation, by_turn], axis=1)


def _pairs(batch: Batch) -> tuple[Tensor, Tensor]:
    """(b, m, n) whether pairs count as points, and whether as lines."""
    known = batch.seen_known.cpu().numpy(), batch.mapped_known.cpu().numpy()
    points, lines = points_and_lines(*_ends(batch), *known)
    device = batch.ray.device
    return torch.from_numpy(points).to(device), torch.from_numpy(lines).to(device)


def _sums(batch: Batch) -> Weighted:
    """Rays and points of eq. 7, with weights still to come."""
    ray, bottom_ray, point_m, bottom_m = _ends(batch)
    # again of length 1, which float32 is only to six digits
    return weighted_sums(_unit(ray), _unit(bottom_ray), point_m, bottom_m)


def _ends(batch: Batch) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    ends = batch.ray, batch.bottom_ray, batch.point_m, batch.bottom_m
    ray, bottom_ray, point_m, bottom_m = (_numbers(one) for one in ends)
    return ray, bottom_ray, point_m, bottom_m


def _numbers(tensor: Tensor) -> FloatArray:
    array: FloatArray = np.ascontiguousarray(tensor.detach().double().cpu().numpy())
    return array


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
