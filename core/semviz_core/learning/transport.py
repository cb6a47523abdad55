"""Optimal transport between seen and mapped elements, batched, with exact gradients.

Two kinds: with uniform priors as in the paper (eq. 3-4), and with a dustbin for each element. Both
are P_ij = a_i K_ij b_j with given totals of rows and columns. Sinkhorn's scaling takes turns with
Newton steps on the logarithms of a and b (as Tang et al. 2024): scaling alone needs hundreds of
sweeps where a network has become sure, or a dustbin is weak. All in float64 and the log domain.

The gradient is implicit (Luise et al. 2018): totals do not change, so it follows from one solve of
the system that the Newton steps solve too. It needs no intermediate results, is exact at the
optimum, and where rounds run out it is that for the totals that P has.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from semviz_core.matching.uniform import MU

TOLERANCE = 1e-9
"""Converged when no row's total is off by a larger part; columns are exact."""
MOST_ROUNDS = 30
_EVEN = 20.0
"""Of kernels whose logarithms are within (nats), scaling gets near the optimum by itself."""
_LOOSE, _LOOSE_ROUNDS = 0.1, 8  # near enough for a start
_SWEEPS_FIRST, _SWEEPS = 10, 2
_LONGEST_STEP = 10.0  # nats: further away the Newton step means nothing
_DAMPING = 1e-11  # what only moves mass between parts that hardly meet
_TINY = 1e-300


def sinkhorn(cost: Tensor, possible: Tensor, mu: float = MU) -> Tensor:
    """The paper's P (b, m, n) of eq. 3-4 for ``cost`` (b, m, n) under uniform priors, as
    ``matching.uniform`` has it for one frame, whatever the costs.

    ``possible`` (b, m, n) holds blocks in which every row goes with every column: the classes, or
    all that is not padded. Each block is a transport of its own, whose P sums to 1: rows to 1 / m,
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
    """LOG probabilities (b, m + 1, n + 1); rows i < m and columns j < n sum to 1.

    ``score`` (b, m, n) says for pairs what ``seen_bin`` (b, m) and ``mapped_bin`` (b, n) say for no
    pair: log-odds are their difference, as in ``matching.sinkhorn``. Impossible pairs and the
    corner are -inf. Elements without a possible pair, such as padded ones, are in their dustbin
    for certain: log 1 = 0.
    """
    log_odds = score.double() - seen_bin.double()[:, :, None] - mapped_bin.double()[:, None, :]
    log_kernel = log_odds.masked_fill(~possible, -torch.inf)
    ones = log_kernel.new_ones(())
    rows, columns = ones.expand(seen_bin.shape), ones.expand(mapped_bin.shape)
    given = log_kernel, rows, columns, True
    pairs, seen_alone, mapped_alone = _Scaled.apply(*given)  # type: ignore[no-untyped-call]
    bottom = torch.nn.functional.pad(mapped_alone, (0, 1), value=-torch.inf)
    top = torch.cat([pairs, seen_alone[:, :, None]], dim=2)
    return torch.cat([top, bottom[:, None, :]], dim=1).to(score.dtype)


class _Scaling(NamedTuple):
    """P = exp(log_kernel + log_a + log_b) and what lies in dustbins (zeros if there are none)."""

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
        """(b, m) and (b, n)."""
        return self.P.sum(dim=2) + self.seen_alone, self.P.sum(dim=1) + self.mapped_alone

    def swept(self, rows: Tensor, columns: Tensor, sweeps: int) -> "_Scaling":
        """After Sinkhorn's scaling of rows and columns in turn."""
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
    """The scaling under which rows and columns have these totals.

    Kernels that are far from even are approached from an even one, by powers of them.
    """
    finite = log_kernel.nan_to_num(neginf=0.0)
    power = min(1.0, _EVEN / max(float(finite.abs().amax()), _TINY))
    largest = power * torch.where(torch.isfinite(log_kernel), log_kernel, -_EVEN).amax(dim=2)
    log_a = -largest.clamp_min(0.0) if dustbins else -largest
    now = _Scaling.at(power * log_kernel, log_a, torch.zeros_like(columns), dustbins)
    now = now.swept(rows, columns, _SWEEPS_FIRST)
    while power < 1.0:
        now = _improved(now, power * log_kernel, rows, columns, _LOOSE, _LOOSE_ROUNDS, dustbins)
        growth = min(2.0, 1.0 / power)
        power *= growth
        log_a, log_b = growth * now.log_a, growth * now.log_b
        now = _Scaling.at(power * log_kernel, log_a, log_b, dustbins).swept(rows, columns, _SWEEPS)
    return _improved(now, log_kernel, rows, columns, TOLERANCE, MOST_ROUNDS, dustbins)


