"""Paint the objects that can hide one another: cars, poles and signs, from far to near.

Cars are a few flat polygons that hide the elements behind them. Sign faces are drawn once and
stamped onto the image. Silhouettes cover exactly the painted pixels, without lamp arms.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.simulation import drawing
from semviz_core.simulation.layout import Layout
from semviz_core.simulation.objects import Car, Color, Pole, Sign, StandingObject
from semviz_core.simulation.sign_faces import face, outline, worn_face


class Patch(NamedTuple):
    """One flat polygon."""

    corners_m: FloatArray
    """(k, 3) in the map frame."""
    color: Color


# The outline of a car from its rear bumper over the roof to its front: x forward and z up (m),
# and half of its width there.
_SEDAN = np.array(
    [
        (-2.14, 0.30, 0.80),
        (-2.18, 0.62, 0.85),
        (-2.10, 0.94, 0.80),
        (-1.66, 0.99, 0.78),
        (-1.02, 1.40, 0.60),
        (0.22, 1.43, 0.60),
        (1.02, 0.96, 0.79),
        (1.92, 0.80, 0.76),
        (2.14, 0.56, 0.80),
        (2.10, 0.26, 0.78),
    ]
)
_HATCHBACK = _SEDAN.copy()
_HATCHBACK[2:5] = [(-2.08, 0.92, 0.82), (-2.02, 0.98, 0.80), (-1.66, 1.42, 0.60)]
_BELT = slice(3, 7)  # the points round the windows
_SILL = np.array([(-2.12, 2.1, 2.0, -2.0), (0.42, 0.4, 0.25, 0.25)])
_SHOULDER = np.array([(-2.08, 1.2, 1.9, 1.9, 1.2, -2.08), (0.87, 0.87, 0.74, 0.70, 0.79, 0.79)])
_DOOR = np.array([(-0.36, -0.33, -0.33, -0.36), (0.4, 0.4, 0.95, 0.95)])
_WHEELS_M = (-1.32, 1.34)
_WHEEL_M = 0.31

_GLASS: Color = (44, 54, 62)
_TYRE: Color = (24, 24, 26)
_RIM: Color = (150, 154, 158)
_BUMPER: Color = (38, 40, 42)
_TAIL: Color = (176, 26, 28)
_HEADLIGHT: Color = (226, 230, 232)
_PLATE: Color = (232, 232, 224)
_WHEEL: tuple[tuple[float, Color], ...] = (
    (0.37, (18.0, 18.0, 20.0)),
    (_WHEEL_M, _TYRE),
    (0.62 * _WHEEL_M, _RIM),
    (0.2 * _WHEEL_M, (70.0, 72.0, 76.0)),
)
"""Arch, tyre, rim and hub: radius and colour."""
_CIRCLE = np.array([np.cos(np.linspace(0, 2 * np.pi, 21)), np.sin(np.linspace(0, 2 * np.pi, 21))])
_DETAIL_M = 35.0
_BOX_M = np.array([(x, y, z) for x in (-2.2, 2.2) for y in (-0.9, 0.9) for z in (0.0, 1.45)])
"""(8, 3) corners of the box round the model."""


def patches(car: Car, center_m: FloatArray, sun: FloatArray) -> list[Patch]:
    """Return the visible polygons of a car from ``center_m`` (3,), in the order of painting."""
    R = car.rotation
    eye, light = R.T @ (center_m - car.middle_m) / car.scale, R.T @ sun
    side = 1.0 if eye[1] > 0 else -1.0
    near = float(np.linalg.norm(eye)) < _DETAIL_M
    model = [
        *_strips(car, eye, light),
        *_side(car, side, light, near),
        *(_rear() if eye[0] < 0 else _front()),
    ]
    corners = np.concatenate([patch.corners_m for patch in model]) * car.scale @ R.T + car.middle_m
    parts = np.split(corners, np.cumsum([len(patch.corners_m) for patch in model])[:-1])
    return [Patch(part, patch.color) for part, patch in zip(parts, model, strict=True)]


def _profile(car: Car) -> FloatArray:
    return _HATCHBACK if car.hatchback else _SEDAN


def _strips(car: Car, eye: FloatArray, light: FloatArray) -> list[Patch]:
    """Return bumpers, bonnet, windscreens and roof, which span the car's width, far ones first."""
    profile = _profile(car)
    paint = car.color
    colors = (_BUMPER, paint, paint, _GLASS, paint, _GLASS, paint, paint, _BUMPER)
    patches_by_distance: list[tuple[float, Patch]] = []
    for begin, end, color in zip(profile[:-1], profile[1:], colors, strict=True):
        normal = np.array([begin[1] - end[1], 0.0, end[0] - begin[0]])
        normal /= np.linalg.norm(normal)
        corners = np.array(
            [
                (begin[0], begin[2], begin[1]),
                (end[0], end[2], end[1]),
                (end[0], -end[2], end[1]),
                (begin[0], -begin[2], begin[1]),
            ]
        )
        middle = corners.mean(axis=0)
        if normal @ (eye - middle) > 0:
            gain, distance = _brightness(normal, light), float(np.linalg.norm(eye - middle))
            if color is _GLASS:
                patches_by_distance.append(
                    (distance + 0.01, Patch(corners, drawing.lit(paint, gain)))
                )
                corners, gain = middle + 0.86 * (corners - middle), 1.35 * gain
            patches_by_distance.append((distance, Patch(corners, drawing.lit(color, gain))))
    return [patch for _, patch in sorted(patches_by_distance, key=lambda entry: -entry[0])]


