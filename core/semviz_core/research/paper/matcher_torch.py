"""The paper's feature extractor and optimal transport in torch, batched.

Section III-B, eq. 1: residual layers over KNN graphs. In each layer every element is the anchor of
edges to its k nearest others in that layer's features. So elements of different classes meet only
in deeper layers. An edge is (anchor, neighbour - anchor). A two-layer perceptron of the edges is
averaged over them and added to the anchor. The first linear layer, A anchor + B (neighbour -
anchor), is computed per element and gathered; the second, linear, comes after the average. That is
the same network at a quarter of its cost.

Each layer normalizes its input over the elements of the frame, channel by channel (context
normalization: Yi et al. 2018, Campbell et al. 2020, Liu et al. 2020). It relates each element
to all others, is exact under padding, and needs no batch statistics. Padded rows are not
computed, which saves a quarter of a training step.

The mean over an element's edges is one torch operation with its own gradient: on a CPU, writing
and reading the edges would take half of a training step. The matcher joins the features of two
streams, observed and mapped, by `transport`.

Transport between observed and mapped elements is of two kinds: uniform priors as in the paper (eq.
3-4), and a dustbin for each element. Both are P_ij = a_i K_ij b_j with given row and column totals.
Sinkhorn scaling alternates with Newton steps on the logarithms of a and b (as Tang et al. 2024).
Scaling alone needs hundreds of sweeps where a network is confident or a dustbin is weak. All in
float64 and the log domain.

The gradient is implicit (Luise et al. 2018): totals are constant, so it follows from one solve
of the Newton system. It needs no intermediate results, is exact at the optimum, and at an
iteration limit is the gradient for the totals that P has.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from semviz_core.research.paper import matcher
from semviz_core.research.paper.matcher import LEAST_SQUARE, MU, RAY_UNITS, UNITS_M, Model
from semviz_core.research.training.batch import Batch

TOLERANCE = 1e-9
"""Converged if no row's total has a larger relative error; columns are exact."""
MOST_ROUNDS = 30
_EVEN = 20.0
"""If the logarithms of a kernel are within this (nats), scaling alone gets near the optimum."""
_LOOSE, _LOOSE_ROUNDS = 0.1, 8  # near enough for a start
_SWEEPS_FIRST, _SWEEPS = 10, 2
_LONGEST_STEP = 10.0  # nats: the Newton step is not valid further away
_DAMPING = 1e-11  # only affects mass between parts that are almost separate
_TINY = 1e-300


def sinkhorn(cost: Tensor, possible: Tensor, mu: float = MU) -> Tensor:
    """Return the paper's P (b, m, n) of eq. 3-4 for ``cost`` (b, m, n) under uniform priors.

    ``matcher.uniform_transport`` does the same for one frame, within a limit of the costs.
    ``possible`` (b, m, n) forms blocks in which every row goes with every column: the classes, or
    all elements without padding. Each block is its own transport, whose P sums to 1: rows to 1 / m,
    columns to 1 / n of the block. Rows and columns in no block are 0.
    """
    log_kernel = (cost.double() / -mu).masked_fill(~possible, -torch.inf)
    seen_in_block = (possible * possible.sum(dim=1, keepdim=True)).amax(dim=2)
    mapped_in_block = (possible * possible.sum(dim=2, keepdim=True)).amax(dim=1)
    rows, columns = _share(seen_in_block), _share(mapped_in_block)
    log_P, _, _ = _Scaled.apply(log_kernel, rows, columns, False)  # type: ignore[no-untyped-call]
    return torch.exp(log_P).to(cost.dtype)


