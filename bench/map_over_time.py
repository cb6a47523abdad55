"""Planted changes of a map, found by passes: how many, after how many passes, and false ones.

    python bench/map_over_time.py --seeds 1:4

A simulated street is driven again and again. Of its elements 5 % vanish, 5 % appear and 3 % move,
each between two passes drawn at random. The simulated detector has its recall, noise, occlusion and
false positives; in each pass, further elements are hidden throughout (parked cars, trees). The map
is that of the street before the first pass; poses are those that the localizer finds in it.
"""

import sys
from dataclasses import dataclass

import numpy as np
import tests_support  # noqa: F401
import tyro
from changing_street import ChangingStreet, drive, place_m
from numpy.random import Generator

from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.passes.changes import MapChanges, find_changes
from semviz_annotation.mapping.passes.evidence import Pass
from semviz_core.base.detector_model import NoiseName
from semviz_core.simulation.layout import Section, StreetOptions
from semviz_core.simulation.street import Street

VANISH, APPEAR, MOVE = 0.05, 0.05, 0.03
HIDDEN = 0.08
"""Share of elements that something hides throughout a pass."""
OCCASIONS = (5, 10, 15, 20, 25)
"""Passes before which things change; they are looked for ``WITHIN`` passes later."""
WITHIN = 5
KINDS = ("vanished", "new", "moved")
MOVED_BY_M = (1.0, 2.5)
FOUND_WITHIN_M = 1.0
FRAMES = 240
"""A metre apart."""


@dataclass(frozen=True)
class Options:
    seeds: str = "1:4"
    """FIRST:END of the streets."""
    noise: NoiseName = "low"
    """Noise of the detections."""


def random_world(seed: int) -> ChangingStreet:
    """A street with random changes."""
    options = StreetOptions(frames=FRAMES, sections=(Section("normal", FRAMES + 40.0),))
    street, rng = Street(seed, options), np.random.default_rng([seed, 1])
    ids = rng.permutation(street.truth_map.elements.id).tolist()
    counts = [max(round(share * len(ids)), 1) for share in (VANISH, APPEAR, MOVE)]
    parts = np.split(np.array(ids), np.cumsum(counts))[:3]
    vanishes, appears, moves = (
        {int(id_): int(rng.choice(OCCASIONS)) for id_ in part} for part in parts
    )
    return ChangingStreet(street, vanishes, appears, moves, {id_: _offset_m(rng) for id_ in moves})


def _offset_m(rng: Generator) -> np.ndarray:
    length_m, angle = rng.uniform(*MOVED_BY_M), rng.uniform(-np.pi, np.pi)
    return np.array([length_m * np.cos(angle), length_m * np.sin(angle), 0.0])


@dataclass
class Tally:
    """What was found, of what there was."""

    found: dict[str, int]
    planted: dict[str, int]
    lost: int = 0
    standing: int = 0
    false_new: int = 0


def judge(world: ChangingStreet, passes: list[Pass], occasion: int, tally: Tally) -> None:
    """Count the changes before the pass ``occasion`` that the passes so far tell."""
    first, truth = world.first_map, world.street.truth_map
    result = find_changes(passes, first, Labels(triangle_center=first.triangle_center))
    told = {(change.kind, change.name) for change in result.changes}
    new_m = np.array([c.place_m[:2] for c in result.changes if c.kind == "new"]).reshape(-1, 2)
    for kind, changed in (("vanished", world.vanishes), ("moved", world.moves)):
        for id_ in (id_ for id_, before in changed.items() if before == occasion):
            if world.is_shown(id_):
                tally.planted[kind] += 1
                tally.found[kind] += (kind, first.name_of(id_)) in told
    for id_ in (id_ for id_, before in world.appears.items() if before == occasion):
        if world.is_shown(id_):
            tally.planted["new"] += 1
            away_m = np.linalg.norm(new_m - place_m(truth, id_), axis=1)
            tally.found["new"] += bool((away_m < FOUND_WITHIN_M).any())
    if occasion == OCCASIONS[-1]:
        _count_false(world, result, new_m, tally)


def _count_false(
    world: ChangingStreet, result: MapChanges, new_m: np.ndarray, tally: Tally
) -> None:
    changed = {**world.vanishes, **world.moves}
    names = {result.semantic_map.name_of(id_) for id_ in changed}
    told = [c for c in result.changes if c.kind in ("vanished", "moved")]
    tally.lost += sum(change.name not in names for change in told)
    tally.standing += len(result.semantic_map) - len(changed)
    true_m = np.array([place_m(world.street.truth_map, id_) for id_ in world.appears])
    away_m = np.linalg.norm(new_m[:, None] - true_m.reshape(1, -1, 2), axis=2)
    tally.false_new += int((away_m.min(axis=1, initial=np.inf) >= FOUND_WITHIN_M).sum())


def main(options: Options) -> int:
    start, end = map(int, options.seeds.split(":"))
    tally = Tally(dict.fromkeys(KINDS, 0), dict.fromkeys(KINDS, 0))
    for seed in range(start, end):
        world = random_world(seed)
        passes: list[Pass] = []
        for occasion in OCCASIONS:
            while len(passes) < occasion + WITHIN:
                passes.append(drive(world, len(passes), options.noise, HIDDEN))
            judge(world, passes, occasion, tally)
        print(f"street {seed}: {tally}", flush=True)
    for kind in KINDS:
        print(f"{kind:<9} {tally.found[kind]} of {tally.planted[kind]} within {WITHIN} passes")
    print(f"standing elements lost: {tally.lost} of {tally.standing}")
    print(f"new elements that are none: {tally.false_new}")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