def _improved(
    now: _Scaling,
    log_kernel: Tensor,
    rows: Tensor,
    columns: Tensor,
    tolerance: float,
    rounds: int,
    dustbins: bool,
) -> _Scaling:
    """After rounds of a Newton step and two sweeps, until all of the batch is within tolerance."""
    for _ in range(rounds):
        got_rows, got_columns = now.totals()
        missing_rows, missing_columns = rows - got_rows, columns - got_columns
        if bool((missing_rows.abs() <= tolerance * rows).all()):
            break
        by_row, by_column = _solve(now, missing_rows, missing_columns)
        longest = torch.maximum(by_row.abs().amax(dim=1), by_column.abs().amax(dim=1))
        share = (_LONGEST_STEP / longest).clamp_max(1.0)[:, None]
        log_a, log_b = now.log_a + share * by_row, now.log_b + share * by_column
        now = _Scaling.at(log_kernel, log_a, log_b, dustbins).swept(rows, columns, _SWEEPS)
    return now


def _solve(now: _Scaling, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """p (b, m), q (b, n) of [R P; P^T C] [p; q] = [x; y], R and C the totals, by Schur complement.

    Where P falls into parts the system is singular along what is added to rows and taken from
    columns of a part: that changes nothing of P, so any solution will do.
    """
    row_total, column_total = (torch.where(one > _TINY, one, 1.0) for one in now.totals())
    by_column = now.P / column_total[:, None, :]
    schur = torch.diag_embed(row_total * (1.0 + _DAMPING))
    schur -= by_column @ now.P.transpose(1, 2)
    factor, failed = torch.linalg.cholesky_ex(schur)
    right = x - _times(by_column, y)
    p = torch.cholesky_solve(right[:, :, None], factor)[:, :, 0]
    p = torch.where((failed == 0)[:, None], p, 0.0)
    return p, (y - _times(now.P.transpose(1, 2), p)) / column_total


class _Scaled(torch.autograd.Function):
    """Logarithms of P (b, m, n) and of what is in the dustbins (b, m), (b, n)."""

    @staticmethod
    def forward(
        ctx: Any, log_kernel: Tensor, rows: Tensor, columns: Tensor, dustbins: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        found = _scaled(log_kernel, rows, columns, dustbins)
        ctx.save_for_backward(*found)
        log_P = log_kernel + found.log_a[:, :, None] + found.log_b[:, None, :]
        return log_P, found.log_a, found.log_b

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_pair: Tensor, by_seen: Tensor, by_mapped: Tensor
    ) -> tuple[Tensor, None, None, None]:
        found = _Scaling(*ctx.saved_tensors)
        by_seen, by_mapped = by_seen + by_pair.sum(dim=2), by_mapped + by_pair.sum(dim=1)
        p, q = _solve(found, by_seen, by_mapped)
        return by_pair - found.P * (p[:, :, None] + q[:, None, :]), None, None, None


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """(b, m) of (b, m, n) and (b, n)."""
    return torch.bmm(matrix, vector[:, :, None])[:, :, 0]


def _share(count: Tensor) -> Tensor:
    """1 / count, 0 for none."""
    return torch.where(count > 0, 1.0 / count.clamp_min(1).double(), 0.0)
