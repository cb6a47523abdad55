"""Elements missing in the map, told from false detections in runs of several passes.

    python bench/clutter.py
    python bench/clutter.py --first-seed 2000      (where limits were chosen)

A run passes 90 m of a simulated road three times, a frame each 3 m. Of the elements that it
detects four times or more, three are taken out of its map. Besides, there are false detections,
independent from frame to frame, 0 to 40 % of the true ones. The ids of detections are unknown.
Told with the true poses, with those of the frames that are ok alone, with none, and with none but
odometry. An element that is reported as missing in the map or as moved is found if it is within 2 m
of one that was taken out, else it is invented.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import tests_support  # noqa: F401
import tyro
from support.planted_faults import WHOLE, Given
from support.planted_runs import STEP, odometry_of

from semviz_core.base.frame import Odometry
from semviz_core.base.localization import Localization
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.diagnosis.fault import GroundTruth
from semviz_core.diagnosis.run import diagnose_run
from semviz_core.research.evaluation.problems import DETECTOR, make_problem, mapped_elements
from semviz_core.research.evaluation.roads import BenchmarkRoad, simulated_road

PASSES, FRAMES = 3, 30
TAKEN, LEAST_SEEN = 3, 4
FOUND_M = 2.0
SHARES = (0.0, 0.1, 0.2, 0.4)
Knowledge = Literal["true pose", "if ok", "nothing", "odometry"]
KNOWLEDGE: tuple[Knowledge, ...] = get_args(Knowledge)


@dataclass(frozen=True)
class Options:
    runs: int = 18
    """For each share of false detections."""
    first_seed: int = 7000
    shares: tuple[float, ...] = SHARES


@dataclass(frozen=True, eq=False)
class ClutteredRun:
    frames: list[tuple[Localization, GroundTruth]]
    odometry: list[Odometry | None]
    """The motion of each frame from the one before of its pass."""
    semantic_map: SemanticMap
    taken_m: FloatArray
    """(k, 2) places of the elements that are not in the map."""
    false: int
    """Number of false detections."""


def main(options: Options) -> None:
    roads = [simulated_road(options.first_seed + k) for k in range(4)]
    header = ["false", "false dets", *(f"{name}, inv." for name in KNOWLEDGE), "frames ok"]
    print("".join(f"{name:>18}" for name in header))
    for share in options.shares:
        runs = list(_runs(options, roads, share))
        taken, false = sum(len(run.taken_m) for run in runs), sum(run.false for run in runs)
        row = [f"{share:.0%}", str(false)]
        for knowledge in KNOWLEDGE:
            found, invented = np.sum([_told(run, knowledge) for run in runs], axis=0)
            row.append(f"{found} of {taken}, {invented}")
        is_ok = [result.status == "ok" for run in runs for result, _ in run.frames]
        row.append(f"{np.mean(is_ok):.0%}")
        print("".join(f"{cell:>18}" for cell in row), flush=True)


def _runs(options: Options, roads: list[BenchmarkRoad], share: float) -> Iterator[ClutteredRun]:
    seeds = range(options.first_seed, options.first_seed + options.runs)
    return (cluttered_run(seed, roads[seed % len(roads)], share) for seed in seeds)


def cluttered_run(seed: int, road: BenchmarkRoad, share: float) -> ClutteredRun:
    """Return a run of ``PASSES`` passes with ``share`` false detections for each true one."""
    rng = np.random.default_rng([seed, 21])
    level = replace(WHOLE, clutter_share=share)
    first = int(rng.integers(len(road) - FRAMES * STEP))
    elements = mapped_elements(road, seed, level)
    given = [
        Given.of(make_problem(seed, level, road, first + k * STEP, variant=number), elements)
        for number in range(PASSES)
        for k in range(FRAMES)
    ]
    ids, times = np.unique(np.concatenate([frame.ids for frame in given]), return_counts=True)
    often = ids[(ids >= 0) & (times >= LEAST_SEEN)]
    gone = rng.choice(often, min(TAKEN, len(often)), replace=False)
    left = elements[~np.isin(elements.id, gone)]
    frames = [
        (replace(frame, elements=left).localized(), GroundTruth(frame.T_camera_map))
        for frame in given
    ]
    taken_m = elements.anchor_m[np.isin(elements.id, gone), :2]
    false = sum(int((frame.ids < 0).sum()) for frame in given)
    odometry = odometry_of(given, seed, ())
    odometry[::FRAMES] = [None] * PASSES
    whole = replace(given[0], elements=left).semantic_map
    return ClutteredRun(frames, odometry, whole, taken_m, false)


def _told(run: ClutteredRun, knowledge: Knowledge) -> tuple[int, int]:
    """Return how many of the elements taken out are found, and how many others are invented."""
    frames: list[tuple[Localization, GroundTruth | None]] = [
        (result, truth if knowledge in ("true pose", "if ok") else None)
        for result, truth in run.frames
        if knowledge != "if ok" or result.status == "ok"
    ]
    odometry = run.odometry if knowledge == "odometry" else None
    faults = diagnose_run(frames, run.semantic_map, DETECTOR, odometry=odometry).elements
    found: set[int] = set()
    invented = 0
    for fault in faults:
        places = [item.value for item in fault.evidence if item.name in ("x", "y")]
        near: list[int] = []
        if places:
            away_m = np.linalg.norm(run.taken_m - np.array(places), axis=1)
            near = np.flatnonzero(away_m < FOUND_M).tolist()
        found.update(near)
        invented += not near
    return len(found), invented


if __name__ == "__main__":
    main(tyro.cli(Options))
