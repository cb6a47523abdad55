"""Drives with the poles and signs beside them, as in benchmark problems, and errors of their maps.

``simulated_road`` needs no files; ``kitti_road`` reads a real drive and its surveyed poles. The
map frame is metres, z up; camera 0 is rotated to z up. The errors of a map are noise, missing,
obsolete and duplicated elements, or one planted fault.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, float_array, unit_vectors
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import MOST_TEXT_BYTES, check_file, first_line
from semviz_core.datasets.trajectory import T_MAP_WORLD, parsed_numbers, read_numbers, read_text
from semviz_core.localizability.route import poses_along

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


MISSING_SHARE = 0.05
DUPLICATED_SHARE = 0.03
OBSOLETE_SHARE = 0.05
OBSOLETE_M = 8.0
DUPLICATE_NOISE = 3.0
DEPTH_SIGMA_M = 0.10
"""Along the line of sight from which an element was mapped."""
SIDE_SIGMA_M = 0.02
"""Across it and vertically."""
DIRECTION_SIGMA_RAD = float(np.deg2rad(0.27))
MAPPED_FROM_M = 15.0


def with_errors(truth: SemanticMap, seed: int) -> SemanticMap:
    """Return a map with noise and with missing, obsolete and duplicated elements.

    Ids stay those of the truth; a duplicate gets a new one above all others. Covariances match the
    noise, but do not include obsolete and duplicated elements.
    """
    rng = np.random.default_rng(seed)
    true = truth.elements
    covariance = _covariance(true, _mapping_view(true, truth.trajectory_m))
    noisy = _noisy(true, covariance, 1.0, rng)
    copies = _noisy(true, covariance, DUPLICATE_NOISE, rng)
    noisy = _displaced(noisy, rng.random(len(true)) < OBSOLETE_SHARE, rng)
    kept = rng.random(len(true)) >= MISSING_SHARE
    copied = np.flatnonzero(kept & (rng.random(len(true)) < DUPLICATED_SHARE))
    new_ids = true.id.max(initial=0) + 1 + np.arange(len(copied))
    elements = joined(noisy[kept], _with(copies[copied], id=new_ids))
    return replace(truth, elements=elements, provenance=(), made_by=f"{truth.made_by}, seed {seed}")


def move_element(semantic_map: SemanticMap, element_id: int, by_m: ArrayLike) -> SemanticMap:
    """Return the map with one element shifted by a vector (3,)."""
    rows = _rows_of(semantic_map, element_id)
    old, by = semantic_map.elements, np.asarray(by_m, dtype=np.float64)
    anchor = old.anchor_m + rows[:, None] * by
    end = old.end_m + rows[:, None] * by
    return replace(semantic_map, elements=_with(old, anchor_m=anchor, end_m=end))


def duplicate_element(semantic_map: SemanticMap, element_id: int, by_m: ArrayLike) -> SemanticMap:
    """Return the map with a copy of one element, shifted by (3,), under the next free id."""
    rows = _rows_of(semantic_map, element_id)
    old = semantic_map.elements
    copy = _with(old[rows], id=np.array([old.id.max() + 1]))
    by = np.asarray(by_m, dtype=np.float64)
    copy = _with(copy, anchor_m=copy.anchor_m + by, end_m=copy.end_m + by)
    provenance = semantic_map.provenance
    if provenance:
        provenance = (*provenance, provenance[int(np.flatnonzero(rows)[0])])
    return replace(semantic_map, elements=joined(old, copy), provenance=provenance)


def remove_element(semantic_map: SemanticMap, element_id: int) -> SemanticMap:
    """Return the map without one element."""
    kept = ~_rows_of(semantic_map, element_id)
    provenance = tuple(
        entry for entry, keep in zip(semantic_map.provenance, kept, strict=False) if keep
    )
    return replace(semantic_map, elements=semantic_map.elements[kept], provenance=provenance)


def _rows_of(semantic_map: SemanticMap, element_id: int) -> BoolArray:
    """Return (n,) True for the element of this id."""
    rows = np.asarray(semantic_map.elements.id == element_id)
    if not rows.any():
        raise SemvizError(f"map of {semantic_map.frame.name} has no element {element_id}")
    return rows


def _mapping_view(true: Elements3D, trajectory_m: FloatArray) -> FloatArray:
    """Return (n, 3) horizontal unit vectors from the mapping camera, about 15 m away."""
    if not len(trajectory_m):
        raise SemvizError("the map has no trajectory_m; errors along the line of sight need one")
    offset = true.anchor_m[:, None, :2] - trajectory_m[None, :, :2]
    distance = np.linalg.norm(offset, axis=2)
    passed = np.arange(len(trajectory_m)) > distance.argmin(axis=1)[:, None]
    choice = np.where(passed, np.inf, np.abs(distance - MAPPED_FROM_M)).argmin(axis=1)
    view = np.zeros((len(true), 3))
    view[:, :2] = offset[np.arange(len(true)), choice]
    return unit_vectors(view)


def _covariance(true: Elements3D, view: FloatArray) -> FloatArray:
    """Return (n, 6, 6) of (anchor, end): both share an error; a pole's direction adds its own."""
    shared = SIDE_SIGMA_M**2 * np.eye(3)
    shared = shared + (DEPTH_SIGMA_M**2 - SIDE_SIGMA_M**2) * view[:, :, None] * view[:, None, :]
    line = true.is_line
    axis = np.where(line[:, None], true.end_m - true.anchor_m, 0.0)
    length2 = (axis**2).sum(axis=1)[:, None, None]
    turned = DIRECTION_SIGMA_RAD**2 * (length2 * np.eye(3) - axis[:, :, None] * axis[:, None, :])
    covariance = np.zeros((len(true), 6, 6))
    covariance[:, :3, :3] = shared
    covariance[line, :3, 3:] = covariance[line, 3:, :3] = shared[line]
    covariance[line, 3:, 3:] = shared[line] + turned[line]
    return covariance


