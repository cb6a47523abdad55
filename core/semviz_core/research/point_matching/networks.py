"""The networks of 2D3D-MatchNet and DeepI2P between points, in torch.

Differences from the published networks, besides the inputs (`methods`) and fewer channels:

- 2D3D-MatchNet: a patch is a set, so a PointNet as for volumes takes the place of VGG-16.
- DeepI2P: with some thirty mapped points, all are nodes, and there is one level of them.
- Both: layers are normalized point by point, since frames differ in size; 2D3D-MatchNet then learns
  a few frames by heart in a third of the steps. Nothing is dropped out.

Bearings are level: gravity is taken out by the prior, as DeepI2P turns about the vertical only.
"""

from abc import abstractmethod
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from semviz_core.common.arrays import IntArray
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.localization.upright import ASSUMED_UP
from semviz_core.research.paper.matcher import UNITS_M
from semviz_core.research.point_matching.methods import PointModel
from semviz_core.research.training.batch import Batch

BEARING_UNITS = (1.0 / 3.0, 1.0, 1.0 / 8.0)
"""Level bearings (right, ahead, up) are divided by these, as the paper's matcher does with rays."""
VOLUME_M = 20.0
"""Radius about a mapped point; the published 1 m would hold no other element."""
DESCRIPTOR = 128
NEIGHBOURS = 16


class PointNetwork(nn.Module):
    """A network that matches the points of a frame."""

    def __init__(self, model: PointModel, classes: int) -> None:
        super().__init__()
        self.semantics = model.semantics
        self.classes = classes if model.semantics else 0

    def possible(self, batch: Batch) -> Tensor:
        """Return (b, m, n) the pairs that may match: known points, of one class if it is used."""
        pairs = batch.same_class if self.semantics else batch.possible
        return pairs & batch.seen_known[:, :, :1] & batch.mapped_known[:, None, :, 0]

    def pairs_of(self, sample: Sample) -> IntArray:
        """Return the matches (k, 2) of a frame, rows of observed and mapped points."""
        if not len(sample.ray) or not len(sample.point_m):
            return np.zeros((0, 2), np.int64)
        with torch.no_grad():
            matches = self.matches(Batch.of([sample]))[0].numpy()
        return np.argwhere(matches)

    @abstractmethod
    def matches(self, batch: Batch) -> Tensor:
        """Return (b, m, n) bool, at most one for each observed point."""

    def _one_hot(self, number: Tensor) -> Tensor:
        """Return (..., classes), or (..., 0) without semantics."""
        if not self.semantics:
            return torch.zeros((*number.shape, 0))
        return functional.one_hot(number, self.classes).float()


def make_network(model: PointModel, classes: int) -> "PointNetwork":
    return MatchNet(model, classes) if model.descriptors else DeepI2P(model, classes)


def level_bearings(batch: Batch) -> Tensor:
    """Return (b, m, 3) unit: right, ahead, up, where ahead is the horizontal optical axis."""
    up = batch.prior[:, :3]
    assumed = torch.from_numpy(np.asarray(ASSUMED_UP)).float()
    up = functional.normalize(torch.where((up * up).sum(1, keepdim=True) > 0.5, up, assumed), dim=1)
    optical = torch.tensor([0.0, 0.0, 1.0]).expand_as(up)
    right = functional.normalize(torch.linalg.cross(optical, up), dim=1)
    axes = torch.stack([right, torch.linalg.cross(up, right), up], dim=2)
    return batch.ray @ axes


def heights_m(batch: Batch) -> Tensor:
    """Return (b, n) the heights of mapped points over the road's plane."""
    slopes = batch.road[:, None, 1:]
    return batch.point_m[..., 2] - batch.road[:, :1] - (batch.point_m[..., :2] * slopes).sum(dim=2)


def layers(*widths: int) -> nn.Sequential:
    """Return linear layers, each normalized and with a ReLU."""
    steps: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        steps += [nn.Linear(inputs, outputs), nn.LayerNorm(outputs), nn.ReLU()]
    return nn.Sequential(*steps)


