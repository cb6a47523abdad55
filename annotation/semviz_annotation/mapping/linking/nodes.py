"""What is linked: label elements, or parts of them, with what is known of who is who beforehand."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz_annotation.labels import LabelElement, Labels
from semviz_annotation.mapping.linking.exclusion import Exclusion, Reason
from semviz_annotation.mapping.placing.sightings import Gathered, Sightings
from semviz_core.arrays import BoolArray, IntArray

LEFT_OUT = -1
"""In place of a part or node, for sightings that belong to none."""


@dataclass(frozen=True, eq=False)
class Judged:
    """What people decided about n label elements; they are counted as in ``Gathered``."""

    kept: BoolArray
    """(n,) one thing, with all its observations"""
    left_out: BoolArray
    """(n,) not for the map"""
    apart: IntArray
    """(j, 2) pairs of label elements that are two things"""

    @classmethod
    def nothing(cls, count: int) -> "Judged":
        """About ``count`` label elements."""
        nobody = np.zeros(count, dtype=bool)
        return cls(nobody, nobody, np.zeros((0, 2), dtype=np.int64))

    @classmethod
    def of(cls, labels: Labels, elements: tuple[LabelElement, ...]) -> "Judged":
        row_of = {element.id: row for row, element in enumerate(elements)}
        verdicts: dict[str, list[tuple[int, ...]]] = {}
        for _, one in sorted(labels.judgements.items()):
            names = [name for name in (one.element_id, one.other_id) if name is not None]
            if all(name in row_of for name in names):
                rows = tuple(sorted(row_of[name] for name in names))
                verdicts.setdefault(one.verdict, []).append(rows)
        kept, left_out = np.zeros((2, len(elements)), dtype=bool)
        kept[[row for (row,) in verdicts.get("keep", ())]] = True
        left_out[[row for (row,) in verdicts.get("leave out", ())]] = True
        apart = np.array(sorted(verdicts.get("apart", ())), dtype=np.int64)
        return cls(kept, left_out, apart.reshape(-1, 2))


@dataclass(frozen=True, eq=False)
class Nodes:
    """m parts of label elements: most elements are one part, those with two things are more."""

    element: IntArray
    """(m,) row of the label element; ascending"""
    part: IntArray
    """(m,) 0 is its main part"""
    of_sighting: IntArray
    """(k,) node of each sighting that was gathered, or ``LEFT_OUT``"""
    sightings: Sightings
    """Of the nodes."""

    @classmethod
    def of(cls, sightings: Sightings, part: IntArray) -> "Nodes":
        """From the part (k,) of each sighting of label elements."""
        used = part != LEFT_OUT
        names = np.stack([sightings.thing[used], part[used]], axis=1)
        nodes, index = np.unique(names, axis=0, return_inverse=True)
        of_sighting = np.full(len(part), LEFT_OUT)
        of_sighting[used] = index.ravel()
        return cls(
            nodes[:, 0], nodes[:, 1], of_sighting, sightings.regrouped(of_sighting, len(nodes))
        )

    def __len__(self) -> int:
        return len(self.element)

    @property
    def first_sighting(self) -> IntArray:
        """(m,) a gathered sighting of each."""
        return self.sightings.observation[self.sightings.first]

    def of_split_off(self, gathered: Gathered) -> dict[str, int]:
        """The node of each observation that is not of its label element's main part, by id."""
        rows = np.flatnonzero(self.of_sighting != LEFT_OUT)
        rows = rows[self.part[self.of_sighting[rows]] > 0]
        ids = (gathered.observations[k].id for k in gathered.sightings.observation[rows])
        return dict(zip(ids, self.of_sighting[rows].tolist(), strict=True))

    @cached_property
    def main(self) -> dict[int, int]:
        """The node of each label element's main part, where it is used."""
        return {int(self.element[row]): int(row) for row in np.flatnonzero(self.part == 0)}


def exclusion_of(labels: Labels, gathered: Gathered, nodes: Nodes, judged: Judged) -> Exclusion:
    """What excludes nodes from being one thing.

    Images count over all frames, not only those that were gathered; outside of these, what shows a
    label element shows its main part.
    """
    numbers: dict[Reason, int] = {}
    marks: list[tuple[int, int]] = []

    def mark(node: int, reason: Reason) -> None:
        if node != LEFT_OUT:
            marks.append((node, numbers.setdefault(reason, len(numbers))))

    row_of = {element.id: row for row, element in enumerate(gathered.elements)}
    parts = nodes.of_split_off(gathered)
    for row in sorted(labels.observations.values(), key=lambda row: (row.frame_index, row.side)):
        if row.element_id in row_of:
            node = parts.get(row.id, nodes.main.get(row_of[row.element_id], LEFT_OUT))
            mark(node, Reason(f"frame {row.frame_index} shows both in its {row.side} image"))
    for pair in judged.apart.tolist():
        names = " and ".join(str(gathered.elements[row].number) for row in pair)
        for row in pair:
            said = Reason(f"a person said that {names} are two things", "human")
            mark(nodes.main.get(row, LEFT_OUT), said)
    for node in np.flatnonzero(np.isin(nodes.element, nodes.element[nodes.part > 0])).tolist():
        number = gathered.elements[nodes.element[node]].number
        mark(node, Reason(f"they are two parts of what is labelled as {number}"))
    columns = np.array(sorted(marks), dtype=np.int64).reshape(-1, 2)
    return Exclusion(columns[:, 0], columns[:, 1], tuple(numbers))
