"""Which elements of two maps are the same thing.

They are where they share label elements; without labels, where they share an id, if ids mean the
same in both maps; and what is left over, where it stands at one place.
"""

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from semviz_annotation.mapping.quality.stand import stand_m
from semviz_core.elements import Elements3D
from semviz_core.semantic_map import SemanticMap

SAME_PLACE_M = 1.0
"""Without a name in common, elements further apart than this are not taken for the same."""


@dataclass
class Same:
    """Rows of the base map (first) and of the other one."""

    pairs: list[tuple[int, int]] = field(default_factory=list)
    """The same thing, once each; by row of the base."""
    merged: dict[int, list[int]] = field(default_factory=dict)
    """Rows of the base, two or more, that are one row of the other map."""
    split: dict[int, list[int]] = field(default_factory=dict)
    """Rows of the other map, two or more, that are one row of the base."""
    gone: list[int] = field(default_factory=list)
    """Rows of the base that are nothing in the other map."""
    new: list[int] = field(default_factory=list)
    """Rows of the other map that are nothing in the base."""


def same_elements(base: SemanticMap, other: SemanticMap) -> Same:
    """Every row of both maps is in a pair, or merged, split, gone or new."""
    if base.provenance and other.provenance:
        names = _labels(base), _labels(other)
    elif _ids_mean_the_same(base.elements, other.elements):
        names = _ids(base), _ids(other)
    else:
        names = _nameless(base), _nameless(other)
    result = _joined(base.elements, other.elements, *names)
    _join_by_place(base.elements, other.elements, result)
    return result


_Names: TypeAlias = list[frozenset[Hashable]]
"""Of each element of a map; those with a name in common are the same."""


def _labels(semantic_map: SemanticMap) -> _Names:
    return [frozenset(one.label_ids) for one in semantic_map.provenance]


def _ids(semantic_map: SemanticMap) -> _Names:
    return [frozenset([number]) for number in semantic_map.elements.id.tolist()]


def _nameless(semantic_map: SemanticMap) -> _Names:
    return [frozenset()] * len(semantic_map)


def _ids_mean_the_same(base: Elements3D, other: Elements3D) -> bool:
    """Whether most ids that both have are at one place."""
    _, mine, theirs = np.intersect1d(base.id, other.id, return_indices=True)
    away = np.linalg.norm(stand_m(base)[mine] - stand_m(other)[theirs], axis=1)
    return bool(len(away) and np.median(away) < SAME_PLACE_M)


def _joined(base: Elements3D, other: Elements3D, base_names: _Names, other_names: _Names) -> Same:
    """By names: equal ids first, then in the order of rows; what has no name in common is gone or
    new. Who finds its partners taken was merged into the first of them, or split off it."""
    holders: dict[Hashable, list[int]] = {}
    for j, names in enumerate(other_names):
        for name in names:
            holders.setdefault(name, []).append(j)
    links = [sorted({j for one in names for j in holders.get(one, ())}) for names in base_names]
    partner = _partners(base, other, links)
    first_link = {j: i for i, rows in reversed(list(enumerate(links))) for j in rows}
    base_of = {j: i for i, j in partner.items()}
    result = Same(pairs=sorted(partner.items()))
    for i, rows in enumerate(links):
        if i not in partner:
            if rows:
                result.merged.setdefault(rows[0], [base_of[rows[0]]]).append(i)
            else:
                result.gone.append(i)
    for j in range(len(other)):
        if j not in base_of:
            if j in first_link:
                i = first_link[j]
                result.split.setdefault(i, [partner[i]]).append(j)
            else:
                result.new.append(j)
    return result


def _partners(base: Elements3D, other: Elements3D, links: list[list[int]]) -> dict[int, int]:
    """Rows of the base to one of their linked rows each, none of which is taken twice."""
    partner = {i: j for i, rows in enumerate(links) for j in rows if base.id[i] == other.id[j]}
    taken = set(partner.values())
    for i, rows in enumerate(links):
        free = [j for j in rows if j not in taken]
        if i not in partner and free:
            partner[i] = free[0]
            taken.add(free[0])
    return partner


def _join_by_place(base: Elements3D, other: Elements3D, result: Same) -> None:
    """What is gone and what is new, of one kind and nearest to each other, is the same."""
    from scipy.spatial import cKDTree

    gone, new = np.array(result.gone, dtype=np.int64), np.array(result.new, dtype=np.int64)
    for kind in (True, False):
        mine, theirs = gone[base.is_line[gone] == kind], new[other.is_line[new] == kind]
        if not len(mine) or not len(theirs):
            continue
        here, there = stand_m(base)[mine], stand_m(other)[theirs]
        distance, nearest = cKDTree(there).query(here)
        _, back = cKDTree(here).query(there)
        mutual = (distance < SAME_PLACE_M) & (back[nearest] == np.arange(len(mine)))
        result.pairs += zip(mine[mutual].tolist(), theirs[nearest[mutual]].tolist(), strict=True)
    result.pairs.sort()
    paired = {i for i, _ in result.pairs}, {j for _, j in result.pairs}
    result.gone = [i for i in result.gone if i not in paired[0]]
    result.new = [j for j in result.new if j not in paired[1]]
