"""Paint fronts of houses, board fences and vehicles behind the elements of a crop.

They are full of upright edges (frames of windows, doors, boards, ribs), none of which is a pole,
and of lettering, which is no sign. Their sides are upright, as those of walls along a street are.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.research.training.crop_light import Floats, fractal
from semviz_core.research.training.crop_paint import any_color, lay_over, wide_and_high, window

_LEAST_PX, _MOST_PX = (30.0, 130.0), 450.0
"""Limits of a front's sides, the least being one of two: far fronts, and near ones."""
_SLANTS = 0.1, 0.25
"""Sigmas of the rise of a front's upper and lower edge, over its height."""
_BEFORE_PX = 3.0
"""Least distance of a pole's foot from the front behind it."""
_LETTERS = "ABCDEFGHIKLMNOPRSTUVWXZ0123456789"


def paint_fronts(
    image: Floats, behind: BoolArray, feet_px: FloatArray, rng: np.random.Generator
) -> BoolArray:
    """Paint some fronts where ``behind``, each seen from the front or along a street.

    A front ends above the ``feet_px`` (k, 2) of poles in its columns: they stand before it. Returns
    (height, width) where a front is painted.
    """
    height, width = behind.shape
    painted = np.zeros(behind.shape, bool)
    for _ in range(rng.integers(1, 5)):
        wide, high = wide_and_high(rng.choice(_LEAST_PX), _MOST_PX, rng)
        left, top = rng.uniform(-0.3, 0.9) * width, rng.uniform(-0.2, 0.7) * height
        slant = np.clip(rng.normal(0.0, rng.choice(_SLANTS), 2), -0.4, 0.4) * high
        lowest = high + abs(slant[1])
        before = feet_px[(feet_px[:, 0] > left) & (feet_px[:, 0] < left + wide), 1]
        if len(before):
            top += min(0.0, float(before.min()) - _BEFORE_PX - top - lowest)
        corners = np.array(
            [(0, slant[0]), (wide, -slant[0]), (wide, high + slant[1]), (0, high - slant[1])]
        )
        corners += np.array([left, top])
        part, corner = window(corners.min(axis=0), corners.max(axis=0))
        shown = behind[part]
        if min(shown.shape) < 4:
            continue
        front = _front(wide, high, rng)
        to_crop = cv2.getPerspectiveTransform(
            np.array([(0, 0), (wide, 0), (wide, high), (0, high)], np.float32) - np.float32(0.5),
            (corners - corner).astype(np.float32),
        )
        size = shown.shape[::-1]
        cover = cv2.warpPerspective(np.ones((high, wide), np.float32), to_crop, size)
        colors = cv2.warpPerspective(front, to_crop, size, borderMode=cv2.BORDER_REPLICATE)
        lay_over(image[part], (cover * shown).astype(np.float32), colors.astype(np.float32))
        painted[part] |= cover > 0.5
    return painted


def _front(wide: int, high: int, rng: np.random.Generator) -> ByteImage:
    """Return a picture (high, wide, 3) of a front of a random kind."""
    picture: ByteImage = np.full((high, wide, 3), any_color(rng), np.uint8)
    (_windows, _windows, _glass, _boards, _panels)[rng.integers(5)](picture, rng)
    if rng.random() < 0.4:
        letter(picture, rng)
    if rng.random() < 0.5:
        grain = 1.0 + rng.uniform(0.02, 0.2) * fractal(rng, (high, wide), rng.uniform(4.0, 80.0))
        picture = np.clip(picture * grain[..., None], 0, 255).astype(np.uint8)
    return picture