def _largest(features: Tensor, owner: Tensor, owners: int) -> Tensor:
    """Return (owners, c) the largest of features (k, c) >= 0 of each owner."""
    start = features.new_zeros((owners, features.shape[1]))
    index = owner[:, None].expand_as(features)
    return start.scatter_reduce(0, index, features, "amax", include_self=True)


class PointNet(nn.Module):
    """Unit descriptors of sets of points."""

    def __init__(self, inputs: int, turned: bool) -> None:
        super().__init__()
        self.turned = turned
        if turned:
            self.turn_points = layers(3, 64, 128, 256)
            hidden, last = layers(256, 128), nn.Linear(128, 9)
            nn.init.zeros_(last.weight)  # begins with the identity
            nn.init.zeros_(last.bias)
            self.turn = nn.Sequential(hidden, last)
        self.points = layers(inputs, 64, 64, 64, 128, 256)
        self.set = nn.Sequential(layers(256, DESCRIPTOR), nn.Linear(DESCRIPTOR, DESCRIPTOR))

    def forward(self, points: Tensor, owner: Tensor, owners: int) -> Tensor:
        """Return (owners, DESCRIPTOR) of points (k, inputs), whose first three may be turned."""
        if self.turned:
            place = points[:, :3]
            turn = self.turn(_largest(self.turn_points(place), owner, owners))
            turn = turn.view(-1, 3, 3) + torch.eye(3)
            place = (turn[owner] @ place[..., None])[..., 0]
            points = torch.cat([place, points[:, 3:]], dim=1)
        return functional.normalize(self.set(_largest(self.points(points), owner, owners)), dim=1)


class MatchNet(PointNetwork):
    """2D3D-MatchNet: descriptors of observed and of mapped points in one space."""

    def __init__(self, model: PointModel, classes: int) -> None:
        super().__init__(model, classes)
        self.seen = PointNet(5 + 2 * self.classes, turned=False)
        self.mapped = PointNet(4 + 2 * self.classes, turned=True)

    def distances(self, batch: Batch) -> Tensor:
        """Return (b, m, n) the distances of descriptors."""
        seen, mapped = self._seen(batch), self._mapped(batch)
        return (2.0 - 2.0 * seen @ mapped.transpose(1, 2)).clamp_min(1e-6).sqrt()

    def matches(self, batch: Batch) -> Tensor:
        possible = self.possible(batch)
        distance = self.distances(batch).masked_fill(~possible, torch.inf)
        nearest = functional.one_hot(distance.argmin(dim=2), possible.shape[2])
        return nearest.bool() & possible

    def _seen(self, batch: Batch) -> Tensor:
        """Return (b, m, DESCRIPTOR): a point's patch is all bearings, itself included."""
        level = level_bearings(batch)
        bearing = torch.stack([torch.atan2(level[..., 0], level[..., 1]), level[..., 2].asin()], 2)
        known = batch.seen & batch.seen_known[..., 0]
        return self._described(
            self.seen,
            (known[:, :, None] & known[:, None, :]).nonzero(),
            bearing / torch.tensor([BEARING_UNITS[0], BEARING_UNITS[2]]),
            level / torch.tensor(BEARING_UNITS),
            batch.seen_class,
        )

    def _mapped(self, batch: Batch) -> Tensor:
        """Return (b, n, DESCRIPTOR): a point's volume is the points near it, itself included."""
        near = torch.cdist(batch.point_m, batch.point_m) < VOLUME_M
        units = torch.tensor(UNITS_M)
        return self._described(
            self.mapped,
            (near & batch.mapped[:, :, None] & batch.mapped[:, None, :]).nonzero(),
            batch.point_m / units,
            heights_m(batch)[..., None] / units[2],
            batch.mapped_class,
        )

    def _described(
        self, network: PointNet, pairs: Tensor, place: Tensor, own: Tensor, number: Tensor
    ) -> Tensor:
        """Describe points by ``pairs`` (k, 3) of frame, point and a point near it.

        ``place`` (b, p, 2 or 3) enters as a difference, ``own`` (b, p, ...) is that of the point.
        """
        frame, point, near = pairs.T
        one_hot = self._one_hot(number)
        inputs = [
            place[frame, near] - place[frame, point],
            own[frame, point],
            one_hot[frame, near],
            one_hot[frame, point],
        ]
        b, p = number.shape
        descriptors: Tensor = network(torch.cat(inputs, dim=1), frame * p + point, b * p)
        return descriptors.view(b, p, DESCRIPTOR)


