"""Places from rays and planes, linearly, of many things at once.

Signs are intersections of rays. Poles are intersections of planes: each sighting's line and camera
centre span a plane, and all planes share the pole. So the ends need not be the same pixels in all
views; they come from where the rays of the observed ends pass the line.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import MIN_DEPTH_M
from semviz_core.errors import SemvizError

MIN_ANGLE_RAD = float(np.deg2rad(0.2))
"""Below this, 1 px of a 720 px lens is nearly half of the angle: depth means nothing."""
_PARALLEL_RAD = 1e-5
"""Below this two directions are one, whatever the caller accepts: a hundredth of a pixel."""
_HORIZON_M = 10_000.0
"""An end further away than this comes from lines that do not belong together."""


@dataclass(frozen=True, eq=False)
class Start:
    """First places of n things; they mean nothing where there is a failure."""

    anchor_m: FloatArray
    """(n, 3)"""
    end_m: FloatArray
    """(n, 3); NaN for points"""
    angle_rad: FloatArray
    """(n,) between two of the rays or planes: the one furthest from the first, and the one furthest
    from that. That is the widest angle, or nearly."""
    failure: NDArray[np.object_]
    """(n,) str: why there is no place, or nothing."""
    too_narrow: BoolArray
    """(n,) whether it failed since the rays or planes are nearly parallel."""

    @classmethod
    def nowhere(cls, count: int) -> "Start":
        """To be filled."""
        unknown = np.full((count, 3), np.nan)
        words = np.full(count, "", dtype=object)
        return cls(unknown, unknown.copy(), np.zeros(count), words, np.zeros(count, dtype=bool))

    def fail(self, where: BoolArray, reason: str) -> None:
        """The first reason is kept."""
        self.failure[where & (self.failure == "")] = reason

    def fail_narrow(self, what: str, min_angle_rad: float) -> None:
        narrow = self.angle_rad < max(min_angle_rad, _PARALLEL_RAD)
        for thing in np.flatnonzero(narrow & (self.failure == "")):
            self.too_narrow[thing] = True
            self.failure[thing] = (
                f"the {what} are nearly parallel ({np.rad2deg(self.angle_rad[thing]):.2f} deg "
                "apart): too far away, or along the line between the cameras"
            )

    @property
    def ok(self) -> BoolArray:
        """(n,) True where there is a place."""
        return np.asarray(self.failure == "")

    def places_m(self) -> FloatArray:
        """(n, 6) of (anchor, end); zero for the ends of points."""
        return np.concatenate([self.anchor_m, np.nan_to_num(self.end_m)], axis=1)

    def put(self, things: BoolArray, others: "Start") -> None:
        """``others`` are those with True in things (n,)."""
        for mine, theirs in zip(vars(self).values(), vars(others).values(), strict=True):
            mine[things] = theirs


def linear_start(views: Views, sightings: Sightings, min_angle_rad: float) -> Start:
    """Of all things in ``sightings``. Raises SemvizError for poles among sightings of a sign."""
    start = Start.nowhere(sightings.count)
    start.fail(sightings.seen < 2, "labelled in one image only")
    several = sightings.seen > 1
    is_line, is_point = sightings.of(sightings.is_line), sightings.of(~sightings.is_line)
    if (is_line & is_point).any():
        raise SemvizError("one element is a pole in some views and a sign in others")
    points, lines = is_point & several, is_line & several
    for things, started in ((points, _points), (lines, _lines)):
        if things.any():
            start.put(things, started(views, sightings.only(things), min_angle_rad))
    return start


# -- points


def _points(views: Views, sightings: Sightings, min_angle_rad: float) -> Start:
    start = Start.nowhere(sightings.count)
    rays = views.rays(sightings.view, sightings.anchor_px)
    start.angle_rad[:] = _widest_angle(sightings, rays, unsigned=False)
    start.fail_narrow("rays", min_angle_rad)
    start.anchor_m[:], ahead = _intersected(views, sightings)
    start.fail(~ahead, "the rays meet behind the camera: are these two different things?")
    return start


def _intersected(views: Views, sightings: Sightings) -> tuple[FloatArray, BoolArray]:
    """(n, 3) the points nearest to all their rays, in the images; (n,) whether ahead of all.

    Iterative-LS (Hartley & Sturm 1997, 5.3): each view gives two planes through its ray, one for
    each image axis; dividing by the depth turns distances to them into pixels.
    """
    P = views.projection[sightings.view]
    A = P[:, :2, :3] - sightings.anchor_px[:, :, None] * P[:, 2:, :3]
    middle, away = _near_cameras(views, sightings)
    b = (A @ away[:, :, None])[:, :, 0]
    weight = np.ones(len(sightings))
    ahead = np.ones(sightings.count, dtype=bool)
    points = middle
    for _ in range(3):
        AtA = sightings.per_thing(np.add, weight[:, None, None] * (A.transpose(0, 2, 1) @ A))
        Atb = sightings.per_thing(np.add, weight[:, None] * np.einsum("kri,kr->ki", A, b))
        points = middle + _solved(AtA, Atb)
        depth = views.depth_m(sightings.view, points[sightings.thing])
        ahead &= ~sightings.of(~(depth >= MIN_DEPTH_M))
        weight = 1.0 / np.where(depth >= MIN_DEPTH_M, depth, 1.0) ** 2
    return points, ahead


def _near_cameras(views: Views, sightings: Sightings) -> tuple[FloatArray, FloatArray]:
    """(n, 3) the mean of the centres that see a thing, and (k, 3) the centres from there.

    Numbers near zero keep their digits.
    """
    centers = views.center_m[sightings.view]
    middle = sightings.per_thing(np.add, centers) / sightings.seen[:, None]
    return middle, centers - middle[sightings.thing]


# -- lines


def _lines(views: Views, sightings: Sightings, min_angle_rad: float) -> Start:
    start = Start.nowhere(sightings.count)
    rays = end_rays(views, sightings)
    normals = np.cross(rays[:, 0], rays[:, 1])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    short = sightings.of(lengths[:, 0] < _PARALLEL_RAD)
    start.fail(short, "peak and bottom are the same point in one of the images")
    normals /= np.maximum(lengths, _PARALLEL_RAD)
    start.angle_rad[:] = _widest_angle(sightings, normals, unsigned=True)
    start.fail_narrow("planes", min_angle_rad)
    _put_ends(views, sightings, rays, *_common_lines(views, sightings, normals), start)
    return start


def _common_lines(
    views: Views, sightings: Sightings, normals: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(n, 3) a point and (n, 3) the unit direction of the line nearest to all planes."""
    spread = sightings.per_thing(np.add, normals[:, :, None] * normals[:, None])
    direction = np.linalg.eigh(spread)[1][:, :, 0]
    middle, away = _near_cameras(views, sightings)
    offsets = (away * normals).sum(axis=1, keepdims=True)
    right = sightings.per_thing(np.add, offsets * normals)
    held = spread + direction[:, :, None] * direction[:, None]  # the point nearest to the cameras
    return middle + _solved(held, right), direction


