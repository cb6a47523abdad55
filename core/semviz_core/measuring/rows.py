"""Find where a pole ends by what its rows look like: edges on both sides, and its colour between.

Every row near the end tells a little of whether the pole is still there; the end is where the sum
of what speaks for the rows before it, and against those beyond, is largest.
"""

from typing import NamedTuple

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.measuring.picture import Picture
from semviz_core.measuring.pole import STEP_PX, across, edge_votes

_SAME = 14.0
"""Levels by which a row's colour counts as half the pole's."""
_APART_PX = 3.0
"""Ends further apart than this are two."""
_FEWEST = 4
_MOST_SHARE = 0.4
"""Of a pole's length, that its end may be before where it was thought to be."""
WEIGHTS = np.array([-3.5281, 2.2309, 2.1028, 3.3147])
"""Log-odds of a row of the pole: constant, weaker and stronger edge, colour. Fitted on simulated
streets with seeds from 20_000 by ``python bench/measure.py --fit``."""


class RowsEnd(NamedTuple):
    """Where the rows of a pole end."""

    off_px: float
    """Beyond the end that was thought of; negative: before it."""
    margin: float
    """Log-odds by which the place excels all that are not beside it."""


def end_by_rows(
    picture: Picture,
    other_px: FloatArray,
    end_px: FloatArray,
    width_px: float,
    sigma_px: float,
    hidden: bool = False,
) -> RowsEnd | None:
    """Near the end of a pole that begins at ``other_px``; ``sigma_px`` is how far off that may be.

    ``hidden``: something covers the pole before that end, so it is not looked for there. None
    where the image has too few rows to tell.
    """
    off, evidence = row_evidence(picture, other_px, end_px, width_px, 2.5 * sigma_px)
    if hidden:
        off, evidence = off[off > 0.0], evidence[off > 0.0]
    if len(off) < _FEWEST:
        return None
    odds = WEIGHTS[0] + evidence @ WEIGHTS[1:]
    total = np.concatenate([[0.0], np.cumsum(odds)])
    places = np.append(off - 0.5, off[-1] + 0.5)
    total = total - 0.5 * (places / sigma_px) ** 2
    best = int(np.argmax(total))
    others = total[np.abs(places - places[best]) > _APART_PX]
    return RowsEnd(float(places[best]), float(total[best] - others.max(initial=-np.inf)))


def row_evidence(
    picture: Picture, other_px: FloatArray, end_px: FloatArray, width_px: float, reach_px: float
) -> tuple[FloatArray, FloatArray]:
    """Rows (n,), px beyond the end, that lie in the image, and of each (n, 3): votes of its weaker
    and its stronger edge, and how much of the pole's colour it has."""
    length = float(np.linalg.norm(end_px - other_px))
    along = (end_px - other_px) / length
    off = np.arange(-round(min(reach_px, _MOST_SHARE * length)), round(reach_px) + 1.0)
    points = end_px + off[:, None] * along
    height, width = picture.image.shape[:2]
    inside = ((points > -0.5) & (points < [width - 0.5, height - 0.5])).all(axis=1)
    off, points = off[inside], points[inside]
    half = width_px / 2.0 + 4.0
    beside = np.arange(-half, half + STEP_PX / 2, STEP_PX)
    normal = across(np.stack([other_px, end_px]))
    if len(off) < 2:
        return off, np.zeros((len(off), 3))
    strip = picture.sample(points[:, None] + beside[:, None] * normal)
    edge = edge_votes(strip)
    sides = [
        edge[:, np.abs(beside - at) <= 0.75].max(axis=1) for at in (-width_px / 2, width_px / 2)
    ]
    inner = np.abs(beside) <= max(0.3, width_px / 2.0 - 0.75)
    body = end_px + np.linspace(0.2, 0.7, 16)[:, None] * (other_px - end_px)
    level = picture.sample(body[:, None] + beside[inner][:, None] * normal).mean(axis=1)
    gone = ((strip[:, inner].mean(axis=1) - np.median(level, axis=0)) ** 2).mean(axis=1)
    same = 1.0 / (1.0 + gone / _SAME**2)
    return off, np.stack([np.minimum(*sides), np.maximum(*sides), same], axis=1)
