"""Comparison of two maps of one place: moved, new, gone, merged, split or renamed elements.

Elements correspond if they share label elements. Without labels they correspond by id, if ids mean
the same in both maps. The rest correspond by position.
"""

from collections.abc import Hashable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, TypeAlias

import numpy as np

from semviz_core.base.classes import OLDER_CENTER, TRIANGULAR, TriangleCenter, describe_center
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import SemanticMap, footprint_m
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.common.errors import SemvizError

SAME_PLACE_M = 1.0
"""Largest distance of elements that correspond by position."""


@dataclass
class MapCorrespondences:
    """Corresponding rows of the base map and the other map."""

    pairs: list[tuple[int, int]] = field(default_factory=list)
    """One-to-one correspondences (base, other), by row of the base."""
    merged: dict[int, list[int]] = field(default_factory=dict)
    """Row of the other map -> two or more rows of the base that became one."""
    split: dict[int, list[int]] = field(default_factory=dict)
    """Row of the base -> two or more rows of the other map that it became."""
    gone: list[int] = field(default_factory=list)
    """Rows of the base without a correspondence."""
    new: list[int] = field(default_factory=list)
    """Rows of the other map without a correspondence."""


def match_elements(base: SemanticMap, other: SemanticMap) -> MapCorrespondences:
    """Return the correspondences; every row of both maps is paired, merged, split, gone or new."""
    if base.provenance and other.provenance:
        names = _labels(base), _labels(other)
    elif _ids_mean_the_same(base.elements, other.elements):
        names = _ids(base), _ids(other)
    else:
        names = _no_names(base), _no_names(other)
    result = _correspondences(base.elements, other.elements, *names)
    _match_by_position(base.elements, other.elements, result)
    return result


_Names: TypeAlias = list[frozenset[Hashable]]
"""Names of each element of a map; elements with a common name correspond."""


def _labels(semantic_map: SemanticMap) -> _Names:
    return [frozenset(provenance.label_ids) for provenance in semantic_map.provenance]


def _ids(semantic_map: SemanticMap) -> _Names:
    return [frozenset([number]) for number in semantic_map.elements.id.tolist()]


def _no_names(semantic_map: SemanticMap) -> _Names:
    return [frozenset()] * len(semantic_map)


def _ids_mean_the_same(base: Elements3D, other: Elements3D) -> bool:
    """Return whether most ids of both maps are at the same positions."""
    _, base_rows, other_rows = np.intersect1d(base.id, other.id, return_indices=True)
    away = np.linalg.norm(footprint_m(base)[base_rows] - footprint_m(other)[other_rows], axis=1)
    return bool(len(away) and np.median(away) < SAME_PLACE_M)


def _correspondences(
    base: Elements3D, other: Elements3D, base_names: _Names, other_names: _Names
) -> MapCorrespondences:
    """Match elements by names: equal ids first, then in the order of rows.

    Elements without a common name are gone or new. If all its candidates are taken, an element was
    merged into the first of them, or split off it.
    """
    holders: dict[Hashable, list[int]] = {}
    for j, names in enumerate(other_names):
        for name in names:
            holders.setdefault(name, []).append(j)
    links = [sorted({j for name in names for j in holders.get(name, ())}) for names in base_names]
    match = _match_by_names(base, other, links)
    first_link = {j: i for i, rows in reversed(list(enumerate(links))) for j in rows}
    base_of = {j: i for i, j in match.items()}
    result = MapCorrespondences(pairs=sorted(match.items()))
    for i, rows in enumerate(links):
        if i not in match:
            if rows:
                result.merged.setdefault(rows[0], [base_of[rows[0]]]).append(i)
            else:
                result.gone.append(i)
    for j in range(len(other)):
        if j not in base_of:
            if j in first_link:
                i = first_link[j]
                result.split.setdefault(i, [match[i]]).append(j)
            else:
                result.new.append(j)
    return result


def _match_by_names(base: Elements3D, other: Elements3D, links: list[list[int]]) -> dict[int, int]:
    """Return a one-to-one match of base rows to one of their linked rows each."""
    match = {i: j for i, rows in enumerate(links) for j in rows if base.id[i] == other.id[j]}
    taken = set(match.values())
    for i, rows in enumerate(links):
        free = [j for j in rows if j not in taken]
        if i not in match and free:
            match[i] = free[0]
            taken.add(free[0])
    return match


