"""What changed in a mapped place over several passes, and the map after it.

An element vanished if passes saw it and it no longer exists, by all of them. A candidate that
exists now is new, or one that vanished close by has moved there. What the passes cannot tell stays
in the map as it is; so does what none of them saw, which may be hidden from their way.
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.passes.candidates import candidates
from semviz_annotation.mapping.passes.evidence import Evidence, Pass, evidence_of
from semviz_annotation.mapping.passes.existence import (
    Existence,
    PassCounts,
    change_between,
    existence_of,
)
from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.semantic_map import SemanticMap, footprint_m
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnProgress, unwatched

ChangeKind = Literal["vanished", "new", "moved", "unsure"]
KINDS: tuple[ChangeKind, ...] = ("vanished", "new", "moved", "unsure")
GONE, SURE, LIKELY = 0.05, 0.95, 0.5
"""Probabilities of existence: an element is gone below ``GONE``, and unsure up to ``LIKELY``. A new
one is real with ``SURE``, and now there with ``LIKELY``."""
GONE_BESIDE_NEW = 0.2
"""Below this, an element is gone if a new one of its class appeared close by: then it moved."""
MOVED_M = 3.0
"""An element that vanished and a new one of its class are one that moved, up to this distance."""


@dataclass(frozen=True)
class Change:
    """One element that is not as the map says, or may not be."""

    kind: ChangeKind
    name: str
    """Of the element in the map; of a new one in the order of finding, ``n-01``."""
    class_name: str
    existence: float
    """Probability that it exists in the last pass; of one that moved, at its new place."""
    since: str
    """Name of the pass that first missed, or first saw it; empty if unsure."""
    seen: tuple[int, ...]
    """Frames of each pass that detect it; of one that moved, at either place."""
    chances: tuple[int, ...]
    """Frames of each pass in which it would be in view."""
    place_m: tuple[float, float, float]
    """Footprint, or a sign's centre; of one that moved, where it is now."""
    probability: tuple[float, ...]
    """That it exists in each pass, by all of them; of one that moved, at either place."""
    element_id: int | None
    """In the map; None for a new one."""
    row: int
    """In ``MapChanges.whole``: of a new or moved element, the candidate that it is now."""
    was_m: tuple[float, float, float] | None = None
    """Where one that moved was."""

    @property
    def moved_m(self) -> float | None:
        """Distance between the two places of one that moved."""
        return None if self.was_m is None else math.dist(self.place_m, self.was_m)

    @property
    def story(self) -> str:
        """What the passes say, in a few words."""
        match self.kind:
            case "vanished":
                return f"not seen from {self.since} on"
            case "new":
                return f"{self.class_name}, seen from {self.since} on"
            case "moved":
                return f"moved {self.moved_m:.1f} m before {self.since}"
            case _:
                met = sum(1 for chances in self.chances if chances)
                return f"seen by {sum(1 for seen in self.seen if seen)} of {met} passes"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        values = asdict(self)
        del values["row"]
        return values | {"moved_m": self.moved_m}


@dataclass(frozen=True, eq=False)
class MapChanges:
    """What passes say about a map."""

    semantic_map: SemanticMap
    passes: tuple[str, ...]
    changes: tuple[Change, ...]
    """Vanished, new, moved, unsure; the surest first."""
    whole: Elements3D
    """The elements of the map, then the candidates for new ones."""
    evidence: Evidence
    """Of ``whole``."""
    existence: Existence
    """Of ``whole``."""

    def row_in_map(self, change: Change) -> int:
        """Return the row, of the map and of ``whole``, of an element of the map that changed."""
        return int(np.flatnonzero(self.semantic_map.elements.id == change.element_id)[0])

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        counts = Counter(change.kind for change in self.changes)
        return {
            "passes": list(self.passes),
            "elements": len(self.semantic_map),
            **{kind: counts[kind] for kind in KINDS},
            "changes": [change.as_dict() for change in self.changes],
        }

    def as_text(self) -> str:
        """Return one line per change, with the frames that saw it, for each pass."""
        head = f"{len(self.semantic_map)} elements, {len(self.passes)} passes"
        if not self.changes:
            return f"{head}, no change"
        counts = Counter(change.kind for change in self.changes)
        told = ", ".join(f"{counts[kind]} {kind}" for kind in KINDS if counts[kind])
        return "\n".join([f"{head}: {told}", *self._lines()])

    def _lines(self) -> Iterator[str]:
        width = max(len(change.story) for change in self.changes)
        for change in self.changes:
            cells = " ".join(map(_cell, change.seen, change.chances))
            yield f"{change.name:<7} {change.story:<{width}} {change.existence:5.2f}  {cells}"

    @property
    def sure(self) -> frozenset[str]:
        """Names of the changes that are not unsure."""
        return frozenset(change.name for change in self.changes if change.kind != "unsure")