def _side(car: Car, side: float, light: FloatArray, near: bool) -> list[Patch]:
    """Return doors, windows and wheels of the visible side."""
    profile = _profile(car)
    paint = drawing.lit(car.color, _brightness(np.array([0.0, side * 0.97, 0.2]), light))
    lower = np.concatenate([profile[:4], profile[6:]])
    body = np.column_stack([lower[:, 0], side * lower[:, 2], lower[:, 1]])
    belt = profile[_BELT]
    cabin = np.column_stack([belt[:, 0], side * belt[:, 2], belt[:, 1]])
    sill = _on_side(_SILL[0], _SILL[1], side, 0.86)
    shoulder = _on_side(_SHOULDER[0], _SHOULDER[1], side, 0.83)
    parts = [
        Patch(body, paint),
        Patch(cabin, drawing.lit(paint, 1.04)),
        Patch(shoulder, drawing.lit(paint, 1.16)),
        Patch(sill, drawing.lit(paint, 0.62)),
    ]
    for begin, end in ((0.07, 0.47), (0.53, 0.93)):
        parts.append(Patch(_pane(cabin, begin, end), drawing.lit(_GLASS, 1.15)))
    if near:
        parts.append(Patch(_on_side(_DOOR[0], _DOOR[1], side, 0.86), drawing.lit(paint, 0.75)))
    for x in _WHEELS_M:
        for radius, color in _WHEEL if near else _WHEEL[:2]:
            ring = np.maximum(_WHEEL_M + radius * _CIRCLE[1], 0.0 if radius <= _WHEEL_M else 0.22)
            parts.append(Patch(_on_side(x + radius * _CIRCLE[0], ring, side, 0.86), color))
    return parts


def _rear() -> list[Patch]:
    """Return lights and number plate."""
    return [
        *(Patch(_across(-2.17, y, 0.17, 0.66, 0.84), _TAIL) for y in (-0.64, 0.64)),
        Patch(_across(-2.18, 0.0, 0.26, 0.5, 0.61), _PLATE),
    ]


def _front() -> list[Patch]:
    """Return headlights, grille and number plate."""
    return [
        Patch(_across(2.12, 0.0, 0.4, 0.56, 0.66), _BUMPER),
        *(Patch(_across(2.08, y, 0.2, 0.58, 0.72), _HEADLIGHT) for y in (-0.56, 0.56)),
        Patch(_across(2.16, 0.0, 0.26, 0.36, 0.47), _PLATE),
    ]


def _across(x: float, y: float, half_width: float, low: float, high: float) -> FloatArray:
    """Return an upright rectangle (4, 3) across the car."""
    left, right = y - half_width, y + half_width
    return np.array([(x, left, low), (x, right, low), (x, right, high), (x, left, high)])


def _on_side(x: FloatArray, z: FloatArray, side: float, half_width: float) -> FloatArray:
    """Return points (k, 3) on one of the car's sides."""
    return np.column_stack([x, np.full(len(x), side * half_width), z])


def _pane(cabin: FloatArray, begin: float, end: float) -> FloatArray:
    """Return a window (4, 3) between two shares of the cabin's side."""
    rear_low, rear_high, front_high, front_low = cabin
    low, high = front_low - rear_low, front_high - rear_high
    top = [rear_high + begin * high, rear_high + end * high]
    bottom = [rear_low + begin * low, rear_low + end * low]
    rises = [(t - b) for t, b in zip(top, bottom, strict=True)]
    return np.array(
        [
            bottom[0] + 0.08 * rises[0],
            bottom[0] + 0.86 * rises[0],
            bottom[1] + 0.86 * rises[1],
            bottom[1] + 0.08 * rises[1],
        ]
    )


def _brightness(normal: FloatArray, light: FloatArray) -> float:
    return 0.62 + 0.3 * max(0.0, float(normal @ light)) + 0.16 * max(0.0, float(normal[2]))


SIGHT_M = 75.0
_HAZE_M = 260.0
_STREET_LAMP: Color = (206, 210, 212)


def objects_far_to_near(layout: Layout, view: drawing.PinholeView) -> list[StandingObject]:
    """Return the objects in front of the camera within SIGHT_M, far ones first.

    A car's distance is that of its nearest corner, so objects beside it are painted before it.
    """
    standing, corners = layout.standing
    distance = np.linalg.norm(corners - view.center_m[:2], axis=2).min(axis=1)
    rows = np.flatnonzero(distance < SIGHT_M)
    near = rows[np.argsort(-distance[rows], kind="stable")]  # signs come after their poles
    return [standing[row] for row in near if _is_ahead(standing[row], view)]


