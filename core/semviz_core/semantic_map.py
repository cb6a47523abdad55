"""The sparse semantic map: elements in one frame, with a spatial index."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.arrays import FloatArray, IntArray, float_array
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
    x_heading_deg: float = 90.0
    """Compass direction of the x axis at the origin: 90, so x east and y north, unless said."""


@dataclass(frozen=True)
class Provenance:
    """Where one map element comes from."""

    label_ids: tuple[str, ...] = ()
    """UUIDs of the label elements that were merged into it."""
    observation_ids: tuple[str, ...] = ()
    """UUIDs of the observations it was triangulated from."""


DecisionKind: TypeAlias = Literal["merge", "apart", "split", "leave out"]


@dataclass(frozen=True)
class Decision:
    """What was decided about label elements when the map was built, and what speaks for it."""

    kind: DecisionKind
    """``merge``: they are one thing; ``apart``: near each other and alike, yet two; ``split``: one
    label element is two things; ``leave out``: it, or some of its observations, is not used."""
    label_ids: tuple[str, ...]
    """UUIDs of the label elements that it is about, by their numbers."""
    numbers: tuple[int, ...]
    """Their numbers, as people know them."""
    by: Literal["machine", "human"]
    reason: str
    """One sentence."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """Figures by name and unit, such as ``distance_m``."""
    observation_ids: tuple[str, ...] = ()
    """Those that are split off or left out; empty where it is about all of them."""


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
    decisions: tuple[Decision, ...] = ()
    """What was decided on the way from labels to elements."""
    made_by: str = ""
    """Method, version and settings, for people."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """JSON values: the same for programs, to build it again; empty where it was not built here."""
    operation: int = 0
    """Number of the last label operation that the map knows; 0 without labels."""

    def __post_init__(self) -> None:
        trajectory = float_array(self.trajectory_m, (None, 3), "trajectory_m")
        object.__setattr__(self, "trajectory_m", trajectory)
        present = np.unique(self.elements.class_id).tolist()
        unknown = [one for one in present if one not in self.classes]
        if unknown:
            raise SemvizError(f"the map has elements of unknown classes {unknown}")
        self._check_shapes()
        if self.provenance and len(self.provenance) != len(self.elements):
            raise SemvizError("provenance must have one entry for each map element, or none")

    def _check_shapes(self) -> None:
        """SemvizError for poles without an end, and signs with one."""
        elements = self.elements
        lines = [one.id for one in self.classes if one.kind == "line"]
        wrong = np.flatnonzero(np.isin(elements.class_id, lines) != elements.is_line)
        if len(wrong):
            name = self.classes.element_name(elements.class_id[wrong[0]], elements.id[wrong[0]])
            has = "has an end, but is a point" if elements.is_line[wrong[0]] else "has no end"
            raise SemvizError(f"{name} {has}; a pole has two ends, a sign its middle alone")

    def __len__(self) -> int:
        return len(self.elements)

    def crop(self, center_m: ArrayLike, radius_m: float) -> Elements3D:
        """The elements whose anchor is within ``radius_m`` of ``center_m`` on the ground plane.

        ``center_m`` is (2,) or (3,) in the map frame. In the map's order.
        """
        return self.elements[_rows_near(self._anchors, center_m, radius_m)]

    def road_near(self, center_m: ArrayLike, radius_m: float) -> FloatArray:
        """(k, 3) points of ``trajectory_m`` within ``radius_m`` of ``center_m``: ``Prior.road_m``.

        On the ground plane, as in ``crop``. At most one in each cubic metre, so that a drive which
        stood still or came back adds none, while a bridge and the road below it both stay.
        """
        return self._road_m[_rows_near(self._road, center_m, radius_m)]

    def name_of(self, element_id: int) -> str:
        """Of an element, such as ``P-04``. Raises SemvizError where there is none of this id."""
        row = self._row_of.get(element_id)
        if row is None:
            raise SemvizError(f"the map has no element {element_id}")
        return self.classes.element_name(int(self.elements.class_id[row]), element_id)

    @cached_property
    def _row_of(self) -> dict[int, int]:
        return {int(one): row for row, one in enumerate(self.elements.id)}

    @cached_property
    def _anchors(self) -> "cKDTree":
        return _ground_index(self.elements.anchor_m)

    @cached_property
    def _road_m(self) -> FloatArray:
        cubes = np.floor(self.trajectory_m)
        _, first = np.unique(cubes, axis=0, return_index=True)
        return self.trajectory_m[np.sort(first)]

    @cached_property
    def _road(self) -> "cKDTree":
        return _ground_index(self._road_m)

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) over the elements and the frame: tells whether a run used this map."""
        hasher = hashlib.sha256(self.frame.name.encode())
        for one in fields(Elements3D):
            hasher.update(np.ascontiguousarray(getattr(self.elements, one.name)).tobytes())
        return hasher.hexdigest()


def _ground_index(points_m: FloatArray) -> "cKDTree":
    from scipy.spatial import cKDTree

    return cKDTree(points_m[:, :2], balanced_tree=False, compact_nodes=False)


def _rows_near(index: "cKDTree", center_m: ArrayLike, radius_m: float) -> IntArray:
    """Rows of ``index`` within ``radius_m`` of ``center_m``, ascending."""
    radius = float(float_array(radius_m, (), "radius_m"))
    if radius < 0.0:
        raise SemvizError(f"radius_m is {radius:g}; give metres, 0 or more")
    center = float_array(center_m, (None,), "center_m")
    if len(center) not in (2, 3):
        raise SemvizError(f"center_m has shape {center.shape}, expected (2,) or (3,)")
    rows = index.query_ball_point(center[:2], radius, return_sorted=True)
    return np.asarray(rows, dtype=np.int64)
