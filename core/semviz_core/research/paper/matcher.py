"""The paper's learned matcher and its baselines (Chen, Xue, Pang, RA-L 2022), for inference.

Two streams of a graph network give features. Their distances are costs (eq. 2), and an optimal
transport with uniform priors, without dustbins, turns those into P (eq. 3-4). For one frame it
is Sinkhorn scaling in NumPy, valid for costs up to 2 and mu = 0.1; `transport` does the same
for batches with gradients. Differences from the paper, and why:

- Inputs are scaled by how much they vary (``RAY_UNITS``, ``UNITS_M``). In metres, a one-hot
  class step would not separate elements in the first layers, as the paper assumes, and heights,
  the most informative input, would hardly count. One unit for all three axes needs about three
  times as many samples.
- Features have length 1, as in Campbell et al. 2020, whose transport and mu these are. Costs
  are then at most 2, and mu = 0.1 means the same for every frame. The paper does not specify
  this.
- Features are normalized over the elements of a frame only (`matcher_torch`).
- The correspondence loss counts pairs, not mass (`training`).
- The learning rate falls to 0 at the end: after a few thousand samples, half the rate learns
  more.
- The pose loss follows the optimum of eq. 6-7 by second-order steps (`pnpl_layer`), not by
  L-BFGS.

BPnPNet (Campbell, Liu, Gould 2020, with the graphs of Liu et al. 2020) is the source of the
paper's transport, back end, losses and schedule. It takes only points (``split_lines``), and
k = 10.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.weights import NetworkWeights, load_trained, version_error
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.common.jit import compiled
from semviz_core.localization.correspondences.candidate_pairs import (
    PRIOR_LENGTH,
    Sample,
    SampleTarget,
)

Floats = NDArray[np.floating[Any]]


@compiled
def mean_of_edges(ends: Floats, near: IntArray) -> Floats:
    """Return (r, c) the mean over q of max(0, anchor_i + neighbour_j), j = near[i, q]."""
    rows, count = near.shape
    channels = ends.shape[1] // 2
    zero, share = ends.dtype.type(0.0), ends.dtype.type(1.0 / count)
    mean = np.zeros((rows, channels), ends.dtype)
    for i in range(rows):
        for j in near[i]:
            for c in range(channels):
                edge = ends[i, c] + ends[j, channels + c]
                mean[i, c] += edge if edge > zero else zero
        for c in range(channels):
            mean[i, c] *= share
    return mean


@compiled
def gradient_of_edges(ends: Floats, near: IntArray, by_mean: Floats) -> Floats:
    """Return the gradient (r, 2 c) by ``ends``, given that by the mean (r, c)."""
    rows, count = near.shape
    channels = ends.shape[1] // 2
    zero, share = ends.dtype.type(0.0), ends.dtype.type(1.0 / count)
    gradient = np.zeros_like(ends)
    for i in range(rows):
        for j in near[i]:
            for c in range(channels):
                edge = ends[i, c] + ends[j, channels + c]
                by_edge = by_mean[i, c] * share if edge > zero else zero
                gradient[i, c] += by_edge
                gradient[j, channels + c] += by_edge
    return gradient


CHANNELS = 128
LAYERS = 12
EPSILON = 1e-3
"""Added to variances: a channel that is equal for all elements of a frame has none."""
Float32 = NDArray[np.float32]


def graph_features(
    tensors: Mapping[str, Float32], stream: str, elements: Float32, neighbours: int
) -> Float32:
    """Return the features (n, CHANNELS) of elements (n, inputs), as ``GraphNetwork.forward``.

    ``tensors`` holds the parameters by torch's names, which begin with ``stream``. Raise KeyError
    or ValueError for another network.
    """

    def linear(name: str, inputs: Float32) -> Float32:
        weight, bias = tensors[f"{stream}.{name}.weight"], tensors[f"{stream}.{name}.bias"]
        return np.asarray(inputs @ weight.T + bias)

    features = linear("inlet", elements)
    for layer in range(LAYERS):
        normal = _context_norm(features)
        near = _nearest(normal, neighbours)
        hidden = mean_of_edges(linear(f"layers.{layer}.before", normal), near)
        features = features + linear(f"layers.{layer}.after", hidden)
    return linear("outlet", _context_norm(features))


def _context_norm(features: Float32) -> Float32:
    centred = features - features.mean(axis=0)
    variance = np.square(centred).mean(axis=0)
    return np.asarray(centred / np.sqrt(variance + np.float32(EPSILON)))


def _nearest(features: Float32, neighbours: int) -> NDArray[np.int64]:
    """Return (n, neighbours) rows; the element itself fills up if there are too few others."""
    n = len(features)
    itself = np.arange(n)
    product = features @ features.T
    distance = product.diagonal() - 2.0 * product
    distance[itself, itself] = np.inf
    count = min(neighbours, n - 1)
    near = np.tile(itself[:, None], (1, neighbours))
    if count:
        near[:, :count] = np.argpartition(distance, count - 1, axis=1)[:, :count]
    return near


RAY_UNITS = (1.0 / 3.0, 1.0 / 8.0, 1.0)
"""Unit rays are divided by these before they enter the network."""
UNITS_M = (25.0, 25.0, 3.0)
"""Coordinates of mapped points are divided by these."""
LEAST_SQUARE = 1e-6
"""Least squared distance of features: the root has no gradient at 0."""


@dataclass(frozen=True)
class Model:
    """The differences between the paper's matcher and its baselines."""

    semantics: bool
    """Classes are inputs."""
    branches: bool
    """Each class has its own transport; otherwise all elements share one."""
    lines: bool
    """Directions of poles are inputs; otherwise bottoms are points besides the peaks
    (``split_lines``)."""
    neighbours: int
    """k of the graphs."""