def _match_by_position(base: Elements3D, other: Elements3D, result: MapCorrespondences) -> None:
    """Match gone and new elements of one kind that are mutually nearest."""
    from scipy.spatial import cKDTree

    gone, new = np.array(result.gone, dtype=np.int64), np.array(result.new, dtype=np.int64)
    for kind in (True, False):
        base_rows, other_rows = gone[base.is_line[gone] == kind], new[other.is_line[new] == kind]
        if not len(base_rows) or not len(other_rows):
            continue
        base_m, other_m = footprint_m(base)[base_rows], footprint_m(other)[other_rows]
        distance, nearest = cKDTree(other_m).query(base_m)
        _, back = cKDTree(base_m).query(other_m)
        mutual = (distance < SAME_PLACE_M) & (back[nearest] == np.arange(len(base_rows)))
        result.pairs += zip(
            base_rows[mutual].tolist(), other_rows[nearest[mutual]].tolist(), strict=True
        )
    result.pairs.sort()
    paired = {i for i, _ in result.pairs}, {j for _, j in result.pairs}
    result.gone = [i for i in result.gone if i not in paired[0]]
    result.new = [j for j in result.new if j not in paired[1]]


MOVED_M = 0.01
"""Limit of a move: one more label moves elements by as much."""
MOVES_LISTED = 10
"""In the text."""
_UNSEEN_M2 = 1e6
"""Added to the variance along a pole of an end that nobody saw, whose position is arbitrary."""


@dataclass(frozen=True)
class Moved:
    """An element in both maps, displaced by more than ``MOVED_M``."""

    name: str
    """Name in the other map."""
    distance_m: float
    """Displacement of the end that moved farther; ends that nobody saw count across the pole
    only."""
    sigmas: float | None
    """In standard deviations of the base map; None if it states none."""


@dataclass(frozen=True)
class Renamed:
    """An element with another class or number."""

    base: str
    other: str


@dataclass(frozen=True)
class Regrouped:
    """Several elements of one map that are one in the other: merged or split."""

    one: str
    several: tuple[str, ...]


@dataclass(frozen=True)
class MapDiff:
    """Differences of the other map from the base. Names are such as ``P-04``."""

    unchanged: int
    """Number of elements with the same position and class."""
    moved: tuple[Moved, ...]
    """Sorted by displacement in sigmas, largest first."""
    new: tuple[str, ...]
    gone: tuple[str, ...]
    merged: tuple[Regrouped, ...]
    split: tuple[Regrouped, ...]
    class_changed: tuple[Renamed, ...]
    renumbered: tuple[Renamed, ...]
    """Elements at the same position, but of other label elements or ids."""
    operations: tuple[int, int]
    """Last label operation of base and other; 0 without labels."""
    triangle_centers: tuple[TriangleCenter, TriangleCenter] = (OLDER_CENTER, OLDER_CENTER)
    """What the points of triangular signs are in base and other."""
    redefined: int = 0
    """Triangular signs whose points differ by definition; not compared, unless a metre apart."""

    def as_dict(self) -> dict[str, Any]:
        """Return values for JSON."""
        return asdict(self)

    def as_text(self) -> str:
        """Return a line per difference; of the moves, the largest only."""
        base, other = self.operations
        lines = [f"labels known up to operation: {base}, {other}", f"unchanged: {self.unchanged}"]
        if self.redefined:
            was, is_ = map(describe_center, self.triangle_centers)
            lines.append(f"triangular signs, not compared: {self.redefined}; at {was}, now {is_}")
        lines.append(f"moved by more than {MOVED_M * 100:g} cm: {len(self.moved)}")
        for move in self.moved[:MOVES_LISTED]:
            sigmas = "" if move.sigmas is None else f" ({move.sigmas:.1f} sigma)"
            lines.append(f"  {move.name}: {move.distance_m:.2f} m{sigmas}")
        if len(self.moved) > MOVES_LISTED:
            lines.append(f"  {len(self.moved) - MOVES_LISTED} more; --json lists all")
        lines += [f"new: {name}" for name in self.new]
        lines += [f"gone: {name}" for name in self.gone]
        lines += [f"merged: {', '.join(group.several)} into {group.one}" for group in self.merged]
        lines += [f"split: {group.one} into {', '.join(group.several)}" for group in self.split]
        lines += [
            f"class changed: {change.base} is {change.other}" for change in self.class_changed
        ]
        lines += [f"renumbered: {change.base} is {change.other}" for change in self.renumbered]
        return "\n".join(lines)


