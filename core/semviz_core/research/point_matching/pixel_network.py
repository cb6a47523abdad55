"""The network of DeepI2P from pixels, in torch: which points of a cloud are inside a picture, and
in which of its cells.

It follows the published network (Li, Lee, CVPR 2021), with a quarter to half of its channels and
a twentieth of its points. Further differences:

- The image's ResNet has 18 layers of 16 to 128 channels and no weights from elsewhere.
- A point's place about the local origin is an input beside that about its node, so that a small
  network need not piece it together from its neighbours.
- Features go from nodes B to nodes A to points; published, also from B to points.
- Groups or points are normalized, not batches; nothing is dropped out.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.research.evaluation.street_frames import COLUMNS, ROWS
from semviz_core.research.point_matching.networks import layers

CELLS = COLUMNS * ROWS
NODES_A, NODES_B = 64, 64
NEIGHBOURS_A, NEAREST = 16, 3
POINTS = 1024
"""Of a cloud."""
CANDIDATES = 512
"""Points that nodes are chosen among."""
PLACE_UNIT_M = 20.0
_WIDTH = 16
_GROUPS = 8


@dataclass(frozen=True, eq=False)
class CloudBatch:
    """p pictures with b clouds of n points, as many for each picture."""

    picture: Tensor
    """(p, 160, 640, 3) uint8"""
    points: Tensor
    """(b, n, 7) local: point (m), intensity, normal."""
    node_a: Tensor
    """(b, NODES_A) int64 rows of points."""
    node_b: Tensor
    """(b, NODES_B)"""
    inside: Tensor
    """(b, n) bool, the truth; False where it is not known."""
    cell: Tensor
    """(b, n) int64, where inside."""

    def to(self, device: torch.device) -> "CloudBatch":
        moved = {field.name: getattr(self, field.name).to(device) for field in fields(self)}
        return CloudBatch(**moved)


class _Block(nn.Module):
    """Two convolutions and a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = _convolution(inputs, outputs, 3, stride)
        self.second = _convolution(outputs, outputs, 3, 1)
        is_same = inputs == outputs and stride == 1
        self.shortcut = nn.Identity() if is_same else _convolution(inputs, outputs, 1, stride)

    def forward(self, maps: Tensor) -> Tensor:
        change: Tensor = self.second(functional.relu(self.first(maps)))
        return functional.relu(change + self.shortcut(maps))


def _convolution(inputs: int, outputs: int, size: int, stride: int) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
    return nn.Sequential(convolution, nn.GroupNorm(_GROUPS, outputs))


