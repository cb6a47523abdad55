"""The ends of a pole along its axis: where they are visible, or as in another image.

A detected end counts as seen only if the image rows there support it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz_annotation.assist.appearance import SIMILARITY_WEIGHTS, pole_width, similarity
from semviz_annotation.assist.marked_image import Mark, MarkedImage, pixel
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.pole_axis import across
from semviz_core.subpixel.pole_ends import end_by_rows, grown_end, visible_end
from semviz_core.subpixel.sampling import Samples

_STEP_PX = 0.5
_ROUND_PX = 6.0
"""Length of the patch around an end, on the pole and beyond it."""
_APART_PX = 1.0
"""Largest difference between the displacements of both ends."""
_BESIDE_PX = 2.0
_ASIDE, _ASIDE_PX = 0.02, 1.0
"""A pole is followed past its end with a line that is off by so much per px, and at its end."""
_CLEAR = 0.1
"""The best position must exceed the similarity of all that are not next to it by this much."""


def with_visible_ends(
    image: MarkedImage, mark: Mark, width_px: float, reach_px: float
) -> tuple[Mark, bool, bool]:
    """Return a pole's mark with known ends moved to its visible ends, and which ends were found."""
    ends = mark.ends_px
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    known = (mark.anchor_known, mark.end_known)
    places = [
        visible_end(image, ends[1 - k], ends[k], width_px, reach_px) if known[k] else None
        for k in range(2)
    ]
    moved = [0.0 if place is None else place for place in places]
    moved_mark = replace(
        mark, anchor_px=pixel(ends[0] - moved[0] * along), end_px=pixel(ends[1] + moved[1] * along)
    )
    return moved_mark, places[0] is not None, places[1] is not None


def align_ends(
    source: MarkedImage,
    target: MarkedImage,
    marked: Mark,
    candidate: Mark,
    width_px: float,
    sigma_px: float,
) -> tuple[Mark, int]:
    """Return the pole ``candidate`` in ``target`` with its ends aligned to ``marked`` in
    ``source``.

    Ends move along the pole only, by about ``sigma_px``, both by about the same amount. An end
    stays if the match is not clear, or if it is not known in both. ``width_px`` is the width in
    ``target``. Also return how many known ends of ``candidate`` stayed.
    """
    ends = candidate.ends_px
    known = (
        marked.anchor_known and candidate.anchor_known,
        marked.end_known and candidate.end_known,
    )
    count = int(np.ceil(np.clip(2.5 * sigma_px, 1.5, 12.0) / _STEP_PX))
    shifts = np.asarray(np.arange(-count, count + 1) * _STEP_PX, dtype=np.float64)
    fits = np.zeros((2, len(shifts)))
    scale = _length_px(marked.ends_px) / _length_px(ends)
    for k in [k for k in range(2) if known[k]]:
        points = _end_points(marked.ends_px, k, width_px * scale, scale, np.zeros(1))[0]
        fits[k] = _fits(source.sample(points), target, _end_points(ends, k, width_px, 1.0, shifts))
    prior = np.asarray(-0.5 * (shifts / (3.0 * sigma_px)) ** 2, dtype=np.float64)
    common = shifts[int(np.argmax(fits.sum(axis=0) + prior))]
    along = (ends[1] - ends[0]) / _length_px(ends)
    stayed = int(candidate.anchor_known) + int(candidate.end_known)
    for k in [k for k in range(2) if known[k]]:
        moved = _clear_peak(shifts, fits[k] + prior, common)
        if moved is not None:
            ends[k] += moved * along
            stayed -= 1
    return replace(candidate, anchor_px=pixel(ends[0]), end_px=pixel(ends[1])), stayed


def _length_px(ends_px: FloatArray) -> float:
    return float(np.linalg.norm(ends_px[1] - ends_px[0]))


def _fits(patch: Samples, target: MarkedImage, points: FloatArray) -> FloatArray:
    """Return the weighted similarity (n,) of a patch (rows, columns, 3) to n places of points."""
    patches = target.sample(points.reshape(-1, *points.shape[2:]))
    return similarity(patch, patches.reshape(len(points), *patch.shape)) @ SIMILARITY_WEIGHTS


