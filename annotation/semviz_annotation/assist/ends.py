"""Find where a pole visibly ends, along its axis."""

from dataclasses import replace

import numpy as np

from semviz_annotation.assist.pole import across
from semviz_annotation.assist.shot import Mark, Shot, pixel
from semviz_core.arrays import FloatArray

_STEP_PX = 0.5
_BEFORE, _AFTER = 2.0, 3.0
"""Px of pole and of what is beyond its end, that are compared."""
_SAME = 14.0
"""Levels by which the pole may differ from itself."""
_LEVELS = 20.0
"""Least difference of the two."""


def visible_end(
    shot: Shot,
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
    height, width = shot.image.shape[:2]
    if ((points < 0.0) | (points > [width - 1.0, height - 1.0])).any():
        return None
    normal = across(np.stack([other_px, end_px]))
    half = max(0.0, width_px / 2.0 - 0.75)
    beside = np.linspace(-half, half, 5)[:, None] * normal
    colors = shot.sample(points[:, None] + beside).mean(axis=1).astype(np.float64)
    body = end_px + np.linspace(0.05, 0.6, 24)[:, None] * (other_px - end_px)
    pole = np.median(shot.sample(body[:, None] + beside).mean(axis=1), axis=0)
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


def with_visible_ends(
    shot: Shot, mark: Mark, width_px: float, reach_px: float
) -> tuple[Mark, bool, bool]:
    """A pole's mark with its known ends where the pole visibly ends, and which were found so."""
    ends = mark.ends_px
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    known = (mark.anchor_known, mark.end_known)
    places = [
        visible_end(shot, ends[1 - k], ends[k], width_px, reach_px) if known[k] else None
        for k in range(2)
    ]
    moved = [0.0 if one is None else one for one in places]
    found = replace(
        mark, anchor_px=pixel(ends[0] - moved[0] * along), end_px=pixel(ends[1] + moved[1] * along)
    )
    return found, places[0] is not None, places[1] is not None


def with_visible_peak(shot: Shot, mark: Mark, width_px: float, reach_px: float) -> Mark:
    """As ``with_visible_ends``, for a pole whose place is known well: the peak alone.

    Its bottom has a shadow, a foot or grass on it, and was marked by somebody who knew.
    """
    found, *_ = with_visible_ends(shot, replace(mark, end_known=False), width_px, reach_px)
    return replace(found, end_known=mark.end_known)
