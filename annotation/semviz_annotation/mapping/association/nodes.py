"""Nodes for linking, constraints from review decisions, and pairs that cannot be one landmark.

A node is a label element or a part of one. Two labels in one image are two landmarks; so are
elements that a review decision keeps apart.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from semviz_annotation.labels.labels import LabelElement, Labels
from semviz_annotation.mapping.placement.observations import LabelObservations, ObservationArray
from semviz_core.common.arrays import BoolArray, IntArray


class Reason(NamedTuple):
    """Why two nodes are not one landmark."""

    text: str
    by: Literal["machine", "human"] = "machine"


@dataclass(frozen=True, eq=False)
class CannotLink:
    """Cannot-link constraints: nodes that share a mark are not one landmark.

    A mark is an image that shows the node, or a review decision that it and another node differ.
    """

    node: IntArray
    """(q,)"""
    mark: IntArray
    """(q,) row of ``reasons``"""
    reasons: tuple[Reason, ...]

    def of_groups(self, group: IntArray) -> "CannotLink":
        """Return the marks of groups of nodes; node i is in group (n,)[i]."""
        return CannotLink(group[self.node], self.mark, self.reasons)

    def marked(self, mark: int) -> IntArray:
        """Return the nodes that have a mark, ascending."""
        return np.unique(self.node[self.mark == mark])

    def forbids(self, first: IntArray, second: IntArray) -> BoolArray:
        """Return whether nodes first (p,) and second (p,) share a mark; fast if the first have
        few."""
        return self.shared(first, second) >= 0

    def shared(self, first_node: IntArray, second_node: IntArray) -> IntArray:
        """Return the smallest mark (p,) that first and second nodes (p,) share; -1 if none."""
        order = np.lexsort((self.mark, self.node))
        node, mark = self.node[order], self.mark[order]
        first, last = (
            np.searchsorted(node, first_node),
            np.searchsorted(node, first_node, side="right"),
        )
        rows, pair = spans(first, last)
        width = len(self.reasons)
        keys = node * width + mark
        target_keys = second_node[pair] * width + mark[rows]
        at = np.minimum(np.searchsorted(keys, target_keys), len(keys) - 1)
        matching = np.flatnonzero(keys[at] == target_keys) if len(rows) else rows
        result = np.full(len(first_node), -1)
        result[pair[matching[::-1]]] = mark[rows[matching[::-1]]]
        return result

    def clashing(self, group: IntArray, rank: IntArray) -> BoolArray:
        """Return which nodes (n,) must stay out of their group (n,), so that it can be one
        landmark.

        Of two nodes that share a mark, the one of lower rank (n,) stays. Group -1 is none.
        """
        rows = np.flatnonzero(group[self.node] >= 0)
        node, mark = self.node[rows], self.mark[rows]
        by = np.lexsort((rank[node], mark, group[node]))
        node, mark = node[by], mark[by]
        again = (group[node[1:]] == group[node[:-1]]) & (mark[1:] == mark[:-1])
        result = np.zeros(len(group), dtype=bool)
        result[node[1:][again]] = True
        return result


def spans(first: IntArray, last: IntArray) -> tuple[IntArray, IntArray]:
    """Return the numbers from first (p,) to below last (p,), concatenated, and the index of each
    range."""
    counts = last - first
    whose = np.repeat(np.arange(len(first)), counts)
    before = np.cumsum(counts) - counts
    return np.arange(len(whose)) - before[whose] + first[whose], whose


LEFT_OUT = -1
"""Instead of a part or node, for observations that belong to none."""


@dataclass(frozen=True, eq=False)
class ReviewConstraints:
    """Review decisions about n label elements, in the order of ``LabelObservations.elements``."""

    kept: BoolArray
    """(n,) whether an element is one landmark with all its observations"""
    left_out: BoolArray
    """(n,) whether an element is left out of the map"""
    apart: IntArray
    """(j, 2) pairs of label elements that are different landmarks"""

    @classmethod
    def nothing(cls, count: int) -> "ReviewConstraints":
        """Return no constraints on ``count`` label elements."""
        nobody = np.zeros(count, dtype=bool)
        return cls(nobody, nobody, np.zeros((0, 2), dtype=np.int64))

    @classmethod
    def of(cls, labels: Labels, elements: tuple[LabelElement, ...]) -> "ReviewConstraints":
        row_of = {element.id: row for row, element in enumerate(elements)}
        verdicts: dict[str, list[tuple[int, ...]]] = {}
        for _, decision in sorted(labels.review_decisions.items()):
            names = [name for name in (decision.element_id, decision.other_id) if name is not None]
            if all(name in row_of for name in names):
                rows = tuple(sorted(row_of[name] for name in names))
                verdicts.setdefault(decision.verdict, []).append(rows)
        kept, left_out = np.zeros((2, len(elements)), dtype=bool)
        kept[[row for (row,) in verdicts.get("keep", ())]] = True
        left_out[[row for (row,) in verdicts.get("leave out", ())]] = True
        apart = np.array(sorted(verdicts.get("apart", ())), dtype=np.int64)
        return cls(kept, left_out, apart.reshape(-1, 2))


@dataclass(frozen=True, eq=False)
class TrackNodes:
    """m parts of label elements: most elements are one part, those of several landmarks are
    more."""

    element: IntArray
    """(m,) row of the label element, ascending"""
    part: IntArray
    """(m,) number of the part; 0 is the main part"""
    of_observation: IntArray
    """(k,) node of each gathered observation, or ``LEFT_OUT``"""
    observations: ObservationArray
    """The observations of the nodes."""

    @classmethod
    def of(cls, observations: ObservationArray, part: IntArray) -> "TrackNodes":
        """Return the nodes for the part (k,) of each observation of label elements."""
        used = part != LEFT_OUT
        names = np.stack([observations.landmark[used], part[used]], axis=1)
        nodes, index = np.unique(names, axis=0, return_inverse=True)
        of_observation = np.full(len(part), LEFT_OUT)
        of_observation[used] = index.ravel()
        return cls(
            nodes[:, 0],
            nodes[:, 1],
            of_observation,
            observations.regrouped(of_observation, len(nodes)),
        )

    def __len__(self) -> int:
        return len(self.element)

    @property
    def first_observation(self) -> IntArray:
        """(m,) one gathered observation of each node"""
        return self.observations.label_row[self.observations.first]

    def of_split_off(self, gathered: LabelObservations) -> dict[str, int]:
        """Return the nodes of observations outside the main part of their label element, by id."""
        rows = np.flatnonzero(self.of_observation != LEFT_OUT)
        rows = rows[self.part[self.of_observation[rows]] > 0]
        ids = (gathered.label_rows[k].id for k in gathered.observations.label_row[rows])
        return dict(zip(ids, self.of_observation[rows].tolist(), strict=True))

    @cached_property
    def main(self) -> dict[int, int]:
        """The node of each label element's main part, if it is used."""
        return {int(self.element[row]): int(row) for row in np.flatnonzero(self.part == 0)}


def cannot_link_constraints(
    labels: Labels, gathered: LabelObservations, nodes: TrackNodes, constraints: ReviewConstraints
) -> CannotLink:
    """Return the constraints between nodes.

    All frames count, not only the gathered ones. In other frames, an observation counts for the
    main part of its label element.
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
    for pair in constraints.apart.tolist():
        names = " and ".join(str(gathered.elements[row].number) for row in pair)
        for row in pair:
            said = Reason(f"a person said that {names} are two landmarks", "human")
            mark(nodes.main.get(row, LEFT_OUT), said)
    for node in np.flatnonzero(np.isin(nodes.element, nodes.element[nodes.part > 0])).tolist():
        number = gathered.elements[nodes.element[node]].number
        mark(node, Reason(f"they are two parts of what is labelled as {number}"))
    columns = np.array(sorted(marks), dtype=np.int64).reshape(-1, 2)
    return CannotLink(columns[:, 0], columns[:, 1], tuple(numbers))
