"""The sparse semantic map: elements in one frame, with a spatial index."""

import hashlib
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from semviz_core.arrays import FloatArray, float_array
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


@dataclass(frozen=True)
class MapFrame:
    """Which coordinates a map, a sequence and its poses share: metres, z up, right-handed."""

    name: str
    """Such as ``kitti-02`` or ``street-7``; two values with other names never meet."""
    origin: tuple[float, float, float] | None = None
    """WGS84 latitude (deg), longitude (deg), height (m) of the local origin, where known."""


@dataclass(frozen=True)
class Provenance:
    """Where one map element comes from."""

    label_ids: tuple[str, ...] = ()
    """UUIDs of the label elements that were merged into it."""
    observation_ids: tuple[str, ...] = ()
    """UUIDs of the observations it was triangulated from."""


@dataclass(frozen=True, eq=False)
class SemanticMap:
    """Elements, what they mean and where they come from."""

    elements: Elements3D
    frame: MapFrame
    classes: ClassSet = DEFAULT_CLASSES
    trajectory_m: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(k, 3) camera centres from which the map was made: where the road is, and how high."""
    provenance: tuple[Provenance, ...] = ()
    """One for each element, or empty for maps not made from labels."""
    made_by: str = ""
    """Method, version and settings, for people."""
    operation: int = 0
    """Number of the last label operation that the map knows; 0 without labels."""

    def __post_init__(self) -> None:
        trajectory = float_array(self.trajectory_m, (None, 3), "trajectory_m")
        object.__setattr__(self, "trajectory_m", trajectory)
        present = np.unique(self.elements.class_id).tolist()
        unknown = [one for one in present if one not in self.classes]
        if unknown:
            raise SemvizError(f"the map has elements of unknown classes {unknown}")
        if self.provenance and len(self.provenance) != len(self.elements):
            raise SemvizError("provenance must have one entry for each map element, or none")

    def __len__(self) -> int:
        return len(self.elements)

    @cached_property
    def _index(self) -> "cKDTree":
        from scipy.spatial import cKDTree

        positions = self.elements.anchor_m[:, :2]
        return cKDTree(positions, balanced_tree=False, compact_nodes=False)

    def crop(self, center_m: FloatArray, radius_m: float) -> Elements3D:
        """The elements whose anchor is within ``radius_m`` of ``center_m`` on the ground plane.

        ``center_m`` is (2,) or (3,) in the map frame. In the map's order.
        """
        center = float_array(np.asarray(center_m)[:2], (2,), "center_m")
        rows = self._index.query_ball_point(center, radius_m, return_sorted=True)
        return self.elements[np.asarray(rows, dtype=np.int64)]

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) over the elements and the frame: tells whether a run used this map."""
        hasher = hashlib.sha256(self.frame.name.encode())
        for one in fields(Elements3D):
            hasher.update(np.ascontiguousarray(getattr(self.elements, one.name)).tobytes())
        return hasher.hexdigest()