def _put_ends(
    views: Views,
    sightings: Sightings,
    rays: FloatArray,
    origin: FloatArray,
    direction: FloatArray,
    start: Start,
) -> None:
    """Anchor and end: where the rays (k, 2, 3) of the observed ones pass the lines."""
    along = along_lines(views, sightings, rays, origin, direction)
    downwards = along[:, 0] < along[:, 1]
    flip = ~sightings.of(downwards)
    direction = np.where(flip, -1.0, 1.0)[:, None] * direction
    along *= np.where(flip, -1.0, 1.0)[sightings.thing][:, None]
    swapped = sightings.of(~(along[:, 0] < along[:, 1]))
    start.fail(swapped, "peak and bottom are swapped in one of the images: swap its ends")
    first, last = outermost(sightings, along)
    start.anchor_m[:] = origin + first[:, None] * direction
    start.end_m[:] = origin + last[:, None] * direction
    far = beyond_horizon(views, sightings, start.anchor_m, start.end_m)
    start.fail(far, "an end would be at the horizon: are these two different things?")
    behind = np.zeros(sightings.count, dtype=bool)
    for ends in (start.anchor_m, start.end_m):
        depth = views.depth_m(sightings.view, ends[sightings.thing])
        behind |= sightings.of(~(depth >= MIN_DEPTH_M))
    start.fail(behind, "the planes meet behind the camera: are these two different things?")


