"""Two maps of one place compared: what moved, is new, is gone, was merged, split or renamed."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from semviz_annotation.mapping.quality.same import same_elements
from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap

MOVED_M = 0.01
"""Nobody can measure less, and rebuilding with one more label moves elements by that."""
MOVES_LISTED = 10
"""In the text."""
_UNSEEN_M2 = 1e6
"""Added along a pole to the variance of an end that nobody saw: where that is means nothing."""


@dataclass(frozen=True)
class Moved:
    """One element in both maps, further apart than ``MOVED_M``."""

    name: str
    """In the other map."""
    distance_m: float
    """Of the end that moved further; ends that nobody saw count across the pole only."""
    sigmas: float | None
    """In standard deviations of the base map's place; None where that states none."""


@dataclass(frozen=True)
class Renamed:
    """One element under two names: another class, or another number."""

    base: str
    other: str


@dataclass(frozen=True)
class Regrouped:
    """Several elements that are one in the other map (merged), or the other way round (split)."""

    one: str
    several: tuple[str, ...]


@dataclass(frozen=True)
class MapDiff:
    """What the other map has differently from the base. Names are such as ``P-04``."""

    unchanged: int
    """Elements of both that are at the same place and of the same class."""
    moved: tuple[Moved, ...]
    """The largest distance in sigmas first."""
    new: tuple[str, ...]
    gone: tuple[str, ...]
    merged: tuple[Regrouped, ...]
    split: tuple[Regrouped, ...]
    class_changed: tuple[Renamed, ...]
    renumbered: tuple[Renamed, ...]
    """At one place, but not of one label element or id."""
    operations: tuple[int, int]
    """Up to which label operation base and other know the labels; 0 without labels."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def as_text(self) -> str:
        """A line for each difference; the largest moves only."""
        base, other = self.operations
        lines = [f"labels known up to operation: {base}, {other}", f"unchanged: {self.unchanged}"]
        lines.append(f"moved by more than {MOVED_M * 100:g} cm: {len(self.moved)}")
        for one in self.moved[:MOVES_LISTED]:
            sigmas = "" if one.sigmas is None else f" ({one.sigmas:.1f} sigma)"
            lines.append(f"  {one.name}: {one.distance_m:.2f} m{sigmas}")
        if len(self.moved) > MOVES_LISTED:
            lines.append(f"  {len(self.moved) - MOVES_LISTED} more; --json lists all")
        lines += [f"new: {name}" for name in self.new]
        lines += [f"gone: {name}" for name in self.gone]
        lines += [f"merged: {', '.join(one.several)} into {one.one}" for one in self.merged]
        lines += [f"split: {one.one} into {', '.join(one.several)}" for one in self.split]
        lines += [f"class changed: {one.base} is {one.other}" for one in self.class_changed]
        lines += [f"renumbered: {one.base} is {one.other}" for one in self.renumbered]
        return "\n".join(lines)


def diff_maps(base: SemanticMap, other: SemanticMap) -> MapDiff:
    """Raises SemvizError where the maps are of different frames."""
    if base.frame.name != other.frame.name:
        raise SemvizError(
            f"the maps are of '{base.frame.name}' and of '{other.frame.name}'; "
            "compare maps of one sequence"
        )
    same = same_elements(base, other)
    rows = np.array(same.pairs, dtype=np.int64).reshape(-1, 2)
    mine, theirs = base.elements[rows[:, 0]], other.elements[rows[:, 1]]
    distance_m, sigmas = _displacement(mine, theirs)
    has_moved, other_class = distance_m > MOVED_M, mine.class_id != theirs.class_id
    moved = [
        Moved(
            name=_name(other, rows[one, 1]),
            distance_m=float(distance_m[one]),
            sigmas=float(sigmas[one]) if np.isfinite(sigmas[one]) else None,
        )
        for one in np.flatnonzero(has_moved)
    ]
    return MapDiff(
        unchanged=int((~has_moved & ~other_class).sum()),
        moved=tuple(sorted(moved, key=lambda one: (-(one.sigmas or 0.0), -one.distance_m))),
        new=_names(other, same.new),
        gone=_names(base, same.gone),
        merged=tuple(
            Regrouped(_name(other, j), _names(base, rows)) for j, rows in same.merged.items()
        ),
        split=tuple(
            Regrouped(_name(base, i), _names(other, rows)) for i, rows in same.split.items()
        ),
        class_changed=_renamed(base, other, rows[other_class]),
        renumbered=_renamed(base, other, rows[mine.id != theirs.id]),
        operations=(base.operation, other.operation),
    )


def _renamed(base: SemanticMap, other: SemanticMap, rows: IntArray) -> tuple[Renamed, ...]:
    """Of pairs of rows (p, 2)."""
    return tuple(Renamed(_name(base, i), _name(other, j)) for i, j in rows.tolist())


def _name(semantic_map: SemanticMap, row: int) -> str:
    elements = semantic_map.elements
    return semantic_map.classes.element_name(elements.class_id[row], elements.id[row])


def _names(semantic_map: SemanticMap, rows: Iterable[int]) -> tuple[str, ...]:
    return tuple(_name(semantic_map, row) for row in rows)


def _displacement(base: Elements3D, other: Elements3D) -> tuple[FloatArray, FloatArray]:
    """(p,) m between the same elements, and in standard deviations of the base's place; infinite
    where that states none."""
    lines = base.is_line & other.is_line
    axis = np.where(lines[:, None], base.end_m - base.anchor_m, 0.0)
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
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
    """(2, p) distances and sigmas of ends (p, 3) of poles along unit axes (p, 3), or of signs."""
    along = (offset_m * axis).sum(axis=1, keepdims=True) * axis
    distance = np.linalg.norm(np.where(known[:, None], offset_m, offset_m - along), axis=1)
    loose = _UNSEEN_M2 * axis[:, :, None] * axis[:, None, :]
    covariance = covariance_m2 + np.where(known[:, None, None], 0.0, loose)
    states_one = np.linalg.det(covariance_m2) > 0.0
    covariance = np.where(states_one[:, None, None], covariance, np.eye(3))
    solved = np.linalg.solve(covariance, offset_m[:, :, None])[:, :, 0]
    sigmas = np.sqrt((offset_m * solved).sum(axis=1))
    return np.array([distance, np.where(states_one | ~offset_m.any(axis=1), sigmas, np.inf)])
