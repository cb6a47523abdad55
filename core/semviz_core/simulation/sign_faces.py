"""Faces of new signs, drawn large and without light: outline, border and pictogram of a class."""

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.common.arrays import FloatArray
from semviz_core.simulation import drawing
from semviz_core.simulation.objects import Color

RED: Color = (196, 24, 36)
BLUE: Color = (22, 78, 160)
WHITE: Color = (244, 244, 242)
BLACK: Color = (26, 26, 28)
YELLOW: Color = (246, 200, 30)

_SIZE = 512  # drawn large, then downsampled to smooth the edges

Face = NDArray[np.uint8]


@cache
def outline(class_id: int) -> FloatArray:
    """Return the outline (n, 2) of a class's plate in [-1, 1], x right, y down."""
    if class_id == TRIANGULAR:
        return np.array([[0.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    if class_id == RECTANGULAR:
        return np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


@cache
def face(class_id: int, number: int, aspect: float) -> drawing.Texture:
    """Return a face of a class; ``number`` selects it, ``aspect`` is width over height."""
    draw = {TRIANGULAR: _triangular, RECTANGULAR: _rectangular, ROUNDED: _rounded}[class_id]
    plate = np.zeros((_SIZE, round(_SIZE * aspect), 3), np.uint8)
    opacity = np.zeros(plate.shape[:2], np.uint8)
    cv2.fillPoly(opacity, [_px(outline(class_id), opacity)], 255)
    draw(plate, number)
    size = (plate.shape[1] // 4, plate.shape[0] // 4)
    return drawing.Texture.of(
        drawing.halved(plate, size), drawing.halved(opacity, size) / np.float32(255.0)
    )


def _triangular(plate: Face, number: int) -> None:
    """Draw a warning sign: red border, white field, black pictogram."""
    plate[:] = RED
    _polygon(plate, outline(TRIANGULAR) * 0.68 + [0.0, 0.14], WHITE)
    if number % 4 == 0:  # danger
        _polygon(plate, [(-0.09, -0.3), (0.09, -0.3), (0.05, 0.38), (-0.05, 0.38)], BLACK)
        _disc(plate, (0.0, 0.56), 0.09, BLACK)
    elif number % 4 == 1:  # bend
        _stroke(plate, [(-0.12, 0.66), (-0.12, 0.3), (0.12, 0.12), (0.12, -0.2)], 0.14, BLACK)
    elif number % 4 == 2:  # crossing
        _stroke(plate, [(-0.24, 0.6), (0.24, 0.05)], 0.13, BLACK)
        _stroke(plate, [(0.24, 0.6), (-0.24, 0.05)], 0.13, BLACK)
    else:  # pedestrian
        _disc(plate, (0.02, -0.12), 0.09, BLACK)
        _stroke(plate, [(0.0, 0.02), (-0.02, 0.34), (0.16, 0.66)], 0.1, BLACK)
        _stroke(plate, [(-0.02, 0.34), (-0.2, 0.66)], 0.1, BLACK)
        _stroke(plate, [(-0.2, 0.2), (0.0, 0.08), (0.2, 0.24)], 0.07, BLACK)


def _rectangular(plate: Face, number: int) -> None:
    """Draw a square (parking, crossing), tall (one-way) or wide (place name) sign."""
    shape = plate.shape[1] / plate.shape[0]
    plate[:] = WHITE
    if shape > 1.25:
        plate[:] = BLACK
        _frame(plate, 0.04, YELLOW)
        name = ("LINDEN", "AUDORF", "BRUECK", "MOHNAU")[number % 4]
        _text(plate, name, (0.0, -0.28), 0.36, BLACK)
        for width, y in ((0.66, 0.28), (0.44, 0.56)):
            _stroke(plate, [(-width, y), (width, y)], 0.09, BLACK)
    elif shape < 0.8:
        _frame(plate, 0.05, BLUE)
        _stroke(plate, [(0.0, 0.66), (0.0, -0.2)], 0.24, WHITE)
        _polygon(plate, [(0.0, -0.72), (0.56, -0.1), (-0.56, -0.1)], WHITE)
    elif number % 2:
        _frame(plate, 0.05, BLUE)
        _text(plate, "P", (0.0, 0.0), 1.25, WHITE)
    else:
        _frame(plate, 0.05, BLUE)
        _polygon(plate, [(0.0, -0.72), (0.74, 0.66), (-0.74, 0.66)], WHITE)
        _disc(plate, (0.02, -0.22), 0.11, BLACK)
        _stroke(plate, [(0.0, -0.06), (0.0, 0.2), (0.2, 0.56)], 0.11, BLACK)
        _stroke(plate, [(0.0, 0.2), (-0.22, 0.56)], 0.11, BLACK)


def _rounded(plate: Face, number: int) -> None:
    """Draw a speed limit, no entry, no stopping, or a mandatory direction."""
    plate[:] = WHITE
    _disc(plate, (0.0, 0.0), 0.97, RED)
    choice = number % 5
    if choice < 2:
        _disc(plate, (0.0, 0.0), 0.72, WHITE)
        _text(plate, ("30", "50", "70")[number // 5 % 3], (0.0, 0.0), 0.72, BLACK)
    elif choice == 2:
        _polygon(plate, [(-0.68, -0.18), (0.68, -0.18), (0.68, 0.18), (-0.68, 0.18)], WHITE)
    elif choice == 3:
        _disc(plate, (0.0, 0.0), 0.76, BLUE)
        _stroke(plate, [(-0.52, -0.52), (0.52, 0.52)], 0.2, RED)
        _stroke(plate, [(0.52, -0.52), (-0.52, 0.52)], 0.2, RED)
    else:
        _disc(plate, (0.0, 0.0), 0.95, BLUE)
        _stroke(plate, [(0.0, 0.6), (0.0, -0.1)], 0.22, WHITE)
        _polygon(plate, [(0.0, -0.7), (0.42, -0.1), (-0.42, -0.1)], WHITE)


def _px(points: FloatArray, plate: Face) -> NDArray[np.int32]:
    """Return the pixels of points in [-1, 1]."""
    size = np.array([plate.shape[1], plate.shape[0]])
    return np.asarray(np.round((np.asarray(points) + 1.0) / 2.0 * size - 0.5), dtype=np.int32)


def _polygon(plate: Face, points: FloatArray | list[tuple[float, float]], color: Color) -> None:
    cv2.fillPoly(plate, [_px(np.asarray(points), plate)], color)


def _disc(plate: Face, middle: tuple[float, float], radius: float, color: Color) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    _polygon(plate, np.array(middle) + radius * ring, color)


def _stroke(plate: Face, points: list[tuple[float, float]], width: float, color: Color) -> None:
    line = [_px(np.array(points), plate)]
    thickness = max(1, round(width * plate.shape[0] / 2))
    cv2.polylines(plate, line, False, color, thickness)


def _frame(plate: Face, width: float, color: Color) -> None:
    """Fill all but a border with one colour."""
    border = round(width * plate.shape[0])
    plate[border:-border, border:-border] = color


def _text(plate: Face, text: str, middle: tuple[float, float], height: float, color: Color) -> None:
    """Draw centred capitals of a height, in units of half the plate's height."""
    pixels = height * plate.shape[0] / 2
    thickness = max(1, round(pixels / 6))
    scale = pixels / 21.0
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
    x, y = _px(np.array([middle]), plate)[0]
    origin = (int(x - width / 2), int(y + pixels / 2))
    cv2.putText(plate, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, color, thickness)
