"""Parked cars as polygons in the map: few enough to paint, enough to hide what is behind."""

from typing import NamedTuple

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.sources.street.brushes import lit
from semviz_core.sources.street.things import Car, Color


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
_LAMP: Color = (226, 230, 232)
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


def patches(car: Car, center_m: FloatArray, sun: FloatArray) -> list[Patch]:
    """What a camera at ``center_m`` (3,) sees of a car, in the order to paint it."""
    R = car.rotation
    eye, light = R.T @ (center_m - car.middle_m) / car.scale, R.T @ sun
    side = 1.0 if eye[1] > 0 else -1.0
    near = float(np.linalg.norm(eye)) < _DETAIL_M
    model = [
        *_strips(car, eye, light),
        *_side(car, side, light, near),
        *(_rear() if eye[0] < 0 else _front()),
    ]
    corners = np.concatenate([one.corners_m for one in model]) * car.scale @ R.T + car.middle_m
    parts = np.split(corners, np.cumsum([len(one.corners_m) for one in model])[:-1])
    return [Patch(part, one.color) for part, one in zip(parts, model, strict=True)]


def _profile(car: Car) -> FloatArray:
    return _HATCHBACK if car.hatchback else _SEDAN


def _strips(car: Car, eye: FloatArray, light: FloatArray) -> list[Patch]:
    """Bumpers, bonnet, windscreens and roof: what spans the car's width; the far ones first."""
    profile = _profile(car)
    paint = car.color
    colors = (_BUMPER, paint, paint, _GLASS, paint, _GLASS, paint, paint, _BUMPER)
    found: list[tuple[float, Patch]] = []
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
                found.append((distance + 0.01, Patch(corners, lit(paint, gain))))
                corners, gain = middle + 0.86 * (corners - middle), 1.35 * gain
            found.append((distance, Patch(corners, lit(color, gain))))
    return [patch for _, patch in sorted(found, key=lambda one: -one[0])]


def _side(car: Car, side: float, light: FloatArray, near: bool) -> list[Patch]:
    """Doors, windows and wheels of the side in sight."""
    profile = _profile(car)
    paint = lit(car.color, _brightness(np.array([0.0, side * 0.97, 0.2]), light))
    lower = np.concatenate([profile[:4], profile[6:]])
    body = np.column_stack([lower[:, 0], side * lower[:, 2], lower[:, 1]])
    belt = profile[_BELT]
    cabin = np.column_stack([belt[:, 0], side * belt[:, 2], belt[:, 1]])
    sill = _on_side(_SILL[0], _SILL[1], side, 0.86)
    shoulder = _on_side(_SHOULDER[0], _SHOULDER[1], side, 0.83)
    found = [
        Patch(body, paint),
        Patch(cabin, lit(paint, 1.04)),
        Patch(shoulder, lit(paint, 1.16)),
        Patch(sill, lit(paint, 0.62)),
    ]
    for begin, end in ((0.07, 0.47), (0.53, 0.93)):
        found.append(Patch(_pane(cabin, begin, end), lit(_GLASS, 1.15)))
    if near:
        found.append(Patch(_on_side(_DOOR[0], _DOOR[1], side, 0.86), lit(paint, 0.75)))
    for x in _WHEELS_M:
        for radius, color in _WHEEL if near else _WHEEL[:2]:
            ring = np.maximum(_WHEEL_M + radius * _CIRCLE[1], 0.0 if radius <= _WHEEL_M else 0.22)
            found.append(Patch(_on_side(x + radius * _CIRCLE[0], ring, side, 0.86), color))
    return found


def _rear() -> list[Patch]:
    """Lights and number plate."""
    return [
        *(Patch(_across(-2.17, y, 0.17, 0.66, 0.84), _TAIL) for y in (-0.64, 0.64)),
        Patch(_across(-2.18, 0.0, 0.26, 0.5, 0.61), _PLATE),
    ]


def _front() -> list[Patch]:
    """Headlights, grille and number plate."""
    return [
        Patch(_across(2.12, 0.0, 0.4, 0.56, 0.66), _BUMPER),
        *(Patch(_across(2.08, y, 0.2, 0.58, 0.72), _LAMP) for y in (-0.56, 0.56)),
        Patch(_across(2.16, 0.0, 0.26, 0.36, 0.47), _PLATE),
    ]


def _across(x: float, y: float, half_width: float, low: float, high: float) -> FloatArray:
    """(4, 3) upright rectangle that faces along the car."""
    left, right = y - half_width, y + half_width
    return np.array([(x, left, low), (x, right, low), (x, right, high), (x, left, high)])


def _on_side(x: FloatArray, z: FloatArray, side: float, half_width: float) -> FloatArray:
    """(k, 3) points on one of the car's sides."""
    return np.column_stack([x, np.full(len(x), side * half_width), z])


def _pane(cabin: FloatArray, begin: float, end: float) -> FloatArray:
    """(4, 3) window between two shares of the cabin's side (rear belt, roof, roof, front belt)."""
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
