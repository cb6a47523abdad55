"""What changed in a mapped place over several passes, and the map after it.

An element vanished if passes saw it and it no longer exists, by all of them. A candidate that
exists now is new, or one that vanished close by has moved there. What the passes cannot tell stays
in the map as it is; so does what none of them saw, which may be hidden from their way.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import derived_id
from semviz_annotation.mapping.association.tracks import OnProgress
from semviz_annotation.mapping.passes.candidates import candidates
from semviz_annotation.mapping.passes.evidence import Pass, counts_of
from semviz_annotation.mapping.passes.existence import Existence, PassCounts, existence_of
from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.semantic_map import Decision, Provenance, SemanticMap, footprint_m
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError

ChangeKind = Literal["vanished", "new", "moved", "unsure"]
KINDS: tuple[ChangeKind, ...] = ("vanished", "new", "moved", "unsure")
GONE, SURE, LIKELY = 0.05, 0.95, 0.5
"""Probabilities of existence: an element is gone below, one is new above; unsure in between."""
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
    moved_m: float | None = None
    """Distance between the two places of one that moved."""


@dataclass(frozen=True, eq=False)
class MapChanges:
    """What passes say about a map."""

    semantic_map: SemanticMap
    passes: tuple[str, ...]
    changes: tuple[Change, ...]
    """Vanished, new, moved, unsure; the surest first."""
    candidates: Elements3D
    replaced: dict[str, int]
    """Of each new or moved element, by name, the row of the candidate that it is now."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        counts = Counter(change.kind for change in self.changes)
        return {
            "passes": list(self.passes),
            "elements": len(self.semantic_map),
            **{kind: counts[kind] for kind in KINDS},
            "changes": [asdict(change) for change in self.changes],
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
        width = max(len(_story(change)) for change in self.changes)
        for change in self.changes:
            cells = " ".join(map(_cell, change.seen, change.chances))
            yield f"{change.name:<7} {_story(change):<{width}} {change.existence:5.2f}  {cells}"

    def changed_map(self, keep: Collection[str] = ()) -> SemanticMap:
        """Return the map without what vanished, with what is new, and with what moved in its new
        place; ``keep`` names changes that are not to be made. Raise SemvizError if one is unknown.
        """
        names = {change.name for change in self.changes}
        if unknown := sorted(set(keep) - names):
            raise SemvizError(f"{unknown[0]} is no change of this map; leave it out of --keep")
        made = [change for change in self.changes if change.name not in keep]
        elements, provenance = self._without([each for each in made if each.kind == "vanished"])
        for change in made:
            if change.kind in ("new", "moved"):
                elements, provenance = self._with(elements, provenance, change)
        base = self.semantic_map
        return replace(
            base,
            elements=elements,
            provenance=tuple(provenance),
            decisions=(*base.decisions, *self._decisions(made)),
            made_by=f"{base.made_by}; changed by {len(self.passes)} passes".removeprefix("; "),
            settings={},
        )

    def _without(self, vanished: Sequence[Change]) -> tuple[Elements3D, list[Provenance]]:
        base = self.semantic_map
        gone = [self._id_of[change.name] for change in vanished]
        stays = np.flatnonzero(~np.isin(base.elements.id, gone))
        origin = base.provenance or (Provenance(),) * len(base)
        return base.elements[stays], [origin[row] for row in stays.tolist()]

    def _with(
        self, elements: Elements3D, provenance: list[Provenance], change: Change
    ) -> tuple[Elements3D, list[Provenance]]:
        one = self.candidates[[self.replaced[change.name]]]
        if change.kind == "new":
            source = Provenance((derived_id(f"{change.name} of {self.passes}"),), (), 9.0)
            return joined(elements, one), [*provenance, source]
        row = int(np.flatnonzero(elements.id == self._id_of[change.name])[0])
        others = np.delete(np.arange(len(elements)), row)
        moved = joined(elements[others], replace(one, id=elements.id[[row]]))
        back = np.argsort(np.append(others, row), kind="stable")
        return moved[back], provenance

    @cached_property
    def _id_of(self) -> dict[str, int]:
        """The ids of the elements of the map, by name."""
        base = self.semantic_map
        return {base.name_of(id_): id_ for id_ in base.elements.id.tolist()}

    def _decisions(self, made: Sequence[Change]) -> Iterator[Decision]:
        for change in made:
            if change.kind == "vanished":
                yield Decision(
                    "leave out", (), (), "machine", f"{change.name} {_story(change)}",
                    {"existence": change.existence},
                )  # fmt: skip


def find_changes(
    passes: Sequence[Pass],
    semantic_map: SemanticMap,
    labels: Labels,
    on_progress: OnProgress = lambda what, done, of: None,
) -> MapChanges:
    """Return what passes, oldest first, say about the elements of a map.

    Raise SemvizError for fewer than two passes with sure frames.
    """
    passes = [one for one in passes if one.sure]
    if len(passes) < 2:
        raise SemvizError(
            f"{len(passes)} passes have frames with status ok; one pass cannot tell a miss from a "
            "change: give 2 or more"
        )
    extra = candidates(passes, semantic_map, labels, on_progress)
    whole = joined(semantic_map.elements, extra)
    counts = counts_of(passes, replace(semantic_map, elements=whole, provenance=(), attributes={}))
    found = existence_of(counts, np.arange(len(whole)) < len(semantic_map))
    names = tuple(one.name for one in passes)
    return _named(semantic_map, whole, counts, found, names)


class _Moved(NamedTuple):
    new: int
    """Row of the candidate."""
    distance_m: float


def _named(
    semantic_map: SemanticMap,
    whole: Elements3D,
    counts: PassCounts,
    found: Existence,
    passes: tuple[str, ...],
) -> MapChanges:
    """Name what changed; ``whole`` are the elements of the map, then the candidates."""
    n, now = len(semantic_map), found.now
    met, seen = counts.chances[:n].any(axis=1), counts.seen[:n].any(axis=1)
    is_gone = (now[:n] < GONE) & seen
    vanished = np.flatnonzero(is_gone)
    doubtful = np.flatnonzero((now[:n] < LIKELY) & met & ~is_gone)
    appeared = n + np.flatnonzero(now[n:] > SURE)
    moved = _moved(whole, vanished, appeared)
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
    replaced = {f"n-{number:02d}": row - n for number, row in enumerate(new, 1)}
    replaced |= {describe.name(row): pair.new - n for row, pair in moved.items()}
    return MapChanges(semantic_map, passes, tuple(order), whole[n:], replaced)


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
            moved_m=pair.distance_m,
        )

    @cached_property
    def place_m(self) -> FloatArray:
        return footprint_m(self.whole)


def _place(place_m: FloatArray) -> tuple[float, float, float]:
    x, y, z = place_m.tolist()
    return x, y, z


def _story(change: Change) -> str:
    match change.kind:
        case "vanished":
            return f"not seen from {change.since} on"
        case "new":
            return f"{change.class_name}, seen from {change.since} on"
        case "moved":
            return f"moved {change.moved_m:.1f} m before {change.since}"
        case _:
            met = sum(1 for chances in change.chances if chances)
            return f"seen by {sum(1 for seen in change.seen if seen)} of {met} passes"


def _cell(seen: int, chances: int) -> str:
    """Return what a pass says: frames that saw it, ``0/14`` if it should have been seen."""
    text = "." if not chances else str(seen) if seen else f"0/{chances}"
    return f"{text:>4}"