def find_changes(
    passes: Sequence[Pass],
    semantic_map: SemanticMap,
    labels: Labels,
    on_progress: OnProgress = unwatched,
) -> MapChanges:
    """Return what passes, oldest first, say about the elements of a map.

    Raise SemvizError for fewer than two passes with sure frames.
    """
    passes = [one for one in passes if one.sure]
    if len(passes) < 2:
        raise SemvizError(
            f"{'only one pass' if passes else 'no pass'} has frames with status ok; one pass "
            "cannot tell a miss from a change: give 2 or more"
        )
    extra = candidates(passes, semantic_map, labels, on_progress)
    whole = joined(semantic_map.elements, extra)
    both = replace(semantic_map, elements=whole, provenance=(), attributes={})
    evidence = evidence_of(passes, both, len(extra))
    is_mapped = np.arange(len(whole)) < len(semantic_map)
    change = change_between([one.start_s for one in passes])
    found = existence_of(evidence.counts, is_mapped, change)
    replaced = _replaced(whole, is_mapped, found)
    found = existence_of(evidence.counts, is_mapped, change, replaced)
    names = tuple(one.name for one in passes)
    return _named(semantic_map, whole, evidence, found, names)


def _replaced(whole: Elements3D, is_mapped: BoolArray, found: Existence) -> IntArray:
    """Return the pass (n,) in which a new element of its class appeared beside each; or -1."""
    replaced, place_m = np.full(len(whole), -1), footprint_m(whole)
    for new in np.flatnonzero(_is_new(found) & ~is_mapped & (found.first > 0)):
        near = np.linalg.norm(place_m - place_m[new], axis=1) <= MOVED_M
        near &= is_mapped & (whole.class_id == whole.class_id[new])
        replaced[near] = found.first[new]
    return replaced


def _is_new(found: Existence) -> BoolArray:
    """Return which candidates are elements that the map lacks: real, and rather not gone again. One
    that is hidden in the last pass is real all the same."""
    return np.asarray((found.ever > SURE) & (found.now > LIKELY))


class _Moved(NamedTuple):
    new: int
    """Row of the candidate."""
    distance_m: float


def _named(
    semantic_map: SemanticMap,
    whole: Elements3D,
    evidence: Evidence,
    found: Existence,
    passes: tuple[str, ...],
) -> MapChanges:
    """Name what changed; ``whole`` are the elements of the map, then the candidates."""
    n, now, counts = len(semantic_map), found.now, evidence.counts
    met, seen = counts.chances[:n].any(axis=1), counts.seen[:n].any(axis=1)
    is_gone = (now[:n] < GONE) & seen
    appeared = n + np.flatnonzero(_is_new(found)[n:])
    moved = _moved(whole, np.flatnonzero((now[:n] < GONE_BESIDE_NEW) & seen), appeared)
    is_gone[list(moved)] = True
    vanished = np.flatnonzero(is_gone)
    doubtful = np.flatnonzero((now[:n] < LIKELY) & met & ~is_gone)
    taken = {pair.new for pair in moved.values()}
    new = [row for row in appeared.tolist() if row not in taken]
    describe = _Describer(semantic_map, whole, counts, found, passes)
    changes = [
        *(describe.change("vanished", row) for row in vanished.tolist() if row not in moved),
        *(describe.change("new", row, number) for number, row in enumerate(new, 1)),
        *(describe.moved(row, pair) for row, pair in moved.items()),
        *(describe.change("unsure", row) for row in doubtful.tolist()),
    ]
    order = sorted(changes, key=lambda each: (KINDS.index(each.kind), _doubt(each), each.name))
    return MapChanges(semantic_map, passes, tuple(order), whole, evidence, found)