def sinkhorn_with_dustbins(
    score: Tensor, seen_bin: Tensor, mapped_bin: Tensor, possible: Tensor
) -> Tensor:
    """Return LOG probabilities (b, m + 1, n + 1); rows i < m and columns j < n sum to 1.

    ``score`` (b, m, n) rates pairs, ``seen_bin`` (b, m) and ``mapped_bin`` (b, n) no pair. The
    log-odds are their difference, as in ``sinkhorn_with_dustbin``. Impossible pairs and
    the corner are -inf. Elements without a possible pair, such as padding, are in their dustbin for
    certain: log 1 = 0.
    """
    log_odds = score.double() - seen_bin.double()[:, :, None] - mapped_bin.double()[:, None, :]
    log_kernel = log_odds.masked_fill(~possible, -torch.inf)
    ones = log_kernel.new_ones(())
    rows, columns = ones.expand(seen_bin.shape), ones.expand(mapped_bin.shape)
    totals = log_kernel, rows, columns, True
    pairs, seen_alone, mapped_alone = _Scaled.apply(*totals)  # type: ignore[no-untyped-call]
    bottom = torch.nn.functional.pad(mapped_alone, (0, 1), value=-torch.inf)
    top = torch.cat([pairs, seen_alone[:, :, None]], dim=2)
    return torch.cat([top, bottom[:, None, :]], dim=1).to(score.dtype)


class _Scaling(NamedTuple):
    """P = exp(log_kernel + log_a + log_b) and the mass in dustbins (zeros if there are none)."""

    log_a: Tensor  # (b, m)
    log_b: Tensor  # (b, n)
    P: Tensor  # (b, m, n)
    seen_alone: Tensor  # (b, m)
    mapped_alone: Tensor  # (b, n)

    @classmethod
    def at(cls, log_kernel: Tensor, log_a: Tensor, log_b: Tensor, dustbins: bool) -> "_Scaling":
        P = torch.exp(log_kernel + log_a[:, :, None] + log_b[:, None, :])
        if dustbins:
            return cls(log_a, log_b, P, torch.exp(log_a), torch.exp(log_b))
        return cls(log_a, log_b, P, torch.zeros_like(log_a), torch.zeros_like(log_b))

    def totals(self) -> tuple[Tensor, Tensor]:
        """Return the totals of rows (b, m) and columns (b, n)."""
        return self.P.sum(dim=2) + self.seen_alone, self.P.sum(dim=1) + self.mapped_alone

    def swept(self, rows: Tensor, columns: Tensor, sweeps: int) -> "_Scaling":
        """Return the scaling after ``sweeps`` of Sinkhorn's algorithm."""
        P, u, v = self.P, rows, torch.ones_like(columns)
        for _ in range(sweeps):
            u = rows / (_times(P, v) + self.seen_alone).clamp_min(_TINY)
            v = columns / (_times(P.transpose(1, 2), u) + self.mapped_alone).clamp_min(_TINY)
        return _Scaling(
            self.log_a + torch.log(u.clamp_min(_TINY)),
            self.log_b + torch.log(v.clamp_min(_TINY)),
            u[:, :, None] * P * v[:, None, :],
            u * self.seen_alone,
            v * self.mapped_alone,
        )


def _scaled(log_kernel: Tensor, rows: Tensor, columns: Tensor, dustbins: bool) -> _Scaling:
    """Return the scaling under which rows and columns have these totals.

    A kernel that is far from even is approached by its powers, beginning with an even one.
    """
    finite = log_kernel.nan_to_num(neginf=0.0)
    power = min(1.0, _EVEN / max(float(finite.abs().amax()), _TINY))
    largest = power * torch.where(torch.isfinite(log_kernel), log_kernel, -_EVEN).amax(dim=2)
    log_a = -largest.clamp_min(0.0) if dustbins else -largest
    scaling = _Scaling.at(power * log_kernel, log_a, torch.zeros_like(columns), dustbins)
    scaling = scaling.swept(rows, columns, _SWEEPS_FIRST)
    while power < 1.0:
        scaling = _converged(
            scaling, power * log_kernel, rows, columns, _LOOSE, _LOOSE_ROUNDS, dustbins
        )
        growth = min(2.0, 1.0 / power)
        power *= growth
        log_a, log_b = growth * scaling.log_a, growth * scaling.log_b
        scaling = _Scaling.at(power * log_kernel, log_a, log_b, dustbins).swept(
            rows, columns, _SWEEPS
        )
    return _converged(scaling, log_kernel, rows, columns, TOLERANCE, MOST_ROUNDS, dustbins)