def diff_maps(base: SemanticMap, other: SemanticMap) -> MapDiff:
    """Compare two maps. Raise SemvizError if they are of different map frames."""
    if base.frame.name != other.frame.name:
        raise SemvizError(
            f"the maps are of '{base.frame.name}' and of '{other.frame.name}'; "
            "compare maps of one sequence"
        )
    same = match_elements(base, other)
    rows = np.array(same.pairs, dtype=np.int64).reshape(-1, 2)
    base_elements, other_elements = base.elements[rows[:, 0]], other.elements[rows[:, 1]]
    distance_m, sigmas = _displacement(base_elements, other_elements)
    has_moved, other_class = distance_m > MOVED_M, base_elements.class_id != other_elements.class_id
    redefined = (base_elements.class_id == TRIANGULAR) & ~other_class
    redefined &= (base.triangle_center != other.triangle_center) & (distance_m < SAME_PLACE_M)
    has_moved &= ~redefined
    moved = [
        Moved(
            name=_name(other, rows[pair, 1]),
            distance_m=float(distance_m[pair]),
            sigmas=float(sigmas[pair]) if np.isfinite(sigmas[pair]) else None,
        )
        for pair in np.flatnonzero(has_moved)
    ]
    return MapDiff(
        unchanged=int((~has_moved & ~other_class & ~redefined).sum()),
        moved=tuple(sorted(moved, key=lambda move: (-(move.sigmas or 0.0), -move.distance_m))),
        new=_names(other, same.new),
        gone=_names(base, same.gone),
        merged=tuple(
            Regrouped(_name(other, j), _names(base, rows)) for j, rows in same.merged.items()
        ),
        split=tuple(
            Regrouped(_name(base, i), _names(other, rows)) for i, rows in same.split.items()
        ),
        class_changed=_renamed(base, other, rows[other_class]),
        renumbered=_renamed(base, other, rows[base_elements.id != other_elements.id]),
        operations=(base.operation, other.operation),
        triangle_centers=(base.triangle_center, other.triangle_center),
        redefined=int(redefined.sum()),
    )


def _renamed(base: SemanticMap, other: SemanticMap, rows: IntArray) -> tuple[Renamed, ...]:
    """Return the renamed elements of pairs of rows (p, 2)."""
    return tuple(Renamed(_name(base, i), _name(other, j)) for i, j in rows.tolist())


def _name(semantic_map: SemanticMap, row: int) -> str:
    elements = semantic_map.elements
    return semantic_map.classes.element_name(elements.class_id[row], elements.id[row])


def _names(semantic_map: SemanticMap, rows: Iterable[int]) -> tuple[str, ...]:
    return tuple(_name(semantic_map, row) for row in rows)


def _displacement(base: Elements3D, other: Elements3D) -> tuple[FloatArray, FloatArray]:
    """Return displacements (p,) m of pairs, and in standard deviations of the base; infinite if it
    states none."""
    lines = base.is_line & other.is_line
    axis = unit_vectors(np.where(lines[:, None], base.end_m - base.anchor_m, 0.0))
    by_end = [
        _end_displacement(
            other.anchor_m - base.anchor_m,
            base.covariance_m2[:, :3, :3],
            axis,
            ~lines | (base.anchor_known & other.anchor_known),
        ),
        _end_displacement(
            np.where(lines[:, None], other.end_m - base.end_m, 0.0),
            base.covariance_m2[:, 3:, 3:],
            axis,
            base.end_known & other.end_known,
        ),
    ]
    distance, sigmas = np.array(by_end).max(axis=0)
    return distance, sigmas


def _end_displacement(
    offset_m: FloatArray, covariance_m2: FloatArray, axis: FloatArray, known: BoolArray
) -> FloatArray:
    """Return distances and sigmas (2, p) of ends (p, 3) of poles along unit axes (p, 3), or of
    signs."""
    along = (offset_m * axis).sum(axis=1, keepdims=True) * axis
    distance = np.linalg.norm(np.where(known[:, None], offset_m, offset_m - along), axis=1)
    loose = _UNSEEN_M2 * axis[:, :, None] * axis[:, None, :]
    covariance = covariance_m2 + np.where(known[:, None, None], 0.0, loose)
    states_one = np.linalg.det(covariance_m2) > 0.0
    covariance = np.where(states_one[:, None, None], covariance, np.eye(3))
    solved = np.linalg.solve(covariance, offset_m[:, :, None])[:, :, 0]
    sigmas = np.sqrt((offset_m * solved).sum(axis=1))
    return np.array([distance, np.where(states_one | ~offset_m.any(axis=1), sigmas, np.inf)])
