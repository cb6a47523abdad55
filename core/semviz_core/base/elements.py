"""Poles and signs, observed (2D) and mapped (3D), as structs of arrays.

A line element (pole) runs from its anchor, the peak, to its end, the bottom. A point element
(sign) has its anchor at its centre and an end of NaN. Either end of a pole can be unknown: cut
off by the image border or hidden by a car. Its coordinates are then those of the last visible
point, and only the line through both ends is a measurement.
"""

from dataclasses import dataclass, field, fields
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.base.pose import Pose
from semviz_core.common import arrays
from semviz_core.common.errors import SemvizError

SIGMA_PX_RANGE = (1e-6, 1e6)
"""Sigmas that are accepted; squares of smaller or larger ones lose all digits."""

Rows: TypeAlias = ArrayLike | slice
Elements = TypeVar("Elements", "Elements2D", "Elements3D")


@dataclass(frozen=True, eq=False)
class Elements2D:
    """m elements observed in one image."""

    anchor_px: arrays.FloatArray
    """(m, 2) peak of a pole, centre of a sign."""
    end_px: arrays.FloatArray
    """(m, 2) bottom of a pole, NaN for points."""
    class_id: arrays.IntArray
    """(m,)"""
    score: arrays.FloatArray
    """(m,) detector's confidence in [0, 1]; 1 for labels."""
    sigma_px: arrays.FloatArray
    """(m, 2) standard deviation across and along a pole at its ends; equal for signs."""
    anchor_known: arrays.BoolArray
    """(m,) False where a pole's peak is cut off or hidden."""
    end_known: arrays.BoolArray
    """(m,) False where a pole's bottom is cut off or hidden, and for points."""
    to_centroid_px: arrays.FloatArray = field(default_factory=lambda: np.zeros(0))
    """(m,) rows from the middle of a triangular sign's box down to the centroid of its corners: a
    sixth of its height, negative if it is upside down. NaN if unknown, as for all if not given."""

    def __post_init__(self) -> None:
        _set(self, "anchor_px", arrays.float_array(self.anchor_px, (None, 2), "anchor_px"))
        _set(self, "end_px", arrays.float_array(self.end_px, (None, 2), "end_px", nan=True))
        _set(self, "class_id", arrays.int_array(self.class_id, (None,), "class_id"))
        _set(self, "score", arrays.float_array(self.score, (None,), "score"))
        _set(self, "sigma_px", arrays.float_array(self.sigma_px, (None, 2), "sigma_px"))
        _set(self, "anchor_known", arrays.bool_array(self.anchor_known, (None,), "anchor_known"))
        _set(self, "end_known", arrays.bool_array(self.end_known, (None,), "end_known"))
        shift = self.to_centroid_px if len(self.to_centroid_px) else np.full(len(self), np.nan)
        _set(self, "to_centroid_px", arrays.float_array(shift, (None,), "to_centroid_px", nan=True))
        _check_lengths(self, "observed elements")
        _check_ends(self.end_px, self.end_known, "end_px")
        low, high = SIGMA_PX_RANGE
        _check(self.sigma_px, low, high, "sigma_px")
        _check(self.score, 0.0, 1.0, "score")

    @classmethod
    def from_ends(
        cls, anchor_px: ArrayLike, end_px: ArrayLike, class_id: ArrayLike, sigma_px: float = 1.0
    ) -> "Elements2D":
        """Return elements with all ends known, score 1 and one sigma; ``[]`` gives none."""
        end = arrays.float_array(end_px, (None, 2), "end_px", nan=True)
        m = len(end)
        return cls(
            anchor_px=arrays.float_array(anchor_px, (None, 2), "anchor_px"),
            end_px=end,
            class_id=arrays.int_array(class_id, (None,), "class_id"),
            score=np.ones(m),
            sigma_px=np.full((m, 2), arrays.float_array(sigma_px, (), "sigma_px")),
            anchor_known=np.ones(m, dtype=bool),
            end_known=_rows_finite(end),
        )

    @property
    def is_line(self) -> arrays.BoolArray:
        """(m,) True for poles."""
        return _rows_finite(self.end_px)

    def __len__(self) -> int:
        return len(self.class_id)

    def __getitem__(self, rows: Rows) -> "Elements2D":
        """Return the elements at ``rows``: indices (k,), a mask (m,) or a slice."""
        return _select(self, _index(rows, len(self)))


