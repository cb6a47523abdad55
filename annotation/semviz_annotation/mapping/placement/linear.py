"""Linear triangulation of many landmarks from rays and planes.

Signs are intersections of rays. Poles are intersections of planes: each observation's line and
camera centre span a plane, and all planes share the pole. So the ends need not be the same points
in all views: they follow from where the rays of the observed ends pass the line.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_core.base.camera import MIN_DEPTH_M
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError

MIN_ANGLE_RAD = float(np.deg2rad(0.2))
"""At smaller angles, 1 px of a 720 px lens is nearly half of the angle, so depth is unknown."""
_PARALLEL_RAD = 1e-5
"""Directions at a smaller angle are always parallel: a hundredth of a pixel."""
_HORIZON_M = 10_000.0
"""An end farther away results from lines of different landmarks."""


@dataclass(frozen=True, eq=False)
class Start:
    """Start positions of n landmarks, undefined if there is a failure."""

    anchor_m: FloatArray
    """(n, 3)"""
    end_m: FloatArray
    """(n, 3); NaN for points"""
    angle_rad: FloatArray
    """(n,) approximate largest angle between two rays or planes: from the one farthest from the
    first to the one farthest from that"""
    failure: NDArray[np.object_]
    """(n,) str: why there is no position; empty if there is one"""
    too_narrow: BoolArray
    """(n,) whether it failed because the rays or planes are nearly parallel"""

    @classmethod
    def empty(cls, count: int) -> "Start":
        """Return ``count`` start positions to be filled in."""
        unknown = np.full((count, 3), np.nan)
        words = np.full(count, "", dtype=object)
        return cls(unknown, unknown.copy(), np.zeros(count), words, np.zeros(count, dtype=bool))

    def fail(self, where: BoolArray, reason: str) -> None:
        """Set the failure where there is none yet."""
        self.failure[where & (self.failure == "")] = reason

    def fail_narrow(self, what: str, min_angle_rad: float) -> None:
        narrow = self.angle_rad < max(min_angle_rad, _PARALLEL_RAD)
        for landmark in np.flatnonzero(narrow & (self.failure == "")):
            self.too_narrow[landmark] = True
            self.failure[landmark] = (
                f"the {what} are nearly parallel ({np.rad2deg(self.angle_rad[landmark]):.2f} deg "
                "apart): too far away, or along the line between the cameras"
            )

    @property
    def ok(self) -> BoolArray:
        """(n,) whether there is a position."""
        return np.asarray(self.failure == "")

    def places_m(self) -> FloatArray:
        """Return (n, 6) anchor and end; zero for the ends of points."""
        return np.concatenate([self.anchor_m, np.nan_to_num(self.end_m)], axis=1)

    def put(self, landmarks: BoolArray, others: "Start") -> None:
        """Set the landmarks (n,) that are True to ``others``."""
        for own, other in zip(vars(self).values(), vars(others).values(), strict=True):
            own[landmarks] = other


def linear_start(views: ViewArray, observations: ObservationArray, min_angle_rad: float) -> Start:
    """Triangulate all landmarks in ``observations``.

    Raise SemvizError if a landmark is observed both as pole and as sign.
    """
    start = Start.empty(observations.count)
    start.fail(observations.seen < 2, "labelled in one image only")
    several = observations.seen > 1
    is_line, is_point = (
        observations.of(observations.is_line),
        observations.of(~observations.is_line),
    )
    if (is_line & is_point).any():
        raise SemvizError("one element is a pole in some views and a sign in others")
    points, lines = is_point & several, is_line & several
    for landmarks, started in ((points, _points), (lines, _lines)):
        if landmarks.any():
            start.put(landmarks, started(views, observations.only(landmarks), min_angle_rad))
    return start


# -- points


def _points(views: ViewArray, observations: ObservationArray, min_angle_rad: float) -> Start:
    start = Start.empty(observations.count)
    rays = views.rays(observations.view, observations.anchor_px)
    start.angle_rad[:] = _widest_angle(observations, rays, unsigned=False)
    start.fail_narrow("rays", min_angle_rad)
    start.anchor_m[:], ahead = _intersected(views, observations)
    start.fail(~ahead, "the rays meet behind the camera: are these two different landmarks?")
    return start


def _intersected(views: ViewArray, observations: ObservationArray) -> tuple[FloatArray, BoolArray]:
    """Return the points (n, 3) nearest to all their rays, in pixels, and whether they are in front
    (n,).

    Iterative-LS (Hartley & Sturm 1997, 5.3): each view gives two planes through its ray, one for
    each image axis; dividing by the depth turns distances to them into pixels.
    """
    P = views.projection[observations.view]
    A = P[:, :2, :3] - observations.anchor_px[:, :, None] * P[:, 2:, :3]
    middle, away = _near_cameras(views, observations)
    b = (A @ away[:, :, None])[:, :, 0]
    weight = np.ones(len(observations))
    ahead = np.ones(observations.count, dtype=bool)
    points = middle
    for _ in range(3):
        AtA = observations.per_landmark(np.add, weight[:, None, None] * (A.transpose(0, 2, 1) @ A))
        Atb = observations.per_landmark(np.add, weight[:, None] * np.einsum("kri,kr->ki", A, b))
        points = middle + _solved(AtA, Atb)
        depth = views.depth_m(observations.view, points[observations.landmark])
        ahead &= ~observations.of(~(depth >= MIN_DEPTH_M))
        weight = 1.0 / np.where(depth >= MIN_DEPTH_M, depth, 1.0) ** 2
    return points, ahead


def _near_cameras(
    views: ViewArray, observations: ObservationArray
) -> tuple[FloatArray, FloatArray]:
    """Return the mean (n, 3) of the camera centres that see a landmark, and the centres from there
    (k, 3).

    Small numbers keep the precision.
    """
    centers = views.center_m[observations.view]
    middle = observations.per_landmark(np.add, centers) / observations.seen[:, None]
    return middle, centers - middle[observations.landmark]


# -- lines


def _lines(views: ViewArray, observations: ObservationArray, min_angle_rad: float) -> Start:
    start = Start.empty(observations.count)
    rays = end_rays(views, observations)
    normals = np.cross(rays[:, 0], rays[:, 1])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    short = observations.of(lengths[:, 0] < _PARALLEL_RAD)
    start.fail(short, "peak and bottom are the same point in one of the images")
    normals /= np.maximum(lengths, _PARALLEL_RAD)
    start.angle_rad[:] = _widest_angle(observations, normals, unsigned=True)
    start.fail_narrow("planes", min_angle_rad)
    _put_ends(views, observations, rays, *_common_lines(views, observations, normals), start)
    return start


def _common_lines(
    views: ViewArray, observations: ObservationArray, normals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a point (n, 3) and the unit direction (n, 3) of the line nearest to all planes."""
    spread = observations.per_landmark(np.add, normals[:, :, None] * normals[:, None])
    direction = np.linalg.eigh(spread)[1][:, :, 0]
    middle, away = _near_cameras(views, observations)
    offsets = (away * normals).sum(axis=1, keepdims=True)
    right = observations.per_landmark(np.add, offsets * normals)
    held = spread + direction[:, :, None] * direction[:, None]  # the point nearest to the cameras
    return middle + _solved(held, right), direction