def _noisy(
    true: Elements3D, covariance: FloatArray, scale: float, rng: np.random.Generator
) -> Elements3D:
    """Return the elements with errors drawn from the covariance, scaled by ``scale``."""
    values, vectors = np.linalg.eigh(covariance)
    draws = rng.standard_normal((len(true), 6)) * np.sqrt(np.maximum(values, 0.0))
    error = scale * np.einsum("nij,nj->ni", vectors, draws)
    return _with(
        true,
        anchor_m=true.anchor_m + error[:, :3],
        end_m=true.end_m + error[:, 3:],
        covariance_m2=covariance,
    )


def _displaced(elements: Elements3D, rows: BoolArray, rng: np.random.Generator) -> Elements3D:
    """Return the elements with some of them moved horizontally by 8 m, in any direction."""
    angle = rng.uniform(-np.pi, np.pi, len(elements))
    by = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(elements))], axis=1)
    by *= OBSOLETE_M * rows[:, None]
    return _with(elements, anchor_m=elements.anchor_m + by, end_m=elements.end_m + by)


def _with(elements: Elements3D, **values: FloatArray | IntArray) -> Elements3D:
    return Elements3D(**{**vars(elements), **values})


CAMERA_HEIGHT_M = 1.65
LEAST_OFFSET_M = 1.5
"""Least distance of a pole from the drive."""
T_CAM0_VELODYNE = Pose(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.0, 0.0, -0.27])
)
"""The design of KITTI's car: the laser 0.27 m behind camera 0 (Geiger 2013, fig. 3). It is used
without a calibration file, and only for horizontal positions."""
_THINNED_M = 1.0