def beyond_horizon(
    views: Views, sightings: Sightings, anchor_m: FloatArray, end_m: FloatArray
) -> BoolArray:
    """(n,) whether an end (n, 3) of a thing is so far away that its lines are of two things."""
    middle, _ = _near_cameras(views, sightings)
    reach = np.maximum(np.abs(anchor_m - middle), np.abs(end_m - middle)).max(axis=1)
    return np.asarray(~(reach < _HORIZON_M))  # NaN too


def end_rays(views: Views, sightings: Sightings) -> FloatArray:
    """(k, 2, 3) unit, through the observed anchors and ends of poles."""
    ends_px = (sightings.anchor_px, sightings.end_px)
    return np.stack([views.rays(sightings.view, px) for px in ends_px], axis=1)


def along_lines(
    views: Views, sightings: Sightings, rays: FloatArray, origin: FloatArray, direction: FloatArray
) -> FloatArray:
    """(k, 2) m along each thing's line (unit direction) to where its rays (k, 2, 3) come nearest.

    Not a number, or infinite, where a ray is parallel to the line.
    """
    direction = direction[sightings.thing]
    away = views.center_m[sightings.view] - origin[sightings.thing]
    cosine = np.einsum("kei,ki->ke", rays, direction)
    onto_line = (direction * away).sum(axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        onto_ray = np.einsum("kei,ki->ke", rays, away)
        return np.asarray((onto_line - cosine * onto_ray) / (1.0 - cosine**2))


def outermost(sightings: Sightings, along: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n,) where on its line each pole's anchor and end is: the mean of the places that show it.

    Where none does, the outermost place to which the pole was seen. ``along`` is (k, 2).
    """
    ends = []
    for which, known, outer in (
        (0, sightings.anchor_known, np.minimum),
        (1, sightings.end_known, np.maximum),
    ):
        here = along[:, which]
        shown = sightings.per_thing(np.add, known.astype(float))
        with np.errstate(invalid="ignore"):  # of infinite places there is no mean
            total = sightings.per_thing(np.add, np.where(known, here, 0.0))
            furthest = sightings.per_thing(outer, here)
        ends.append(np.where(shown > 0, total / np.maximum(shown, 1.0), furthest))
    return ends[0], ends[1]


# -- both


def _widest_angle(sightings: Sightings, directions: FloatArray, unsigned: bool) -> FloatArray:
    """(n,) between two of a thing's unit directions (k, 3), as ``Start.angle_rad`` says."""
    first = sightings.first
    least = np.ones(sightings.count)
    for _ in range(2):
        cosine = (directions[first[sightings.thing]] * directions).sum(axis=1)
        cosine = np.abs(cosine) if unsigned else cosine
        least = sightings.per_thing(np.minimum, cosine)
        first = _first_row(sightings, cosine == least[sightings.thing])
    return np.asarray(np.arccos(np.clip(least, -1.0, 1.0)))


def _first_row(sightings: Sightings, rows: BoolArray) -> IntArray:
    """(n,) the first row of each thing with True in rows (k,)."""
    number = np.where(rows, np.arange(len(rows)), len(rows))
    return np.asarray(sightings.per_thing(np.minimum, number))


def _solved(A: FloatArray, b: FloatArray) -> FloatArray:
    """(n, 3) x with A x = b, of A (n, 3, 3) and b (n, 3); NaN where A has no inverse."""
    singular = ~(np.linalg.cond(A) < 1e15)
    A = np.where(singular[:, None, None], np.eye(3), A)
    return np.where(singular[:, None], np.nan, np.linalg.solve(A, b[:, :, None])[:, :, 0])