@dataclass(frozen=True, eq=False)
class Elements3D:
    """n elements of a map, in the map frame (metres, z up)."""

    id: arrays.IntArray
    """(n,) unique; stable over rebuilds of the map."""
    anchor_m: arrays.FloatArray
    """(n, 3) peak of a pole, centre of a sign."""
    end_m: arrays.FloatArray
    """(n, 3) bottom of a pole, NaN for points."""
    class_id: arrays.IntArray
    """(n,)"""
    covariance_m2: arrays.FloatArray
    """(n, 6, 6) of (anchor, end); zero in the rows of a point's end."""
    anchor_known: arrays.BoolArray
    """(n,) False where no view showed a pole's peak."""
    end_known: arrays.BoolArray
    """(n,) False where no view showed a pole's bottom, and for points."""

    def __post_init__(self) -> None:
        _set(self, "id", arrays.int_array(self.id, (None,), "id"))
        _set(self, "anchor_m", arrays.float_array(self.anchor_m, (None, 3), "anchor_m"))
        _set(self, "end_m", arrays.float_array(self.end_m, (None, 3), "end_m", nan=True))
        _set(self, "class_id", arrays.int_array(self.class_id, (None,), "class_id"))
        covariance = arrays.float_array(self.covariance_m2, (None, 6, 6), "covariance_m2")
        _set(self, "covariance_m2", covariance)
        _set(self, "anchor_known", arrays.bool_array(self.anchor_known, (None,), "anchor_known"))
        _set(self, "end_known", arrays.bool_array(self.end_known, (None,), "end_known"))
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
        """Return elements with all ends known and one isotropic sigma; ``[]`` gives none."""
        end = arrays.float_array(end_m, (None, 3), "end_m", nan=True)
        sigma = arrays.float_array(sigma_m, (), "sigma_m")
        _check(sigma, 0.0, np.sqrt(arrays.LARGEST), "sigma_m")
        n, is_line = len(end), _rows_finite(end)
        covariance = np.zeros((n, 6, 6))
        covariance[:, range(3), range(3)] = sigma**2
        covariance[:, range(3, 6), range(3, 6)] = np.where(is_line, sigma**2, 0.0)[:, None]
        return cls(
            id=arrays.int_array(id, (None,), "id"),
            anchor_m=arrays.float_array(anchor_m, (None, 3), "anchor_m"),
            end_m=end,
            class_id=arrays.int_array(class_id, (None,), "class_id"),
            covariance_m2=covariance,
            anchor_known=np.ones(n, dtype=bool),
            end_known=is_line,
        )

    @property
    def is_line(self) -> arrays.BoolArray:
        """(n,) True for poles."""
        return _rows_finite(self.end_m)

    def __len__(self) -> int:
        return len(self.class_id)

    def __getitem__(self, rows: Rows) -> "Elements3D":
        """Return the elements at ``rows``: indices (k,) without repeats, a mask (n,) or a slice."""
        selected = _select(self, _index(rows, len(self)))
        _check_ids(selected.id)
        return selected

    def transformed(self, T_target_map: Pose) -> "Elements3D":
        """Return the same elements in another frame."""
        J = np.kron(np.eye(2), T_target_map.rotation)
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        values["anchor_m"] = T_target_map.apply(self.anchor_m)
        values["end_m"] = T_target_map.apply(self.end_m)
        values["covariance_m2"] = J @ self.covariance_m2 @ J.T
        return Elements3D(**values)


def joined(first: Elements, *others: Elements) -> Elements:
    """Return the elements of ``first``, then those of the others."""
    parts = (first, *others)
    return type(first)(
        **{
            each.name: np.concatenate([getattr(part, each.name) for part in parts])
            for each in fields(first)
        }
    )


def _set(value: object, name: str, array: object) -> None:
    object.__setattr__(value, name, array)  # the dataclass is frozen


def _rows_finite(points: arrays.FloatArray) -> arrays.BoolArray:
    return np.asarray(np.isfinite(points).all(axis=1))


def _check_lengths(elements: Elements2D | Elements3D, name: str) -> None:
    lengths = {each.name: len(getattr(elements, each.name)) for each in fields(elements)}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{each} {length}" for each, length in lengths.items())
        raise SemvizError(f"{name} have arrays of different lengths: {listed}; give one row each")


def _check_ends(end: arrays.FloatArray, end_known: arrays.BoolArray, name: str) -> None:
    missing = np.isnan(end)
    partly = np.asarray(missing.any(axis=1) & ~missing.all(axis=1))
    if partly.any():
        raise SemvizError(
            f"{name}{arrays.first_place(partly)} is NaN in part; only points have NaN, throughout"
        )
    endless = end_known & missing[:, 0]
    if endless.any():
        raise SemvizError(
            f"end_known{arrays.first_place(endless)} is set for elements without an end; "
            f"set it False or give {name}"
        )


def _check(values: arrays.FloatArray, low: float, high: float, name: str) -> None:
    outside = np.asarray((values < low) | (values > high))
    if outside.any():
        value = values[outside].flat[0]
        where = arrays.first_place(outside) if values.ndim else ""
        raise SemvizError(f"{name}{where} is {value:g}; give a number from {low:g} to {high:g}")


def _check_ids(ids: arrays.IntArray) -> None:
    ordered = np.sort(ids)
    repeated = ordered[1:] == ordered[:-1]
    if repeated.any():
        raise SemvizError(f"two map elements share an id: {ordered[1:][repeated][0]}; number anew")


def _index(rows: Rows, count: int) -> arrays.IntArray:
    if isinstance(rows, slice):
        return np.arange(*rows.indices(count))
    index = np.asarray(rows)
    if index.dtype == np.bool_:
        return np.flatnonzero(arrays.bool_array(index, (count,), "rows"))
    index = arrays.int_array(index, (None,), "rows")
    if index.size and not (-count <= index.min() and index.max() < count):
        raise SemvizError(
            f"rows {index.min()} to {index.max()} of {count} elements; give rows below {count}"
        )
    return index


def _select(elements: Elements, index: arrays.IntArray) -> Elements:
    """Return rows of validated elements, without validating them again."""
    selected = object.__new__(type(elements))
    for each in fields(elements):
        rows = getattr(elements, each.name).take(index, axis=0)
        rows.flags.writeable = False
        _set(selected, each.name, rows)
    return selected
