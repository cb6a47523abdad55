"""The paper's learned matcher and those it is compared with (Chen, Xue, Pang, RA-L 2022).

Two streams of a graph network give features; their distances are costs (eq. 2), and an optimal
transport with uniform priors turns those into P (eq. 3-4). What is not as written, and why:

- Inputs are in units of how much they vary (``RAY_UNITS``, ``UNITS_M``). In metres a class, one
  step along a one-hot axis, would not keep elements apart in the first layers, as the paper says
  that it does; and heights, which say most of what is what, would hardly count: with one unit for
  all three axes training needs about three times as many samples to come as far.
- Features have length 1, as in Campbell et al. 2020, whose transport and mu these are: costs are
  then at most 2, and mu = 0.1 means the same for every frame. The paper does not say.
- Features are normalized over the elements of a frame only (``networks.graph``).
- The correspondence loss counts pairs, not mass (``losses``).
- The pose loss follows the optimum of eq. 6-7 by second-order steps (``pnpl``), not by L-BFGS.

BPnPNet (Campbell, Liu, Gould 2020, with the graphs of Liu et al. 2020) is where the paper's
transport, back-end, losses and schedule come from. It knows points only, and k = 10.
"""

from dataclasses import asdict, dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from semviz_core.learning.batch import Batch
from semviz_core.learning.networks.graph import GraphNetwork
from semviz_core.learning.transport import sinkhorn

RAY_UNITS = (1.0 / 3.0, 1.0 / 8.0, 1.0)
"""Unit rays are divided by these before they enter,"""
UNITS_M = (25.0, 25.0, 3.0)
"""and coordinates of mapped points by these."""
_LEAST_SQUARE = 1e-6  # of distances: the root has no slope at 0


@dataclass(frozen=True)
class Model:
    """What sets the paper's matcher and those it is compared with apart."""

    semantics: bool
    """Classes are inputs."""
    branches: bool
    """Each class has a transport of its own; else all elements share one."""
    lines: bool
    """Directions of poles are inputs; else bottoms are points beside the peaks
    (``splitting``)."""
    neighbours: int
    """k of the graphs."""


MODELS = {
    "paper": Model(semantics=True, branches=True, lines=True, neighbours=4),
    "paper-no-semantics": Model(semantics=False, branches=False, lines=True, neighbours=4),
    "bpnpnet": Model(semantics=False, branches=False, lines=False, neighbours=10),
    "bpnpnet-semantic": Model(semantics=True, branches=False, lines=False, neighbours=10),
}


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
        return square.clamp(min=_LEAST_SQUARE).sqrt()

    def _inputs(self, place: Tensor, down: Tensor, element_class: Tensor) -> Tensor:
        """(b, k, inputs): place, and as the model has them direction (0 for points) and class."""
        parts = [place]
        if self.model.lines:
            parts.append(functional.normalize(down, dim=2))
        if self.model.semantics:
            parts.append(functional.one_hot(element_class, self.classes).to(place.dtype))
        return torch.cat(parts, dim=2)


def options_of(name: str, classes: list[str]) -> dict[str, object]:
    """What a matcher of ``MODELS`` is made with, as JSON."""
    units = {"ray_units": list(RAY_UNITS), "units_m": list(UNITS_M)}
    return {"model": asdict(MODELS[name]), **units, "classes": classes}