MODELS = {
    "paper": Model(semantics=True, branches=True, lines=True, neighbours=4),
    "paper-no-semantics": Model(semantics=False, branches=False, lines=True, neighbours=4),
    "bpnpnet": Model(semantics=False, branches=False, lines=False, neighbours=10),
    "bpnpnet-semantic": Model(semantics=True, branches=False, lines=False, neighbours=10),
}


def options_of(name: str, classes: list[str]) -> dict[str, object]:
    """Return the options of a matcher of ``MODELS`` as JSON."""
    units = {"ray_units": list(RAY_UNITS), "units_m": list(UNITS_M)}
    return {"model": asdict(MODELS[name]), **units, "classes": classes}


MU = 0.1
"""Weight of the entropy in eq. 3."""
TOLERANCE = 1e-9
"""Converged if no row's total has a larger relative error; columns are exact."""
MOST_SWEEPS = 5000


def uniform_transport(cost: FloatArray, possible: BoolArray, mu: float = MU) -> FloatArray:
    """Return P (m, n) of ``cost`` (m, n), 0 for pairs that are not ``possible`` (m, n).

    Possible pairs form blocks in which every row goes with every column: classes, or all elements.
    The P of each block sums to 1.
    """
    P = np.zeros(cost.shape)
    remaining: BoolArray = np.asarray(possible.any(axis=1))
    while remaining.any():
        columns = np.flatnonzero(possible[np.argmax(remaining)])
        rows = np.flatnonzero(possible[:, columns[0]])
        block = np.ix_(rows, columns)
        P[block] = _scaled(np.exp(cost[block] / -mu))
        remaining[rows] = False
    return P


@compiled
def _scaled(kernel: FloatArray) -> FloatArray:
    m, n = kernel.shape
    a, b = np.full(m, 1.0 / m), np.full(n, 1.0 / n)
    for _ in range(MOST_SWEEPS):
        b[:] = 1.0 / (n * (a @ kernel))
        totals = kernel @ b
        if np.abs(a * totals * m - 1.0).max() < TOLERANCE:
            break
        a[:] = 1.0 / (m * totals)
    return a[:, None] * kernel * b


@dataclass(frozen=True, eq=False)
class SoftMatches:
    """The paper's P of one frame."""

    sample: Sample
    """The input: the frame's elements, then the bottoms of poles if lines are split."""
    cost: FloatArray
    """(m, n) eq. 2."""
    possible: BoolArray
    """(m, n) the blocks of the transport."""
    probability: FloatArray
    """(m, n) P of eq. 3-4; 0 for pairs that are not possible."""