def _converged(
    scaling: _Scaling,
    log_kernel: Tensor,
    rows: Tensor,
    columns: Tensor,
    tolerance: float,
    rounds: int,
    dustbins: bool,
) -> _Scaling:
    """Alternate Newton steps and sweeps until the whole batch is within ``tolerance``."""
    for _ in range(rounds):
        got_rows, got_columns = scaling.totals()
        missing_rows, missing_columns = rows - got_rows, columns - got_columns
        if bool((missing_rows.abs() <= tolerance * rows).all()):
            break
        by_row, by_column = _solve(scaling, missing_rows, missing_columns)
        longest = torch.maximum(by_row.abs().amax(dim=1), by_column.abs().amax(dim=1))
        share = (_LONGEST_STEP / longest).clamp_max(1.0)[:, None]
        log_a, log_b = scaling.log_a + share * by_row, scaling.log_b + share * by_column
        scaling = _Scaling.at(log_kernel, log_a, log_b, dustbins).swept(rows, columns, _SWEEPS)
    return scaling


def _solve(scaling: _Scaling, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Solve [R P; P^T C] [p; q] = [x; y] for p (b, m), q (b, n); R and C are the totals.

    It uses the Schur complement. If P falls into separate parts, the system is singular: adding a
    constant to the rows of a part and subtracting it from its columns does not change P, so any
    solution will do.
    """
    row_total, column_total = (torch.where(total > _TINY, total, 1.0) for total in scaling.totals())
    by_column = scaling.P / column_total[:, None, :]
    schur = torch.diag_embed(row_total * (1.0 + _DAMPING))
    schur -= by_column @ scaling.P.transpose(1, 2)
    factor, failed = torch.linalg.cholesky_ex(schur)
    right = x - _times(by_column, y)
    p = torch.cholesky_solve(right[:, :, None], factor)[:, :, 0]
    p = torch.where((failed == 0)[:, None], p, 0.0)
    return p, (y - _times(scaling.P.transpose(1, 2), p)) / column_total


class _Scaled(torch.autograd.Function):
    """Logarithms of P (b, m, n) and of the mass in the dustbins (b, m), (b, n)."""

    @staticmethod
    def forward(
        ctx: Any, log_kernel: Tensor, rows: Tensor, columns: Tensor, dustbins: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        scaling = _scaled(log_kernel, rows, columns, dustbins)
        ctx.save_for_backward(*scaling)
        log_P = log_kernel + scaling.log_a[:, :, None] + scaling.log_b[:, None, :]
        return log_P, scaling.log_a, scaling.log_b

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_pair: Tensor, by_seen: Tensor, by_mapped: Tensor
    ) -> tuple[Tensor, None, None, None]:
        scaling = _Scaling(*ctx.saved_tensors)
        by_seen, by_mapped = by_seen + by_pair.sum(dim=2), by_mapped + by_pair.sum(dim=1)
        p, q = _solve(scaling, by_seen, by_mapped)
        return by_pair - scaling.P * (p[:, :, None] + q[:, None, :]), None, None, None


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return the product (b, m) of (b, m, n) and (b, n)."""
    return torch.bmm(matrix, vector[:, :, None])[:, :, 0]


def _share(count: Tensor) -> Tensor:
    """Return 1 / count, 0 for none."""
    return torch.where(count > 0, 1.0 / count.clamp_min(1).double(), 0.0)


def edge_mean(ends: Tensor, near: Tensor) -> Tensor:
    """Return (r, c) the mean over q of max(0, anchor_i + neighbour_near[i, q]).

    ``ends`` (r, 2 c) holds an element's channels as an anchor, then as a neighbour; ``near`` (r, k)
    holds rows.
    """
    if ends.is_cpu:
        at_least_32_bits = ends.to(torch.promote_types(ends.dtype, torch.float32))
        mean: Tensor = _EdgeMean.apply(at_least_32_bits, near)  # type: ignore[no-untyped-call]
        return mean
    anchor, neighbour = ends.chunk(2, dim=1)
    edges = neighbour.index_select(0, near.flatten()).view(*near.shape, -1) + anchor[:, None]
    return edges.relu_().sum(dim=1) / near.shape[1]


class _EdgeMean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, ends: Tensor, near: Tensor) -> Tensor:
        ctx.save_for_backward(ends, near)
        return torch.from_numpy(matcher.mean_of_edges(ends.numpy(), near.numpy()))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_mean: Tensor) -> tuple[Tensor, None]:
        ends, near = (tensor.numpy() for tensor in ctx.saved_tensors)
        return torch.from_numpy(
            matcher.gradient_of_edges(ends, near, by_mean.contiguous().numpy())
        ), None


