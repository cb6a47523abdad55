"""The paper's matcher in torch: the features of two streams, and the transport between them."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from semviz_core.learning.batch import Batch
from semviz_core.learning.models import LEAST_SQUARE, RAY_UNITS, UNITS_M, Model
from semviz_core.learning.networks.graph import GraphNetwork
from semviz_core.learning.transport import sinkhorn


@dataclass(frozen=True, eq=False)
class Correspondence:
    """What a matcher says of every pair of a batch."""

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
        """(b, m, n) bool: the blocks of the transport."""
        return batch.same_class if self.model.branches else batch.possible

    def cost(self, batch: Batch) -> Tensor:
        """(b, m, n) distances of features of length 1 (eq. 2)."""
        top, bottom = (ray / ray[..., 2:] for ray in (batch.ray, batch.bottom_ray))
        ray = batch.ray / batch.ray.new_tensor(RAY_UNITS)
        seen = self._inputs(ray, bottom - top, batch.seen_class)
        down = batch.bottom_m - batch.point_m
        place = batch.point_m / batch.point_m.new_tensor(UNITS_M)
        mapped = self._inputs(place, down, batch.mapped_class)
        one = functional.normalize(self.seen(seen, batch.seen), dim=2)
        other = functional.normalize(self.mapped(mapped, batch.mapped), dim=2)
        square = 2.0 - 2.0 * one @ other.transpose(1, 2)
        return square.clamp(min=LEAST_SQUARE).sqrt()

    def _inputs(self, place: Tensor, down: Tensor, element_class: Tensor) -> Tensor:
        """(b, k, inputs): place, and as the model has them direction (0 for points) and class."""
        parts = [place]
        if self.model.lines:
            parts.append(functional.normalize(down, dim=2))
        if self.model.semantics:
            parts.append(functional.one_hot(element_class, self.classes).to(place.dtype))
        return torch.cat(parts, dim=2)
