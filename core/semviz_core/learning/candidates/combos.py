"""Rows of one thing with rows of another, sample by sample."""

import torch
from torch import Tensor


def rows_of(mask: Tensor) -> Tensor:
    """(k,) rows where ``mask`` (a,) is True: found once, however many things are taken there."""
    return torch.nonzero(mask)[:, 0]


def of_one_sample(sample: Tensor, other_sample: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """(k,), (k,) rows of all combinations of what has ``sample`` (a,) with what has
    ``other_sample`` (b,), in ascending order, of ``size`` samples."""
    count = torch.bincount(other_sample, minlength=size)
    before = torch.cumsum(count, dim=0) - count
    others = count[sample]
    rows = torch.arange(len(sample), device=count.device)
    row = torch.repeat_interleave(rows, others)
    begin = torch.cumsum(others, dim=0) - others - before[sample]
    return row, torch.arange(len(row), device=count.device) - begin[row]


def best_of_alike(value: Tensor, kind: Tensor) -> Tensor:
    """Rows of the largest value (a,) of each ``kind`` (a,)."""
    order = torch.argsort(value, descending=True, stable=True)
    order = order[torch.argsort(kind[order], stable=True)]
    first = torch.ones_like(order, dtype=torch.bool)
    first[1:] = kind[order[1:]] != kind[order[:-1]]
    return order[first]


def best_of_each(value: Tensor, sample: Tensor, size: int, most: int) -> Tensor:
    """(k,) rows of the ``most`` largest values (a,) of each of ``size`` samples, largest first."""
    order = torch.argsort(value, descending=True, stable=True)
    order = order[torch.argsort(sample[order], stable=True)]
    count = torch.bincount(sample, minlength=size)
    before = torch.cumsum(count, dim=0) - count
    rank = torch.arange(len(order), device=order.device) - before[sample[order]]
    return order[rank < most]
