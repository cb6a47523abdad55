"""What stands beside the road and can hide one another: cars, poles, signs."""

import numpy as np

from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.sources.street import cars, sign_faces
from semviz_core.sources.street.brushes import Air, fill, mixed, rod, stamp
from semviz_core.sources.street.layout import Layout
from semviz_core.sources.street.things import Car, Color, Pole, Sign, Standing
from semviz_core.sources.street.view import NEAR_M, View

SIGHT_M = 75.0
_HAZE_M = 260.0
_LAMP: Color = (206, 210, 212)


def standing_in_order(layout: Layout, view: View) -> list[Standing]:
    """Everything in front of the camera within sight, the far ones first.

    A car counts with its nearest corner, since what stands beside it stands behind it.
    """
    things, corners = layout.standing
    distance = np.linalg.norm(corners - view.center_m[:2], axis=2).min(axis=1)
    rows = np.flatnonzero(distance < SIGHT_M)
    near = rows[np.argsort(-distance[rows], kind="stable")]  # signs come after their poles
    return [things[row] for row in near if _is_ahead(things[row], view)]


def _is_ahead(thing: Standing, view: View) -> bool:
    """Cars are cut at the near plane; the others are too far aside to reach it in sight."""
    if isinstance(thing, Pole):
        return bool((view.depth(np.array([thing.bottom_m, thing.peak_m])) > NEAR_M).all())
    return isinstance(thing, Car) or bool(view.depth(thing.middle_m) > 2 * NEAR_M)


def paint_standing(
    picture: ByteImage, view: View, thing: Standing, sun: FloatArray, haze: Color
) -> None:
    """One of them on the picture."""
    if isinstance(thing, Car):
        air = air_at(view.distance(thing.middle_m), haze)
        for corners, color in cars.patches(thing, view.center_m, sun):
            polygon = view.polygon(corners)
            if polygon is not None:
                fill(picture, polygon, mixed(color, haze, air.haze))
    elif isinstance(thing, Pole):
        _paint_pole(picture, view, thing, sun, haze)
    else:
        _paint_sign(picture, view, thing, sun, haze)


def silhouette(thing: Standing, view: View, sun: FloatArray) -> list[FloatArray]:
    """Polygons (k, 2) in pixels that cover what ``paint_standing`` paints; no lamp arms."""
    if isinstance(thing, Car):
        polygons = [view.polygon(one.corners_m) for one in cars.patches(thing, view.center_m, sun)]
    elif isinstance(thing, Pole):
        axis = np.array([thing.bottom_m, thing.peak_m])
        across = np.cross(axis[1] - axis[0], view.center_m - axis[0])
        across *= thing.radius_m / np.linalg.norm(across)
        polygons = [view.polygon(np.concatenate([axis - across, axis[::-1] + across]))]
    else:
        plate = sign_faces.outline(thing.class_id)
        corners = plate[:, :1] * thing.right_m - plate[:, 1:] * thing.up_m
        polygons = [view.polygon(thing.middle_m + corners)]
    return [one for one in polygons if one is not None]


def air_at(distance_m: float, haze: Color, gain: float = 1.0) -> Air:
    """Haze grows with distance."""
    return Air(gain, 1.0 - float(np.exp(-distance_m / _HAZE_M)), haze)


def paint_rod(
    picture: ByteImage, view: View, ends_m: FloatArray, radius_m: float, color: Color, light: float
) -> None:
    """A round rod between two points (2, 3) of the map, both in front of the camera."""
    depth = view.depth(ends_m)
    if (depth < NEAR_M).any():
        return
    near, far = radius_m * float(view.camera.K[0, 0]) / depth
    rod(picture, view.project(ends_m), (float(near), float(far)), color, light)


def _paint_pole(picture: ByteImage, view: View, pole: Pole, sun: FloatArray, haze: Color) -> None:
    air = air_at(view.distance(pole.bottom_m), haze)
    light = float(sun @ view.T_map_camera.rotation[:, 0])
    color = mixed(pole.color, haze, air.haze)
    axis = np.array([pole.bottom_m, pole.peak_m])
    if pole.arm_m.any():
        head = pole.peak_m + pole.arm_m
        paint_rod(picture, view, np.array([pole.peak_m, head]), 0.032, color, light)
        lamp = np.array([head - 0.5 * pole.arm_m / np.linalg.norm(pole.arm_m), head])
        paint_rod(picture, view, lamp, 0.075, mixed(_LAMP, haze, air.haze), light)
    paint_rod(picture, view, axis, pole.radius_m, color, light)


def _paint_sign(picture: ByteImage, view: View, sign: Sign, sun: FloatArray, haze: Color) -> None:
    right, up = sign.right_m, sign.up_m
    aspect = round(float(np.linalg.norm(right) / np.linalg.norm(up)), 2)
    texture = sign_faces.face(sign.class_id, sign.face % 60, aspect)
    facing = np.cross(right, up) / np.linalg.norm(np.cross(right, up))
    gain = 0.9 + 0.14 * max(0.0, float(facing @ sun))
    air = air_at(view.distance(sign.middle_m), haze, gain)
    stamp(picture, view, texture, sign.middle_m - right + up, 2 * right, -2 * up, air)
