"""Train the paper's matcher and its baselines with the paper's losses (eq. 9-11).

The correspondence loss is eq. 9; the pose loss is eq. 10, combined by eq. 11. Its pose is that of
weighted PnPL (eq. 6-7) as a torch layer. Unlike the paper's L-BFGS, the optimum is found to second
order (`weighted_pnpl`), at the same cost. The gradient is implicit (Gould et al. 2021), one 6x6
solve a frame, and not clipped. A frame without an optimum is flagged and has no gradient. Start
poses come from the paper's P3P-RANSAC over the likeliest pairs of P (section V-A).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.common.arrays import BoolArray, FloatArray, unit_vectors
from semviz_core.common.jit import in_order
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.localization.matched.p3p_ransac import SAMPLE, Points, most_inliers
from semviz_core.research.paper import weighted_pnpl
from semviz_core.research.paper.matcher import MODELS, options_of, split_lines
from semviz_core.research.paper.matcher_torch import GraphMatcher
from semviz_core.research.training.batch import Batch, BatchTruth, Progress, SampleSource, cosine
from semviz_core.research.training.simulated_samples import PAPER_DISTRIBUTION

_FRAMES_PER_THREAD, _MOST_THREADS = 50, 3
"""RANSAC takes most of a step of a large batch on a GPU."""


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
    # normalized again, since float32 has six digits: 0.003 rad are 4e-6 of a cosine
    rays = unit_vectors(np.stack([_as_array(batch.ray), _as_array(batch.bottom_ray)]))
    points = np.stack([_as_array(batch.point_m), _as_array(batch.bottom_m)])
    seen_known, mapped_known = batch.seen_known.cpu().numpy(), batch.mapped_known.cpu().numpy()
    counts = batch.seen.sum(dim=1).tolist()

    def fill(k: int) -> None:
        i, j = weighted_pnpl.most_probable_pairs(P[k], counts[k]).T
        known = seen_known[k, i] & mapped_known[k, j]
        if known.sum() < SAMPLE:
            return
        likeliest = Points.of(i, known, rays[:, k, i], points[:, k, j])
        rotation, translation, inliers, _ = most_inliers(likeliest, seed + k)
        if inliers >= SAMPLE:
            starts.rotation[k], starts.translation[k], starts.ok[k] = rotation, translation, True

    threads = min(b // _FRAMES_PER_THREAD + 1, _MOST_THREADS)
    for _ in in_order(fill, range(b), threads):
        pass
    return starts


def _as_array(tensor: Tensor) -> FloatArray:
    array: FloatArray = tensor.detach().double().cpu().numpy()
    return array


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
    is_point, is_line = (pair.to(probability.device, torch.float64) for pair in _pairs(batch))
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
    return torch.from_numpy(points), torch.from_numpy(lines)


def _sums(batch: Batch) -> weighted_pnpl.Weighted:
    """Return the terms of eq. 7 without weights."""
    ray, bottom_ray, point_m, bottom_m = _ends(batch)
    return weighted_pnpl.weighted_sums(
        unit_vectors(ray), unit_vectors(bottom_ray), point_m, bottom_m
    )


def _ends(batch: Batch) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    ends = batch.ray, batch.bottom_ray, batch.point_m, batch.bottom_m
    ray, bottom_ray, point_m, bottom_m = (_contiguous_array(end) for end in ends)
    return ray, bottom_ray, point_m, bottom_m


def _contiguous_array(tensor: Tensor) -> FloatArray:
    array: FloatArray = np.ascontiguousarray(tensor.detach().double().cpu().numpy())
    return array


_NO_ANGLE = 1e-9
"""The gradient of angles and distances (rad, m) below this fades to 0."""


def correspondence_loss(P: Tensor, pairs: Tensor, possible: Tensor) -> Tensor:
    """Return the loss (b,) of eq. 9 for P: from 1 (no mass on ``pairs``) to -1.

    It differs from the paper, which gives no scale, in two ways. The sum of P is constant, so only
    true pairs matter. And each true pair counts alike, by its share of the most that uniform priors
    allow: the smaller of 1 / m and 1 / n of its block. Otherwise pairs of small blocks would count
    more, and pairs of crowded maps hardly. It equals eq. 9 if m = n = the number of pairs in one
    block.
    """
    seen_in_block, mapped_in_block = (
        possible.sum(dim=1, keepdim=True),
        possible.sum(dim=2)[..., None],
    )
    share = P * torch.maximum(seen_in_block, mapped_in_block)
    true = pairs & possible
    return 1.0 - 2.0 * (share * true).sum(dim=(1, 2)) / true.sum(dim=(1, 2)).clamp_min(1)


def pose_loss(
    rotation: Tensor, translation: Tensor, true_rotation: Tensor, true_translation: Tensor
) -> Tensor:
    """Return the loss (b,) of eq. 10: the angle (rad) between rotations plus the distance (m).

    As in eq. 10, the distance is that of translations of T_camera_local, which differs from the
    distance of the cameras if the angle is wrong. The arccos of eq. 10 has no digits and no
    gradient near 0, so the angle is computed from its sine and cosine.
    """
    between = true_rotation.transpose(1, 2) @ rotation
    cosine = 0.5 * (between.diagonal(dim1=1, dim2=2).sum(dim=1) - 1.0)
    twice = between - between.transpose(1, 2)
    sine = 0.5 * _length(torch.stack([twice[:, 2, 1], twice[:, 0, 2], twice[:, 1, 0]], dim=1))
    return torch.atan2(sine, cosine) + _length(translation - true_translation)


def whole_loss(correspondence: Tensor, pose: Tensor, ok: Tensor, gamma: float) -> Tensor:
    """Return eq. 11 averaged over the batch; items whose pose is not ``ok`` have no pose loss."""
    return (correspondence + gamma * torch.where(ok, pose, 0.0)).mean()


def _length(vector: Tensor) -> Tensor:
    """Return the lengths (b,) of vectors (b, 3)."""
    return torch.sqrt((vector**2).sum(dim=1) + _NO_ANGLE**2) - _NO_ANGLE


PAPER_SAMPLES = 596_800
"""200 epochs of the paper's 2984 frames."""
POSE_FROM = 120 / 200
"""Share of the training from which on the pose loss counts."""
_FEW = 5