class DeepI2P(PointNetwork):
    """DeepI2P: which mapped points are in the image, and at which observed point."""

    def __init__(self, model: PointModel, classes: int) -> None:
        super().__init__(model, classes)
        self.points = layers(4 + self.classes, 32, 32, 32)
        self.nodes = layers(64, 64, 64)
        self.cloud = layers(3 + 64, 128, 256)
        self.seen = layers(3 + self.classes, 64, 64, DESCRIPTOR)
        self.query = nn.Linear(64 + DESCRIPTOR, DESCRIPTOR)
        self.head = layers(64 + 32 + 256 + 2 * DESCRIPTOR, 256, 256)
        self.inside = nn.Linear(256, 2)
        self.place = nn.Linear(256, DESCRIPTOR)
        self.key = nn.Linear(DESCRIPTOR, DESCRIPTOR)
        self.none = nn.Parameter(torch.zeros(()))

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return logits (b, n, 2) of a mapped point outside and inside of the image, and logits
        (b, n, m + 1) of its observed point, the last of none."""
        known = batch.seen & batch.seen_known[..., 0]
        level = level_bearings(batch) / torch.tensor(BEARING_UNITS)
        seen = self.seen(torch.cat([level, self._one_hot(batch.seen_class)], dim=2))
        image = (seen * known[..., None]).amax(dim=1, keepdim=True)
        place = batch.point_m / torch.tensor(UNITS_M)
        point, node, cloud = self._cloud(batch, place)
        image = image.expand(-1, place.shape[1], -1)
        weight = self.query(torch.cat([node, image], dim=2)) @ seen.transpose(1, 2)
        weight = (weight / DESCRIPTOR**0.5).masked_fill(~known[:, None, :], -torch.inf)
        attended = weight.softmax(dim=2).nan_to_num() @ seen  # no known point: zeros
        cloud = cloud[:, None, :].expand(-1, place.shape[1], -1)
        features = self.head(torch.cat([node, point, cloud, attended, image], dim=2))
        cell = self.place(features) @ self.key(seen).transpose(1, 2) / DESCRIPTOR**0.5
        cell = cell.masked_fill(~self.possible(batch).transpose(1, 2), -torch.inf)
        none = self.none.expand(*cell.shape[:2], 1)
        return self.inside(features), torch.cat([cell, none], dim=2)

    def _cloud(self, batch: Batch, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return features of points (b, n, 32), of nodes (b, n, 64) and of the cloud (b, 256)."""
        height = heights_m(batch)[..., None] / UNITS_M[2]
        one_hot = self._one_hot(batch.mapped_class)
        points = self.points(torch.cat([place, height, one_hot], dim=2))
        points = points * batch.mapped[..., None]  # >= 0: padding is never the largest
        distance = torch.cdist(place, place).masked_fill(~batch.mapped[:, None, :], torch.inf)
        near = distance.topk(min(NEIGHBOURS, place.shape[1]), dim=2, largest=False).indices
        rows = torch.arange(len(batch))[:, None, None]
        nodes = self.nodes(torch.cat([points, points[rows, near].amax(dim=2)], dim=2))
        cloud = self.cloud(torch.cat([place, nodes], dim=2)) * batch.mapped[..., None]
        return points, nodes, cloud.amax(dim=1)

    def matches(self, batch: Batch) -> Tensor:
        """Of the mapped points at one observed point, the most probable matches."""
        logits: tuple[Tensor, Tensor] = self(batch)
        inside, cell = logits
        probability = cell.softmax(dim=2)
        is_likeliest = functional.one_hot(cell.argmax(dim=2), cell.shape[2]).bool()
        is_inside = inside[..., 1] > inside[..., 0]
        chosen = is_likeliest & is_inside[..., None] & batch.mapped[..., None]
        probability = (probability * chosen)[..., :-1].transpose(1, 2)  # (b, m, n)
        best = functional.one_hot(probability.argmax(dim=2), probability.shape[2]).bool()
        return best & (probability > 0.0)
