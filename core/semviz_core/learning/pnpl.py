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
from semviz_core.solving.matched.weighted import Optimum, Weighted, weight_gradient, weighted_pnpl


def differentiable_pnpl(
    probability: Tensor, batch: Batch, start: StartPoses
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation (b, 3, 3), translation (b, 3) of T_camera_local, float64, and which are ok (b,).

    ``probability`` is the P (b, m, n) of eq. 7: f_p sums over pairs whose peaks (or middles) are
    known on both sides, f_l over pairs of lines. What is not ok had no start, did not converge to
    a minimum, or to one that P does not fix: it is its start, and has no gradient.
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
        ctx.found = weighted_pnpl(ctx.of, start.rotation, start.translation)
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
    """(b, m, n) whether pairs count as points, and whether as lines.

    Lines are told by a lower end of their own; all others have theirs at the anchor.
    """
    seen_line = (batch.ray != batch.bottom_ray).any(dim=2)
    mapped_line = (batch.point_m != batch.bottom_m).any(dim=2)
    seen_known, mapped_known = batch.seen_known[..., 0], batch.mapped_known[..., 0]
    points = seen_known[:, :, None] & mapped_known[:, None, :]
    return points, seen_line[:, :, None] & mapped_line[:, None, :]


def _sums(batch: Batch) -> Weighted:
    """Rays and points of eq. 7, with weights still to come."""
    first, last = _unit(_numbers(batch.ray)), _unit(_numbers(batch.bottom_ray))
    peak, bottom = _numbers(batch.point_m), _numbers(batch.bottom_m)
    none = np.zeros((0, 0, 0))
    return Weighted(
        ray=first,
        point_m=peak,
        point_weight=none,
        normal=_unit(np.cross(first, last)),
        line_point_m=peak + _unit(bottom - peak),
        line_weight=none,
    )


def _numbers(tensor: Tensor) -> FloatArray:
    array: FloatArray = np.ascontiguousarray(tensor.detach().double().cpu().numpy())
    return array


def _unit(vectors: FloatArray) -> FloatArray:
    """Of length 1; zeros stay zeros."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-9))
