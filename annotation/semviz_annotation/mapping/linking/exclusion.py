"""Who cannot be one thing: what one image shows twice is two, and so is what a person calls two."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from semviz_core.arrays import BoolArray, IntArray


class Reason(NamedTuple):
    """Why two nodes are not one thing."""

    text: str
    by: Literal["machine", "human"] = "machine"


@dataclass(frozen=True, eq=False)
class Exclusion:
    """Marks of nodes, two or more of which may become one thing; not those that share a mark.

    A mark is an image that shows the node, or a judgement that it and another are two.
    """

    node: IntArray
    """(q,)"""
    mark: IntArray
    """(q,) row of ``reasons``"""
    reasons: tuple[Reason, ...]

    def of_groups(self, group: IntArray) -> "Exclusion":
        """The same marks on groups of nodes: node i is in group (n,)[i]."""
        return Exclusion(group[self.node], self.mark, self.reasons)

    def marked(self, mark: int) -> IntArray:
        """The nodes that have a mark, ascending."""
        return np.unique(self.node[self.mark == mark])

    def forbids(self, one: IntArray, other: IntArray) -> BoolArray:
        """(p,) whether nodes one (p,) and other (p,) share a mark; quick where one has few."""
        return self.shared(one, other) >= 0

    def shared(self, one: IntArray, other: IntArray) -> IntArray:
        """(p,) the least mark that nodes one (p,) and other (p,) share; -1 where there is none."""
        order = np.lexsort((self.mark, self.node))
        node, mark = self.node[order], self.mark[order]
        first, last = np.searchsorted(node, one), np.searchsorted(node, one, side="right")
        rows, pair = spans(first, last)
        width = len(self.reasons)
        keys = node * width + mark
        wanted = other[pair] * width + mark[rows]
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        found = np.flatnonzero(keys[at] == wanted) if len(rows) else rows
        result = np.full(len(one), -1)
        result[pair[found[::-1]]] = mark[rows[found[::-1]]]
        return result

    def clashing(self, group: IntArray, rank: IntArray) -> BoolArray:
        """(n,) which nodes must stay out of their group (n,), so that it can be one thing.

        Of two that share a mark, the one of the lower rank (n,) stays. -1 is in no group.
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
    """The numbers from first (p,) to below last (p,), one after another, and whose they are."""
    counts = last - first
    whose = np.repeat(np.arange(len(first)), counts)
    before = np.cumsum(counts) - counts
    return np.arange(len(whose)) - before[whose] + first[whose], whose