def _put_ends(
    views: ViewArray,
    observations: ObservationArray,
    rays: FloatArray,
    origin: FloatArray,
    direction: FloatArray,
    start: Start,
) -> None:
    """Set anchor and end to where the rays (k, 2, 3) of the observed ends pass the lines."""
    along = along_lines(views, observations, rays, origin, direction)
    downwards = along[:, 0] < along[:, 1]
    flip = ~observations.of(downwards)
    direction = np.where(flip, -1.0, 1.0)[:, None] * direction
    along *= np.where(flip, -1.0, 1.0)[observations.landmark][:, None]
    swapped = observations.of(~(along[:, 0] < along[:, 1]))
    start.fail(swapped, "peak and bottom are swapped in one of the images: swap its ends")
    first, last = outermost(observations, along)
    start.anchor_m[:] = origin + first[:, None] * direction
    start.end_m[:] = origin + last[:, None] * direction
    far = beyond_horizon(views, observations, start.anchor_m, start.end_m)
    start.fail(far, "an end would be at the horizon: are these two different landmarks?")
    behind = np.zeros(observations.count, dtype=bool)
    for ends in (start.anchor_m, start.end_m):
        depth = views.depth_m(observations.view, ends[observations.landmark])
        behind |= observations.of(~(depth >= MIN_DEPTH_M))
    start.fail(behind, "the planes meet behind the camera: are these two different landmarks?")


