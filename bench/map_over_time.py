"""Planted changes of a map, found by passes: how many, after how many passes, and false ones.

    python bench/map_over_time.py --seeds 1:4

A simulated street is driven again and again. Of its elements 5 % vanish, 5 % appear and 3 % move,
each between two passes drawn at random. The simulated detector has its recall, noise, occlusion and
false positives; in each pass, further elements are hidden throughout (parked cars, trees). The map
is that of the street before the first pass; poses are those that the localizer finds in it.

Beside it stands what an oracle decides, which knows what each detection in the same frames is of
and what the street's own things hide: what it misses, no association of these detections can find.
"""

import sys
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import tests_support  # noqa: F401
import tyro
from changing_street import ChangingStreet, drive, place_m
from numpy.random import Generator

from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.passes.changes import (
    GONE,
    GONE_BESIDE_NEW,
    LIKELY,
    SURE,
    MapChanges,
    find_changes,
)
from semviz_annotation.mapping.passes.evidence import Pass
from semviz_annotation.mapping.passes.existence import PassCounts, existence_of
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

    found: Counter[str]
    by_oracle: Counter[str]
    planted: Counter[str]
    lost: int = 0
    standing: int = 0
    false_new: int = 0


class Oracle:
    """Decides by the same filter, knowing what each detection of a sure frame is of."""

    def __init__(self, world: ChangingStreet, noise: NoiseName) -> None:
        self._world, self._noise = world, noise
        self._rows = {int(id_): row for row, id_ in enumerate(world.street.truth_map.elements.id)}
        self._counts: list[tuple[np.ndarray, ...]] = []

    def add(self, one: Pass) -> None:
        """Count the chances, the expected and the true detections (n,) of a pass."""
        world, number, n = self._world, int(one.name), len(self._rows)
        hidden = world.hidden(number, HIDDEN)
        chances, seen, expected = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n)
        for position in one.sure:
            index = one.frames[position].index
            shown = world.street.labels(index, "left")[1]
            away_m = world.street.distance_m(shown, index, "left")
            near = away_m < one.detector.far_m
            rows = [self._rows[int(id_)] for id_ in shown[near]]
            chances[rows] += 1
            expected[rows] += one.detector.recall_at(away_m[near])
            _, ids = world.detections(number, index, self._noise, hidden)
            seen[[self._rows[id_] for id_ in set(ids[ids >= 0].tolist())]] += 1
        expected *= seen.sum() / expected[seen > 0].sum()
        self._counts.append((np.maximum(chances, seen), expected, seen))

    def decide(self) -> None:
        """Judge all elements by the passes so far; one that moves is two."""
        counts = PassCounts(*(np.column_stack(each) for each in zip(*self._counts, strict=True)))
        mapped = np.array([id_ not in self._world.appears for id_ in self._rows])
        before, after, moved = counts.seen.copy(), counts.seen.copy(), np.zeros_like(mapped)
        for id_, number in self._world.moves.items():
            before[self._rows[id_], number:] = after[self._rows[id_], :number] = 0
            moved[self._rows[id_]] = True
        self._mapped = existence_of(replace(counts, seen=before), mapped)
        self._new = existence_of(replace(counts, seen=after), mapped & ~moved)

    def tells(self, kind: str, id_: int) -> bool:
        """Whether it finds a change."""
        row = self._rows[id_]
        now = self._mapped.now[row]
        if kind == "vanished":
            return bool(now < GONE)
        is_new = bool(self._new.ever[row] > SURE and self._new.now[row] > LIKELY)
        return is_new and (kind == "new" or bool(now < GONE_BESIDE_NEW))


def judge(
    world: ChangingStreet, passes: list[Pass], occasion: int, oracle: Oracle, tally: Tally
) -> None:
    """Count the changes before the pass ``occasion`` that the passes so far tell."""
    first, truth = world.first_map, world.street.truth_map
    result = find_changes(passes, first, Labels(triangle_center=first.triangle_center))
    told = {(change.kind, change.name) for change in result.changes}
    oracle.decide()
    new_m = np.array([c.place_m[:2] for c in result.changes if c.kind == "new"]).reshape(-1, 2)
    planted = {"vanished": world.vanishes, "new": world.appears, "moved": world.moves}
    for kind, changed in planted.items():
        for id_ in (id_ for id_, before in changed.items() if before == occasion):
            if not world.is_shown(id_):
                continue
            if kind == "new":
                away_m = np.linalg.norm(new_m - place_m(truth, id_), axis=1)
                found = bool((away_m < FOUND_WITHIN_M).any())
            else:
                found = (kind, first.name_of(id_)) in told
            tally.planted[kind] += 1
            tally.found[kind] += found
            tally.by_oracle[kind] += oracle.tells(kind, id_)
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
    tally = Tally(Counter(), Counter(), Counter())
    for seed in range(start, end):
        world = random_world(seed)
        oracle, passes = Oracle(world, options.noise), list[Pass]()
        for occasion in OCCASIONS:
            while len(passes) < occasion + WITHIN:
                passes.append(drive(world, len(passes), options.noise, HIDDEN))
                oracle.add(passes[-1])
            judge(world, passes, occasion, oracle, tally)
        print(f"street {seed}: {tally}", flush=True)
    for kind in KINDS:
        told = f"{tally.found[kind]} of {tally.planted[kind]} within {WITHIN} passes"
        print(f"{kind:<9} {told}, the oracle {tally.by_oracle[kind]}")
    print(f"standing elements lost: {tally.lost} of {tally.standing}")
    print(f"new elements that are none: {tally.false_new}")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
