"""The paper's feature extractor in torch: residual layers over KNN graphs.

Section III-B, eq. 1. In each layer every element is the anchor of edges to its k nearest others
in that layer's features. So elements of different classes meet only in deeper layers. An edge
is (anchor, neighbour - anchor). A two-layer perceptron of the edges is averaged over them and
added to the anchor. The first linear layer, A anchor + B (neighbour - anchor), is computed per
element and gathered; the second, linear, comes after the average. That is the same network at a
quarter of its cost.

Each layer normalizes its input over the elements of the frame, channel by channel (context
normalization: Yi et al. 2018, Campbell et al. 2020, Liu et al. 2020). It relates each element
to all others, is exact under padding, and needs no batch statistics. Padded rows are not
computed, which saves a quarter of a training step.

The mean over an element's edges is one torch operation with its own gradient: on a CPU, writing
and reading the edges would take half of a training step. The matcher joins the features of two
streams, observed and mapped, by `transport`.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from semviz_core.research.paper import matcher
from semviz_core.research.paper.matcher import LEAST_SQUARE, RAY_UNITS, UNITS_M, Model
from semviz_core.research.paper.transport import sinkhorn
from semviz_core.research.training.batch import Batch


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
