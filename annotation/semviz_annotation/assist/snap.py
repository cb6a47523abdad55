"""Move a mark to the edges under it: a pole's axis and ends, a sign's centre, or a whole pole.

An end is moved along the axis to where it is visible, or as in another image. A detected end
counts as seen only if the image rows there support it.

Of a whole pole only one point is given. A short part around it gives the axis; the pole is then
followed up and down. Each longer part gives a better axis, so that the ends are followed again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.assist.appearance import SIMILARITY_WEIGHTS, pole_width, similarity
from semviz_annotation.assist.marked_image import Mark, MarkedImage, clip_to_image, pixel
from semviz_annotation.assist.score import probability
from semviz_annotation.labels.views import PosedView
from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, ElementClass
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.pole_axis import Axis, across, edge_support, find_axes, stripe
from semviz_core.subpixel.pole_ends import (
    WEIGHTS,
    end_by_rows,
    row_evidence,
    visible_end,
)
from semviz_core.subpixel.pole_fit import refine_axis
from semviz_core.subpixel.sampling import Samples
from semviz_core.subpixel.sign_outline import Outline, find_outlines

_STEP_PX = 0.5
_ROUND_PX = 6.0
"""Length of the patch around an end, on the pole and beyond it."""
_APART_PX = 1.0
"""Largest difference between the displacements of both ends."""
_BESIDE_PX = 2.0
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


REACH_PX = 4.0
"""The largest error of a click across a pole."""
CLEAR = 0.6
"""Below this probability a mark stays where it was clicked."""
_SHORTEST_PX = 8.0
_THIN_PX, _DIFFERS = 4.0, 0.35
"""A thinner line must differ from both sides in this share of its rows."""
_AXES = 3
"""Candidates for a pole's axis that are tried, the likeliest first, until one is clear."""
_LARGEST_SHIFT = 0.75
"""Largest distance of a sign's centre from the click, in half sizes of the sign."""


@dataclass(frozen=True)
class Snapped:
    """A mark moved onto the edges in the image."""

    mark: Mark
    moved_px: float
    """Largest displacement of an end."""
    anchor_snapped: bool
    """Whether the peak was also found along the pole; always True for signs."""
    end_snapped: bool


@dataclass(frozen=True, eq=False)
class Snap:
    """A candidate for a snapped mark, with its evidence."""

    snapped: Snapped
    evidence: FloatArray
    size_px: float
    """A pole's width, or half a sign's mean width and height."""


def snap(
    image: MarkedImage, mark: Mark, element_class: ElementClass, reach_px: float = REACH_PX
) -> Snapped | None:
    """Return ``mark`` moved onto the edges in the image; None if they are not clear.

    A pole's ends move across to its axis, by at most ``reach_px``. Known ends also move along it to
    its visible end, if that is clear. A sign's centre is found from a click on its face; its class
    gives its shape, and the image what the middle of a triangle is.
    """
    candidate = best_snap(image, mark, element_class, reach_px)
    what = "snap pole" if mark.end_px is not None else "snap sign"
    if candidate is None or probability(what, candidate.evidence) < CLEAR:
        return None
    return candidate.snapped


def best_snap(
    image: MarkedImage, mark: Mark, element_class: ElementClass, reach_px: float = REACH_PX
) -> Snap | None:
    """Return the candidate of ``snap``, whatever its probability."""
    if mark.end_px is not None:
        return _pole(image, mark, reach_px)
    return _sign(image, mark, element_class)


def warm_up() -> None:
    """Compile what a snap runs, or load it from disk, by snapping to a drawn pole and signs."""
    size = 240
    camera = Camera(size, size, np.array([[size, 0.0, 120.0], [0.0, size, 120.0], [0.0, 0.0, 1.0]]))
    rgb = np.full((size, size, 3), 200, np.uint8)
    rgb[40:200, 40:48] = rgb[105:135, 135:165] = 40
    image = MarkedImage.of(PosedView(camera, Pose.identity()), rgb)
    for element_class in DEFAULT_CLASSES:
        is_line = element_class.kind == "line"
        mark = Mark((44.5, 42.0), (44.5, 198.0)) if is_line else Mark((150.5, 119.5))
        snap(image, mark, element_class)


def _pole(image: MarkedImage, mark: Mark, reach_px: float) -> Snap | None:
    marked = mark.ends_px
    if np.linalg.norm(marked[1] - marked[0]) < _SHORTEST_PX:
        return None
    best: Snap | None = None
    most = 0.0
    axes = find_axes(image, marked, reach_px, _AXES + 1)
    for axis in axes[:_AXES]:
        others = [other.score for other in axes if other is not axis]
        found = _on_axis(image, mark, axis, max(others, default=axis.score - 5.0), reach_px)
        clear = 0.0 if found is None else probability("snap pole", found.evidence)
        if clear > most:
            best, most = found, clear
        if most >= CLEAR:
            break
    return best


def _on_axis(
    image: MarkedImage, mark: Mark, found: Axis, next_score: float, reach_px: float
) -> Snap | None:
    """Return a pole on a candidate for its axis; None if it is too far, or only one edge."""
    marked = mark.ends_px
    axis = refine_axis(image, found)
    moved = np.linalg.norm(axis.ends_px - marked, axis=1)
    if moved.max() > reach_px + 1.0:
        return None
    differs = stripe(image, axis.ends_px, axis.width_px)
    if axis.width_px < _THIN_PX and differs < _DIFFERS:
        return None
    margin = found.score - next_score
    drift = np.abs(axis.ends_px - found.ends_px).max()
    evidence = np.array(
        [
            *edge_support(image, axis.ends_px, axis.width_px), differs, np.clip(margin, 0.0, 3.0),
            moved.max() / reach_px, drift, np.log(axis.width_px),
            np.log(np.linalg.norm(marked[1] - marked[0])),
        ]
    )  # fmt: skip
    across = replace(mark, anchor_px=pixel(axis.ends_px[0]), end_px=pixel(axis.ends_px[1]))
    snapped, peak, foot = with_visible_ends(image, across, axis.width_px, reach_px)
    furthest = float(np.linalg.norm(snapped.ends_px - marked, axis=1).max())
    return Snap(Snapped(snapped, furthest, peak, foot), evidence, axis.width_px)