class DeepI2PPixels(nn.Module):
    """Classifies the points of a cloud by a picture."""

    def __init__(self) -> None:
        super().__init__()
        w = _WIDTH
        self.stem = nn.Sequential(_convolution(3, w, 7, 2), nn.ReLU(), nn.MaxPool2d(3, 2, 1))
        stages = [(w, w, 1), (w, 2 * w, 2), (2 * w, 4 * w, 2), (4 * w, 8 * w, 2)]
        self.stages = nn.ModuleList(
            nn.Sequential(_Block(inputs, outputs, stride), _Block(outputs, outputs, 1))
            for inputs, outputs, stride in stages
        )
        self.point = layers(10, 16, 16, 32)
        self.point_at_a = layers(64, 32, 32)
        self.a_at_b = layers(3 + 32, 64, 64)
        self.b = layers(128, 128, 128)
        self.cloud = layers(3 + 128, 128, 256)
        self.weight_b = nn.Sequential(layers(128 + 128, 128), nn.Linear(128, CELLS))
        self.fused_b = layers(128 + 128 + 128 + 256, 256, 128)
        self.weight_a = nn.Sequential(layers(32 + 128, 128), nn.Linear(128, 4 * CELLS))
        self.fused_a = layers(32 + 128 + 64, 128, 64)
        self.head = nn.Sequential(layers(64 + 32 + 32, 128, 128), nn.Linear(128, 2 + CELLS))

    def labels(self, picture: ByteImage, points: FloatArray) -> tuple[BoolArray, IntArray]:
        """Return which points (n, 7) are called inside, and their likeliest cells (n,).

        n is a multiple of ``POINTS``; each so many are a cloud, as in training.
        """
        rng = np.random.default_rng(0)
        clouds = points.reshape(-1, POINTS, points.shape[1])
        node = np.array([nodes(cloud, rng) for cloud in clouds])
        unknown = np.zeros(clouds.shape[:2], dtype=np.int64)
        frame = picture[None], clouds.astype(np.float32), node[:, 0], node[:, 1], unknown, unknown
        with torch.no_grad():
            inside, cell = self(CloudBatch(*map(torch.from_numpy, frame)))
        called = (inside[..., 1] > inside[..., 0]).flatten()
        return called.numpy(), cell.argmax(dim=2).flatten().numpy()

    def forward(self, batch: CloudBatch) -> tuple[Tensor, Tensor]:
        """Return logits (b, n, 2) of a point outside and inside of the picture, and (b, n, CELLS)
        of its cell."""
        clouds = len(batch.points) // len(batch.picture)
        fine, coarse = (maps.repeat_interleave(clouds, 0) for maps in self._maps(batch.picture))
        image = coarse.mean(dim=2)
        place = batch.points[..., :3] / PLACE_UNIT_M
        at_a, at_b = _taken(place, batch.node_a), _taken(place, batch.node_b)
        own = torch.cdist(place, at_a).argmin(dim=2)
        offset = place - _taken(at_a, own)
        point = self.point(torch.cat([place, offset, batch.points[..., 3:]], dim=2))
        both = torch.cat([point, _taken(_pooled(point, own), own)], dim=2)
        point_at_a = self.point_at_a(both)
        a = _pooled(point_at_a, own)
        b = self._nodes_b(a, at_a, at_b)
        cloud = self.cloud(torch.cat([at_b, b], dim=2)).amax(dim=1)
        b = self._with_picture(b, coarse, self.weight_b, self.fused_b, image, cloud)
        b_at_a = _interpolated(b, at_b, at_a)
        weight = self.weight_a(torch.cat([a, _to_each(image, a)], dim=2))
        seen = weight @ fine.transpose(1, 2) / fine.shape[2]
        a = self.fused_a(torch.cat([a, b_at_a, seen], dim=2))
        features = torch.cat([_interpolated(a, at_a, place), point, point_at_a], dim=2)
        logits: Tensor = self.head(features)
        return logits[..., :2], logits[..., 2:]

    def _maps(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """Return features (b, 64, 4 CELLS) at 1/16, and (b, 128, CELLS) at 1/32."""
        maps = self.stem((picture.permute(0, 3, 1, 2).float() - 128.0) / 64.0)
        *early, third, last = self.stages
        for stage in early:
            maps = stage(maps)
        fine = third(maps)
        return fine.flatten(2), last(fine).flatten(2)

    def _nodes_b(self, a: Tensor, at_a: Tensor, at_b: Tensor) -> Tensor:
        """Return (b, NODES_B, 128) features of nodes B from the nodes A next to them."""
        near = torch.cdist(at_b, at_a).topk(NEIGHBOURS_A, dim=2, largest=False).indices
        flat = near.flatten(1)
        shape = (*near.shape, -1)
        offset = _taken(at_a, flat).view(shape) - at_b[:, :, None]
        each = self.a_at_b(torch.cat([offset, _taken(a, flat).view(shape)], dim=3))
        largest = each.amax(dim=2, keepdim=True).expand_as(each)
        features: Tensor = self.b(torch.cat([each, largest], dim=3))
        return features.amax(dim=2)

    def _with_picture(
        self,
        node: Tensor,
        maps: Tensor,
        weight: nn.Module,
        fuse: nn.Module,
        image: Tensor,
        cloud: Tensor,
    ) -> Tensor:
        whole = _to_each(image, node)
        seen = weight(torch.cat([node, whole], dim=2)) @ maps.transpose(1, 2) / maps.shape[2]
        fused: Tensor = fuse(torch.cat([node, seen, whole, _to_each(cloud, node)], dim=2))
        return fused


def _to_each(whole: Tensor, nodes: Tensor) -> Tensor:
    return whole[:, None].expand(-1, nodes.shape[1], -1)


def _taken(values: Tensor, rows: Tensor) -> Tensor:
    """Return (b, k, c) of values (b, n, c) at rows (b, k)."""
    return values.gather(1, rows[..., None].expand(-1, -1, values.shape[2]))


def _pooled(features: Tensor, node: Tensor) -> Tensor:
    """Return (b, NODES_A, c) the largest of features (b, n, c) >= 0 of each node's points."""
    start = features.new_zeros((len(features), NODES_A, features.shape[2]))
    index = node[..., None].expand_as(features)
    return start.scatter_reduce(1, index, features, "amax", include_self=True)


def _interpolated(features: Tensor, at: Tensor, place: Tensor) -> Tensor:
    """Return (b, k, c) of node features (b, m, c) at places (b, k, 3), from the nearest three."""
    distance, rows = torch.cdist(place, at).topk(NEAREST, dim=2, largest=False)
    weight = 1.0 / (distance + 1e-2)
    weight = weight / weight.sum(dim=2, keepdim=True)
    taken = _taken(features, rows.flatten(1)).view(*rows.shape, -1)
    return (taken * weight[..., None]).sum(dim=2)


def nodes(points: FloatArray, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    """Return nodes A and B, rows of points, each far from the others (farthest point sampling)."""
    sampled = []
    for count in (NODES_A, NODES_B):
        rows = rng.permutation(len(points))[:CANDIDATES]
        place, chosen = points[rows, :3], [0]
        distance = np.full(len(rows), np.inf)
        while len(chosen) < count:
            distance = np.minimum(distance, ((place - place[chosen[-1]]) ** 2).sum(axis=1))
            chosen.append(int(distance.argmax()))
        sampled.append(rows[chosen])
    return sampled[0], sampled[1]
