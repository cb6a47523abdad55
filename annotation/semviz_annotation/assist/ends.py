"""Find where a pole ends, along its axis: where it visibly does, or looks as in another image."""

from dataclasses import replace

import numpy as np

from semviz_annotation.assist.look import LIKENESS, likeness
from semviz_annotation.assist.shot import Mark, Shot, pixel
from semviz_core.arrays import FloatArray
from semviz_core.measuring.ends import visible_end
from semviz_core.measuring.picture import Samples
from semviz_core.measuring.pole import across

_STEP_PX = 0.5
_ROUND_PX = 6.0
"""Px of pole, and of what is beyond, by which an end is known again."""
_APART_PX = 1.0
"""How differently both ends may be off."""
_BESIDE_PX = 2.0
_CLEAR = 0.1
"""By this much the best place must be more like it than all that are not beside it."""


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


def same_ends(
    here: Shot, there: Shot, marked: Mark, found: Mark, width_px: float, sigma_px: float
) -> tuple[Mark, int]:
    """A pole that was ``found`` with its ends where they look as ``marked`` in ``here``.

    Along the pole only, by about ``sigma_px``, both about alike, and where that is clear: an end
    that is not known in both stays. ``width_px`` is the pole's there. Also how many of the ends
    that were found as known stayed.
    """
    ends = found.ends_px
    known = (marked.anchor_known and found.anchor_known, marked.end_known and found.end_known)
    count = int(np.ceil(np.clip(2.5 * sigma_px, 1.5, 12.0) / _STEP_PX))
    shifts = np.asarray(np.arange(-count, count + 1) * _STEP_PX, dtype=np.float64)
    fits = np.zeros((2, len(shifts)))
    scale = _length_px(marked.ends_px) / _length_px(ends)
    for k in [k for k in range(2) if known[k]]:
        points = _end_points(marked.ends_px, k, width_px * scale, scale, np.zeros(1))[0]
        fits[k] = _fits(here.sample(points), there, _end_points(ends, k, width_px, 1.0, shifts))
    prior = np.asarray(-0.5 * (shifts / (3.0 * sigma_px)) ** 2, dtype=np.float64)
    both = shifts[int(np.argmax(fits.sum(axis=0) + prior))]
    along = (ends[1] - ends[0]) / _length_px(ends)
    stayed = int(found.anchor_known) + int(found.end_known)
    for k in [k for k in range(2) if known[k]]:
        moved = _clear_peak(shifts, fits[k] + prior, both)
        if moved is not None:
            ends[k] += moved * along
            stayed -= 1
    return replace(found, anchor_px=pixel(ends[0]), end_px=pixel(ends[1])), stayed


def _length_px(ends_px: FloatArray) -> float:
    return float(np.linalg.norm(ends_px[1] - ends_px[0]))


def _fits(look: Samples, there: Shot, points: FloatArray) -> FloatArray:
    """(n,) how like a look (rows, columns, 3) the places (n, rows, columns, 2) are."""
    looks = there.sample(points.reshape(-1, *points.shape[2:]))
    return likeness(look, looks.reshape(len(points), *look.shape)) @ LIKENESS


def _clear_peak(shifts: FloatArray, fit: FloatArray, near: float) -> float | None:
    """Where (n,) values are largest near a place, between the steps; None where it is not clear."""
    at = int(np.argmax(np.where(np.abs(shifts - near) <= _APART_PX, fit, -np.inf)))
    others = fit[np.abs(shifts - shifts[at]) > _BESIDE_PX]
    if not 0 < at < len(shifts) - 1 or fit[at] - others.max(initial=-np.inf) < _CLEAR:
        return None
    low, mid, high = fit[at - 1 : at + 2]
    if mid < max(low, high):  # it rises on, away from that place
        return None
    return float(shifts[at] + 0.5 * _STEP_PX * (low - high) / min(low + high - 2.0 * mid, -1e-9))


def _end_points(
    ends_px: FloatArray, k: int, width_px: float, scale: float, shifts: FloatArray
) -> FloatArray:
    """(shifts, rows, columns, 2) round an end, each place moved along the pole."""
    along = (ends_px[1] - ends_px[0]) / np.linalg.norm(ends_px[1] - ends_px[0])
    rows = (np.linspace(-_ROUND_PX, _ROUND_PX, 13) * scale + shifts[:, None])[..., None, None]
    columns = np.linspace(-1.0, 1.0, 7)[:, None] * (width_px / 2.0 + 1.0 * scale)
    return np.asarray(ends_px[k] + rows * along + columns * across(ends_px))