@dataclass(frozen=True, eq=False)
class BenchmarkRoad:
    """A drive and the poles beside it. Map frame: metres, z up."""

    name: str
    T_map_camera: tuple[Pose, ...]
    """The camera along the drive, in order; at least two."""
    poles_m: FloatArray
    """(p, 2) positions of the poles."""

    def __post_init__(self) -> None:
        if len(self.T_map_camera) < 2:
            raise SemvizError(f"road {self.name}: {len(self.T_map_camera)} poses; give two or more")
        object.__setattr__(self, "poles_m", float_array(self.poles_m, (None, 2), "poles_m"))

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.T_map_camera)

    @cached_property
    def center_m(self) -> FloatArray:
        """(k, 3) camera centres along the drive."""
        return np.array([pose.translation for pose in self.T_map_camera])

    @cached_property
    def thinned_m(self) -> FloatArray:
        """(t, 3) camera centres at least a metre apart."""
        kept = [0]
        for row, center in enumerate(self.center_m):
            if np.linalg.norm(center - self.center_m[kept[-1]]) >= _THINNED_M:
                kept.append(row)
        return self.center_m[kept]

    @cached_property
    def ground_m(self) -> FloatArray:
        """(p,) height of the ground at each pole: that of the road at the nearest pose."""
        return np.asarray(self.center_m[self._nearest(self.poles_m), 2] - CAMERA_HEIGHT_M)

    @cached_property
    def mapping_view(self) -> FloatArray:
        """(p, 2) horizontal unit vectors towards each pole from where it was mapped: the pose
        before the nearest one whose distance is closest to MAPPED_FROM_M."""
        views = np.empty_like(self.poles_m)
        for row, (pole, nearest) in enumerate(
            zip(self.poles_m, self._nearest(self.poles_m), strict=True)
        ):
            offset = pole - self.center_m[max(0, nearest - 100) : nearest + 1, :2]
            distance = np.linalg.norm(offset, axis=1)
            views[row] = offset[np.abs(distance - MAPPED_FROM_M).argmin()]
        return unit_vectors(views)

    def near(self, place_m: FloatArray, radius_m: float) -> FloatArray:
        """Return thinned camera centres (k, 3) within ``radius_m`` of ``place_m``, horizontally."""
        offset = self.thinned_m[:, :2] - np.asarray(place_m)[:2]
        return self.thinned_m[np.hypot(offset[:, 0], offset[:, 1]) <= radius_m]

    def height(self, place_m: FloatArray) -> float:
        """Return the height of the camera centre nearest to ``place_m``, horizontally."""
        return float(self.center_m[self._nearest(np.asarray(place_m)[None, :2])[0], 2])

    @cached_property
    def _index(self) -> "cKDTree":
        from scipy.spatial import cKDTree

        return cKDTree(self.center_m[:, :2])

    def _nearest(self, places_m: FloatArray) -> IntArray:
        """Return the row (n,) of the pose nearest to each position (n, 2), horizontally."""
        return np.asarray(self._index.query(places_m)[1], dtype=np.int64)


def kitti_road(
    poses: Path, pole_map: Path, name: str, calibration: Path | None = None
) -> BenchmarkRoad:
    """Return a KITTI drive (camera 0, turned to z up) and its surveyed poles.

    ``poses`` is a text file of 3x4 poses. ``pole_map`` is an npz file whose ``poleparams`` (p, 2 or
    more) are x ahead and y left in the velodyne frame of frame 0. ``calibration`` is a calib.txt
    with Tr (default: ``T_CAM0_VELODYNE``). Objects within 1.5 m of the drive are dropped: they are
    no poles. Raise SemvizError if a file is missing or wrong.
    """
    drive = []
    for number, row in enumerate(read_numbers(poses, 12), 1):
        try:
            drive.append(T_MAP_WORLD @ Pose.from_matrix(row.reshape(3, 4)))
        except SemvizError as error:
            raise SemvizError(f"{poses}, line {number}: {error}") from None
    T_cam0_velodyne = T_CAM0_VELODYNE if calibration is None else _velodyne(calibration)
    poles = _read_poles(pole_map)
    standing = np.column_stack([poles, np.zeros(len(poles))])
    places = (T_MAP_WORLD @ T_cam0_velodyne).apply(standing)[:, :2]
    return _without_poles_on_road(BenchmarkRoad(name, tuple(drive), places))


def _velodyne(calibration: Path) -> Pose:
    """Return T_cam0_velodyne from the line ``Tr:``."""
    for line in read_text(calibration).splitlines():
        if line.startswith("Tr:"):
            where = f"{calibration}, Tr"
            return Pose.from_matrix(parsed_numbers(line[3:], 12, where).reshape(3, 4))
    raise SemvizError(f"{calibration}: no line 'Tr:' (velodyne to camera 0)")