def beyond_horizon(
    views: ViewArray, observations: ObservationArray, anchor_m: FloatArray, end_m: FloatArray
) -> BoolArray:
    """Return whether an end (n, 3) is so far away that the lines are of different landmarks
    (n,)."""
    middle, _ = _near_cameras(views, observations)
    reach = np.maximum(np.abs(anchor_m - middle), np.abs(end_m - middle)).max(axis=1)
    return np.asarray(~(reach < _HORIZON_M))  # NaN too


def end_rays(views: ViewArray, observations: ObservationArray) -> FloatArray:
    """Return unit rays (k, 2, 3) through the observed anchors and ends of poles."""
    ends_px = (observations.anchor_px, observations.end_px)
    return np.stack([views.rays(observations.view, px) for px in ends_px], axis=1)


def along_lines(
    views: ViewArray,
    observations: ObservationArray,
    rays: FloatArray,
    origin: FloatArray,
    direction: FloatArray,
) -> FloatArray:
    """Return positions (k, 2) m along each landmark's line where the rays (k, 2, 3) come nearest.

    NaN or infinite if a ray is parallel to the line, which has a unit direction.
    """
    direction = direction[observations.landmark]
    away = views.center_m[observations.view] - origin[observations.landmark]
    cosine = np.einsum("kei,ki->ke", rays, direction)
    onto_line = (direction * away).sum(axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        onto_ray = np.einsum("kei,ki->ke", rays, away)
        return np.asarray((onto_line - cosine * onto_ray) / (1.0 - cosine**2))


def outermost(observations: ObservationArray, along: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the positions (n,) of each pole's anchor and end on its line: means over known ends.

    Without a known end, the outermost point to which the pole was seen. ``along`` is (k, 2).
    """
    ends = []
    for which, known, outer in (
        (0, observations.anchor_known, np.minimum),
        (1, observations.end_known, np.maximum),
    ):
        positions = along[:, which]
        shown = observations.per_landmark(np.add, known.astype(float))
        with np.errstate(invalid="ignore"):  # of infinite places there is no mean
            total = observations.per_landmark(np.add, np.where(known, positions, 0.0))
            furthest = observations.per_landmark(outer, positions)
        ends.append(np.where(shown > 0, total / np.maximum(shown, 1.0), furthest))
    return ends[0], ends[1]


# -- both


def _widest_angle(
    observations: ObservationArray, directions: FloatArray, unsigned: bool
) -> FloatArray:
    """Return the largest angles (n,) of a landmark's unit directions (k, 3); see
    ``Start.angle_rad``."""
    first = observations.first
    least = np.ones(observations.count)
    for _ in range(2):
        cosine = (directions[first[observations.landmark]] * directions).sum(axis=1)
        cosine = np.abs(cosine) if unsigned else cosine
        least = observations.per_landmark(np.minimum, cosine)
        first = _first_row(observations, cosine == least[observations.landmark])
    return np.asarray(np.arccos(np.clip(least, -1.0, 1.0)))


def _first_row(observations: ObservationArray, rows: BoolArray) -> IntArray:
    """Return the first row (n,) of each landmark with True in rows (k,)."""
    number = np.where(rows, np.arange(len(rows)), len(rows))
    return np.asarray(observations.per_landmark(np.minimum, number))


def _solved(A: FloatArray, b: FloatArray) -> FloatArray:
    """Solve A x = b for x (n, 3), with A (n, 3, 3) and b (n, 3); NaN if A is singular."""
    singular = ~(np.linalg.cond(A) < 1e15)
    A = np.where(singular[:, None, None], np.eye(3), A)
    return np.where(singular[:, None], np.nan, np.linalg.solve(A, b[:, :, None])[:, :, 0])