def _doubt(change: Change) -> float:
    """Return how unsure a change is."""
    return change.existence if change.kind == "vanished" else 1.0 - change.existence


def _moved(whole: Elements3D, vanished: IntArray, appeared: IntArray) -> dict[int, _Moved]:
    """Pair vanished elements with new ones of their class, the nearest first."""
    place_m = footprint_m(whole)
    pairs = [
        (float(np.linalg.norm(place_m[row] - place_m[new])), row, new)
        for row in vanished.tolist()
        for new in appeared.tolist()
        if whole.class_id[row] == whole.class_id[new]
    ]
    moved: dict[int, _Moved] = {}
    taken: set[int] = set()
    for distance_m, row, new in sorted(pairs):
        if distance_m <= MOVED_M and row not in moved and new not in taken:
            moved[row] = _Moved(new, distance_m)
            taken.add(new)
    return moved


@dataclass(frozen=True, eq=False)
class _Describer:
    """Describes rows of the map and its candidates."""

    semantic_map: SemanticMap
    whole: Elements3D
    counts: PassCounts
    found: Existence
    passes: tuple[str, ...]

    def name(self, row: int) -> str:
        return self.semantic_map.name_of(int(self.whole.id[row]))

    def change(self, kind: ChangeKind, row: int, number: int = 0) -> Change:
        since = self.found.first[row] if kind == "new" else self.found.gone[row]
        return Change(
            kind,
            f"n-{number:02d}" if kind == "new" else self.name(row),
            self.semantic_map.classes[int(self.whole.class_id[row])].name,
            float(self.found.now[row]),
            "" if kind == "unsure" else self.passes[int(since)],
            tuple(self.counts.seen[row].tolist()),
            tuple(self.counts.chances[row].tolist()),
            _place(self.place_m[row]),
            _rounded(self.found.probability[row]),
            None if kind == "new" else int(self.whole.id[row]),
            row,
        )

    def moved(self, row: int, pair: _Moved) -> Change:
        """Describe one that moved: seen at either place, in view at the place where it was."""
        before = self.change("moved", row)
        first, gone = int(self.found.first[pair.new]), int(self.found.gone[row])
        seen = self.counts.seen[row] + self.counts.seen[pair.new]
        chances = np.maximum(self.counts.chances[row], self.counts.chances[pair.new])
        return replace(
            before,
            existence=float(self.found.now[pair.new]),
            since=self.passes[max(first, gone)],
            seen=tuple(seen.tolist()),
            chances=tuple(np.maximum(seen, chances).tolist()),
            place_m=_place(self.place_m[pair.new]),
            probability=_rounded(self.found.probability[[row, pair.new]].max(axis=0)),
            row=pair.new,
            was_m=before.place_m,
        )

    @cached_property
    def place_m(self) -> FloatArray:
        return footprint_m(self.whole)


def _rounded(probability: FloatArray) -> tuple[float, ...]:
    return tuple(probability.round(4).tolist())


def _place(place_m: FloatArray) -> tuple[float, float, float]:
    x, y, z = place_m.tolist()
    return x, y, z


def _cell(seen: int, chances: int) -> str:
    """Return what a pass says: frames that saw it, ``0/14`` if it should have been seen."""
    text = "." if not chances else str(seen) if seen else f"0/{chances}"
    return f"{text:>4}"
