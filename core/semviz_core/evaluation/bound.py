"""The Cramer-Rao bound: how well any unbiased method can do, given perfect matches."""

from dataclasses import replace

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.evaluation.problems import Problem
from semviz_core.solving.least_squares import information
from semviz_core.solving.scene import Scene

_LEAST_INFORMATION = 1e-6  # 1 / (1000 m)^2, 1 / (57000 deg)^2: such a pose is not fixed at all


def bound_covariance(problem: Problem, *, with_prior: bool = True) -> FloatArray | None:
    """(6, 6) covariance of the left perturbation of T_camera_map that no unbiased method beats.

    From the true pairs, with the noise of detections and map, and everything in the prior if
    ``with_prior``; bottoms that are hidden do not count. None where some direction is not fixed.
    """
    known = problem.observed.end_known & problem.end_visible
    scene = Scene.of(problem.camera, replace(problem.observed, end_known=known), problem.submap)
    prior = problem.prior if with_prior else None
    matrix = information(scene, prior, problem.T_camera_map, problem.pairs)
    if np.linalg.eigvalsh(matrix)[0] < _LEAST_INFORMATION:
        return None
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
