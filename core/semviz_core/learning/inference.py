"""What a trained matcher of ``models`` says of one frame, without torch."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.classes import ClassSet
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.learning.models import LEAST_SQUARE, MODELS, RAY_UNITS, UNITS_M, Model
from semviz_core.learning.networks.graph_numpy import Float32, graph_features
from semviz_core.learning.sample import PRIOR_LENGTH, Sample
from semviz_core.learning.splitting import split_lines
from semviz_core.learning.weights import Weights, load_trained, other_version
from semviz_core.matching.uniform import uniform_transport


@dataclass(frozen=True, eq=False)
class SoftMatches:
    """The paper's P of one frame."""

    sample: Sample
    """What was matched: the frame's elements first; poles' bottoms follow where lines are split."""
    cost: FloatArray
    """(m, n) eq. 2."""
    possible: BoolArray
    """(m, n) the blocks of the transport."""
    probability: FloatArray
    """(m, n) P of eq. 3-4; 0 for pairs that are not possible."""


@dataclass(frozen=True, eq=False)
class Matcher:
    """A trained network, and the classes that it knows."""

    model: Model
    weights: Weights
    classes: ClassSet

    def match(
        self, observed: Elements2D, submap: Elements3D, camera: Camera, prior: Prior
    ) -> SoftMatches:
        sample = Sample.of(observed, submap, camera, prior, self.classes)
        if not self.model.lines:
            sample = split_lines(sample)
        return self.of_sample(sample)

    def of_sample(self, sample: Sample) -> SoftMatches:
        """Of a sample whose lines are split already, where the model wants that."""
        possible = np.ones((len(sample.ray), len(sample.point_m)), dtype=bool)
        if self.model.branches:
            possible = sample.seen_class[:, None] == sample.mapped_class
        cost = self._cost(sample)
        return SoftMatches(sample, cost, possible, uniform_transport(cost, possible))

    def _cost(self, sample: Sample) -> FloatArray:
        """(m, n) as ``GraphMatcher.cost``."""
        top, bottom = (ray / ray[:, 2:] for ray in (sample.ray, sample.bottom_ray))
        seen = self._inputs(sample.ray / RAY_UNITS, bottom - top, sample.seen_class)
        down = sample.bottom_m - sample.point_m
        mapped = self._inputs(sample.point_m / UNITS_M, down, sample.mapped_class)
        one, other = self._features("seen", seen), self._features("mapped", mapped)
        square = 2.0 - 2.0 * (one @ other.T).astype(np.float64)
        return np.asarray(np.sqrt(np.maximum(square, LEAST_SQUARE)))

    def _inputs(self, place: FloatArray, down: FloatArray, element_class: IntArray) -> Float32:
        parts = [place]
        if self.model.lines:
            parts.append(_unit(down))
        if self.model.semantics:
            parts.append(np.eye(len(self.classes))[element_class])
        return np.concatenate(parts, axis=1).astype(np.float32)

    def _features(self, stream: str, inputs: Float32) -> Float32:
        """(k, CHANNELS) of length 1."""
        tensors, k = self.weights.tensors, self.model.neighbours
        return _unit(graph_features(tensors, stream, inputs, k)).astype(np.float32)


def load_matcher(name: str, path: Path | None, classes: ClassSet) -> Matcher:
    """The matcher called ``name`` with the weights at ``path``, or those that come with semviz.

    Raises SemvizError where there are none, or they are for something else.
    """
    return load_trained(name, path, classes, _built)


def _built(weights: Weights, classes: ClassSet, path: Path) -> Matcher:
    matcher = Matcher(MODELS[weights.task], weights, classes)
    try:
        matcher.of_sample(_smallest())
    except (KeyError, ValueError):  # other names, other shapes
        raise other_version(weights.task, path) from None
    return matcher


def _smallest() -> Sample:
    """One element seen and one mapped."""
    place, one, known = np.array([[0.0, 0.0, 1.0]]), np.zeros(1, np.int64), np.ones((1, 2), bool)
    return Sample(
        ray=place, bottom_ray=place, sigma_rad=np.ones((1, 2)), score=np.ones(1), seen_class=one,
        seen_known=known, point_m=place, bottom_m=place, mapped_class=one, mapped_known=known,
        road=np.zeros(3), prior=np.zeros(PRIOR_LENGTH), origin_m=np.zeros(3),
    )  # fmt: skip


def _unit(vectors: FloatArray | Float32) -> FloatArray:
    """Of length 1; zeros stay zeros."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12))
