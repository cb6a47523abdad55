"""The paper's feature extractor (section III-B, eq. 1): residual layers over point-wise KNN graphs.

In each layer every element is the anchor of edges to its k nearest others in the features of that
layer, so that elements of different classes meet in deeper layers only. An edge is (anchor,
neighbour - anchor); a two-layer perceptron of the edges is averaged over them and added to the
anchor. As the first linear layer of an edge is A anchor + B (neighbour - anchor), it is computed
per element and gathered; as the second one is linear, it comes after the average. That is the
same network at a quarter of its cost.

Each layer normalizes its input over the elements of the frame, channel by channel (the context
normalization of Yi et al. 2018, as in Campbell et al. 2020 and Liu et al. 2020): it tells each
element of all others, is exact under padding, and needs no statistics of a batch, unlike the batch
normalization which those have beside it.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from semviz_core.learning.networks.edges import edge_mean
from semviz_core.learning.networks.graph_numpy import CHANNELS, EPSILON, LAYERS


class GraphNetwork(nn.Module):
    """Features of one stream: ``inputs`` numbers of an element to ``CHANNELS``."""

    def __init__(self, inputs: int, neighbours: int) -> None:
        super().__init__()
        self.inlet = nn.Linear(inputs, CHANNELS)
        self.layers = nn.ModuleList(_EdgeLayer(neighbours) for _ in range(LAYERS))
        self.outlet = nn.Linear(CHANNELS, CHANNELS)

    def forward(self, elements: Tensor, real: Tensor) -> Tensor:
        """(b, n, CHANNELS) of elements (b, n, inputs); those not ``real`` (b, n) change nothing."""
        rows = Rows.of(real, elements.dtype)
        features = self.inlet(elements)
        for layer in self.layers:
            features = layer(features, rows)
        out: Tensor = self.outlet(context_norm(features, rows.share))
        return out


@dataclass(frozen=True, eq=False)
class Rows:
    """The r real elements of a batch one below the other: what is padded is not computed with,
    which saves a quarter of a training step."""

    share: Tensor
    """(b, n) one over the number of real elements of the frame, 0 for padded ones."""
    place: Tensor
    """(r,) of each row among the b n elements."""
    first: Tensor
    """(r, 1) place of the first element of its frame."""
    row: Tensor
    """(b n,) of each element; any for padded ones."""
    strange: Tensor
    """(r, n) bool: elements of its frame that are no neighbours: itself, and padded ones."""

    @classmethod
    def of(cls, real: Tensor, kind: torch.dtype) -> "Rows":
        n = real.shape[1]
        share = (real / real.sum(dim=1, keepdim=True).clamp(min=1)).to(kind)
        place = real.flatten().nonzero()[:, 0]
        itself = place[:, None] % n == torch.arange(n, device=place.device)
        strange = ~real[place // n] | itself
        row = real.flatten().cumsum(0) - 1
        return cls(share, place, (place // n * n)[:, None], row, strange)


class _EdgeLayer(nn.Module):
    def __init__(self, neighbours: int) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.before = nn.Linear(CHANNELS, 2 * CHANNELS)  # of anchor and of neighbour
        self.after = nn.Linear(CHANNELS, CHANNELS)

    def forward(self, features: Tensor, rows: Rows) -> Tensor:
        normal = context_norm(features, rows.share)
        near = nearest(normal.detach(), rows, self.neighbours)
        elements = normal.flatten(0, 1).index_select(0, rows.place)
        change = self.after(edge_mean(self.before(elements), near))
        return features.flatten(0, 1).index_add(0, rows.place, change).view_as(features)


def context_norm(features: Tensor, share: Tensor) -> Tensor:
    """Features (b, n, c) with mean 0 and variance 1 over each frame, channel by channel.

    ``share`` (b, n) is one over the number of real elements, 0 for padded ones.
    """
    weight = share[:, None, :]
    centred = features - weight @ features
    variance = weight @ centred.square()
    return centred * torch.rsqrt(variance + EPSILON)


def nearest(features: Tensor, rows: Rows, neighbours: int) -> Tensor:
    """(r, neighbours) the nearest others in the frame by features (b, n, c), as rows.

    Where there are fewer others, the element itself takes their place: an edge of length 0.
    """
    product = features @ features.transpose(1, 2)
    square = product.diagonal(dim1=1, dim2=2)
    # |x_j - x_i|^2 but for |x_i|^2, which orders no row
    distance = (square[:, None, :] - 2.0 * product).flatten(0, 1).index_select(0, rows.place)
    count = min(neighbours, features.shape[1] - 1)
    found = distance.masked_fill_(rows.strange, torch.inf).topk(count, dim=1, largest=False)
    itself = torch.arange(len(rows.place), device=features.device)[:, None]
    near = torch.where(found.values < torch.inf, rows.row[found.indices + rows.first], itself)
    return torch.cat([near, itself.expand(-1, neighbours - count)], dim=1)
