"""How well observations fit one thing, at any depth up to infinity.

Within a pixel's noise the rays to something far are parallel, or meet behind the cameras. Then the
best point ahead of them all is the one at infinity, which only their direction tells. So points
are homogeneous here: (x, y, z, 1) in the map frame, or (x, y, z, 0) for a direction.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz_annotation.labels import Observation
from semviz_annotation.triangulate import Failed, triangulate
from semviz_annotation.view import View
from semviz_core.arrays import FloatArray
from semviz_core.evaluation.image_errors import across_px


def misfit_px(views: Sequence[View], observations: Sequence[Observation]) -> float:
    """How badly the last of some observations fits one thing with the others, px.

    Reprojection error (rms) of the worse end; ends that are known in less than two views don't
    count. Both are taken as points, for planes through poles in two views always meet. With more
    views, or where an observation has no end that counts, the last one's error across the line
    counts too: many good views must not hide it. Infinite for views that cannot show one thing,
    whatever its depth.
    """
    seen = list(zip(views, observations, strict=True))
    ends = (
        [(view, one, _anchor(one)) for view, one in seen if one.anchor_known],
        [(view, one, _end(one)) for view, one in seen if one.end_px and one.end_known],
    )
    counted = [points for points in ends if len(points) > 1]
    errors = [
        _point_misfit_px([view for view, _, _ in points], [end for _, _, end in points])
        for points in counted
    ]
    shown = [one for points in counted for _, one, _ in points]
    is_line = observations[0].end_px is not None
    if is_line and (len(seen) > 2 or any(one not in shown for one in observations)):
        errors.append(_line_misfit_px(views, observations))
    worst = max(errors)
    return worst if np.isfinite(worst) else float("inf")


def best_ends(views: Sequence[View], observations: Sequence[Observation]) -> FloatArray:
    """(2, 4) homogeneous: where the rays to the two ends agree best; NaN for a sign's end."""
    anchor = _best_point(views, [_anchor(one) for one in observations])
    if observations[0].end_px is None:
        return np.stack([anchor, np.full(4, np.nan)])
    return np.stack([anchor, _best_point(views, [_end(one) for one in observations])])


def seen_at(view: View, points: FloatArray) -> FloatArray:
    """(n, 2) px of homogeneous points (n, 4); NaN behind the camera."""
    pose = view.T_camera_map
    return view.camera.project(points[:, :3] @ pose.rotation.T + points[:, 3:] * pose.translation)


def _best_point(views: Sequence[View], points: Sequence[Observation]) -> FloatArray:
    """(4,) with the least reprojection error, to first order, ahead of all views or at infinity.

    Iterative-Eigen (Hartley & Sturm 1997, 5.3), which takes infinity as it takes any other point.
    """
    rays = np.array([view.rays(_pixels(one))[0] for view, one in zip(views, points, strict=True)])
    center = np.mean([view.center_m for view in views], axis=0)  # small numbers condition better
    planes = np.array([_planes(*seen, center) for seen in zip(views, rays, strict=True)])
    axes = np.array([view.T_camera_map.rotation[2] for view in views])
    offsets = np.array([view.center_m - center for view in views])
    depth_of = np.column_stack([axes, -(axes * offsets).sum(axis=1)])
    depths = np.ones(len(views))
    for _ in range(3):
        point = np.linalg.svd((planes / depths[:, None, None]).reshape(-1, 4))[2][3]
        point *= np.copysign(1.0, point[3])
        depths = depth_of @ point
        if (depths <= 0.0).any():
            return np.append(rays.mean(axis=0), 0.0)
    return np.append(point[:3] + point[3] * center, point[3])


def _planes(view: View, ray: FloatArray, center: FloatArray) -> FloatArray:
    """(2, 4) planes through a ray, level and upright in its image; px times depth off them."""
    R = view.T_camera_map.rotation
    x, y, z = R @ ray
    normals = np.stack([R[0] - x / z * R[2], R[1] - y / z * R[2]])
    normals *= np.diag(view.camera.K)[:2, None]
    return np.column_stack([normals, -normals @ (view.center_m - center)])


def _point_misfit_px(views: Sequence[View], points: Sequence[Observation]) -> float:
    best = _best_point(views, points)[None]
    errors = [seen_at(view, best) - _pixels(one) for view, one in zip(views, points, strict=True)]
    return _rms(np.linalg.norm(np.concatenate(errors), axis=1))


def _line_misfit_px(views: Sequence[View], poles: Sequence[Observation]) -> float:
    """Of the last, across the line; at infinity that is the mean of the planes through them all."""
    place = triangulate(views, poles, min_angle_rad=0.0)
    if isinstance(place, Failed):
        line = _line_at_infinity(views, poles)
    else:
        line = np.column_stack([np.stack([place.anchor_m, place.end_m]), np.ones(2)])
    return _rms(across_px(seen_at(views[-1], line), _pixels(poles[-1])))


def _line_at_infinity(views: Sequence[View], poles: Sequence[Observation]) -> FloatArray:
    """(2, 4) homogeneous."""
    rays = np.array([view.rays(_pixels(one)) for view, one in zip(views, poles, strict=True)])
    normal = np.cross(rays[:, 0], rays[:, 1]).sum(axis=0)
    normal /= max(float(np.linalg.norm(normal)), 1e-12)
    on_line = rays[-1] - (rays[-1] @ normal)[:, None] * normal
    return np.concatenate([on_line, np.zeros((2, 1))], axis=1)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.square(errors).mean()))


def _pixels(one: Observation) -> FloatArray:
    """(1, 2) px of a point, (2, 2) of a pole."""
    return np.array([one.anchor_px] if one.end_px is None else [one.anchor_px, one.end_px])


def _anchor(one: Observation) -> Observation:
    """A peak (or middle) alone."""
    return replace(one, end_px=None)


def _end(pole: Observation) -> Observation:
    """A bottom alone."""
    return replace(pole, anchor_px=pole.end_px or pole.anchor_px, end_px=None)