def _windows(picture: ByteImage, rng: np.random.Generator) -> None:
    """Paint windows and doors with frames, bars and sills, in rows and columns."""
    high, wide = picture.shape[:2]
    columns, rows = int(rng.integers(1, 7)), int(rng.integers(1, 5))
    frame, pane, sill = any_color(rng), any_color(rng) * rng.uniform(0.2, 1.0), any_color(rng)
    share = rng.uniform(0.25, 0.8, 2)
    thick = max(1, round(0.06 * share[0] * wide / columns * rng.uniform(0.3, 1.5)))
    bars = rng.integers(0, 3, 2)
    for column in range(columns):
        for row in range(rows):
            size = share * (wide / columns, high / rows)
            if row == rows - 1 and rng.random() < 0.2:  # a door
                size[1] = 0.97 * high / rows
            low = (np.array([column, row]) + 0.5) * (wide / columns, high / rows) - size / 2.0
            first, last = _point(low), _point(low + size)
            glass = pane * rng.uniform(0.5, 1.6)
            cv2.rectangle(picture, first, last, _color(glass), cv2.FILLED)
            for bar in range(1, bars[0] + 1):
                x = round(low[0] + size[0] * bar / (bars[0] + 1))
                cv2.line(picture, (x, first[1]), (x, last[1]), _color(frame), thick)
            for bar in range(1, bars[1] + 1):
                y = round(low[1] + size[1] * bar / (bars[1] + 1))
                cv2.line(picture, (first[0], y), (last[0], y), _color(frame), thick)
            cv2.rectangle(picture, first, last, _color(frame), thick)
            if rng.random() < 0.5:
                cv2.line(picture, (first[0], last[1]), last, _color(sill), thick + 1)
    if rng.random() < 0.3:  # a downpipe
        x = int(rng.integers(wide))
        cv2.line(picture, (x, 0), (x, high), _color(any_color(rng)), int(rng.integers(1, 6)))


def _glass(picture: ByteImage, rng: np.random.Generator) -> None:
    """Paint a wall of glass, or a balcony's railing: panes of many shades between thin bars."""
    high, wide = picture.shape[:2]
    columns, rows = int(rng.integers(3, 25)), int(rng.integers(1, 13))
    shades = np.clip(1.0 + rng.uniform(0.0, 0.5) * rng.standard_normal((rows, columns)), 0.1, 2.0)
    panes = any_color(rng) * shades[..., None]
    size = (wide, high)
    picture[:] = cv2.resize(np.clip(panes, 0, 255), size, interpolation=cv2.INTER_NEAREST)
    thick, bar = int(rng.integers(1, 5)), _color(any_color(rng))
    for x in np.linspace(0, wide, columns + 1).round().astype(int).tolist():
        cv2.line(picture, (x, 0), (x, high), bar, thick)
    if rng.random() < 0.7:
        for y in np.linspace(0, high, rows + 1).round().astype(int).tolist():
            cv2.line(picture, (0, y), (wide, y), bar, int(rng.integers(1, 5)))


def _boards(picture: ByteImage, rng: np.random.Generator) -> None:
    """Paint upright boards or ribs, each of another shade, with gaps."""
    wide = picture.shape[1]
    pitch = rng.uniform(3.0, 24.0)
    number = np.floor(np.arange(wide) / pitch + rng.random()).astype(int)
    shade = 1.0 + rng.uniform(0.03, 0.4) * rng.standard_normal(number.max() + 1)[number]
    if rng.random() < 0.6:  # gaps
        shade[np.flatnonzero(np.diff(number))] *= rng.uniform(0.1, 1.8)
    picture[:] = np.clip(picture * shade[None, :, None], 0, 255).astype(np.uint8)


def _panels(picture: ByteImage, rng: np.random.Generator) -> None:
    """Paint plain panels, as those of a lorry or a container: stripes, edges and shades."""
    high, wide = picture.shape[:2]
    for _ in range(rng.integers(1, 8)):
        size = wide_and_high(6.0, max(8.0, 0.8 * max(wide, high)), rng)
        first = rng.uniform(-0.2, 1.0, 2) * (wide, high)
        thick = int(rng.integers(1, 5)) if rng.random() < 0.5 else cv2.FILLED
        cv2.rectangle(picture, _point(first), _point(first + size), _color(any_color(rng)), thick)


def letter(picture: ByteImage, rng: np.random.Generator) -> None:
    """Write random letters on a picture (height, width, 3), in one to three lines."""
    high, wide = picture.shape[:2]
    for _ in range(rng.integers(1, 4)):
        text = "".join(rng.choice(list(_LETTERS), int(rng.integers(1, 12))).tolist())
        scale = float(np.exp(rng.uniform(np.log(0.25), np.log(2.0))))
        place = int(rng.integers(-wide // 4, wide)), int(rng.integers(0, high + 8))
        thick, color = int(rng.integers(1, 4)), _color(any_color(rng))
        cv2.putText(picture, text, place, int(rng.integers(0, 5)), scale, color, thick, cv2.LINE_AA)


def _point(place: FloatArray) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))


def _color(color: FloatArray | NDArray[np.float64]) -> tuple[float, float, float]:
    red, green, blue = np.clip(color, 0.0, 255.0).tolist()
    return red, green, blue
