"""Matches of 2D3D-MatchNet and DeepI2P between points, and their pose by EPnP in RANSAC.

Poles are two points (``split_lines``). Networks and losses follow the published code
(2D3D-MatchNet: Feng, Hu, Ang, Lee, ICRA 2019; DeepI2P: Li, Lee, CVPR 2021), with fewer channels and
these readings:

- 2D3D-MatchNet compares descriptors of image patches and of volumes of a scan. Here a patch is the
  bearings of all observed points around one of them, a volume the mapped points within 20 m of one
  of them. A point matches the mapped point with the nearest descriptor.
- DeepI2P classifies points of a scan: whether they are inside the image, and in which of its cells.
  Here the cells are the observed points, or none. The published inverse projection has no cells
  and cannot fix a pose by some thirty mapped points, so the pose is that of its second solver.

Classes, where used, are inputs, and forbid matches between different ones. Weighted PnPL never
follows, since the paper shows these methods without it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.pose import Pose
from semviz_core.base.weights import NetworkWeights, load_trained
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import require_extra
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.research.evaluation.methods import Method, MethodResult
from semviz_core.research.evaluation.problems import LocalizationProblem
from semviz_core.research.paper.matcher import split_lines
from semviz_core.research.point_matching.epnp import epnp_ransac
from semviz_core.research.training.simulated_samples import sample_of

if TYPE_CHECKING:
    from semviz_core.research.point_matching.networks import PointNetwork


@dataclass(frozen=True)
class PointModel:
    """The differences between the networks."""

    descriptors: bool
    """2D3D-MatchNet; otherwise DeepI2P."""
    semantics: bool
    """Classes are inputs, and only points of one class match."""


POINT_MODELS = {
    "matchnet": PointModel(descriptors=True, semantics=False),
    "deepi2p": PointModel(descriptors=False, semantics=False),
    "matchnet-semantic": PointModel(descriptors=True, semantics=True),
    "deepi2p-semantic": PointModel(descriptors=False, semantics=True),
}

TRIALS, THRESHOLD_PX = 1000, 10.0


def pose_of_pairs(sample: Sample, camera: Camera, pairs: IntArray) -> Pose | str:
    """Return T_camera_local by matched points, or the reason for none.

    ``pairs`` (k, 2) are rows of the sample's observed and mapped points.
    """
    ray, point_m = sample.ray[pairs[:, 0]], sample.point_m[pairs[:, 1]]
    pixel = (ray / ray[:, 2:] @ camera.K.T)[:, :2]
    return epnp_ransac(pixel, point_m, camera, TRIALS, THRESHOLD_PX)


@dataclass(frozen=True)
class PointMethod:
    """A trained network, then EPnP in RANSAC."""

    name: str
    network: "PointNetwork"
    classes: ClassSet

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        start = perf_counter()
        frame = problem.observed, problem.submap, problem.camera, problem.prior
        sample = split_lines(Sample.of(*frame, self.classes))
        pairs = self.network.pairs_of(sample)
        matched = perf_counter()
        pose = pose_of_pairs(sample, problem.camera, pairs)
        time_ms = {"match": (matched - start) * 1e3, "pnp": (perf_counter() - matched) * 1e3}
        return result_of(pose, sample.origin_m, time_ms)


@dataclass(frozen=True)
class TruePoints:
    """A reference, not a method: the true pairs of points, then EPnP in RANSAC."""

    name: str = "EPnP with true pairs"

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        sample = split_lines(sample_of(problem))
        assert sample.truth is not None
        pairs = np.argwhere(sample.truth.pairs & sample.seen_known[:, :1])
        start = perf_counter()
        pose = pose_of_pairs(sample, problem.camera, pairs)
        return result_of(pose, sample.origin_m, {"pnp": (perf_counter() - start) * 1e3})


def result_of(
    pose: Pose | str, origin_m: FloatArray, time_ms: dict[str, float], solver: str = "EPnP"
) -> MethodResult:
    """Return the result of a pose T_camera_local about ``origin_m`` (3,), or of a reason."""
    if isinstance(pose, str):
        return MethodResult(None, None, "cannot", pose, time_ms)
    in_map = Pose(pose.rotation, pose.translation - pose.rotation @ origin_m)
    return MethodResult(in_map, None, "ok", f"{solver} found a pose.", time_ms)


def load_point_method(
    name: str, path: Path | None = None, classes: ClassSet = DEFAULT_CLASSES
) -> PointMethod:
    """Return the method ``name`` with the weights at ``path`` (default: the shipped ones).

    Raise SemvizError if the file is missing or holds another network, or without torch.
    """
    require_extra(f"method {name}", "torch", "train")
    return load_trained(name, path, classes, _built)


def _built(weights: NetworkWeights, classes: ClassSet, path: Path) -> PointMethod:
    from semviz_core.research.point_matching.networks import make_network

    network = make_network(POINT_MODELS[weights.task], len(classes))
    weights.load_into(network, path)
    return PointMethod(weights.task, network.eval(), classes)


METHODS: dict[str, Callable[[], Method]] = {
    **{name: partial(load_point_method, name) for name in POINT_MODELS},
    "EPnP with true pairs": TruePoints,
}
