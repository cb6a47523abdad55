"""What a sample to train on costs, and how large samples are: ``python bench/drills.py``.

Of drills as the learned models have them, on one core. Worlds and their maps are included; roads,
which are made once for so many samples, stand apart.
"""

from time import process_time

import numpy as np

from semviz_core.evaluation.roads import simulated_road
from semviz_core.learning.drills import (
    FRAMES_A_SET_OF_ROADS,
    FRAMES_A_WORLD,
    LEARNED_DRILLS,
    PAPER_DRILLS,
    ROADS_AT_A_TIME,
    Drills,
)

SAMPLES = 2_000
ROADS = 3


def main() -> None:
    print("drills   ms a sample   seen: median p95   mapped: median p95")
    for name, drills in (("paper", PAPER_DRILLS), ("learned", LEARNED_DRILLS)):
        for number in range(0, FRAMES_A_WORLD * ROADS_AT_A_TIME, FRAMES_A_WORLD):
            drills.sample(number)  # its road is made
        times, sizes = zip(*(_world(drills, first) for first in _worlds()), strict=True)
        (m, n), (m95, n95) = np.percentile(np.concatenate(sizes), [50.0, 95.0], axis=0)
        print(f"{name:<9}{np.mean(times):11.2f}{m:15.0f} {m95:3.0f}{n:17.0f} {n95:3.0f}")
    start = process_time()
    for seed in range(ROADS):
        simulated_road(seed)
    road_ms = (process_time() - start) / ROADS * 1e3
    samples = FRAMES_A_SET_OF_ROADS // ROADS_AT_A_TIME
    print(f"a road: {road_ms:.0f} ms, for {samples} samples")


def _worlds() -> range:
    """The first number of each."""
    return range(FRAMES_A_WORLD, FRAMES_A_WORLD + SAMPLES, FRAMES_A_WORLD)


def _world(drills: Drills, first: int) -> tuple[float, list[tuple[int, int]]]:
    """Mean time (ms), and (m, n) of each sample."""
    start = process_time()
    samples = [drills.sample(first + k) for k in range(FRAMES_A_WORLD)]
    mean_ms = (process_time() - start) / FRAMES_A_WORLD * 1e3
    return mean_ms, [(len(one.ray), len(one.point_m)) for one in samples]


if __name__ == "__main__":
    main()
