"""What linking labels decided, in words and figures, for people to judge."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from semviz_annotation.mapping.linking.nearby import stands
from semviz_annotation.mapping.linking.tracks import Tracks
from semviz_annotation.mapping.placing.residuals import residuals
from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.semantic_map import Decision, DecisionKind

_ORDER: tuple[DecisionKind, ...] = ("merge", "apart", "split", "leave out")


def decisions_of(tracks: Tracks) -> tuple[Decision, ...]:
    """All of them, by kind, then by number."""
    book = _Book(tracks)
    made = [*book.merges(), *book.two(), *book.splits(), *book.misfits(), *book.left_out()]
    return tuple(sorted(made, key=lambda one: (_ORDER.index(one.kind), one.numbers, one.reason)))


@dataclass(frozen=True, eq=False)
class _Book:
    tracks: Tracks

    def decision(
        self,
        kind: DecisionKind,
        elements: Sequence[int],
        reason: str,
        evidence: Mapping[str, float] | None = None,
        sightings: IntArray | None = None,
        by: Literal["machine", "human"] = "machine",
    ) -> Decision:
        """About label elements, or some sightings of one, by row."""
        gathered = self.tracks.gathered
        about = [] if sightings is None else sightings.tolist()
        return Decision(
            kind=kind,
            label_ids=tuple(gathered.elements[row].id for row in elements),
            numbers=tuple(gathered.elements[row].number for row in elements),
            by=by,
            reason=reason,
            evidence={name: float(value) for name, value in (evidence or {}).items()},
            observation_ids=tuple(gathered.observations[row].id for row in about),
        )

    def merges(self) -> Iterator[Decision]:
        """Label elements that are one thing."""
        tracks, nodes = self.tracks, self.tracks.nodes
        order = np.argsort(tracks.thing, kind="stable")
        order = order[nodes.part[order] == 0]
        things, first, count = np.unique(tracks.thing[order], return_index=True, return_counts=True)
        for thing, start, several in zip(things, first, count, strict=True):
            if several > 1 and self._ok[thing]:
                members = order[start : start + several]
                evidence = {
                    "distance_m": self._distance_m(members, int(thing)),
                    "chi2_apart": tracks.alone.chi2[members].sum(),
                    "chi2_together": tracks.placed.chi2[thing],
                    "freedom": tracks.placed.rows[thing] - tracks.placed.parameters[thing],
                    "frames": self._frames[thing],
                }
                yield self.decision("merge", nodes.element[members], "they fit one place", evidence)

    def two(self) -> Iterator[Decision]:
        """Things that fit one place, but exclude each other; and what a person called two."""
        tracks = self.tracks
        said: set[tuple[int, ...]] = set()
        for one in tracks.apart:
            elements = tuple(tracks.nodes.element[list(one.nodes)].tolist())
            things = tracks.thing[list(one.nodes)]
            if elements[0] == elements[1] or not self._ok[things].all():
                continue  # two parts of one element: that is a split
            evidence = {
                "distance_m": float(np.linalg.norm(np.subtract(*self._stand_m[things]))),
                "chi2": one.chi2,
                "freedom": one.freedom,
            }
            said.add(elements)
            yield self.decision("apart", elements, one.reason.text, evidence, by=one.reason.by)
        for pair in tracks.judged.apart.tolist():
            if tuple(pair) not in said:
                yield self.decision("apart", pair, "a person said so", by="human")

    def splits(self) -> Iterator[Decision]:
        """Parts of label elements that are other things."""
        tracks, nodes = self.tracks, self.tracks.nodes
        for node in np.flatnonzero((nodes.part > 0) & self._ok[tracks.thing]).tolist():
            row, thing = int(nodes.element[node]), int(tracks.thing[node])
            about = np.flatnonzero(nodes.of_sighting == node)
            main = tracks.thing[nodes.main[row]]
            away = float(np.linalg.norm(self._stand_m[thing] - self._stand_m[main]))
            where = "" if np.isnan(away) else f" {away:.1f} m away"
            same = [one for one in np.flatnonzero(tracks.thing == thing) if nodes.part[one] == 0]
            who = ""
            if same:
                who = f", which is number {tracks.gathered.elements[nodes.element[same[0]]].number}"
            are = "is" if len(about) == 1 else "are"
            reason = f"{len(about)} of its labels {are} of another thing{where}{who}"
            yield self.decision("split", [row], reason, {"distance_m": away}, about)

    def misfits(self) -> Iterator[Decision]:
        """Observations that fit nothing, of label elements that are in the map."""
        tracks, nodes = self.tracks, self.tracks.nodes
        used = np.zeros(len(tracks.gathered.observations), dtype=bool)
        used[tracks.sightings.observation] = True
        unused = np.flatnonzero(~used)
        elements, first = np.unique(tracks.gathered.sightings.thing[unused], return_index=True)
        for row, about in zip(elements.tolist(), np.split(unused, first[1:]), strict=False):
            node = nodes.main.get(row)
            if node is None or not self._ok[tracks.thing[node]]:
                continue
            for unclear in (False, True):
                some = about[tracks.unclear[about] == unclear]
                if len(some):
                    off = self._errors_px(some, int(tracks.thing[node])).max()
                    why = self._why_unused(some, unclear, off)
                    yield self.decision("leave out", [row], why, {"error_px": off}, some)

    def _why_unused(self, rows: IntArray, unclear: bool, off_px: float) -> str:
        one = len(rows) == 1
        many = "a label is" if one else f"{len(rows)} of its labels are"
        why = (
            "not clearly of this thing"
            if unclear
            else f"{'' if one else 'up to '}{off_px:.1f} px off"
        )
        return f"{many} {self.tracks.unused or why}"

    def left_out(self) -> Iterator[Decision]:
        """Whole label elements."""
        tracks = self.tracks
        for row in range(len(tracks.gathered.elements)):
            node = tracks.nodes.main.get(row)
            if tracks.judged.left_out[row]:
                yield self.decision("leave out", [row], "a person said so", by="human")
            elif node is None:
                yield self.decision("leave out", [row], str(tracks.failure[row]))
            elif not self._ok[tracks.thing[node]]:
                failure = str(tracks.placed.failure[tracks.thing[node]])
                yield self.decision("leave out", [row], failure)

    @cached_property
    def _ok(self) -> BoolArray:
        """(n,) things that are in the map."""
        return self.tracks.placed.ok

    @cached_property
    def _frames(self) -> IntArray:
        """(n,) frames that see each thing."""
        sightings = self.tracks.sightings
        frame = self.tracks.gathered.views.frame_index[sightings.view]
        things = np.unique(np.stack([sightings.thing, frame]), axis=1)[0]
        return np.bincount(things, minlength=sightings.count)

    @cached_property
    def _stand_m(self) -> FloatArray:
        """(n, 2) where things stand on the ground plane; NaN without a place."""
        at_m, _, _ = stands(self.tracks.placed)
        return at_m

    @cached_property
    def _stand_alone_m(self) -> FloatArray:
        """(m, 2) where nodes stand by themselves, likewise."""
        at_m, _, _ = stands(self.tracks.alone)
        return at_m

    def _distance_m(self, nodes: IntArray, thing: int) -> float:
        """From a thing to the furthest of its nodes that have a place by themselves."""
        placed = nodes[self.tracks.alone.ok[nodes]]
        away = np.linalg.norm(self._stand_alone_m[placed] - self._stand_m[thing], axis=1)
        return float(away.max(initial=0.0))

    def _errors_px(self, rows: IntArray, thing: int) -> FloatArray:
        """(m,) of gathered sightings, by row, from a thing's place."""
        gathered, placed = self.tracks.gathered, self.tracks.placed
        sightings = gathered.sightings.taken(rows, np.zeros(len(rows), dtype=np.int64), 1)
        here = slice(thing, thing + 1)
        at = residuals(gathered.views, sightings, placed.anchor_m[here], placed.end_m[here])
        return np.where(at.ahead, np.linalg.norm(at.error_px, axis=1), np.inf)
