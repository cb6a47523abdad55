"""The sparse semantic map: elements in one frame, their provenance, and a spatial index.

Coordinates are metres in a right-handed frame, z up. Poles are compared by their footprint, the
horizontal position midway between anchor and end, at height 0, because either end may be
unseen. A sign's footprint is its centre, height included.
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.base.classes import DEFAULT_CLASSES, OLDER_CENTER, ClassSet, TriangleCenter
from semviz_core.base.elements import Elements3D
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, float_array
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


_SLACK = 1e-9
"""What a tree of points may round; relative, and in metres."""


@dataclass(frozen=True)
class MapFrame:
    """The coordinate frame of a map, a sequence and its poses: metres, z up, right-handed."""

    name: str
    """For example ``kitti-02`` or ``street-7``; data of different frames cannot be combined."""
    origin: tuple[float, float, float] | None = None
    """WGS84 latitude (deg), longitude (deg), height (m) of the local origin; None if unknown."""
    x_heading_deg: float = 90.0
    """Compass direction of the x axis at the origin; default: 90, so x east and y north."""


@dataclass(frozen=True)
class Provenance:
    """What one map element was made from."""

    label_ids: tuple[str, ...] = ()
    """UUIDs of the label elements that were merged into it."""
    observation_ids: tuple[str, ...] = ()
    """UUIDs of the observations it was triangulated from."""
    log_odds: float | None = None
    """Log-odds that it exists, of an element made from detections alone; None: people vouch for it,
    or the map is older."""

    @property
    def existence(self) -> str:
        """The probability that it exists, rounded down: ``98.2 %``, at most ``> 99.9 %``; empty
        without log-odds."""
        if self.log_odds is None:
            return ""
        tenths = int(1000.0 / (1.0 + math.exp(-min(max(self.log_odds, -700.0), 700.0))))
        return "> 99.9 %" if tenths >= 999 else f"{tenths / 10.0:.1f} %"


DecisionKind: TypeAlias = Literal["merge", "apart", "split", "leave out"]


@dataclass(frozen=True)
class Decision:
    """A decision of map building about label elements, with its evidence."""

    kind: DecisionKind
    """``merge``: they are one landmark; ``apart``: close and similar, but two landmarks; ``split``:
    one label element is two landmarks; ``leave out``: it, or some of its observations, is not
    used."""
    label_ids: tuple[str, ...]
    """UUIDs of the label elements concerned, in the order of their numbers."""
    numbers: tuple[int, ...]
    """Their numbers, as shown to people."""
    by: Literal["machine", "human"]
    reason: str
    """One sentence."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """Figures by name and unit, for example ``distance_m``."""
    observation_ids: tuple[str, ...] = ()
    """The observations that are split off or left out; empty if all are concerned."""


@dataclass(frozen=True, eq=False)
class SemanticMap:
    """Elements with their classes, provenance and coordinate frame."""

    elements: Elements3D
    frame: MapFrame
    classes: ClassSet = DEFAULT_CLASSES
    trajectory_m: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(k, 3) camera centres of the mapping drive: they give the course and height of the road."""
    provenance: tuple[Provenance, ...] = ()
    """One for each element, or empty for maps not made from labels."""
    decisions: tuple[Decision, ...] = ()
    """Decisions made by map building."""
    made_by: str = ""
    """Method, version and settings, for people."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """The settings as JSON values, to build the map again; empty if semviz did not build it."""
    operation: int = 0
    """Number of the last label operation in the map; 0 without labels."""
    triangle_center: TriangleCenter = OLDER_CENTER
    """What the anchor of a triangular sign is."""
    attributes: Mapping[int, Mapping[str, str]] = field(default_factory=dict)
    """What is known of elements besides their class: values by name, by element id."""

    def __post_init__(self) -> None:
        trajectory = float_array(self.trajectory_m, (None, 3), "trajectory_m")
        object.__setattr__(self, "trajectory_m", trajectory)
        present = np.unique(self.elements.class_id).tolist()
        unknown = [class_id for class_id in present if class_id not in self.classes]
        if unknown:
            raise SemvizError(f"the map has elements of unknown classes {unknown}; add the classes")
        self._check_shapes()
        if self.provenance and len(self.provenance) != len(self.elements):
            raise SemvizError("provenance must have one entry for each map element, or none")

    def _check_shapes(self) -> None:
        """Raise SemvizError if a pole has no end or a sign has one."""
        elements = self.elements
        lines = [class_.id for class_ in self.classes if class_.kind == "line"]
        wrong = np.flatnonzero(np.isin(elements.class_id, lines) != elements.is_line)
        if len(wrong):
            name = self.classes.element_name(elements.class_id[wrong[0]], elements.id[wrong[0]])
            has = "has an end, but is a point" if elements.is_line[wrong[0]] else "has no end"
            raise SemvizError(f"{name} {has}; give a pole two ends, a sign its centre alone")

    def __contains__(self, element_id: int) -> bool:
        """Whether the map has an element with this id."""
        return element_id in self._row_of

    def __len__(self) -> int:
        return len(self.elements)

    def _repr_html_(self) -> str:
        """Show the map from above in a notebook."""
        from semviz_core.base.notebook import map_html

        return map_html(self)

    def crop(self, center_m: ArrayLike, radius_m: float) -> Elements3D:
        """Return elements with an anchor within ``radius_m`` of ``center_m`` on the ground plane.

        ``center_m`` is (2,) or (3,) in the map frame. The map's order is kept.
        """
        return self.elements[_rows_near(self._anchors, center_m, radius_m)]

    def road_near(self, center_m: ArrayLike, radius_m: float) -> FloatArray:
        """Return (k, 3) points of ``trajectory_m`` within ``radius_m``, for ``Prior.road_m``.

        Distances are on the ground plane, as in ``crop``. At most one point per cubic metre is
        kept, so standing still or driving a road again adds none, while a bridge and the road
        below it both stay.
        """
        return self._road_m[_rows_near(self._road, center_m, radius_m)]

    def name_of(self, element_id: int) -> str:
        """Return an element's name, ``P-04``. Raise SemvizError if the id is not in the map."""
        row = self._row_of.get(element_id)
        if row is None:
            raise SemvizError(f"the map has no element {element_id}")
        return self.classes.element_name(int(self.elements.class_id[row]), element_id)

    @cached_property
    def _row_of(self) -> dict[int, int]:
        return {int(element_id): row for row, element_id in enumerate(self.elements.id)}

    @cached_property
    def _anchors(self) -> "cKDTree":
        return _ground_index(self.elements.anchor_m)

    @cached_property
    def _road_m(self) -> FloatArray:
        return self.trajectory_m[first_in_cubes(self.trajectory_m)]

    @cached_property
    def _road(self) -> "cKDTree":
        return _ground_index(self._road_m)

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of what localization uses, to check whether a run used this map."""
        hasher = hashlib.sha256(self.frame.name.encode())
        for column in fields(Elements3D):
            hasher.update(np.ascontiguousarray(getattr(self.elements, column.name)).tobytes())
        if self.triangle_center != OLDER_CENTER:  # maps of earlier versions keep their digest
            hasher.update(self.triangle_center.encode())
        return hasher.hexdigest()


def _ground_index(points_m: FloatArray) -> "cKDTree":
    from scipy.spatial import cKDTree

    return cKDTree(points_m[:, :2], balanced_tree=False, compact_nodes=False)


def checked_circle(center_m: ArrayLike, radius_m: float) -> tuple[FloatArray, float]:
    """Return a centre (2,) and a radius. Raise SemvizError if they are none."""
    radius = float(float_array(radius_m, (), "radius_m"))
    if radius < 0.0:
        raise SemvizError(f"radius_m is {radius:g}; give metres, 0 or more")
    center = float_array(center_m, (None,), "center_m")
    if len(center) not in (2, 3):
        raise SemvizError(f"center_m has shape {center.shape}, expected (2,) or (3,)")
    return center[:2], radius


def _rows_near(index: "cKDTree", center_m: ArrayLike, radius_m: float) -> IntArray:
    """Return rows of ``index`` within ``radius_m`` of ``center_m``, ascending."""
    center, radius = checked_circle(center_m, radius_m)
    around = index.query_ball_point(center, radius * (1.0 + _SLACK) + _SLACK, return_sorted=True)
    rows = np.asarray(around, dtype=np.int64)
    return rows[is_near(np.asarray(index.data)[rows], center, radius)]


def first_in_cubes(points_m: FloatArray) -> IntArray:
    """Return the rows of the points (n, 3) that are the first in their cubic metre, ascending."""
    _, first = np.unique(np.floor(points_m), axis=0, return_index=True)
    return np.sort(first)


def is_near(points_m: FloatArray, center_m: FloatArray, radius_m: float) -> BoolArray:
    """Return (n,) whether points (n, 2 or more) are within a radius on the ground plane."""
    apart = points_m[:, :2] - center_m[:2]
    near: BoolArray = apart[:, 0] ** 2 + apart[:, 1] ** 2 <= radius_m**2
    return near


def footprint_m(elements: Elements3D) -> FloatArray:
    """Return (n, 3) footprints: a sign's centre, or a pole's midpoint at height 0."""
    middle = (elements.anchor_m + elements.end_m) / 2.0 * [1.0, 1.0, 0.0]
    return np.where(elements.is_line[:, None], middle, elements.anchor_m)


def footprint_covariance_m2(elements: Elements3D) -> FloatArray:
    """Return the covariances (n, 3, 3) of ``footprint_m``."""
    middle = elements.covariance_m2.reshape(-1, 2, 3, 2, 3).sum(axis=(1, 3)) / 4.0
    middle[:, 2] = middle[:, :, 2] = 0.0
    is_line = elements.is_line[:, None, None]
    return np.where(is_line, middle, elements.covariance_m2[:, :3, :3])