def _read_poles(path: Path) -> FloatArray:
    """Return ``poleparams`` (p, 2) of an npz file."""
    if not path.exists():
        raise SemvizError(f"{path}: no such file; give the sequence's pole map")
    check_file(path, MOST_TEXT_BYTES)
    try:
        with np.load(path, allow_pickle=False) as arrays:
            if sum(entry.file_size for entry in arrays.zip.infolist()) > MOST_TEXT_BYTES:
                raise ValueError("it unpacks to far more than poles")
            poles = np.asarray(arrays["poleparams"])  # bytes if it is no array
    except KeyError:
        raise SemvizError(f"{path}: holds no 'poleparams'; is it a pole map?") from None
    except Exception as error:  # zipfile, numpy and the system each have their own
        raise SemvizError(
            f"{path}: not a readable npz file ({first_line(error)}); copy it again"
        ) from None
    if poles.ndim != 2 or poles.shape[1] < 2:
        raise SemvizError(f"{path}: poleparams has shape {poles.shape}, expected (n, 2)")
    return float_array(poles[:, :2], (None, 2), f"{path}: poleparams")


def _without_poles_on_road(road: BenchmarkRoad) -> BenchmarkRoad:
    """Return the road without the poles that stand on it."""
    distance, _ = road._index.query(road.poles_m)
    return BenchmarkRoad(road.name, road.T_map_camera, road.poles_m[distance >= LEAST_OFFSET_M])


# --- elements ---

_KIND_SHARE = (0.4, 0.4, 0.2)
"""Shares of posts, lamps and others: of 2.2-3.3 m, 4-8 m and 3-5 m, ``_SIGNED`` with a sign."""
_LOWEST_M, _HIGHEST_M = np.array([2.2, 4.0, 3.0]), np.array([3.3, 8.0, 5.0])
_SIGNED = np.array([0.75, 0.15, 0.0])
_SIGN_CLASSES, _SIGN_SHARE = (TRIANGULAR, RECTANGULAR, ROUNDED), (0.25, 0.45, 0.30)
_LEAN_RAD = float(np.deg2rad(0.7))
_HEIGHT_SIGMA_M = 0.1  # of the ground under an element


@lru_cache(maxsize=4)
def true_elements(road: BenchmarkRoad, seed: int) -> Elements3D:
    """Return the true poles and signs; a pole's id is its row, its sign's id that plus p."""
    rng = np.random.default_rng([seed, 2])
    p = len(road.poles_m)
    kind = rng.choice(3, p, p=_KIND_SHARE)
    height = rng.uniform(_LOWEST_M[kind], _HIGHEST_M[kind])
    ground = road.ground_m + rng.normal(0.0, _HEIGHT_SIGMA_M, p)
    bottom = np.column_stack([road.poles_m, ground])
    lean = rng.normal(0.0, _LEAN_RAD, (p, 2)) * height[:, None]
    peak = bottom + np.column_stack([lean, height])
    signed = np.flatnonzero(rng.random(p) < _SIGNED[kind])
    share = rng.uniform(2.0, np.minimum(height, 2.9))[signed, None] / height[signed, None]
    middle = bottom[signed] + share * (peak[signed] - bottom[signed])
    sign_class = rng.choice(_SIGN_CLASSES, len(signed), p=_SIGN_SHARE)
    return Elements3D.from_ends(
        np.concatenate([np.arange(p), p + signed]),
        np.concatenate([peak, middle]),
        np.concatenate([bottom, np.full_like(middle, np.nan)]),
        np.concatenate([np.full(p, POLE), sign_class]),
    )


# --- simulated road ---

