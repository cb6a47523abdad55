"""Crops of a large map: time and memory, compared with brute force in the same run.

    python bench/map_crop.py
    python bench/map_crop.py --elements 1000000

The map is synthetic: towns of 2 km radius, about 60 elements within 50 m, spread over 600 by 800
km, in random order on disk and in memory (the worst case for caches). Ten million elements need
4.4 GB.
"""

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import tyro

from semviz_core.base.classes import POLE
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import FloatArray

COUNTRY_M = np.array([600e3, 800e3])
TOWN_RADIUS_M = 2000.0
ELEMENTS_PER_TOWN = 96_000
CROP_RADIUS_M = 50.0
DRIVE_M = 1_000_000
"""Length of the trajectory that comes with the map; one point every metre."""


@dataclass(frozen=True)
class Options:
    elements: int = 10_000_000
    crops: int = 2000
    seed: int = 0


def main(options: Options) -> None:
    rng = np.random.default_rng(options.seed)
    start = time.perf_counter()
    semantic_map = country(options.elements, rng)
    elements = semantic_map.elements
    print(f"{len(elements):,} elements made and checked in {time.perf_counter() - start:.1f} s")
    for field in fields(Elements3D):
        print(f"    {field.name:<52}{getattr(elements, field.name).nbytes / 1e6:8.0f} MB")
    triangles = len(elements) * 21 * 4 / 1e6
    print(f"    {'as float32 upper triangles the covariances would be':<52}{triangles:8.0f} MB")
    print(f"    {'resident, elements and all else':<52}{resident_mb():8.0f} MB")

    near = elements.anchor_m[rng.integers(0, len(elements), options.crops)]
    centers = near + rng.normal(0.0, 5.0, near.shape)
    report_index("crop", lambda: semantic_map.crop(centers[0], CROP_RADIUS_M))
    found = [len(semantic_map.crop(center, CROP_RADIUS_M)) for center in centers]
    print(f"elements in a crop: median {np.median(found):.0f}, most {max(found)}")
    report("crop", lambda center: semantic_map.crop(center, CROP_RADIUS_M), centers)
    anchors = np.ascontiguousarray(elements.anchor_m[:, :2])
    report("brute force rows", lambda center: brute_force(anchors, center), centers[:20])

    road = semantic_map.trajectory_m
    fixes = road[rng.integers(0, len(road), options.crops)]
    report_index("road_near", lambda: semantic_map.road_near(fixes[0], 20.0))
    report("road_near, 20 m", lambda fix: semantic_map.road_near(fix, 20.0), fixes)


def country(count: int, rng: np.random.Generator) -> SemanticMap:
    """Poles in towns, and a drive that winds through the country."""
    towns = rng.uniform(0.0, COUNTRY_M, (max(1, count // ELEMENTS_PER_TOWN), 2))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    radius = TOWN_RADIUS_M * np.sqrt(rng.random(count))
    ground = towns[rng.integers(0, len(towns), count)]
    ground += np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    foot = np.column_stack([ground, np.zeros(count)])
    peak = foot + np.array([0.0, 0.0, 4.0])
    elements = Elements3D.from_ends(np.arange(count), peak, foot, np.full(count, POLE))
    heading = np.cumsum(rng.normal(0.0, 0.02, DRIVE_M))
    steps = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(DRIVE_M)])
    return SemanticMap(elements, MapFrame("made-up"), trajectory_m=np.cumsum(steps, axis=0))


def brute_force(anchors_m: FloatArray, center_m: FloatArray) -> object:
    away = anchors_m - center_m[:2]
    return np.flatnonzero(np.einsum("ij,ij->i", away, away) <= CROP_RADIUS_M**2)


def report_index(name: str, first_call: Callable[[], object]) -> None:
    """The first call builds the index."""
    gc.collect()
    before, start = resident_mb(), time.perf_counter()
    first_call()
    seconds = time.perf_counter() - start
    print(f"{name}: index built in {seconds:.1f} s, {resident_mb() - before:.0f} MB")


def report(name: str, call: Callable[[FloatArray], object], centers: FloatArray) -> None:
    seconds = []
    for center in centers:
        start = time.perf_counter()
        call(center)
        seconds.append(time.perf_counter() - start)
    median, p95 = np.percentile(seconds, [50, 95]) * 1e6
    print(f"{name:<20} median {median:10.1f} us, p95 {p95:10.1f} us")


def resident_mb() -> float:
    """Resident memory of this process (Linux)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1e3
    return float("nan")


if __name__ == "__main__":
    main(tyro.cli(Options))
