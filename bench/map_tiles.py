"""Crops of a map in tiles beside those of one map in memory, in one run: time and memory.

    python bench/map_tiles.py
    python bench/map_tiles.py --elements 50000 --labels 5

A city of streets every 150 m, with an element every 20 m on each side, and a point of a drive every
metre. *Cold*: no tile is in the memory of the process; *from disk*: the kernel has dropped them
from its cache, too (``posix_fadvise``). A crop and the road around it are timed together.
"""

import os
import shutil
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from map_crop import resident_mb

from semviz_core.base.classes import POLE
from semviz_core.base.elements import Elements3D
from semviz_core.base.map_file import load_map, save_map
from semviz_core.base.semantic_map import MapFrame, Provenance, SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.store import Store
from semviz_core.map_tiles.publish import publish_map
from semviz_core.map_tiles.tiled_map import TiledMap

BLOCK_M, APART_M = 150.0, 20.0
FEW_BYTES = 400_000
"""Of the cache where tiles are to be cold: the tiles of one place."""


@dataclass(frozen=True)
class Options:
    elements: int = 200_000
    labels: int = 1
    """Labels of an element; each has ten observations."""
    crops: int = 300
    radius_m: float = 120.0
    seed: int = 0


def main(options: Options) -> None:
    rng = np.random.default_rng(options.seed)
    city = made_city(options, rng)
    folder = Path(tempfile.mkdtemp())
    try:
        save_map(city, folder / "one.parquet")
        store = Store.at(folder / "tiles", make=True)
        start = time.process_time(), time.perf_counter()
        manifest = publish_map(store, city, None, "bench")
        print_times("publish", [time.process_time() - start[0]], [time.perf_counter() - start[1]])
        start = time.process_time(), time.perf_counter()
        publish_map(store, moved(city, rng), 1, "bench")
        print_times(
            "publish, one moved", [time.process_time() - start[0]], [time.perf_counter() - start[1]]
        )
        written = len(store.keys("tiles/")) - len(manifest.tiles) - 1
        sizes = [tile.bytes for tile in manifest.tiles]
        print(
            f"{len(city):,} elements, {len(sizes)} tiles, median {np.median(sizes) / 1e3:.0f} kB, "
            f"all {sum(sizes) / 1e6:.0f} MB; {written} files written for one moved element"
        )
        del city
        places = rng.permutation(load_map(folder / "one.parquet").trajectory_m)[: options.crops]
        measure(store, folder / "one.parquet", places, options.radius_m)
    finally:
        shutil.rmtree(folder)


def made_city(options: Options, rng: np.random.Generator) -> SemanticMap:
    """Streets along both axes, with elements on both sides, and a drive along each."""
    per_m = 2.0 / APART_M
    side_m = float(np.sqrt(options.elements / (2.0 * per_m) * BLOCK_M))
    streets = np.arange(0.0, side_m, BLOCK_M)
    along = rng.uniform(0.0, side_m, options.elements)
    across = rng.choice(streets, options.elements) + rng.choice([-6.0, 6.0], options.elements)
    turned = rng.random(options.elements) < 0.5
    ground = np.where(turned[:, None], np.c_[across, along], np.c_[along, across])
    top = np.c_[ground, np.full(options.elements, 4.0)]
    ids = np.arange(options.elements)
    elements = Elements3D.from_ends(ids, top, top * [1.0, 1.0, 0.0], np.full(len(ids), POLE))
    steps = np.arange(0.0, side_m)
    ways = [np.c_[steps, np.full(len(steps), street)] for street in streets]
    way = np.concatenate([*ways, *(one[:, ::-1] for one in ways)])
    names = (f"{rng.bytes(16).hex()}" for _ in range(options.elements * options.labels * 11))
    provenance = tuple(
        Provenance(
            tuple(next(names) for _ in range(options.labels)),
            tuple(next(names) for _ in range(options.labels * 10)),
        )
        for _ in range(options.elements)
    )
    road = np.c_[way, np.full(len(way), 1.7)]
    return SemanticMap(elements, MapFrame("city"), trajectory_m=road, provenance=provenance)


def moved(city: SemanticMap, rng: np.random.Generator) -> SemanticMap:
    """The city with one element 10 cm higher."""
    by_m = np.zeros((len(city), 3))
    by_m[rng.integers(len(city)), 2] = 0.1
    elements = replace(city.elements, anchor_m=city.elements.anchor_m + by_m)
    return replace(city, elements=elements)


def measure(store: Store, one_path: Path, places: FloatArray, radius_m: float) -> None:
    before, start = resident_mb(), time.process_time()
    tiles = TiledMap.open(store, 1)
    print_load("open tiles", start, before)
    timed("warm, tiles", [tiles] * len(places), places, radius_m, warm=True)
    print(f"  in memory then {tiles.cache_bytes / 1e6:.0f} MB")
    few = places[: len(places) // 3]
    reading = TiledMap.open(store, 1, cache_bytes=FEW_BYTES)
    timed("cold, tiles", [reading] * len(few), few, radius_m)
    drop(store)
    timed("from disk, tiles", [reading] * len(few), few, radius_m)
    before, start = resident_mb(), time.process_time()
    one = load_map(one_path)
    one.crop(places[0], radius_m)
    print_load("load one map", start, before)
    timed("one map", [one] * len(places), places, radius_m, warm=True)


def timed(
    what: str,
    maps: "list[TiledMap] | list[SemanticMap]",
    places: FloatArray,
    radius_m: float,
    warm: bool = False,
) -> None:
    """Print the time of crop and road_near together, as for one frame."""
    cpu, wall, found = [], [], []
    for semantic_map, place in zip(maps, places, strict=True):
        if warm:
            semantic_map.crop(place, radius_m)
        start = time.process_time(), time.perf_counter()
        found.append(len(semantic_map.crop(place, radius_m)))
        semantic_map.road_near(place, 60.0)
        cpu.append(time.process_time() - start[0])
        wall.append(time.perf_counter() - start[1])
    print_times(what, cpu, wall, f"{np.median(found):.0f} elements")


def print_load(what: str, start_s: float, before_mb: float) -> None:
    took_s, takes_mb = time.process_time() - start_s, resident_mb() - before_mb
    print(f"{what:<20}CPU {took_s * 1e3:.0f} ms, {takes_mb:.0f} MB")


def print_times(what: str, cpu: list[float], wall: list[float], note: str = "") -> None:
    text = ", ".join(
        f"{name} median {np.median(times) * 1e3:.2f}, p95 {np.percentile(times, 95) * 1e3:.2f} ms"
        for name, times in (("CPU", cpu), ("wall", wall))
    )
    print(f"{what:<20}{text}  {note}")


def drop(store: Store) -> None:
    """Let the kernel forget the tiles."""
    for key in store.keys("tiles/"):
        descriptor = os.open(Path(store.where) / key, os.O_RDONLY)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


if __name__ == "__main__":
    main(tyro.cli(Options))
