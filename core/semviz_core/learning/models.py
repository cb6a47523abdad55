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
- The learning rate falls to 0 at the end: half of it brings more after some thousand samples.
- The pose loss follows the optimum of eq. 6-7 by second-order steps (``pnpl``), not by L-BFGS.

BPnPNet (Campbell, Liu, Gould 2020, with the graphs of Liu et al. 2020) is where the paper's
transport, back-end, losses and schedule come from. It knows points only, and k = 10.
"""

from dataclasses import asdict, dataclass

RAY_UNITS = (1.0 / 3.0, 1.0 / 8.0, 1.0)
"""Unit rays are divided by these before they enter,"""
UNITS_M = (25.0, 25.0, 3.0)
"""and coordinates of mapped points by these."""
LEAST_SQUARE = 1e-6
"""Of distances of features: the root has no slope at 0."""


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


def options_of(name: str, classes: list[str]) -> dict[str, object]:
    """What a matcher of ``MODELS`` is made with, as JSON."""
    units = {"ray_units": list(RAY_UNITS), "units_m": list(UNITS_M)}
    return {"model": asdict(MODELS[name]), **units, "classes": classes}
