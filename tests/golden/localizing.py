"""G1: seeded problems localized by every method, matched pairs, and tracked sequences."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from golden.canonical import digest
from semviz import Localization, Localizer, Tracker, localize_matches
from semviz_core.localization.localizer import known_methods
from semviz_core.research.evaluation.problems import (
    DETECTOR,
    HARD_SETS,
    Difficulty,
    LocalizationProblem,
    make_problem,
)
from semviz_core.research.evaluation.roads import simulated_road
from semviz_core.research.evaluation.sequences import Blackout, make_sequence

PLAIN, PAPER, OF_EACH_HARD_SET = 200, 108, 16
MATCHED = 100
FEWEST = 4
"""Minimum number of elements for a localization."""
DRIVES = ((1, 100, None), (2, 300, Blackout(2.0, 1.5)), (3, 500, Blackout(2.5, 2.0, False)))
"""Seed, first frame and blackout of each sequence."""
DRIVE_FRAMES = 60


def golden_values(_: Path) -> dict[str, Any]:
    """Return status, camera position and a hash of the result, by problem and method."""
    problems = list(_problems())
    found = {f"{len(problems)} problems": digest([_given(problem) for problem in problems])}
    for method in known_methods():
        found |= _by(method, Localizer(method, detector=DETECTOR), problems)
    simple = [result for problem in problems if (result := _one_of_each_class(problem))]
    found |= _by("direct, one of each class", Localizer("direct", detector=DETECTOR), simple)
    found["search from the truth"] = list(_from_the_truth(problems[:MATCHED]))
    found["matches"] = list(_matched(problems[:MATCHED]))
    for seed, first, blackout in DRIVES:
        found[f"drive {seed}"] = list(_tracked(seed, first, blackout))
    return found


def _problems() -> Iterator[LocalizationProblem]:
    yield from (make_problem(seed) for seed in range(PLAIN))
    yield from (make_problem(seed, Difficulty(noise="paper")) for seed in range(PAPER))
    for level in HARD_SETS.values():
        yield from (make_problem(seed, level) for seed in range(OF_EACH_HARD_SET))


def _given(problem: LocalizationProblem) -> list[Any]:
    return [
        problem.observed,
        problem.submap,
        problem.camera,
        problem.prior,
        problem.T_camera_map,
        problem.pairs,
    ]


def _one_of_each_class(problem: LocalizationProblem) -> LocalizationProblem | None:
    """Return the problem with one element per class, as ``direct`` needs it; None if too few."""
    classes = problem.observed.class_id[problem.pairs[:, 0]]
    kinds, first = np.unique(classes, return_index=True)
    rows = problem.pairs[first]
    if len(kinds) < FEWEST:
        return None
    return replace(
        problem,
        observed=problem.observed[rows[:, 0]],
        submap=problem.submap[rows[:, 1]],
    )


def _by(name: str, localizer: Localizer, problems: Iterable[LocalizationProblem]) -> dict[str, Any]:
    lines, reasons = [], []
    for problem in problems:
        found = localizer.localize(problem.observed, problem.submap, problem.camera, problem.prior)
        lines.append(_localization(found))
        reasons.append(found.reason)
    return {name: lines, f"words: reasons of {name}": digest(reasons)}


def _from_the_truth(problems: Iterable[LocalizationProblem]) -> Iterator[str]:
    localizer = Localizer(detector=DETECTOR)
    for problem in problems:
        given = problem.observed, problem.submap, problem.camera, problem.prior
        yield _localization(localizer.localize(*given, start=problem.T_camera_map))


def _localization(found: Localization) -> str:
    rest = {
        "refinement": found.refinement, "match": found.match, "search": found.search,
        "alternatives": found.alternatives, "stages": sorted(found.time_ms),
    }  # fmt: skip
    return _line(found.status, found.T_camera_map, found.covariance, rest)


def _matched(problems: Iterable[LocalizationProblem]) -> Iterator[str]:
    for problem in problems:
        alike = np.argwhere(problem.observed.class_id[:, None] == problem.submap.class_id)
        wrong = alike[:: max(1, len(alike) // 30)]
        pairs = np.unique(np.concatenate([problem.pairs, wrong]), axis=0)
        score = 0.2 + 0.6 * (pairs[:, None] == problem.pairs).all(axis=2).any(axis=1)
        given = problem.observed, problem.submap, problem.camera, pairs, score
        found = localize_matches(*given, prior=problem.prior, detector=DETECTOR)
        pose = getattr(found, "T_camera_map", None)
        yield _line("none" if pose is None else "ok", pose, getattr(found, "covariance", None), {})


def _tracked(seed: int, first: int, blackout: Blackout | None) -> Iterator[str]:
    road = simulated_road(seed)
    frames = range(first, first + DRIVE_FRAMES)
    problems = [make_problem(seed, None, road, frame, driving=True) for frame in frames]
    drive = make_sequence(problems, seed, blackout=blackout)
    tracker = Tracker(drive.camera, drive.semantic_map, DETECTOR)
    for frame in drive.frames:
        track = tracker.step(frame.observed, frame.odometry, frame.prior)
        rest = {"elements": track.element_id, "searched": track.localization is not None}
        yield _line(track.status, track.T_camera_map, track.covariance, rest)


def _line(status: str, pose: Any, covariance: Any, rest: Any) -> str:
    if pose is None:
        return f"{status} {digest(rest)}"
    x, y, z = pose.inverse().translation
    return f"{status} {x:.3f} {y:.3f} {z:.3f} {digest([pose, covariance, rest])}"
