"""Faces of signs, drawn large and without light: new ones, and those of real streets.

A new face is the outline, border and pictogram of a class. Real streets also have planks, street
names, boards, house numbers and backs, with dirt and fading. They replace the new signs of a
street one by one, on the same poles.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.common.arrays import FloatArray
from semviz_core.simulation import drawing
from semviz_core.simulation.objects import Color, FloatPicture, Sign, SignLook

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


_HALF_M: dict[SignLook, tuple[tuple[float, float], tuple[float, float]]] = {
    "plank": ((0.40, 0.65), (0.07, 0.13)),
    "street name": ((0.28, 0.48), (0.06, 0.10)),
    "board": ((0.35, 0.80), (0.40, 0.85)),
    "number": ((0.10, 0.17), (0.08, 0.14)),
}
"""Ranges of half the width and half the height."""
_RECTANGULAR: tuple[SignLook, ...] = ("plank", "street name", "board", "number", "back", "faded")
_OTHERS: tuple[SignLook, ...] = ("new", "faded", "back")
_FACES = 24
"""Different faces of each look."""
_WORN_SIZE = 256

_Plate = NDArray[np.uint8]


def worn(sign: Sign, rng: np.random.Generator) -> Sign:
    """Return a worn sign in place of a new one; its size follows its look, half are plates."""
    class_id = RECTANGULAR if rng.random() < 0.5 else sign.class_id
    looks = _RECTANGULAR if class_id == RECTANGULAR else _OTHERS
    look = looks[int(rng.integers(len(looks)))]
    number = int(rng.integers(_FACES))
    right, up = sign.right_m, sign.up_m
    if look in _HALF_M:
        width, height = (rng.uniform(*limits) for limits in _HALF_M[look])
        right = right / np.linalg.norm(right) * width
        up = up / np.linalg.norm(up) * height
    changed = replace(sign, class_id=class_id, right_m=right, up_m=up)
    return replace(changed, look=look, face=number)


@cache
def worn_face(look: SignLook, class_id: int, number: int, aspect: float) -> drawing.Texture:
    """Return a face; ``number`` selects one of a look, ``aspect`` is width over height."""
    rng = np.random.default_rng([number, class_id, sorted((*_HALF_M, "back", "faded")).index(look)])
    if look == "faded":
        plate, opacity = _faded(class_id, number, aspect, rng)
    else:
        plate = np.zeros((_WORN_SIZE, round(_WORN_SIZE * aspect), 3), np.uint8)
        opacity = np.zeros(plate.shape[:2], np.float32)
        size = np.array([plate.shape[1], plate.shape[0]])
        corners = np.round((outline(class_id) + 1.0) / 2.0 * size - 0.5).astype(np.int32)
        cv2.fillPoly(opacity, [corners], 1.0)
        _PAINTERS[look](plate, rng)
    return drawing.Texture.of(_dirty(plate, rng), opacity)


def _plank(plate: _Plate, rng: np.random.Generator) -> None:
    """Paint a wooden or grey arm of a signpost, with a line of letters."""
    plate[:] = _color(rng, [(122, 96, 66), (150, 148, 140), (70, 84, 66), (196, 190, 170)])
    _letters(plate, rng, 0.34, (0.12, 0.88), bool(rng.random() < 0.5))


def _street_name(plate: _Plate, rng: np.random.Generator) -> None:
    """Paint a blue, green or white plate with a line of letters and perhaps a border."""
    plate[:] = _color(rng, [(28, 60, 132), (40, 86, 60), (230, 230, 224)])
    _letters(plate, rng, 0.45, (0.08, 0.92), plate.mean() > 150)


def _board(plate: _Plate, rng: np.random.Generator) -> None:
    """Paint an information board: a frame round a poster of blocks and lines."""
    plate[:] = _color(rng, [(70, 74, 76), (150, 152, 150), (112, 84, 58)])
    height, width = plate.shape[:2]
    border = round(rng.uniform(0.02, 0.09) * min(height, width))
    inner = plate[border : height - border, border : width - border]
    inner[:] = _color(rng, [(240, 240, 236), (222, 226, 206), (44, 66, 110)])
    for _ in range(int(rng.integers(2, 7))):
        first = (rng.uniform(0.0, 0.8, 2) * inner.shape[1::-1]).astype(int)
        last = first + (rng.uniform(0.08, 0.5, 2) * inner.shape[1::-1]).astype(int)
        block = (int(value) for value in rng.integers(0, 256, 3))
        patch = inner[first[1] : last[1], first[0] : last[0]]
        patch[:] = tuple(block)


def _number(plate: _Plate, rng: np.random.Generator) -> None:
    """Paint a house number or a small notice."""
    plate[:] = _color(rng, [(24, 56, 130), (236, 236, 230), (190, 40, 40)])
    _letters(plate, rng, 0.62, (0.28, 0.72), plate[0, 0].mean() > 150)


def _back(plate: _Plate, rng: np.random.Generator) -> None:
    """Paint a grey back with its bracket, and perhaps a sticker."""
    plate[:] = _color(rng, [(128, 130, 132), (96, 100, 102), (164, 166, 166)])
    height, width = plate.shape[:2]
    for y in (0.3, 0.7):
        row = round(y * height)
        plate[row : row + max(2, height // 24)] = plate[0, 0] * np.float64(rng.uniform(0.6, 0.9))
    if rng.random() < 0.4:
        column, row = (rng.uniform(0.2, 0.6, 2) * (width, height)).astype(int)
        sticker = plate[row : row + height // 6, column : column + width // 6]
        sticker[:] = tuple(int(value) for value in rng.integers(30, 240, 3))


_PAINTERS: dict[SignLook, Callable[[_Plate, np.random.Generator], None]] = {
    "plank": _plank,
    "street name": _street_name,
    "board": _board,
    "number": _number,
    "back": _back,
}


def _faded(
    class_id: int, number: int, aspect: float, rng: np.random.Generator
) -> tuple[_Plate, FloatPicture]:
    """Return a sign whose colours have faded towards grey, and its opacity."""
    colors, opacity = face(class_id, number, aspect).levels[0]
    grey = np.array(_color(rng, [(150, 150, 144), (112, 116, 104)]))
    share = rng.uniform(0.25, 0.75)
    return np.asarray(colors + share * (grey - colors), dtype=np.uint8), opacity


def _dirty(plate: _Plate, rng: np.random.Generator) -> FloatPicture:
    """Return a plate with stains and streaks."""
    height, width = plate.shape[:2]
    stains = sum(
        cv2.resize(
            rng.standard_normal((n, n)) / 2.0, (width, height), interpolation=cv2.INTER_CUBIC
        )
        for n in (3, 6, 12, 24)
    )
    gain = 1.0 + rng.uniform(0.02, 0.16) * np.asarray(stains)[..., None]
    return np.clip(plate * gain, 0.0, 255.0).astype(np.float32)


def _letters(
    plate: _Plate,
    rng: np.random.Generator,
    height: float,
    span: tuple[float, float],
    is_dark: bool,
) -> None:
    """Paint a row of strokes, like letters at a distance, in a share of the plate's height."""
    rows, columns = plate.shape[:2]
    top, bottom = round((0.5 - height / 2.0) * rows), round((0.5 + height / 2.0) * rows)
    ink = (24, 24, 26) if is_dark else (238, 238, 234)
    x, end = round(span[0] * columns), round(rng.uniform(0.6, 1.0) * span[1] * columns)
    pitch = max(4, round(0.55 * height * rows))
    while x < end:
        first, last = sorted(rng.integers(top, bottom, 2).tolist())
        plate[top:bottom, x : x + max(1, pitch // 5)] = ink
        plate[first : first + max(1, rows // 20), x : x + pitch // 2] = ink
        plate[last : last + max(1, rows // 20), x : x + pitch // 2] = ink
        x += round(pitch * rng.uniform(0.8, 1.5))


def _color(rng: np.random.Generator, colors: list[Color]) -> Color:
    """Return one of the colours, a little lighter or darker."""
    return drawing.lit(colors[int(rng.integers(len(colors)))], float(rng.uniform(0.8, 1.15)))