class PaperTask:
    """Training of a matcher of ``MODELS`` on frames with ground truth."""

    samples = PAPER_SAMPLES

    def __init__(self, name: str, source: SampleSource, classes: ClassSet = DEFAULT_CLASSES):
        self.name = name
        self.source = source
        self.model = MODELS[name]
        self.network = GraphMatcher(self.model, len(classes))
        options = options_of(name, [class_.name for class_ in classes])
        self.options: dict[str, Any] = {**options, "data": source.describe()}

    def learning_rate(self, progress: Progress) -> float:
        """Return the paper's rate at most; the paper does not state that it falls."""
        return cosine(progress)

    def make(self, number: int) -> Sample:
        return self._of(self.source.sample(number))

    def held_out(self, number: int) -> Sample:
        return self._of(self.source.held_out(number))

    def _of(self, sample: Sample) -> Sample:
        return sample if self.model.lines else split_lines(sample)

    def collate(self, items: Sequence[Sample]) -> Batch:
        return Batch.of(items)

    def losses(self, batch: Batch, progress: Progress) -> dict[str, Tensor]:
        """Return the loss of eq. 11; gamma is 0 at first, then 1."""
        P = self.network(batch).probability
        truth = _truth(batch)
        possible = self.network.possible(batch)
        correspondence = correspondence_loss(P, truth.pairs, possible)
        if progress.share < POSE_FROM:
            return {"loss": correspondence.mean()}
        on_cpu = batch.to(torch.device("cpu"))  # once, since each number waits for the GPU
        start = start_poses(P, on_cpu, progress.samples)
        rotation, translation, ok = differentiable_pnpl(P, on_cpu, start)
        pose = pose_loss(rotation, translation, truth.rotation, truth.translation)
        return {
            "loss": whole_loss(correspondence, pose, ok, gamma=1.0),
            "correspondence": correspondence.mean(),
            "pose": (pose * ok).sum() / ok.sum().clamp_min(1),
            "ok": ok.double().mean(),
        }

    def finish(self) -> None:
        """Do nothing."""

    def figures(self, batch: Batch) -> dict[str, Tensor]:
        """Return the shares of true pairs that are the most probable, or among the five most
        probable, of their observed element; and the share of P on true pairs."""
        P = self.network(batch).probability
        pairs = _truth(batch).pairs
        paired = pairs.any(dim=2)
        order = P.topk(min(_FEW, P.shape[2]), dim=2).indices
        hit = pairs.gather(2, order)[paired].double()
        loss = correspondence_loss(P, pairs, self.network.possible(batch))
        return {
            "correspondence": loss.mean(),
            "top1": hit[:, 0].mean(),
            "top5": hit.amax(dim=1).mean(),
            "true_mass": ((P * pairs).sum(dim=(1, 2)) / P.sum(dim=(1, 2))).mean(),
        }


def make_task(name: str, source: SampleSource | None) -> PaperTask:
    """Return the task with new weights (default source: simulated roads)."""
    return PaperTask(name, source or PAPER_DISTRIBUTION)


def _truth(batch: Batch) -> BatchTruth:
    if batch.truth is None:
        raise ValueError("training needs samples with a truth")
    return batch.truth
