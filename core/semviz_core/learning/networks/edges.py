"""The mean over an element's edges as one operation of torch, with its gradient.

On a CPU by compiled loops: where elements have many neighbours, writing and reading their edges
takes half of a training step otherwise.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from semviz_core.learning.networks.edge_kernels import mean_of_edges, slope_of_edges


def edge_mean(ends: Tensor, near: Tensor) -> Tensor:
    """(r, c) mean over q of max(0, anchor_i + neighbour_near[i, q]).

    ``ends`` (r, 2 c) are an element's numbers as an anchor and those as a neighbour; ``near``
    (r, k) holds rows.
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
        return torch.from_numpy(mean_of_edges(ends.numpy(), near.numpy()))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_mean: Tensor) -> tuple[Tensor, None]:
        ends, near = (one.numpy() for one in ctx.saved_tensors)
        return torch.from_numpy(slope_of_edges(ends, near, by_mean.contiguous().numpy())), None
