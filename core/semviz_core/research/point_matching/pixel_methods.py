"""DeepI2P from pixels and its references: perfect labels, and the fix alone.

Methods need street frames with a picture and a cloud.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Literal

import numpy as np

from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.pose import Pose
from semviz_core.base.weights import NetworkWeights, load_trained
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError, require_extra
from semviz_core.research.evaluation.methods import Method, MethodResult
from semviz_core.research.evaluation.problems import LocalizationProblem
from semviz_core.research.evaluation.street_frames import (
    PICTURE_CAMERA,
    StreetProblem,
    cell_centers,
    cells,
    seen_in_picture,
)
from semviz_core.research.point_matching.frustum import (
    cell_matches,
    inverse_projection,
    level_axes,
)
from semviz_core.research.point_matching.methods import result_of

if TYPE_CHECKING:
    from semviz_core.research.point_matching.pixel_network import DeepI2PPixels

POINTS = 4096
Solver = Literal["inverse projection", "cells"]


def points_of(problem: LocalizationProblem) -> FloatArray:
    """Return the points (4096, 7) of a frame's cloud about the fix.

    Raise SemvizError if the frame has no cloud.
    """
    if not isinstance(problem, StreetProblem):
        raise SemvizError("needs pictures and scans: only suite street-paper has them")
    cloud = problem.cloud[np.random.default_rng(0).permutation(len(problem.cloud))[:POINTS]]
    cloud[:, :3] -= problem.prior.position_m
    return cloud


def solved(
    problem: LocalizationProblem,
    points_m: FloatArray,
    inside: BoolArray,
    cell: IntArray,
    solver: Solver,
    started: float,
) -> MethodResult:
    """Return the result of a solver with labels that were begun at ``started`` (s)."""
    labelled = perf_counter()
    if solver == "cells":
        pose = cell_matches(points_m, inside, cell_centers(cell))
    else:
        pose = inverse_projection(points_m, inside, PICTURE_CAMERA, problem.prior.up_camera)
    times = {"label": (labelled - started) * 1e3, "solve": (perf_counter() - labelled) * 1e3}
    return result_of(pose, problem.prior.position_m, times, f"By {solver}, DeepI2P")


@dataclass(frozen=True)
class PixelMethod:
    """A trained network, then one of its solvers."""

    name: str
    network: "DeepI2PPixels"
    solver: Solver

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        start = perf_counter()
        points = points_of(problem)
        assert isinstance(problem, StreetProblem)
        inside, cell = self.network.labels(problem.picture, points)
        return solved(problem, points[:, :3], inside, cell, self.solver, start)


@dataclass(frozen=True)
class TrueLabels:
    """A reference, not a method: the true sides or cells of all points, then a solver."""

    name: str
    solver: Solver

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        start = perf_counter()
        points = points_of(problem)[:, :3]
        T_camera_local = problem.T_camera_map @ Pose(np.eye(3), problem.prior.position_m)
        inside, pixel = seen_in_picture(T_camera_local.apply(points))
        return solved(problem, points, inside, cells(pixel, inside), self.solver, start)


@dataclass(frozen=True)
class FixAlone:
    """A reference, not a method: the fix and gravity, with a heading drawn at random."""

    name: str = "fix alone"

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        prior = problem.prior
        seed = np.frombuffer(prior.position_m.tobytes(), dtype=np.uint32)
        turn = np.random.default_rng(seed).uniform(-np.pi, np.pi)
        up = np.array([0.0, -1.0, 0.0]) if prior.up_camera is None else prior.up_camera
        level = Pose.from_rotvec([0.0, 0.0, -turn], np.zeros(3)).rotation
        return result_of(Pose(level_axes(up) @ level, np.zeros(3)), prior.position_m, {}, "Chance")


def load_pixel_method(name: str, solver: Solver, path: Path | None = None) -> PixelMethod:
    """Return the method with the weights at ``path`` (default: the shipped ones).

    Raise SemvizError if the file is missing or holds another network, or without torch.
    """
    require_extra(f"method {name}", "torch", "train")
    return PixelMethod(name, load_trained(TASK, path, DEFAULT_CLASSES, _built), solver)


TASK = "deepi2p-pixels"


def _built(weights: NetworkWeights, classes: ClassSet, path: Path) -> "DeepI2PPixels":
    from semviz_core.research.point_matching.pixel_network import DeepI2PPixels

    network = DeepI2PPixels()
    weights.load_into(network, path)
    return network.eval()


METHODS: dict[str, Callable[[], Method]] = {
    "deepi2p-pixels": partial(load_pixel_method, "deepi2p-pixels", "inverse projection"),
    "deepi2p-pixels-cells": partial(load_pixel_method, "deepi2p-pixels-cells", "cells"),
    "true frustum": partial(TrueLabels, "true frustum", "inverse projection"),
    "true cells": partial(TrueLabels, "true cells", "cells"),
    "fix alone": FixAlone,
}