_BLOCK_M = (115.0, 145.0)
_JITTER_M = 10.0
"""Random shift of the street corners."""
_BEND_M = 8.0
"""Distance of bends from the straight line between corners."""
_LANE_M = 1.6
"""Distance of the drive from the middle of the street, to the right."""
_HILL_SLOPE = 0.02
_BRIDGE_M = 4.5
_RAMP_M = 120.0
"""Half a cosine of this length climbs to the bridge: 7 % at its steepest, hills included."""
_ROUNDING_M = 5.0
_POLES_PER_M = 0.17
"""KITTI's surveyed maps have 14 to 20 poles on 100 m of street within 20 m of the drive."""
_NODES = np.array(
    [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (3, 0), (3, -1), (1.5, -1), (1.5, 2), (0, 2), (0, 1)]
)
_ROUTE = (0, 1, 2, 3, 4, 1, 2, 5, 6, 7, 8, 9, 10, 4, 3)
"""Passes 1-2 twice in one direction and 3-4 in both; 7-8 crosses both on a bridge."""
_BRIDGE = (7, 8)


def simulated_road(seed: int) -> BenchmarkRoad:
    """Return a drive of about 2 km through a small town, a pose each metre; repeatable by seed.

    Streets bend and climb. Two of them are driven twice, one of these in both directions, and a
    bridge of 4.5 m crosses them. Poles stand irregularly on both sides, as densely as KITTI's.
    """
    rng = np.random.default_rng(seed)
    corners = _NODES * rng.uniform(*_BLOCK_M, 2) + rng.uniform(-_JITTER_M, _JITTER_M, _NODES.shape)
    middle, on_bridge = _route(corners)
    warp = rng.uniform(0.0, 2.0 * np.pi, 2)
    middle = middle + _BEND_M * np.sin(middle[:, ::-1] / 40.0 + warp)
    turn = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    middle = middle @ np.array([[c, s], [-s, c]])
    ahead = unit_vectors(np.gradient(middle, axis=0))
    path = middle + _LANE_M * np.column_stack([ahead[:, 1], -ahead[:, 0]])
    hills = rng.uniform(0.0, 2.0 * np.pi, 2)
    height = 50.0 * _HILL_SLOPE * np.sin(middle / 50.0 + hills).sum(axis=1) / np.sqrt(2.0)
    track = np.column_stack([path, height + on_bridge + CAMERA_HEIGHT_M])
    road = BenchmarkRoad(f"simulated-{seed}", poses_along(track), _poles(track, rng))
    return _without_poles_on_road(road)


def _route(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the middle of the street (k, 2) each metre, and its height (k,) above the ground."""
    from scipy.ndimage import gaussian_filter1d

    points, heights = [], []
    for begin, end in pairwise(_ROUTE):
        length = float(np.linalg.norm(corners[end] - corners[begin]))
        along = np.arange(0.0, length)
        share = along[:, None] / length
        points.append(corners[begin] * (1.0 - share) + corners[end] * share)
        climb = np.clip(np.minimum(along, length - along) / _RAMP_M, 0.0, 1.0)
        bump = _BRIDGE_M * 0.5 * (1.0 - np.cos(np.pi * climb))
        heights.append(bump if (begin, end) == _BRIDGE else np.zeros_like(along))
    path = gaussian_filter1d(np.concatenate(points), _ROUNDING_M, axis=0, mode="nearest")
    return path, np.concatenate(heights)


def _poles(track: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return poles (p, 2) on both sides, where the drive passes for the first time."""
    fresh = np.flatnonzero(_first_time(track))
    cells = rng.gamma(2.0, 0.5, (2, len(track) // 40 + 1))  # some stretches have more than others
    rate = 0.5 * _POLES_PER_M * cells[:, fresh // 40]
    count = rng.poisson(rate)
    side, cell = np.nonzero(count)
    rows = fresh[np.repeat(cell, count[side, cell])]
    sides = np.repeat(2.0 * side - 1.0, count[side, cell])
    offset = LEAST_OFFSET_M + rng.gamma(1.8, 3.5, len(rows))
    ahead = unit_vectors(np.gradient(track[:, :2], axis=0)[rows])
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    along = rng.uniform(-0.5, 0.5, len(rows))
    return np.asarray(track[rows, :2] + along[:, None] * ahead + (sides * offset)[:, None] * left)


def _first_time(track: FloatArray) -> BoolArray:
    """Return (k,) True where no earlier part of the drive is within 6 m at the same height."""
    from scipy.spatial import cKDTree

    near = cKDTree(track).query_ball_point(track, 6.0)
    return np.array([min(rows) > row - 30 for row, rows in enumerate(near)])
