"""Poles and signs, seen (2D) and mapped (3D), as structs of arrays.

A line element (pole) runs from its anchor, the peak, to its end, the bottom. A point element
(sign) has its anchor at its middle and an end of NaN. Either end of a pole can be unknown, cut
off by the image or hidden by a car: its coordinates are then those of the last visible point, and
only the line through both counts.
"""

from dataclasses import dataclass, fields
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.arrays import (
    LARGEST,
    BoolArray,
    FloatArray,
    IntArray,
    bool_array,
    float_array,
    int_array,
    place,
)
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose

SIGMA_PX_RANGE = (1e-6, 1e6)
"""Smaller or larger ones are no detector's, and their squares lose all digits."""

Rows: TypeAlias = ArrayLike | slice
Elements = TypeVar("Elements", "Elements2D", "Elements3D")


@dataclass(frozen=True, eq=False)
class Elements2D:
    """m elements seen in one image."""

    anchor_px: FloatArray
    """(m, 2) peak of a pole, middle of a sign."""
    end_px: FloatArray
    """(m, 2) bottom of a pole, NaN for points."""
    class_id: IntArray
    """(m,)"""
    score: FloatArray
    """(m,) detector's confidence in [0, 1]; 1 for labels."""
    sigma_px: FloatArray
    """(m, 2) standard deviation across and along a pole at its ends; both axes alike for signs."""
    anchor_known: BoolArray
    """(m,) False where a pole's peak is cut off or hidden."""
    end_known: BoolArray
    """(m,) False where a pole's bottom is cut off or hidden, and for points."""

    def __post_init__(self) -> None:
        _set(self, "anchor_px", float_array(self.anchor_px, (None, 2), "anchor_px"))
        _set(self, "end_px", float_array(self.end_px, (None, 2), "end_px", nan=True))
        _set(self, "class_id", int_array(self.class_id, (None,), "class_id"))
        _set(self, "score", float_array(self.score, (None,), "score"))
        _set(self, "sigma_px", float_array(self.sigma_px, (None, 2), "sigma_px"))
        _set(self, "anchor_known", bool_array(self.anchor_known, (None,), "anchor_known"))
        _set(self, "end_known", bool_array(self.end_known, (None,), "end_known"))
        _check_lengths(self, "observed elements")
        _check_ends(self.end_px, self.end_known, "end_px")
        low, high = SIGMA_PX_RANGE
        _check(self.sigma_px, low, high, "sigma_px")
        _check(self.score, 0.0, 1.0, "score")

    @classmethod
    def from_ends(
        cls, anchor_px: ArrayLike, end_px: ArrayLike, class_id: ArrayLike, sigma_px: float = 1.0
    ) -> "Elements2D":
        """Elements with every end known, score 1 and one sigma. No ends at all: ``[]``."""
        end = float_array(end_px, (None, 2), "end_px", nan=True)
        m = len(end)
        return cls(
            anchor_px=float_array(anchor_px, (None, 2), "anchor_px"),
            end_px=end,
            class_id=int_array(class_id, (None,), "class_id"),
            score=np.ones(m),
            sigma_px=np.full((m, 2), float_array(sigma_px, (), "sigma_px")),
            anchor_known=np.ones(m, dtype=bool),
            end_known=_rows_finite(end),
        )

    @property
    def is_line(self) -> BoolArray:
        """(m,) True for poles."""
        return _rows_finite(self.end_px)

    def __len__(self) -> int:
        return len(self.class_id)

    def __getitem__(self, rows: Rows) -> "Elements2D":
        """The elements at ``rows``: indices (k,), a mask (m,) or a slice."""
        return _chosen(self, _index(rows, len(self)))


