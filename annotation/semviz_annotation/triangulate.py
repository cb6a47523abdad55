"""An element's place in space from two or more views, linearly, with its covariance.

Signs are triangulated as points. Poles are intersected as planes: each view's line and camera
centre span a plane, and all planes share the pole. So the ends need not be the same pixels in
both views; they come from where the rays of the observed ends pass the line.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from semviz_annotation.labels import Observation
from semviz_annotation.view import View, rig_view
from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.camera import MIN_DEPTH_M, Rig
from semviz_core.errors import SemvizError

MIN_ANGLE_RAD = float(np.deg2rad(0.2))
"""Below this, 1 px of a 720 px lens is nearly half of the angle: depth means nothing."""
_PARALLEL_RAD = 1e-5
"""Below this two directions are one, whatever the caller accepts: a hundredth of a pixel."""
_HORIZON_M = 10_000.0
"""An end further away than this comes from lines that do not belong together."""


@dataclass(frozen=True, eq=False)
class Triangulated:
    """One element in the map frame."""

    anchor_m: FloatArray
    """(3,) peak of a pole, middle of a sign."""
    end_m: FloatArray
    """(3,) bottom of a pole, NaN for signs."""
    covariance_m2: FloatArray
    """(6, 6) of (anchor, end), to first order; zero in the rows of a sign's end."""
    anchor_known: bool
    end_known: bool
    angle_rad: float
    """Largest angle between two of the rays (signs) or planes (poles)."""
    rms_px: float
    """Reprojection error: of the point, or of a pole's ends across its line."""

    @property
    def is_line(self) -> bool:
        return bool(np.isfinite(self.end_m).all())


@dataclass(frozen=True)
class Failed:
    """Why there is no place."""

    reason: str
    too_narrow: bool = False
    """The rays are sound but nearly parallel: views from elsewhere can help."""


def triangulate_pair(
    rig: Rig, left: Observation, right: Observation, sigma_px: float = 1.0
) -> Triangulated | Failed:
    """An element from both images of one frame, in the coordinates of the left camera."""
    return triangulate([rig_view(rig, "left"), rig_view(rig, "right")], [left, right], sigma_px)


def triangulate(
    views: Sequence[View],
    observations: Sequence[Observation],
    sigma_px: float = 1.0,
    min_angle_rad: float = MIN_ANGLE_RAD,
) -> Triangulated | Failed:
    """An element from k >= 2 observations, one in each of ``views``, in their map frame.

    ``sigma_px`` is the standard deviation of an end in each direction. Returns ``Failed`` where the
    geometry gives no answer. Raises SemvizError for fewer than two views, or poles among signs.
    """
    if len(views) < 2 or len(views) != len(observations):
        raise SemvizError("triangulation needs two or more observations, and a view for each")
    lines = {one.end_px is not None for one in observations}
    if len(lines) == 2:
        raise SemvizError("one element is a pole in some views and a sign in others")
    solve = _line if lines == {True} else _point
    return solve(views, observations, sigma_px, min_angle_rad)


def covariance_m2(
    views: Sequence[View],
    observations: Sequence[Observation],
    anchor_m: FloatArray,
    end_m: FloatArray,
    sigma_px: float = 1.0,
) -> FloatArray:
    """(6, 6) first-order covariance of an element at (anchor, end) seen in ``views``.

    The inverse of the information of all residuals: both image axes for signs (end NaN); across the
    line at both observed ends, and along it at the known ones, for poles.
    """
    result = np.zeros((6, 6))
    _, J = errors_px(views, observations, anchor_m, end_m)
    size = J.shape[1]
    result[:size, :size] = np.linalg.inv(J.T @ J) * sigma_px**2
    return result


# -- points


def _point(
    views: Sequence[View],
    observations: Sequence[Observation],
    sigma_px: float,
    min_angle_rad: float,
) -> Triangulated | Failed:
    pixels = np.array([one.anchor_px for one in observations])
    rays = np.array([view.rays(px[None])[0] for view, px in zip(views, pixels, strict=True)])
    angle = _widest_angle(rays @ rays.T)
    if angle < max(min_angle_rad, _PARALLEL_RAD):
        return _too_narrow("rays", angle)
    point = _intersect(views, rays)
    if point is None:
        return Failed("the rays meet behind the camera: are these two different things?")
    end = np.full(3, np.nan)
    errors = np.array([view.project(point[None])[0] for view in views]) - pixels
    return Triangulated(
        anchor_m=point,
        end_m=end,
        covariance_m2=covariance_m2(views, observations, point, end, sigma_px),
        anchor_known=True,
        end_known=False,
        angle_rad=angle,
        rms_px=float(np.sqrt((errors**2).sum(axis=1).mean())),
    )


