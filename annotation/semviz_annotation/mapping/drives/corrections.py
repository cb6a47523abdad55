"""How the errors of a drive's poses move its map: corrections at knots along its way.

A correction is a shift (m) and a turn about the vertical (rad) around the place of the drive. It
varies slowly along the way: an Ornstein-Uhlenbeck process over knots, whose sigma is that of the
poses and whose correlation falls to 1/e over ``CORRELATION_M``. Tilt is taken as known, since every
vehicle measures it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from semviz_core.base.semantic_map import SemanticMap, footprint_m
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from scipy.sparse import csr_array

KNOT_M = 10.0
"""Edge of the cells of a drive's way that share a knot."""
CORRELATION_M = 100.0
_NEAREST = 3
_WEIGHT_M = 6.0
"""An element is moved by the nearest knots, weighted by a Gaussian of this sigma."""
_DRIVES_APART_M = 1e7
_FIXED_SIGMA = 1e-4
"""Of poses that are to stay, as a share of that of others."""
_SQUARE_M = 20.0
"""Edge of the squares of the ground where all drives are corrected alike (``PoseModel``)."""
FREEDOM = 4
"""Numbers of a correction: x, y, z (m), turn (rad)."""


@dataclass(frozen=True)
class PoseErrors:
    """Standard deviations of the poses of a drive."""

    sigma_m: float = 0.5
    """Of each direction."""
    sigma_rad: float = float(np.deg2rad(0.5))
    """Of the heading."""

    def __post_init__(self) -> None:
        if not (0.0 < self.sigma_m < np.inf and 0.0 < self.sigma_rad < np.inf):
            raise SemvizError(
                "the errors of poses must be above 0 and finite; leave them out to use 0.5 m"
            )


@dataclass(frozen=True, eq=False)
class PoseModel:
    """What corrections do to n elements, and how likely they are, at k knots."""

    design: "csr_array"
    """(6n, 4k) how they move both ends of each element"""
    prior: "csr_array"
    """(4k, 4k) their information before any element is compared"""
    together: "csr_array"
    """(4k, 4c) corrections of all drives alike, at c places: a start for the solver"""


