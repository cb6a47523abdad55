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

import torch
from torch import Tensor, nn

CHANNELS = 128
LAYERS = 12
_EPSILON = 1e-3
"""Added to variances: a frame whose elements agree in a channel has none there."""


class GraphNetwork(nn.Module):
    """Features of one stream: ``inputs`` numbers of an element to ``CHANNELS``."""

    def __init__(self, inputs: int, neighbours: int) -> None:
        super().__init__()
        self.inlet = nn.Linear(inputs, CHANNELS)
        self.layers = nn.ModuleList(_EdgeLayer(neighbours) for _ in range(LAYERS))
        self.outlet = nn.Linear(CHANNELS, CHANNELS)

    def forward(self, elements: Tensor, real: Tensor) -> Tensor:
        """(b, n, CHANNELS) of elements (b, n, inputs); those not ``real`` (b, n) change nothing."""
        share = (real / real.sum(dim=1, keepdim=True).clamp(min=1)).to(elements.dtype)
        features = self.inlet(elements)
        for layer in self.layers:
            features = layer(features, real, share)
        out: Tensor = self.outlet(context_norm(features, share))
        return out


class _EdgeLayer(nn.Module):
    def __init__(self, neighbours: int) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.before = nn.Linear(CHANNELS, 2 * CHANNELS)  # of anchor and of neighbour
        self.after = nn.Linear(CHANNELS, CHANNELS)

    def forward(self, features: Tensor, real: Tensor, share: Tensor) -> Tensor:
        b, n, channels = features.shape
        normal = context_norm(features, share)
        near = nearest(normal.detach(), real, self.neighbours)
        first = torch.arange(0, b * n, n, device=near.device)[:, None, None]
        anchor, neighbour = self.before(normal).chunk(2, dim=2)
        rows = neighbour.flatten(0, 1).index_select(0, (near + first).flatten())
        edges = rows.view(b, n, self.neighbours, channels) + anchor[:, :, None]
        hidden = edges.relu_().sum(dim=2) / self.neighbours
        updated: Tensor = features + self.after(hidden)
        return updated


def context_norm(features: Tensor, share: Tensor) -> Tensor:
    """Features (b, n, c) with mean 0 and variance 1 over each frame, channel by channel.

    ``share`` (b, n) is one over the number of real elements, 0 for padded ones.
    """
    weight = share[:, None, :]
    centred = features - weight @ features
    variance = weight @ centred.square()
    return centred * torch.rsqrt(variance + _EPSILON)


def nearest(features: Tensor, real: Tensor, neighbours: int) -> Tensor:
    """(b, n, neighbours) rows of the nearest others among the ``real`` (b, n).

    Where there are fewer others, the element itself takes their place: an edge of length 0.
    """
    n = features.shape[1]
    count = min(neighbours, n - 1)
    product = features @ features.transpose(1, 2)
    square = product.diagonal(dim1=1, dim2=2)
    # |x_j - x_i|^2 but for |x_i|^2, which orders no row
    distance = (square[:, None, :] - 2.0 * product).masked_fill(~real[:, None, :], torch.inf)
    itself = torch.arange(n, device=features.device)
    distance[:, itself, itself] = torch.inf
    found = distance.topk(count, dim=2, largest=False)
    near = torch.where(found.values < torch.inf, found.indices, itself[None, :, None])
    missing = itself[None, :, None].expand(len(near), n, neighbours - count)
    return torch.cat([near, missing], dim=2)