class GraphNetwork(nn.Module):
    """Features of one stream: from ``inputs`` numbers of an element to ``CHANNELS``."""

    def __init__(self, inputs: int, neighbours: int) -> None:
        super().__init__()
        self.inlet = nn.Linear(inputs, matcher.CHANNELS)
        self.layers = nn.ModuleList(_EdgeLayer(neighbours) for _ in range(matcher.LAYERS))
        self.outlet = nn.Linear(matcher.CHANNELS, matcher.CHANNELS)

    def forward(self, elements: Tensor, real: Tensor) -> Tensor:
        """Return features (b, n, CHANNELS) of elements (b, n, inputs); ``real`` (b, n) excludes
        padding."""
        rows = RealRows.of(real, elements.dtype)
        features = self.inlet(elements)
        for layer in self.layers:
            features = layer(features, rows)
        out: Tensor = self.outlet(context_norm(features, rows.share))
        return out


@dataclass(frozen=True, eq=False)
class RealRows:
    """The r real elements of a batch as rows. Leaving out padding saves a quarter of a step."""

    share: Tensor
    """(b, n) one over the number of real elements of the frame, 0 for padding."""
    place: Tensor
    """(r,) index of each row among the b n elements."""
    first: Tensor
    """(r, 1) index of the first element of its frame."""
    row: Tensor
    """(b n,) row of each element; arbitrary for padding."""
    no_neighbour: Tensor
    """(r, n) True for elements of its frame that are no neighbours: itself and padding."""

    @classmethod
    def of(cls, real: Tensor, kind: torch.dtype) -> "RealRows":
        n = real.shape[1]
        share = (real / real.sum(dim=1, keepdim=True).clamp(min=1)).to(kind)
        place = real.flatten().nonzero()[:, 0]
        itself = place[:, None] % n == torch.arange(n, device=place.device)
        no_neighbour = ~real[place // n] | itself
        row = real.flatten().cumsum(0) - 1
        return cls(share, place, (place // n * n)[:, None], row, no_neighbour)


class _EdgeLayer(nn.Module):
    def __init__(self, neighbours: int) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.before = nn.Linear(
            matcher.CHANNELS, 2 * matcher.CHANNELS
        )  # of anchor and of neighbour
        self.after = nn.Linear(matcher.CHANNELS, matcher.CHANNELS)

    def forward(self, features: Tensor, rows: RealRows) -> Tensor:
        normal = context_norm(features, rows.share)
        near = nearest(normal.detach(), rows, self.neighbours)
        elements = normal.flatten(0, 1).index_select(0, rows.place)
        change = self.after(edge_mean(self.before(elements), near))
        return features.flatten(0, 1).index_add(0, rows.place, change).view_as(features)


def context_norm(features: Tensor, share: Tensor) -> Tensor:
    """Normalize features (b, n, c) to mean 0 and variance 1 over each frame, channel by channel.

    ``share`` (b, n) is one over the number of real elements, 0 for padding.
    """
    weight = share[:, None, :]
    centred = features - weight @ features
    variance = weight @ centred.square()
    return centred * torch.rsqrt(variance + matcher.EPSILON)


def nearest(features: Tensor, rows: RealRows, neighbours: int) -> Tensor:
    """Return (r, neighbours) the rows of the nearest others in the frame by features (b, n, c).

    If there are fewer others, the element itself fills up: an edge of length 0.
    """
    product = features @ features.transpose(1, 2)
    square = product.diagonal(dim1=1, dim2=2)
    # |x_j - x_i|^2 without |x_i|^2, which does not change the order
    distance = (square[:, None, :] - 2.0 * product).flatten(0, 1).index_select(0, rows.place)
    count = min(neighbours, features.shape[1] - 1)
    closest = distance.masked_fill_(rows.no_neighbour, torch.inf).topk(count, dim=1, largest=False)
    itself = torch.arange(len(rows.place), device=features.device)[:, None]
    near = torch.where(closest.values < torch.inf, rows.row[closest.indices + rows.first], itself)
    return torch.cat([near, itself.expand(-1, neighbours - count)], dim=1)


@dataclass(frozen=True, eq=False)
class Correspondence:
    """The output of a matcher for every pair of a batch."""

    cost: Tensor
    """(b, m, n) distance of the features (eq. 2)."""
    probability: Tensor
    """(b, m, n) the paper's P (eq. 3-4); 0 for pairs that are not possible."""


class GraphMatcher(nn.Module):
    """Features of both streams, and the transport between them."""

    def __init__(self, model: Model, classes: int) -> None:
        super().__init__()
        self.model = model
        self.classes = classes
        inputs = 3 + 3 * model.lines + classes * model.semantics
        self.seen = GraphNetwork(inputs, model.neighbours)
        self.mapped = GraphNetwork(inputs, model.neighbours)

    def forward(self, batch: Batch) -> Correspondence:
        cost = self.cost(batch)
        return Correspondence(cost, sinkhorn(cost, self.possible(batch)))

    def possible(self, batch: Batch) -> Tensor:
        """Return (b, m, n) True within the blocks of the transport."""
        return batch.same_class if self.model.branches else batch.possible

    def cost(self, batch: Batch) -> Tensor:
        """Return (b, m, n) the distances of unit features (eq. 2)."""
        top, bottom = (ray / ray[..., 2:] for ray in (batch.ray, batch.bottom_ray))
        ray = batch.ray / batch.ray.new_tensor(RAY_UNITS)
        seen = self._inputs(ray, bottom - top, batch.seen_class)
        down = batch.bottom_m - batch.point_m
        place = batch.point_m / batch.point_m.new_tensor(UNITS_M)
        mapped = self._inputs(place, down, batch.mapped_class)
        seen_features = functional.normalize(self.seen(seen, batch.seen), dim=2)
        mapped_features = functional.normalize(self.mapped(mapped, batch.mapped), dim=2)
        square = 2.0 - 2.0 * seen_features @ mapped_features.transpose(1, 2)
        return square.clamp(min=LEAST_SQUARE).sqrt()

    def _inputs(self, place: Tensor, down: Tensor, element_class: Tensor) -> Tensor:
        """Return (b, k, inputs): position and, if the model uses them, direction (0 for points)
        and class."""
        parts = [place]
        if self.model.lines:
            parts.append(functional.normalize(down, dim=2))
        if self.model.semantics:
            parts.append(functional.one_hot(element_class, self.classes).to(place.dtype))
        return torch.cat(parts, dim=2)
