"""Train the pair matcher with the likelihood of the true pairs and of no pair, and by the pose.

The pose is that of weighted PnPL, the paper's eq. 6, repaired: residuals are whitened, so a pair
counts by P / sigma^2; only pairs that are accepted at the start count at all; and the prior adds
its rows, so a few pairs fix the pose. The gradient is implicit, d pose = -H^-1 dg (Gould et al.
2021), with the exact Hessian H: Gauss-Newton's matrix would be wrong where residuals are not
small. A pair that is not accepted has no gradient: the pose loss only reweights accepted pairs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.common.linalg import cholesky, rotate_left, solve_cholesky
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.localization.prior_residuals import MOST_ROWS, prior_rows
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.residuals import (
    EXACT_POSE,
    fill_rows,
    new_rows,
    rows_that_count,
    whiten,
    whiten_by_factor,
)
from semviz_core.research.pair_matcher.network import ConsensusNetwork, Prepared
from semviz_core.research.paper.matcher_torch import sinkhorn_with_dustbins
from semviz_core.research.paper.training import by_perturbation
from semviz_core.research.training.batch import Batch, Progress, SampleSource, cosine
from semviz_core.research.training.simulated_samples import LEARNED_DISTRIBUTION

ITERATIONS = 30
STEP_TOLERANCE = 1e-9
"""Converged if no part of a step (m or rad) is larger."""
DIFFERENCE = 1e-5
"""Step (m and rad) of the central differences of the slope that give the Hessian."""
NEWTON_FROM = 5
"""Step from which on Newton's method takes over: it converges where Gauss and Newton's does not."""
LEAST_CURVATURE = 1e-2
"""Least curvature (1/m^2 or 1/rad^2): a pose is not fixed if its sigma exceeds 10 m."""


@dataclass(frozen=True, eq=False)
class PosePairs:
    """The k accepted pairs of a frame, whitened as at their start pose."""

    problem: PoseProblem
    prior: PriorRecord
    pairs: IntArray
    """(k, 2) rows of observed and mapped elements; an observed element may have several."""
    start: Pose
    factor: FloatArray
    """(k, 4, 4) Cholesky factors of the residuals' covariances."""
    count: IntArray
    """(k,) number of residuals that count."""

    @classmethod
    def of(
        cls, problem: PoseProblem, prior: PriorRecord, pairs: IntArray, start: Pose
    ) -> "PosePairs":
        """Accept those of ``pairs`` (k, 2) that project at ``start`` (T_camera_map)."""
        rows, kept, factors, counts = new_rows(), [], [], []
        for i, j in pairs.tolist():
            count = fill_rows(problem, start.rotation, start.translation, i, j, rows)
            if count:
                whiten(problem, i, j, count, EXACT_POSE, rows)
                kept.append((i, j))
                factors.append(rows.factor.copy())
                counts.append(rows_that_count(problem, i, j, count, rows))
        return cls(
            problem, prior, np.array(kept, dtype=np.int64).reshape(-1, 2), start,
            np.array(factors).reshape(-1, 4, 4), np.array(counts, dtype=np.int64),
        )  # fmt: skip

    def slopes(self, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (k, 6) the slope of each pair's half squared residual by the left perturbation,
        and (6,) that of the prior."""
        slope, _ = _linearized(*self._arguments, R, t)
        return slope[:-1], slope[-1]

    def slope(self, weight: FloatArray, R: FloatArray, t: FloatArray) -> FloatArray:
        """Return the slope (6,) of the cost for weights (k,)."""
        return _slope(*self._arguments, np.append(weight, 1.0), R, t)

    def optimum(self, weight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return rotation, translation and Hessian at the optimum near the start; None if there is
        none, or if the weights and the prior do not fix it."""
        start = self.start.rotation.copy(), self.start.translation.copy()
        R, t, hessian, ok = _optimum(*self._arguments, np.append(weight, 1.0), *start)
        return (R, t, hessian) if ok else None

    @property
    def _arguments(self) -> tuple[PoseProblem, PriorRecord, IntArray, FloatArray, IntArray]:
        return self.problem, self.prior, self.pairs, self.factor, self.count


@compiled
def _linearized(
    problem: PoseProblem,
    prior: PriorRecord,
    pairs: IntArray,
    factor: FloatArray,
    count: IntArray,
    R: FloatArray,
    t: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the slopes (k + 1, 6) and Gauss-Newton matrices (k + 1, 6, 6) of pairs and, last, of
    the prior."""
    k = len(pairs)
    slope, matrix = np.zeros((k + 1, 6)), np.zeros((k + 1, 6, 6))
    rows = new_rows()
    for pair in range(k):
        filled = fill_rows(problem, R, t, pairs[pair, 0], pairs[pair, 1], rows)
        used = min(filled, count[pair])
        rows.factor[:] = factor[pair]
        whiten_by_factor(used, rows, True)
        _add_rows(rows.residual, rows.jacobian, used, slope[pair], matrix[pair])
    residual, jacobian = np.empty(MOST_ROWS), np.empty((MOST_ROWS, 6))
    used = prior_rows(prior, R, t, residual, jacobian)
    _add_rows(residual, jacobian, used, slope[k], matrix[k])
    return slope, matrix


@compiled
def _add_rows(
    residual: FloatArray, jacobian: FloatArray, count: int, slope: FloatArray, matrix: FloatArray
) -> None:
    for row in range(count):
        for a in range(6):
            slope[a] += jacobian[row, a] * residual[row]
            for b in range(6):
                matrix[a, b] += jacobian[row, a] * jacobian[row, b]


@compiled
def _slope(
    problem: PoseProblem,
    prior: PriorRecord,
    pairs: IntArray,
    factor: FloatArray,
    count: IntArray,
    weight: FloatArray,
    R: FloatArray,
    t: FloatArray,
) -> FloatArray:
    """Return the slope (6,) of the cost for weights (k + 1,), the prior's last."""
    slope, _ = _linearized(problem, prior, pairs, factor, count, R, t)
    total = np.zeros(6)
    for row in range(len(weight)):
        total += weight[row] * slope[row]
    return total


@compiled
def _hessian(
    problem: PoseProblem,
    prior: PriorRecord,
    pairs: IntArray,
    factor: FloatArray,
    count: IntArray,
    weight: FloatArray,
    R: FloatArray,
    t: FloatArray,
) -> FloatArray:
    """Return the Hessian (6, 6) of the cost, by central differences of the slope."""
    matrix = np.empty((6, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = DIFFERENCE
        up_R, up_t = rotate_left(R, t, step)
        down_R, down_t = rotate_left(R, t, -step)
        up = _slope(problem, prior, pairs, factor, count, weight, up_R, up_t)
        down = _slope(problem, prior, pairs, factor, count, weight, down_R, down_t)
        matrix[k] = (up - down) / (2.0 * DIFFERENCE)
    return 0.5 * (matrix + matrix.T)


@compiled
def _optimum(
    problem: PoseProblem,
    prior: PriorRecord,
    pairs: IntArray,
    factor: FloatArray,
    count: IntArray,
    weight: FloatArray,
    R: FloatArray,
    t: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """Return rotation, translation, Hessian and whether they are an optimum."""
    none = np.zeros((6, 6))
    for iteration in range(ITERATIONS):
        slope, matrices = _linearized(problem, prior, pairs, factor, count, R, t)
        step, matrix = np.zeros(6), np.zeros((6, 6))
        for row in range(len(weight)):
            step -= weight[row] * slope[row]
            matrix += weight[row] * matrices[row]
        if iteration >= NEWTON_FROM:
            exact = _hessian(problem, prior, pairs, factor, count, weight, R, t)
            if _is_fixed(exact):
                matrix = exact
        if not _is_fixed(matrix):
            return R, t, none, False
        cholesky(matrix, 6)
        solve_cholesky(matrix, step)
        R, t = rotate_left(R, t, step)
        if np.abs(step).max() < STEP_TOLERANCE:
            hessian = _hessian(problem, prior, pairs, factor, count, weight, R, t)
            return R, t, hessian, _is_fixed(hessian)
    return R, t, none, False


@compiled
def _is_fixed(matrix: FloatArray) -> bool:
    """Return whether all eigenvalues of ``matrix`` (6, 6) are above LEAST_CURVATURE."""
    return cholesky(matrix - LEAST_CURVATURE * np.eye(6), 6)


def pose_of_weights(weight: Tensor, pairs: PosePairs) -> tuple[Tensor, Tensor, bool]:
    """Return rotation (3, 3) and translation (3,) of T_camera_map, float64, and whether it is an
    optimum; otherwise it is the start and has no gradient."""
    rotation, translation, ok = _PoseOfWeights.apply(weight, pairs)  # type: ignore[no-untyped-call]
    return rotation, translation, bool(ok)


class _PoseOfWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weight: Tensor, pairs: PosePairs) -> tuple[Tensor, Tensor, Tensor]:
        found = pairs.optimum(weight.detach().double().cpu().numpy())
        ctx.pairs, ctx.found, ctx.device = pairs, found, weight.device
        R, t = (pairs.start.rotation, pairs.start.translation) if found is None else found[:2]
        ok = torch.tensor(found is not None)
        ctx.mark_non_differentiable(ok)
        return torch.tensor(R), torch.tensor(t), ok

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_rotation: Tensor, by_translation: Tensor, _: Tensor
    ) -> tuple[Tensor, None]:
        if ctx.found is None:
            return torch.zeros(len(ctx.pairs.pairs), dtype=torch.float64), None
        R, t, hessian = ctx.found
        given = R[None], t[None], by_rotation.numpy()[None], by_translation.numpy()[None]
        moved = np.linalg.solve(hessian, by_perturbation(*given)[0])
        of_pairs, _ = ctx.pairs.slopes(R, t)
        return torch.from_numpy(-of_pairs @ moved).to(ctx.device), None


RATE = 3e-3
MATCHER_SAMPLES = 200_000
PAIR_WEIGHT = 2.0
"""Weight of a true pair relative to an element without one: a pair has two elements."""
_FEW = (1, 5, 10)


class MatcherTask:
    """Training of the pair matcher on frames with ground truth."""

    samples = MATCHER_SAMPLES

    def __init__(self, name: str, source: SampleSource, classes: ClassSet = DEFAULT_CLASSES):
        self.name = name
        self.source = source
        self.network = ConsensusNetwork(len(classes))
        self.options: dict[str, Any] = {
            "classes": [class_.name for class_ in classes],
            "data": source.describe(),
        }

    def learning_rate(self, progress: Progress) -> float:
        return cosine(progress, RATE)

    def make(self, number: int) -> Sample:
        return self.source.sample(number)

    def held_out(self, number: int) -> Sample:
        return self.source.held_out(number)

    def collate(self, items: Sequence[Sample]) -> Prepared:
        return Prepared.of(items)

    def losses(self, prepared: Prepared, progress: Progress) -> dict[str, Tensor]:
        """Return the mean negative log-likelihood of each element's pair, or of no pair."""
        log_probability = log_probabilities(self.network(prepared), prepared.batch)
        return {"loss": mean_surprise(log_probability, prepared.batch)}

    def finish(self) -> None:
        """Do nothing."""

    def figures(self, prepared: Prepared) -> dict[str, Tensor]:
        """Return the shares of true pairs among the most probable of their observed element, and
        the AUC of having no pair."""
        log_probability = log_probabilities(self.network(prepared), prepared.batch)
        pairs = _pairs(prepared.batch)
        paired = pairs.any(dim=2)
        rank = true_rank(log_probability, pairs)[paired]
        top_shares = {f"top{few}": (rank < few).double().mean() for few in _FEW}
        alone = log_probability[:, :-1, -1]
        with_pair, without = alone[paired], alone[prepared.batch.seen & ~paired]
        return {
            "surprise": mean_surprise(log_probability, prepared.batch),
            **top_shares,
            "auc": (with_pair[:, None] < without).double().mean(),
        }


def log_probabilities(log_odds: Tensor, batch: Batch) -> Tensor:
    """Return log-probabilities (b, m + 1, n + 1) of log-odds (b, m, n) against no pair."""
    b, m, n = log_odds.shape
    zeros = log_odds.new_zeros
    return sinkhorn_with_dustbins(log_odds, zeros((b, m)), zeros((b, n)), batch.same_class)


def true_rank(log_probability: Tensor, pairs: Tensor) -> Tensor:
    """Return (b, m) how many mapped elements are more probable than the true one, if any."""
    likely = log_probability[:, :-1, :-1]
    best = likely.masked_fill(~pairs, -torch.inf).amax(dim=2, keepdim=True)
    return (likely > best).sum(dim=2)


def make_task(name: str, source: SampleSource | None) -> MatcherTask:
    """Return the task with new weights (default source: simulated roads)."""
    return MatcherTask(name, source or LEARNED_DISTRIBUTION)


def mean_surprise(log_probability: Tensor, batch: Batch) -> Tensor:
    """Return the mean negative log-probability; any of an element's true pairs is right, since the
    map may hold an element twice."""
    pairs = _pairs(batch)
    likely = log_probability[:, :-1, :-1].masked_fill(~pairs, -torch.inf)
    paired, taken = pairs.any(dim=2), pairs.any(dim=1)
    true = likely.masked_fill(~paired[..., None], 0.0).logsumexp(dim=2)[paired]
    seen_alone = log_probability[:, :-1, -1][batch.seen & ~paired]
    mapped_alone = log_probability[:, -1, :-1][batch.mapped & ~taken]
    count = PAIR_WEIGHT * len(true) + len(seen_alone) + len(mapped_alone)
    return -(PAIR_WEIGHT * true.sum() + seen_alone.sum() + mapped_alone.sum()) / count


def _pairs(batch: Batch) -> Tensor:
    """Return (b, m, n) the true pairs of one class."""
    if batch.truth is None:
        raise ValueError("training needs samples with a truth")
    return batch.truth.pairs & batch.same_class
