"""Time and size of training samples: ``python bench/training_samples.py``.

Samples are those of the learned models, on one core, including worlds and maps; roads, which many
samples share, are timed separately.
"""

from time import process_time

import numpy as np

from semviz_core.research.evaluation.roads import simulated_road
from semviz_core.research.training.simulated_samples import (
    FRAMES_A_SET_OF_ROADS,
    FRAMES_A_WORLD,
    LEARNED_DISTRIBUTION,
    PAPER_20M_DISTRIBUTION,
    PAPER_DISTRIBUTION,
    ROADS_AT_A_TIME,
    SimulatedSamples,
)

DRILLS = {
    "paper": PAPER_DISTRIBUTION,
    "paper-20m": PAPER_20M_DISTRIBUTION,  # when first made
    "learned": LEARNED_DISTRIBUTION,
}
SAMPLES = 2_000
ROADS = 3


def main() -> None:
    print("drills    ms a sample   seen: median p95   mapped: median p95")
    for name, drills in DRILLS.items():
        for number in range(0, FRAMES_A_WORLD * ROADS_AT_A_TIME, FRAMES_A_WORLD):
            drills.sample(number)  # its road is made
        times, sizes = zip(*(_world(drills, first) for first in _worlds()), strict=True)
        (m, n), (m95, n95) = np.percentile(np.concatenate(sizes), [50.0, 95.0], axis=0)
        print(f"{name:<10}{np.mean(times):11.2f}{m:15.0f} {m95:3.0f}{n:17.0f} {n95:3.0f}")
    start = process_time()
    for seed in range(ROADS):
        simulated_road(seed)
    road_ms = (process_time() - start) / ROADS * 1e3
    samples = FRAMES_A_SET_OF_ROADS // ROADS_AT_A_TIME
    print(f"a road: {road_ms:.0f} ms, for {samples} samples")


def _worlds() -> range:
    """The first number of each."""
    return range(FRAMES_A_WORLD, FRAMES_A_WORLD + SAMPLES, FRAMES_A_WORLD)


def _world(drills: SimulatedSamples, first: int) -> tuple[float, list[tuple[int, int]]]:
    """Mean time (ms), and (m, n) of each sample."""
    start = process_time()
    samples = [drills.sample(first + k) for k in range(FRAMES_A_WORLD)]
    mean_ms = (process_time() - start) / FRAMES_A_WORLD * 1e3
    return mean_ms, [(len(sample.ray), len(sample.point_m)) for sample in samples]


if __name__ == "__main__":
    main()
