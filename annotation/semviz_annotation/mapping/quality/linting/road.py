"""Where the car drove, and how high the ground is there."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from semviz_core.arrays import FloatArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

CAMERA_HEIGHT_M = 1.65
"""KITTI's; taken where the map has too few poles to tell."""
CAMERA_HEIGHTS_M = (1.0, 3.0)
"""From a low car's to a lorry's; what poles say beyond this is wrong about the poles."""
_FEW = 5
"""Poles, fewer of which do not tell the height: one with a hidden bottom would count for much."""
_NEAR_M = 15.0
"""Poles further from the road may stand on other ground."""
_GAP_M = 10.0
"""Cameras further apart than this are not joined: the drive jumps there."""
_STEP_M = 0.25


class Beside(NamedTuple):
    """n points relative to the road."""

    distance_m: FloatArray
    """(n,) horizontal, from where a camera passed."""
    camera_m: FloatArray
    """(n,) height of the camera where it passed nearest."""


@dataclass(frozen=True, eq=False)
class Road:
    """The way of the cameras, (k, 3) points in the order of the drive, k >= 1."""

    cameras_m: FloatArray

    def beside(self, points_m: FloatArray) -> Beside:
        """Where points (n, 3) are. The nearest in space counts: a road may lead over another."""
        lifted = points_m + np.array([0.0, 0.0, CAMERA_HEIGHT_M])
        nearest = self._path[self._index.query(lifted)[1]]
        distance = np.linalg.norm(points_m[:, :2] - nearest[:, :2], axis=1)
        return Beside(distance, nearest[:, 2])

    def camera_height_m(self, bottoms_m: FloatArray) -> float:
        """Of the camera above the ground, by the bottoms (n, 3) of poles, most of them right."""
        beside = self.beside(bottoms_m)
        near = beside.distance_m < _NEAR_M
        if near.sum() < _FEW:
            return CAMERA_HEIGHT_M
        heights = beside.camera_m[near] - bottoms_m[near, 2]
        return float(np.clip(np.median(heights), *CAMERA_HEIGHTS_M))

    @cached_property
    def _path(self) -> FloatArray:
        """(p, 3) points of the way, a step or less from one to the next where the drive goes on."""
        steps = np.diff(self.cameras_m, axis=0, append=self.cameras_m[-1:])
        lengths = np.linalg.norm(steps, axis=1)
        counts = np.where(lengths < _GAP_M, np.ceil(lengths / _STEP_M), 1.0)
        counts = np.maximum(counts, 1.0).astype(np.int64)
        row = np.repeat(np.arange(len(counts)), counts)
        share = (np.arange(len(row)) - (np.cumsum(counts) - counts)[row]) / counts[row]
        return np.asarray(self.cameras_m[row] + share[:, None] * steps[row])

    @cached_property
    def _index(self) -> "cKDTree":
        from scipy.spatial import cKDTree

        return cKDTree(self._path)
