"""What a pole or a sign looks like in one image, to be compared with another."""

import numpy as np

from semviz_annotation.assist.shot import Mark, Shot, pixel
from semviz_core.arrays import FloatArray
from semviz_core.classes import ElementClass
from semviz_core.measuring.outline import find_outlines
from semviz_core.measuring.picture import Samples
from semviz_core.measuring.pole import across, find_axes

_ROWS, _COLUMNS = 24, 11
_BESIDE_PX = 1.5
_SIGN = 13
_HIDDEN_ROWS = 2
"""Of a pole's look, at one end: fewer may be unlike for a shadow."""
_LEVELS = 20.0
"""Mean difference of colours at which a row counts less than half."""
LIKENESS: FloatArray = np.array([1.0, 1.0, -0.3])
"""How much each measure of ``likeness`` counts where places are compared."""


def pole_points(ends_px: FloatArray, width_px: float) -> FloatArray:
    """(rows, columns, 2) of a pole and a little beside it."""
    share = (np.arange(_ROWS) + 0.5) / _ROWS
    offsets = np.linspace(-1.0, 1.0, _COLUMNS) * (width_px / 2.0 + _BESIDE_PX)
    points = ends_px[0] + share[:, None] * (ends_px[1] - ends_px[0])
    return np.asarray(points[:, None] + offsets[:, None] * across(ends_px))


def sign_points(middle_px: FloatArray, half_px: FloatArray) -> FloatArray:
    """(n, n, 2) of a sign and a little beside it."""
    place = np.linspace(-1.15, 1.15, _SIGN)
    return np.asarray(middle_px + np.stack(np.meshgrid(place, place), axis=-1) * half_px)


def pole_look(shot: Shot, ends_px: FloatArray, width_px: float) -> Samples:
    return shot.sample(pole_points(ends_px, width_px))


def likeness(one: Samples, others: Samples) -> FloatArray:
    """(d, 3) of looks (rows, columns, 3) and (d, rows, columns, 3): their normalized correlation,
    the share of rows that are alike, and the logarithm of the typical difference of colours."""
    a = one.reshape(-1) - one.mean()
    b = others.reshape(len(others), -1)
    b = b - b.mean(axis=1, keepdims=True)
    correlation = (b @ a) / (np.linalg.norm(a) * np.linalg.norm(b, axis=1) + 1e-3)
    difference = np.abs(others - one).mean(axis=(2, 3))
    alike = 1.0 / (1.0 + (difference / _LEVELS) ** 2)
    middle = slice(one.shape[1] // 3, one.shape[1] - one.shape[1] // 3)
    colors = np.abs(others[:, :, middle] - one[:, middle]).mean(axis=(2, 3))
    typical = np.log(np.median(colors, axis=1) + 2.0)
    return np.stack([correlation, alike.mean(axis=1), typical], axis=1).astype(np.float64)


def seen_rows(one: Samples, other: Samples) -> tuple[float, float]:
    """From where to where a pole's looks (rows, columns, 3) are alike, as shares of its length.

    0 and 1 where nothing hides its ends: at an end all rows must be unlike, and all others alike.
    """
    middle = slice(one.shape[1] // 3, one.shape[1] - one.shape[1] // 3)
    difference = np.abs(other[:, middle] - one[:, middle]).mean(axis=(1, 2))
    alike = 1.0 / (1.0 + (difference / _LEVELS) ** 2) - 0.5
    return _unlike(alike) / len(one), 1.0 - _unlike(alike[::-1]) / len(one)


def _unlike(alike: FloatArray) -> int:
    """How many of the first rows are unlike (negative), if the others are alike."""
    split = np.concatenate([[0.0], -np.cumsum(alike)])  # what the first n speak for
    count = int(np.argmax(split))
    rest = alike[count:]
    return count if count >= _HIDDEN_ROWS and len(rest) and rest.mean() > 0.15 else 0


def width_of(shot: Shot, ends_px: FloatArray) -> float:
    """A marked pole's width, px; 3 where its edges are not clear."""
    key = Mark(pixel(ends_px[0]), pixel(ends_px[1]))
    if key not in shot.sizes:
        axes = find_axes(shot, ends_px, 1.5, 1)
        shot.sizes[key] = np.clip([axes[0].width_px if axes else 3.0], 1.0, 40.0)
    return float(shot.sizes[key][0])


def half_of(shot: Shot, middle_px: FloatArray, element_class: ElementClass) -> FloatArray:
    """(2,) half a marked sign's width and height, px; 8 where its outline is not clear."""
    key = Mark(pixel(middle_px))
    if key not in shot.sizes:
        found = find_outlines(shot, middle_px, element_class.shape, 2)
        near = [one for one in found if np.linalg.norm(one.middle_px - middle_px) < 3.0]
        shot.sizes[key] = np.clip(near[0].half_px if near else np.array([8.0, 8.0]), 3.0, 60.0)
    return shot.sizes[key]