@dataclass(frozen=True, eq=False)
class Matcher:
    """A trained network with its classes."""

    model: Model
    weights: NetworkWeights
    classes: ClassSet

    def match(
        self, observed: Elements2D, submap: Elements3D, camera: Camera, prior: Prior
    ) -> SoftMatches:
        sample = Sample.of(observed, submap, camera, prior, self.classes)
        if not self.model.lines:
            sample = split_lines(sample)
        return self.of_sample(sample)

    def of_sample(self, sample: Sample) -> SoftMatches:
        """Return the matches of a sample, whose lines are split already if the model needs it."""
        possible = np.ones((len(sample.ray), len(sample.point_m)), dtype=bool)
        if self.model.branches:
            possible = sample.seen_class[:, None] == sample.mapped_class
        cost = self._cost(sample)
        return SoftMatches(sample, cost, possible, uniform_transport(cost, possible))

    def _cost(self, sample: Sample) -> FloatArray:
        """Return the costs (m, n), as ``GraphMatcher.cost``."""
        top, bottom = (ray / ray[:, 2:] for ray in (sample.ray, sample.bottom_ray))
        seen = self._inputs(sample.ray / RAY_UNITS, bottom - top, sample.seen_class)
        down = sample.bottom_m - sample.point_m
        mapped = self._inputs(sample.point_m / UNITS_M, down, sample.mapped_class)
        seen_features, mapped_features = (
            self._features("seen", seen),
            self._features("mapped", mapped),
        )
        square = 2.0 - 2.0 * (seen_features @ mapped_features.T).astype(np.float64)
        return np.asarray(np.sqrt(np.maximum(square, LEAST_SQUARE)))

    def _inputs(self, place: FloatArray, down: FloatArray, element_class: IntArray) -> Float32:
        parts = [place]
        if self.model.lines:
            parts.append(unit_vectors(down))
        if self.model.semantics:
            parts.append(np.eye(len(self.classes))[element_class])
        return np.concatenate(parts, axis=1).astype(np.float32)

    def _features(self, stream: str, inputs: Float32) -> Float32:
        """Return unit features (k, CHANNELS)."""
        tensors, k = self.weights.tensors, self.model.neighbours
        return unit_vectors(graph_features(tensors, stream, inputs, k))


def load_matcher(name: str, path: Path | None, classes: ClassSet) -> Matcher:
    """Return the matcher ``name`` with the weights at ``path`` (default: the shipped ones).

    Raise SemvizError if the file is missing or holds another network.
    """
    return load_trained(name, path, classes, _built)


def _built(weights: NetworkWeights, classes: ClassSet, path: Path) -> Matcher:
    matcher = Matcher(MODELS[weights.task], weights, classes)
    try:
        matcher.of_sample(_smallest())
    except (KeyError, ValueError):  # other names, other shapes
        raise version_error(weights.task, path) from None
    return matcher


def _smallest() -> Sample:
    """Return a sample of one observed and one mapped element."""
    point, class_id, known = (
        np.array([[0.0, 0.0, 1.0]]),
        np.zeros(1, np.int64),
        np.ones((1, 2), bool),
    )
    return Sample(
        ray=point, bottom_ray=point, sigma_rad=np.ones((1, 2)), score=np.ones(1),
        seen_class=class_id, seen_known=known, point_m=point, bottom_m=point,
        mapped_class=class_id, mapped_known=known, road=np.zeros(3),
        prior=np.zeros(PRIOR_LENGTH), origin_m=np.zeros(3),
    )  # fmt: skip


def split_lines(sample: Sample) -> Sample:
    """Return the sample as points only: first all anchors, then the known bottoms of poles.

    The bottoms of a true pair are a true pair too, hidden or not.
    """
    seen, mapped = _bottoms(sample.seen_known), _bottoms(sample.mapped_known)
    seen_rows = np.append(np.arange(len(sample.ray)), seen)
    mapped_rows = np.append(np.arange(len(sample.point_m)), mapped)
    ray = np.concatenate([sample.ray, sample.bottom_ray[seen]])
    point_m = np.concatenate([sample.point_m, sample.bottom_m[mapped]])
    truth = sample.truth
    if truth is not None:
        below = truth.pairs[np.ix_(seen, mapped)]
        corner = np.zeros((len(sample.ray), len(mapped)), dtype=bool)
        other = np.zeros((len(seen), len(sample.point_m)), dtype=bool)
        pairs = np.block([[truth.pairs, corner], [other, below]])
        truth = SampleTarget(truth.rotation, truth.translation, pairs)
    return replace(
        sample,
        ray=ray,
        bottom_ray=ray,
        sigma_rad=sample.sigma_rad[seen_rows],
        score=sample.score[seen_rows],
        seen_class=sample.seen_class[seen_rows],
        seen_known=_points_known(sample.seen_known, seen),
        point_m=point_m,
        bottom_m=point_m,
        mapped_class=sample.mapped_class[mapped_rows],
        mapped_known=_points_known(sample.mapped_known, mapped),
        truth=truth,
    )


def _bottoms(known: BoolArray) -> IntArray:
    """Return the rows of poles whose bottom is known; points have none."""
    return np.flatnonzero(known[:, 1])


def _points_known(known: BoolArray, bottoms: IntArray) -> BoolArray:
    """Return (k, 2) the known flags of anchors, then bottoms; points have no end."""
    first = np.append(known[:, 0], np.ones(len(bottoms), dtype=bool))
    return np.column_stack([first, np.zeros(len(first), dtype=bool)])