def _sign(image: MarkedImage, mark: Mark, element_class: ElementClass) -> Snap | None:
    around = [
        outline
        for outline in find_outlines(image, mark.ends_px[0], element_class.shape)
        if _off_center(image, outline, mark) <= _LARGEST_SHIFT
    ]
    if not around:
        return None
    best, *others = around
    middle = best.middle_px(image.triangle_center)
    margins = [
        best.score - outline.score
        for outline in others
        if np.linalg.norm(outline.middle_px(image.triangle_center) - middle) > 1.0
    ]
    evidence = np.array(
        [*best.evidence[1:], best.score, min([5.0, *margins]), _off_center(image, best, mark)]
    )
    moved = replace(mark, anchor_px=pixel(middle))
    snapped = Snapped(moved, float(np.linalg.norm(middle - mark.ends_px[0])), True, False)
    return Snap(snapped, evidence, float(best.half_px.mean()))


def _off_center(image: MarkedImage, outline: Outline, mark: Mark) -> float:
    """Return how far a mark is from an outline's middle, in half sizes."""
    shift = outline.middle_px(image.triangle_center) - mark.ends_px[0]
    return float(np.abs(shift / outline.half_px).max())


POINTER_PX = 5.0
"""Largest distance of the point from the pole."""
_PARTS_PX = ((-24.0, 24.0), (-4.0, 44.0), (-44.0, 4.0))
"""Where the first part begins and ends, below the point: it may be in the middle or at an end."""
_PIECE_PX, _GAP_PX = 24.0, 6.0
"""Rows that are examined at once; a pole is followed over a gap of so many."""
_MOST_PIECES = 20
_PAST_BORDER_PX = 2.0
_TIMES = 3
"""The axis is fitted anew to the longer part, and followed on."""
_BACKGROUND = -2.5
"""Log-odds of a row beside a pole."""
_CLEAR_ROW = 3.0
"""Largest log-odds of one row: neighbouring rows are not independent."""
_REACH_PX = 4.0
_SHORTEST_WHOLE_PX = 12.0


def whole_pole(image: MarkedImage, point_px: FloatArray, pole: ElementClass) -> Mark | None:
    """Return the pole of class ``pole`` under a point (2,); None if none is clear.

    Ends at the border of the image are cut off.
    """
    first = _first_part(image, point_px, pole)
    if first is None:
        return None
    width, part = first.size_px, first.snapped.mark.ends_px
    step = part[1] - part[0]
    ends = np.stack([part[0] + step / 3.0, part[1] - step / 3.0])
    for _ in range(_TIMES):
        ends = np.stack(
            [
                follow_pole(image, ends[1], ends[0], width),
                follow_pole(image, ends[0], ends[1], width),
            ]
        )
        axis = refine_axis(image, Axis(ends, width, np.zeros(0), 0.0))
        width, ends = axis.width_px, axis.ends_px
    whole = clip_to_image(Mark(pixel(ends[0]), pixel(ends[1])), ends, image.view.camera)
    on_ends, _, _ = with_visible_ends(image, whole, width, _REACH_PX)
    if np.linalg.norm(on_ends.ends_px[1] - on_ends.ends_px[0]) < _SHORTEST_WHOLE_PX:
        return None
    return on_ends


def _first_part(image: MarkedImage, point_px: FloatArray, pole: ElementClass) -> Snap | None:
    """Return the clearest part of a pole near a point."""
    best, most = None, CLEAR
    for part in _PARTS_PX:
        ends = point_px + np.array([[0.0, part[0]], [0.0, part[1]]])
        mark = clip_to_image(Mark((0.0, 0.0), None, False, False), ends, image.view.camera)
        if mark.end_px is None or not image.view.camera.contains(mark.ends_px).all():
            continue
        mark = replace(mark, anchor_known=False, end_known=False)
        found = best_snap(image, mark, pole, POINTER_PX)
        clear = 0.0 if found is None else probability("snap pole", found.evidence)
        if clear > most:
            best, most = found, clear
    return best


def follow_pole(
    image: MarkedImage, inner_px: FloatArray, end_px: FloatArray, width_px: float
) -> FloatArray:
    """Return the end (2,) of a pole that is followed from ``inner_px`` on beyond ``end_px``.

    Piece by piece, since light and background change along a pole. What a row of the pole looks
    like is told by the rows before.
    """
    along = (end_px - inner_px) / np.linalg.norm(end_px - inner_px)
    end = end_px
    for _ in range(_MOST_PIECES):
        off, evidence = row_evidence(image, end - _PIECE_PX * along, end, width_px, _PIECE_PX)
        odds = WEIGHTS[0] + evidence @ WEIGHTS[1:]
        before = odds[off <= 0.0]
        if len(off) and off[-1] < 1.0:
            return np.asarray(end + _PAST_BORDER_PX * along)
        if not len(before):
            break
        least = min(0.5 * (float(np.median(before)) + _BACKGROUND), 0.0)
        gain = np.cumsum(np.clip(odds[off > 0.0] - least, -_CLEAR_ROW, _CLEAR_ROW))
        if gain.max() <= 0.0:
            break
        rows = int(np.argmax(gain)) + 1
        end = end + rows * along
        if rows < _PIECE_PX - _GAP_PX:
            break
    return np.asarray(end)