@dataclass(frozen=True, eq=False)
class Knots:
    """k places along the ways of several drives."""

    position_m: FloatArray
    """(k, 3)"""
    drive: IntArray
    """(k,) ascending"""
    parent: IntArray
    """(k,) the knot before it on the way; -1 for the first of a drive."""

    @classmethod
    def along(cls, maps: Sequence[SemanticMap]) -> "Knots":
        """Return the knots of the drives of ``maps``.

        A map without a way, such as an imported one, has one knot amid its elements.
        """
        ways = [
            one.trajectory_m
            if len(one.trajectory_m)
            else footprint_m(one.elements).mean(axis=0)[None]
            for one in maps
        ]
        parts = [_knots_of(way) for way in ways]
        counts = np.array([len(position) for position, _ in parts])
        first = np.repeat(np.cumsum(counts) - counts, counts)
        parent = np.concatenate([parent for _, parent in parts])
        return cls(
            np.concatenate([position for position, _ in parts]),
            np.repeat(np.arange(len(maps)), counts),
            np.where(parent < 0, -1, parent + first),
        )

    def __len__(self) -> int:
        return len(self.drive)

    def model(
        self, ends_m: FloatArray, drive: IntArray, errors: PoseErrors, fixed: Sequence[int] = ()
    ) -> PoseModel:
        """Return the model of elements ``ends_m`` (n, 6) of the drives (n,), whose poses have such
        errors; the drives ``fixed`` stay where they are."""
        stays = np.isin(self.drive, np.asarray(fixed, np.int64))
        return PoseModel(
            self.design(ends_m, drive), self._information(errors, stays), self._together(stays)
        )

    def _together(self, stays: BoolArray) -> "csr_array":
        """Return the corrections (4k, 4c) of all drives alike that pass a place, those that stay
        apart."""
        from scipy.sparse import csr_array, eye_array, kron

        square = np.floor(self.position_m[:, :2] / _SQUARE_M)
        _, place = np.unique(np.column_stack([square, stays]), axis=0, return_inverse=True)
        shape = (len(self), int(place.max()) + 1)
        one = csr_array((np.ones(len(self)), (np.arange(len(self)), place.ravel())), shape)
        return csr_array(kron(one, eye_array(FREEDOM)))

    def _information(self, errors: PoseErrors, stays: BoolArray) -> "csr_array":
        """Return the information (4k, 4k) of the corrections before any element is compared."""
        from scipy.sparse import csr_array, diags_array, eye_array, kron

        inner = np.flatnonzero(self.parent >= 0)
        parent = self.parent[inner]
        step_m = np.linalg.norm(self.position_m[inner] - self.position_m[parent], axis=1)
        kept = np.exp(-step_m / CORRELATION_M)
        variance = np.ones(len(self))
        variance[inner] = 1.0 - kept**2
        variance[stays] *= _FIXED_SIGMA**2
        shape = (len(self), len(self))
        change = eye_array(len(self)) - csr_array((kept, (inner, parent)), shape)
        along = change.T @ diags_array(1.0 / variance) @ change
        sigma = np.array([errors.sigma_m] * 3 + [errors.sigma_rad])
        return csr_array(kron(along, diags_array(1.0 / sigma**2)))

    def design(self, ends_m: FloatArray, drive: IntArray) -> "csr_array":
        """Return the derivative (6n, 4k) by the corrections of ``ends_m`` (n, 6) that the drives
        (n,) measured; NaN for the ends of signs.
        """
        from scipy.sparse import csr_array

        knot, weight = self._near(ends_m[:, :3], drive)
        around = np.einsum("nw,nwi->ni", weight, self.position_m[knot])
        arm = np.nan_to_num(ends_m.reshape(-1, 2, 3) - around[:, None])
        jacobian = np.zeros((len(ends_m), 2, 3, FREEDOM))
        jacobian[..., :3] = np.eye(3)
        jacobian[..., 0, 3], jacobian[..., 1, 3] = -arm[..., 1], arm[..., 0]
        values = weight[:, :, None, None] * jacobian.reshape(-1, 1, 6, FREEDOM)
        row = 6 * np.arange(len(ends_m))[:, None, None, None] + np.arange(6)[:, None]
        column = FREEDOM * knot[:, :, None, None] + np.arange(FREEDOM)
        row, column = np.broadcast_to(row, values.shape), np.broadcast_to(column, values.shape)
        shape = (6 * len(ends_m), FREEDOM * len(self))
        design = csr_array((values.ravel(), (row.ravel(), column.ravel())), shape)
        design.eliminate_zeros()
        return design

    def nearest(self, points_m: FloatArray, drive: IntArray) -> IntArray:
        """Return the knot (n,) of its drive (n,) that is nearest to each point (n, 3)."""
        return self._near(points_m, drive)[0][:, 0]

    def where(self, rows: IntArray) -> "Knots":
        """Return some of the knots, ascending. Where a way is cut, it begins again."""
        number = np.full(len(self) + 1, -1)  # the last one is that of no parent
        number[rows] = np.arange(len(rows))
        return Knots(self.position_m[rows], self.drive[rows], number[self.parent[rows]])

    def _near(self, points_m: FloatArray, drive: IntArray) -> tuple[IntArray, FloatArray]:
        """Return the knots (n, w) that move points (n, 3), all of the point's drive, and their
        weights; the nearest comes first."""
        from scipy.spatial import cKDTree

        tree = cKDTree(np.column_stack([self.position_m, self.drive * _DRIVES_APART_M]))
        points = np.column_stack([points_m, drive * _DRIVES_APART_M])
        distance_m, knot = tree.query(points, _NEAREST)
        is_other = distance_m > _DRIVES_APART_M / 2.0
        distance_m[is_other], knot = np.inf, np.where(is_other, knot[:, :1], knot)
        further_m2 = distance_m**2 - distance_m[:, :1] ** 2
        weight = np.exp(-further_m2 / (2.0 * _WEIGHT_M**2))
        return knot, weight / weight.sum(axis=1, keepdims=True)


def _knots_of(way_m: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the knots (k, 3) of a way (p, 3) in the order of their first visit, and the knot (k,)
    that each was reached from, -1 for the first."""
    cell = np.floor(way_m / KNOT_M).astype(np.int64)
    _, first, of_point = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    knot = rank[of_point.ravel()]
    counts = np.bincount(knot)
    position = np.stack([np.bincount(knot, way_m[:, axis]) / counts for axis in range(3)], axis=1)
    parent = np.concatenate([[-1], knot[first[order][1:] - 1]])
    return position, parent