@dataclass(frozen=True, eq=False)
class Elements3D:
    """n elements of a map, in the map frame (metres, z up)."""

    id: IntArray
    """(n,) unique; stable over rebuilds of the map."""
    anchor_m: FloatArray
    """(n, 3) peak of a pole, middle of a sign."""
    end_m: FloatArray
    """(n, 3) bottom of a pole, NaN for points."""
    class_id: IntArray
    """(n,)"""
    covariance_m2: FloatArray
    """(n, 6, 6) of (anchor, end); zero in the rows of a point's end."""
    anchor_known: BoolArray
    """(n,) False where no view showed a pole's peak."""
    end_known: BoolArray
    """(n,) False where no view showed a pole's bottom, and for points."""

    def __post_init__(self) -> None:
        _set(self, "id", int_array(self.id, (None,), "id"))
        _set(self, "anchor_m", float_array(self.anchor_m, (None, 3), "anchor_m"))
        _set(self, "end_m", float_array(self.end_m, (None, 3), "end_m", nan=True))
        _set(self, "class_id", int_array(self.class_id, (None,), "class_id"))
        covariance = float_array(self.covariance_m2, (None, 6, 6), "covariance_m2")
        _set(self, "covariance_m2", covariance)
        _set(self, "anchor_known", bool_array(self.anchor_known, (None,), "anchor_known"))
        _set(self, "end_known", bool_array(self.end_known, (None,), "end_known"))
        _check_lengths(self, "map elements")
        _check_ends(self.end_m, self.end_known, "end_m")
        _check_ids(self.id)
        negative = np.diagonal(covariance, axis1=1, axis2=2) < 0.0
        if negative.any():
            row = int(np.flatnonzero(negative.any(axis=1))[0])
            raise SemvizError(
                f"covariance_m2 holds negative variances, first in row {row}; remove or repair them"
            )

    @classmethod
    def from_ends(
        cls,
        id: ArrayLike,
        anchor_m: ArrayLike,
        end_m: ArrayLike,
        class_id: ArrayLike,
        sigma_m: float = 0.05,
    ) -> "Elements3D":
        """Elements with every end known and one isotropic sigma. No ends at all: ``[]``."""
        end = float_array(end_m, (None, 3), "end_m", nan=True)
        sigma = float_array(sigma_m, (), "sigma_m")
        _check(sigma, 0.0, np.sqrt(LARGEST), "sigma_m")
        n, is_line = len(end), _rows_finite(end)
        covariance = np.zeros((n, 6, 6))
        covariance[:, range(3), range(3)] = sigma**2
        covariance[:, range(3, 6), range(3, 6)] = np.where(is_line, sigma**2, 0.0)[:, None]
        return cls(
            id=int_array(id, (None,), "id"),
            anchor_m=float_array(anchor_m, (None, 3), "anchor_m"),
            end_m=end,
            class_id=int_array(class_id, (None,), "class_id"),
            covariance_m2=covariance,
            anchor_known=np.ones(n, dtype=bool),
            end_known=is_line,
        )

    @property
    def is_line(self) -> BoolArray:
        """(n,) True for poles."""
        return _rows_finite(self.end_m)

    def __len__(self) -> int:
        return len(self.class_id)

    def __getitem__(self, rows: Rows) -> "Elements3D":
        """The elements at ``rows``: indices (k,) without repeats, a mask (n,) or a slice."""
        chosen = _chosen(self, _index(rows, len(self)))
        _check_ids(chosen.id)
        return chosen

    def transformed(self, T_target_map: Pose) -> "Elements3D":
        """The same elements in another frame."""
        J = np.kron(np.eye(2), T_target_map.rotation)
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        values["anchor_m"] = T_target_map.apply(self.anchor_m)
        values["end_m"] = T_target_map.apply(self.end_m)
        values["covariance_m2"] = J @ self.covariance_m2 @ J.T
        return Elements3D(**values)


def joined(one: Elements, other: Elements) -> Elements:
    """The elements of ``one``, then those of ``other``."""
    return type(one)(
        **{name: np.concatenate([value, vars(other)[name]]) for name, value in vars(one).items()}
    )


def _set(value: object, name: str, array: object) -> None:
    object.__setattr__(value, name, array)  # the dataclass is frozen


def _rows_finite(points: FloatArray) -> BoolArray:
    return np.asarray(np.isfinite(points).all(axis=1))


def _check_lengths(elements: Elements2D | Elements3D, name: str) -> None:
    lengths = {one.name: len(getattr(elements, one.name)) for one in fields(elements)}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{field} {length}" for field, length in lengths.items())
        raise SemvizError(f"{name} have arrays of different lengths: {listed}; give one row each")


def _check_ends(end: FloatArray, end_known: BoolArray, name: str) -> None:
    missing = np.isnan(end)
    partly = np.asarray(missing.any(axis=1) & ~missing.all(axis=1))
    if partly.any():
        raise SemvizError(f"{name}{place(partly)} is NaN in part; only points have NaN, throughout")
    without = end_known & missing[:, 0]
    if without.any():
        raise SemvizError(
            f"end_known{place(without)} is set for elements without an end; "
            f"set it False or give {name}"
        )


def _check(values: FloatArray, low: float, high: float, name: str) -> None:
    outside = np.asarray((values < low) | (values > high))
    if outside.any():
        value = values[outside].flat[0]
        where = place(outside) if values.ndim else ""
        raise SemvizError(f"{name}{where} is {value:g}; give a number from {low:g} to {high:g}")


def _check_ids(ids: IntArray) -> None:
    ordered = np.sort(ids)
    repeated = ordered[1:] == ordered[:-1]
    if repeated.any():
        raise SemvizError(f"two map elements share an id: {ordered[1:][repeated][0]}; number anew")


def _index(rows: Rows, count: int) -> IntArray:
    if isinstance(rows, slice):
        return np.arange(*rows.indices(count))
    index = np.asarray(rows)
    if index.dtype == np.bool_:
        return np.flatnonzero(bool_array(index, (count,), "rows"))
    index = int_array(index, (None,), "rows")
    if index.size and not (-count <= index.min() and index.max() < count):
        raise SemvizError(f"rows reach from {index.min()} to {index.max()} of {count} elements")
    return index


def _chosen(elements: Elements, index: IntArray) -> Elements:
    """Rows of elements that are checked already, so without checking each number again."""
    chosen = object.__new__(type(elements))
    for one in fields(elements):
        rows = getattr(elements, one.name).take(index, axis=0)
        rows.flags.writeable = False
        _set(chosen, one.name, rows)
    return chosen
