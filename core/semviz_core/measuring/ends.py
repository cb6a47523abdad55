"""Find where a pole visibly ends, along its axis."""

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.measuring.picture import Picture
from semviz_core.measuring.pole import across

_STEP_PX = 0.5
_BEFORE, _AFTER = 2.0, 3.0
"""Px of pole and of what is beyond its end, that are compared."""
_SAME = 14.0
"""Levels by which the pole may differ from itself."""
_LEVELS = 20.0
"""Least difference of the two."""


def visible_end(
    picture: Picture,
    other_px: FloatArray,
    end_px: FloatArray,
    width_px: float,
    reach_px: float,
) -> float | None:
    """How far beyond ``end_px`` (px; negative: before it) a pole ends that begins at ``other_px``.

    None where its colour does not clearly give way to another, once, within ``reach_px``.
    """
    length = float(np.linalg.norm(end_px - other_px))
    most = min(reach_px, 0.3 * length)
    reach = most + _BEFORE + _AFTER
    at = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
    along = (end_px - other_px) / length
    points = end_px + at[:, None] * along
    height, width = picture.image.shape[:2]
    if ((points < 0.0) | (points > [width - 1.0, height - 1.0])).any():
        return None
    normal = across(np.stack([other_px, end_px]))
    half = max(0.0, width_px / 2.0 - 0.75)
    beside = np.linspace(-half, half, 5)[:, None] * normal
    colors = picture.sample(points[:, None] + beside).mean(axis=1).astype(np.float64)
    body = end_px + np.linspace(0.05, 0.6, 24)[:, None] * (other_px - end_px)
    pole = np.median(picture.sample(body[:, None] + beside).mean(axis=1), axis=0)
    off = np.sqrt(((colors - pole) ** 2).mean(axis=1))
    inner, outer = int(_BEFORE / _STEP_PX), int(_AFTER / _STEP_PX)
    sums = np.concatenate([[0.0], np.cumsum(off)])
    split = np.arange(inner, len(at) - outer + 1)  # the end is before this sample
    before = (sums[split] - sums[split - inner]) / inner
    after = (sums[split + outer] - sums[split]) / outer
    step = after - before
    best = int(np.argmax(step))
    if before[best] > _SAME or step[best] < _LEVELS:
        return None
    again = (np.abs(split - split[best]) > outer) & (before < _SAME)
    if again.any() and step[again].max() > 0.6 * step[best]:
        return None
    first, last = split[best] - inner, split[best] + outer
    beyond = np.median(colors[split[best] + 1 : last], axis=0) - pole
    share = np.clip((colors[first:last] - pole) @ beyond / (beyond @ beyond), 0.0, 1.0)
    place = float(at[last - 1] + 0.5 * _STEP_PX - share.sum() * _STEP_PX)
    return place if abs(place) <= most else None
