"""Frames of the problem generator that tests of the core share."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.research.evaluation.problems import Difficulty, LocalizationProblem, make_problem

EXACT = Difficulty(
    sigma_px=1e-4,
    hidden_bottoms=0.0,
    false_detections=0.0,
    missing=0.0,
    duplicated=0.0,
    moved=0.0,
    map_view_sigma_m=0.0,
    map_sigma_m=0.0,
    map_turn_rad=0.0,
    crop_m=90.0,
)
"""Next to no noise and a map without faults, as far as the camera sees."""
NOISY = Difficulty(false_detections=0.0, missing=0.0, duplicated=0.0, moved=0.0)
"""The noise of detections and map, and hidden bottoms; nothing else is wrong."""


@lru_cache
def frames(
    count: int, difficulty: Difficulty | None = None, least: int = 6
) -> list[LocalizationProblem]:
    """The first ``count`` problems, by seed, with at least so many true pairs."""
    found: list[LocalizationProblem] = []
    seed = 0
    while len(found) < count:
        problem = make_problem(seed, difficulty)
        if len(problem.pairs) >= least:
            found.append(problem)
        seed += 1
    return found


def flagged(problem: LocalizationProblem) -> LocalizationProblem:
    """The problem with hidden bottoms flagged, as in labels."""
    known = problem.observed.end_known & problem.end_visible
    return replace(problem, observed=replace(problem.observed, end_known=known))


def signs_on_one_ray(
    problem: LocalizationProblem, nearest_m: float = 15.0, aside_m: float = 0.0
) -> LocalizationProblem:
    """The camera of a problem, before it four signs that hide one another, a metre apart, every
    other one ``aside_m`` off the ray. The prior is about the true place and says, by its sigmas,
    how well it is known."""
    ahead = np.array([[aside_m * (k % 2), 0.0, nearest_m + k] for k in range(4)])
    T_map_camera = problem.T_camera_map.inverse()
    class_id, none = [1, 2, 3, 1], np.full((4, 3), np.nan)
    place = {"position_m": T_map_camera.translation, "vertical_sigma_m": 0.1, "road_m": None}
    return replace(
        problem,
        observed=Elements2D.from_ends(problem.camera.project(ahead), none[:, :2], class_id),
        submap=Elements3D.from_ends(range(4), T_map_camera.apply(ahead), none, class_id),
        prior=replace(problem.prior, **place),
        pairs=np.column_stack([np.arange(4), np.arange(4)]),
        end_visible=np.zeros(4, dtype=bool),
    )
