"""Frames of the problem generator that tests of the core share."""

from dataclasses import replace
from functools import lru_cache

from semviz_core.evaluation.problems import Difficulty, Problem, make_problem

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
def frames(count: int, difficulty: Difficulty | None = None, least: int = 6) -> list[Problem]:
    """The first ``count`` problems, by seed, with at least so many true pairs."""
    found: list[Problem] = []
    seed = 0
    while len(found) < count:
        problem = make_problem(seed, difficulty)
        if len(problem.pairs) >= least:
            found.append(problem)
        seed += 1
    return found


def flagged(problem: Problem) -> Problem:
    """The problem with hidden bottoms flagged, as in labels."""
    known = problem.observed.end_known & problem.end_visible
    return replace(problem, observed=replace(problem.observed, end_known=known))
