"""Poles and signs, seen (2D) and mapped (3D), as structs of arrays.

A line element (pole) runs from its anchor, the peak, to its end, the bottom. A point element
(sign) has its anchor at its middle and an end of NaN. Either end of a pole can be unknown, cut
off by the image or hidden by a car: its coordinates are then those of the last visible point, and
only the line through both counts.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.arrays import BoolArray, FloatArray, IntArray, bool_array, float_array, int_array
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose


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
        _set(self, "class_id", int_array(self.class_id, (None,), "class_id"))
        m = len(self.class_id)
        _set(self, "anchor_px", float_array(self.anchor_px, (m, 2), "anchor_px"))
        _set(self, "end_px", float_array(self.end_px, (m, 2), "end_px", nan=True))
        _set(self, "score", float_array(self.score, (m,), "score"))
        _set(self, "sigma_px", float_array(self.sigma_px, (m, 2), "sigma_px"))
        _set(self, "anchor_known", bool_array(self.anchor_known, (m,), "anchor_known"))
        _set(self, "end_known", bool_array(self.end_known, (m,), "end_known"))
        if (self.sigma_px <= 0).any():
            raise SemvizError("sigma_px must be positive")
        if (self.end_known & ~self.is_line).any():
            raise SemvizError("end_known is set for elements without an end")

    @classmethod
    def from_ends(
        cls, anchor_px: ArrayLike, end_px: ArrayLike, class_id: ArrayLike, sigma_px: float = 1.0
    ) -> "Elements2D":
        """Elements with every end known, score 1 and one sigma."""
        classes = int_array(class_id, (None,), "class_id")
        m = len(classes)
        end = _points(end_px, (m, 2), "end_px")
        return cls(
            anchor_px=_points(anchor_px, (m, 2), "anchor_px"),
            end_px=end,
            class_id=classes,
            score=np.ones(m),
            sigma_px=np.full((m, 2), sigma_px),
            anchor_known=np.ones(m, dtype=bool),
            end_known=_rows_finite(end),
        )

    @property
    def is_line(self) -> BoolArray:
        """(m,) True for poles."""
        return _rows_finite(self.end_px)

    def __len__(self) -> int:
        return len(self.class_id)

    def __getitem__(self, rows: ArrayLike) -> "Elements2D":
        """The elements at ``rows``: indices (k,) or a mask (m,)."""
        return Elements2D(**_rows(self, rows))


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
        _set(self, "class_id", int_array(self.class_id, (None,), "class_id"))
        n = len(self.class_id)
        _set(self, "id", int_array(self.id, (n,), "id"))
        _set(self, "anchor_m", float_array(self.anchor_m, (n, 3), "anchor_m"))
        _set(self, "end_m", float_array(self.end_m, (n, 3), "end_m", nan=True))
        covariance = float_array(self.covariance_m2, (n, 6, 6), "covariance_m2")
        _set(self, "covariance_m2", covariance)
        _set(self, "anchor_known", bool_array(self.anchor_known, (n,), "anchor_known"))
        _set(self, "end_known", bool_array(self.end_known, (n,), "end_known"))
        if (np.diagonal(covariance, axis1=1, axis2=2) < 0).any():
            raise SemvizError("covariance_m2 holds negative variances; remove or repair those rows")
        if len(np.unique(self.id)) != n:
            raise SemvizError("two map elements share an id")
        if (self.end_known & ~self.is_line).any():
            raise SemvizError("end_known is set for elements without an end")

    @classmethod
    def from_ends(
        cls,
        id: ArrayLike,
        anchor_m: ArrayLike,
        end_m: ArrayLike,
        class_id: ArrayLike,
        sigma_m: float = 0.05,
    ) -> "Elements3D":
        """Elements with every end known and one isotropic sigma."""
        classes = int_array(class_id, (None,), "class_id")
        n = len(classes)
        end = _points(end_m, (n, 3), "end_m")
        is_line = _rows_finite(end)
        covariance = np.zeros((n, 6, 6))
        covariance[:, range(3), range(3)] = sigma_m**2
        covariance[:, range(3, 6), range(3, 6)] = np.where(is_line, sigma_m**2, 0.0)[:, None]
        return cls(
            id=int_array(id, (n,), "id"),
            anchor_m=_points(anchor_m, (n, 3), "anchor_m"),
            end_m=end,
            class_id=classes,
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

    def __getitem__(self, rows: ArrayLike) -> "Elements3D":
        """The elements at ``rows``: indices (k,) or a mask (n,)."""
        return Elements3D(**_rows(self, rows))

    def transformed(self, T_target_map: Pose) -> "Elements3D":
        """The same elements in another frame."""
        J = np.kron(np.eye(2), T_target_map.rotation)
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        values["anchor_m"] = T_target_map.apply(self.anchor_m)
        values["end_m"] = T_target_map.apply(self.end_m)
        values["covariance_m2"] = J @ self.covariance_m2 @ J.T
        return Elements3D(**values)


def _set(value: object, name: str, array: object) -> None:
    object.__setattr__(value, name, array)  # the dataclass is frozen


def _points(value: ArrayLike, shape: tuple[int, int], name: str) -> FloatArray:
    """(shape) of points whose ends may be missing; ``[]`` will do for none."""
    none = shape[0] == 0 and not np.size(value)
    return float_array(np.zeros(shape) if none else value, shape, name, nan=True)


def _rows_finite(points: FloatArray) -> BoolArray:
    return np.asarray(np.isfinite(points).all(axis=1))


def _rows(value: Elements2D | Elements3D, rows: ArrayLike) -> dict[str, Any]:
    index = np.asarray(rows)
    if index.size == 0:
        index = index.astype(np.int64)
    return {one.name: getattr(value, one.name)[index] for one in fields(value)}