def _intersect(views: Sequence[View], rays: FloatArray) -> FloatArray | None:
    """The point nearest to all rays in their images; None where it is behind one.

    Iterative-LS (Hartley & Sturm 1997, 5.3): each view gives two planes through its ray, level
    and upright in its image; dividing by the depth turns distances to them into image distances.
    """
    center = np.mean([view.center_m for view in views], axis=0)  # small numbers condition better
    normals, offsets = [], []
    for view, ray in zip(views, rays, strict=True):
        R = view.T_camera_map.rotation
        x, y, z = R @ ray
        planes = np.stack([R[0] - x / z * R[2], R[1] - y / z * R[2]])
        planes *= np.diag(view.camera.K)[:2, None]  # cameras may differ: in pixels, not tangents
        normals.append(planes)
        offsets.append(planes @ (view.center_m - center))
    A, b = np.concatenate(normals), np.concatenate(offsets)
    weights = np.ones(len(A))
    for _ in range(3):
        solution = np.linalg.lstsq(A * weights[:, None], b * weights, rcond=None)[0]
        depths = np.array([view.depth_m(solution + center) for view in views])
        if (depths < MIN_DEPTH_M).any():
            return None
        weights = np.repeat(1.0 / depths, 2)
    return np.asarray(solution + center)


# -- lines


def _line(
    views: Sequence[View],
    observations: Sequence[Observation],
    sigma_px: float,
    min_angle_rad: float,
) -> Triangulated | Failed:
    rays = np.array(
        [view.rays(_ends_px(one)) for view, one in zip(views, observations, strict=True)]
    )
    normals = np.cross(rays[:, 0], rays[:, 1])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if lengths.min() < _PARALLEL_RAD:
        return Failed("peak and bottom are the same point in one of the images")
    normals /= lengths
    angle = _widest_angle(np.abs(normals @ normals.T))  # a normal's sign means nothing
    if angle < max(min_angle_rad, _PARALLEL_RAD):
        return _too_narrow("planes", angle)
    ends = _ends_m(views, observations, rays, *_common_line(views, normals))
    if isinstance(ends, Failed):
        return ends
    return Triangulated(
        anchor_m=ends[0],
        end_m=ends[1],
        covariance_m2=covariance_m2(views, observations, ends[0], ends[1], sigma_px),
        anchor_known=any(one.anchor_known for one in observations),
        end_known=any(one.end_known for one in observations),
        angle_rad=angle,
        rms_px=_across_rms_px(views, observations, ends),
    )