def _clear_peak(shifts: FloatArray, fit: FloatArray, near: float) -> float | None:
    """Return the interpolated maximum of (n,) values near a position; None if it is not clear."""
    at = int(np.argmax(np.where(np.abs(shifts - near) <= _APART_PX, fit, -np.inf)))
    elsewhere = fit[np.abs(shifts - shifts[at]) > _BESIDE_PX]
    if not 0 < at < len(shifts) - 1 or fit[at] - elsewhere.max(initial=-np.inf) < _CLEAR:
        return None
    low, mid, high = fit[at - 1 : at + 2]
    if mid < max(low, high):  # no local maximum: the values still rise
        return None
    return float(shifts[at] + 0.5 * _STEP_PX * (low - high) / min(low + high - 2.0 * mid, -1e-9))


def _end_points(
    ends_px: FloatArray, k: int, width_px: float, scale: float, shifts: FloatArray
) -> FloatArray:
    """Return sample points (shifts, rows, columns, 2) around an end, shifted along the pole."""
    along = (ends_px[1] - ends_px[0]) / np.linalg.norm(ends_px[1] - ends_px[0])
    rows = (np.linspace(-_ROUND_PX, _ROUND_PX, 13) * scale + shifts[:, None])[..., None, None]
    columns = np.linspace(-1.0, 1.0, 7)[:, None] * (width_px / 2.0 + 1.0 * scale)
    return np.asarray(ends_px[k] + rows * along + columns * across(ends_px))


_LEAST_LONGER = (8.0, 0.15)
"""A pole goes on beyond an end by so many px, and by this share of its length, or not at all."""
_LEAST_GAIN, _MOST_FALL = 15.0, -1.5
"""Log-odds of the rows beyond the end, and those of a row after the new end."""


def longer(image: MarkedImage, mark: Mark, width_px: float) -> Mark:
    """Return a pole's mark with the ends beyond which the image shows more of it moved there.

    Of 440 visible ends of KITTI 02 and streets none is moved; of poles cut in half 45 to 77 % get
    their end.
    """
    ends = mark.ends_px
    along = (ends[1] - ends[0]) / _length_px(ends)
    aside = min(_ASIDE, _ASIDE_PX / _length_px(ends))
    known = [mark.anchor_known, mark.end_known]
    moved = ends.copy()
    for k, direction in enumerate((-along, along)):
        beyond = grown_end(image, ends[1 - k], ends[k], width_px, aside)
        least = max(_LEAST_LONGER[0], _LEAST_LONGER[1] * _length_px(ends))
        clear = beyond.gain > _LEAST_GAIN and beyond.fall < _MOST_FALL
        if clear and beyond.off_px > least:
            moved[k] = ends[k] + beyond.off_px * direction
            known[k] = True
    return Mark(pixel(moved[0]), pixel(moved[1]), known[0], known[1])


_UNSTATED_PX = 4.0
"""Default sigma along a pole, for detectors that state none."""
_ROWS_PX = 4.0
"""Prior sigma of the position where the rows of a pole end."""
_MOST_PX = 8.0


def end_evidence(
    images: Sequence[MarkedImage], marks: Sequence[Mark], which: int, sigma_along_px: float | None
) -> FloatArray:
    """Return evidence (2,) that a pole's peak (0) or bottom (1) is seen in each of ``images``.

    Logarithms of the detector's sigma along the pole, and of the largest distance of the end of the
    pole's rows from the marked end.
    """
    off_px = max(_off_px(image, mark, which) for image, mark in zip(images, marks, strict=True))
    return np.log([sigma_along_px or _UNSTATED_PX, min(off_px, _MOST_PX) + 0.5])


def _off_px(image: MarkedImage, mark: Mark, which: int) -> float:
    """Return the distance of the end of a pole's rows from its end; 0 if too few are visible."""
    ends = mark.ends_px
    rows = end_by_rows(image, ends[1 - which], ends[which], pole_width(image, ends), _ROWS_PX)
    return 0.0 if rows is None else abs(rows.off_px)