def _is_ahead(item: StandingObject, view: drawing.PinholeView) -> bool:
    """Whether an object is in front of the camera; cars are clipped at the near plane."""
    if isinstance(item, Pole):
        return bool((view.depth(np.array([item.bottom_m, item.peak_m])) > drawing.NEAR_M).all())
    if isinstance(item, Car):
        return _may_show(item, view)
    return bool(view.depth(item.middle_m) > 2 * drawing.NEAR_M)


def _may_show(car: Car, view: drawing.PinholeView) -> bool:
    """Whether the box round a car reaches into the image, or is cut by the near plane: most cars
    are behind the camera or beside the image, and their polygons take long."""
    corners = _BOX_M * car.scale @ car.rotation.T + car.middle_m
    is_ahead = view.depth(corners) > drawing.NEAR_M
    if is_ahead.all():
        return view.polygon(corners) is not None
    return bool(is_ahead.any())


def paint_object(
    image: ByteImage,
    view: drawing.PinholeView,
    item: StandingObject,
    sun: FloatArray,
    haze: Color,
) -> None:
    """Paint one object."""
    if isinstance(item, Car):
        air = air_at(view.distance(item.middle_m), haze)
        for corners, color in patches(item, view.center_m, sun):
            polygon = view.polygon(corners)
            if polygon is not None:
                drawing.fill(image, polygon, drawing.mixed(color, haze, air.haze))
    elif isinstance(item, Pole):
        _paint_pole(image, view, item, sun, haze)
    else:
        _paint_sign(image, view, item, sun, haze)


def silhouette(
    item: StandingObject, view: drawing.PinholeView, sun: FloatArray
) -> list[FloatArray]:
    """Return polygons (k, 2) in pixels that ``paint_object`` fills, without lamp arms."""
    if isinstance(item, Car):
        polygons = [view.polygon(patch.corners_m) for patch in patches(item, view.center_m, sun)]
    elif isinstance(item, Pole):
        axis = np.array([item.bottom_m, item.peak_m])
        across = np.cross(axis[1] - axis[0], view.center_m - axis[0])
        across *= item.radius_m / np.linalg.norm(across)
        polygons = [view.polygon(np.concatenate([axis - across, axis[::-1] + across]))]
    else:
        plate = outline(item.class_id)
        corners = plate[:, :1] * item.right_m - plate[:, 1:] * item.up_m
        polygons = [view.polygon(item.middle_m + corners)]
    return [polygon for polygon in polygons if polygon is not None]


def air_at(distance_m: float, haze: Color, gain: float = 1.0) -> drawing.Air:
    """Return light and haze at a distance."""
    return drawing.Air(gain, 1.0 - float(np.exp(-distance_m / _HAZE_M)), haze)


def paint_rod(
    image: ByteImage,
    view: drawing.PinholeView,
    ends_m: FloatArray,
    radius_m: float,
    color: Color,
    light: float,
) -> None:
    """Paint a round rod between two points (2, 3) of the map, if both are ahead of the camera."""
    depth = view.depth(ends_m)
    if (depth < drawing.NEAR_M).any():
        return
    near, far = radius_m * float(view.camera.K[0, 0]) / depth
    drawing.rod(image, view.project(ends_m), (float(near), float(far)), color, light)


def _paint_pole(
    image: ByteImage, view: drawing.PinholeView, pole: Pole, sun: FloatArray, haze: Color
) -> None:
    air = air_at(view.distance(pole.bottom_m), haze)
    light = float(sun @ view.T_map_camera.rotation[:, 0])
    color = drawing.mixed(pole.color, haze, air.haze)
    axis = np.array([pole.bottom_m, pole.peak_m])
    if pole.arm_m.any():
        head = pole.peak_m + pole.arm_m
        paint_rod(image, view, np.array([pole.peak_m, head]), 0.032, color, light)
        lamp = np.array([head - 0.5 * pole.arm_m / np.linalg.norm(pole.arm_m), head])
        paint_rod(image, view, lamp, 0.075, drawing.mixed(_STREET_LAMP, haze, air.haze), light)
    paint_rod(image, view, axis, pole.radius_m, color, light)


def _paint_sign(
    image: ByteImage, view: drawing.PinholeView, sign: Sign, sun: FloatArray, haze: Color
) -> None:
    right, up = sign.right_m, sign.up_m
    aspect = round(float(np.linalg.norm(right) / np.linalg.norm(up)), 2)
    if sign.look == "new":
        texture = face(sign.class_id, sign.face % 60, aspect)
    else:
        texture = worn_face(sign.look, sign.class_id, sign.face, aspect)
    facing = np.cross(right, up) / np.linalg.norm(np.cross(right, up))
    gain = 0.9 + 0.14 * max(0.0, float(facing @ sun))
    air = air_at(view.distance(sign.middle_m), haze, gain)
    drawing.stamp(image, view, texture, sign.middle_m - right + up, 2 * right, -2 * up, air)