def _common_line(views: Sequence[View], normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A point and the unit direction of the line nearest to all planes (least squares)."""
    direction = np.linalg.svd(normals)[2][2]
    centers = np.array([view.center_m for view in views])
    middle = centers.mean(axis=0)
    offsets = ((centers - middle) * normals).sum(axis=1)
    planes = np.vstack([normals, direction])  # the point of the line nearest to the cameras
    point = np.linalg.lstsq(planes, np.append(offsets, 0.0), rcond=None)[0]
    return point + middle, direction


def _ends_m(
    views: Sequence[View],
    observations: Sequence[Observation],
    rays: FloatArray,
    origin: FloatArray,
    direction: FloatArray,
) -> FloatArray | Failed:
    """(2, 3) m: anchor and end, where the rays (k, 2, 3) of the observed ones pass the line."""
    places_m = np.array(
        [
            _along(origin, direction, view.center_m, pair)
            for view, pair in zip(views, rays, strict=True)
        ]
    )
    if places_m[0, 1] < places_m[0, 0]:
        direction, places_m = -direction, -places_m
    if not (places_m[:, 0] < places_m[:, 1]).all():
        return Failed("peak and bottom are swapped in one of the images: swap its ends")
    anchor_known = np.array([one.anchor_known for one in observations])
    end_known = np.array([one.end_known for one in observations])
    first = outermost(places_m[:, 0], anchor_known, "first")
    last = outermost(places_m[:, 1], end_known, "last")
    ends = origin + np.array([[first], [last]]) * direction
    if not (np.abs(ends - views[0].center_m) < _HORIZON_M).all():  # NaN too
        return Failed("an end would be at the horizon: are these two different things?")
    if any((view.depth_m(ends) < MIN_DEPTH_M).any() for view in views):
        return Failed("the planes meet behind the camera: are these two different things?")
    return np.asarray(ends)


def _along(
    origin: FloatArray, direction: FloatArray, center: FloatArray, rays: FloatArray
) -> FloatArray:
    """(n,) m along a line (unit direction) to where rays (n, 3) from ``center`` come nearest."""
    cosine = rays @ direction
    away = center - origin
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel to the line: at infinity
        return np.asarray((direction @ away - cosine * (rays @ away)) / (1.0 - cosine**2))


def outermost(places: FloatArray, known: BoolArray, which: Literal["first", "last"]) -> float:
    """Where an end of a pole is: the mean of the places (k,) that show it.

    Where none does, the outermost place to which the pole was seen.
    """
    if known.any():
        return float(places[known].mean())
    return float(places.min() if which == "first" else places.max())


def errors_px(
    views: Sequence[View],
    observations: Sequence[Observation],
    anchor_m: FloatArray,
    end_m: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Residuals (rows,) of an element at (anchor, end), and how they move with it (rows, 3 or 6).

    Signs (end NaN): both image axes in each view. Poles: across the line at both observed ends, and
    along it at the known ones; an end that nobody saw is held along the line where it is.
    """
    seen = list(zip(views, observations, strict=True))
    if np.isnan(end_m).any():
        errors = [view.project(anchor_m)[0] - one.anchor_px for view, one in seen]
        return np.ravel(errors), np.concatenate([view.jacobian(anchor_m) for view in views])
    known = (any(one.anchor_known for one in observations), any(one.end_known for _, one in seen))
    rows = [_line_errors_px(view, one, anchor_m, end_m, known) for view, one in seen]
    return np.concatenate([row[0] for row in rows]), np.concatenate([row[1] for row in rows])


def _line_errors_px(
    view: View,
    one: Observation,
    anchor_m: FloatArray,
    end_m: FloatArray,
    known: tuple[bool, bool],
) -> tuple[FloatArray, FloatArray]:
    """As ``errors_px``, in one view; ``known`` are the ends that any view shows."""
    anchor_px, end_px = view.project(np.stack([anchor_m, end_m]))
    length = np.linalg.norm(end_px - anchor_px)
    along = (end_px - anchor_px) / length
    across = np.array([along[1], -along[0]])
    of_anchor, of_end = view.jacobian(anchor_m), view.jacobian(end_m)
    seen_px = _ends_px(one)
    errors = list((anchor_px - seen_px) @ across)
    shares = (seen_px - anchor_px) @ along / length
    rows = [_pair((1.0 - share) * across @ of_anchor, share * across @ of_end) for share in shares]
    if one.anchor_known or not known[0]:
        errors.append((anchor_px - seen_px[0]) @ along if known[0] else 0.0)
        rows.append(_pair(along @ of_anchor, np.zeros(3)))
    if one.end_known or not known[1]:
        errors.append((end_px - seen_px[1]) @ along if known[1] else 0.0)
        rows.append(_pair(np.zeros(3), along @ of_end))
    return np.array(errors), np.array(rows)


def _pair(of_anchor: FloatArray, of_end: FloatArray) -> FloatArray:
    return np.concatenate([of_anchor, of_end])


def _across_rms_px(
    views: Sequence[View], observations: Sequence[Observation], points_m: FloatArray
) -> float:
    errors = [
        across_px(view.project(points_m), _ends_px(one))
        for view, one in zip(views, observations, strict=True)
    ]
    return float(np.sqrt(np.square(errors).mean()))


def across_px(line_px: FloatArray, points_px: FloatArray) -> FloatArray:
    """(n,) signed distances of a line (2, 2: anchor, end) from points (n, 2).

    Positive where the line is to the right of the point, for a line that runs downwards.
    """
    along = line_px[1] - line_px[0]
    across = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    return np.asarray((line_px[0] - points_px) @ across)


def _ends_px(one: Observation) -> FloatArray:
    return np.array([one.anchor_px, one.end_px])


# -- both


def _widest_angle(cosines: FloatArray) -> float:
    return float(np.arccos(np.clip(cosines.min(), -1.0, 1.0)))


def _too_narrow(what: str, angle_rad: float) -> Failed:
    return Failed(
        f"the {what} are nearly parallel ({np.rad2deg(angle_rad):.2f} deg apart): too far away, "
        "or along the line between the cameras",
        too_narrow=True,
    )
