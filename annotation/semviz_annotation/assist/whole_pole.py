"""The whole pole under one point: its axis, and both ends where the image shows them.

A short part around the point gives the axis; the pole is then followed up and down. Each longer
part gives a better axis, so that the ends are followed again.
"""

from dataclasses import replace

import numpy as np

from semviz_annotation.assist.marked_image import Mark, MarkedImage, clip_to_image, pixel
from semviz_annotation.assist.pole_ends import with_visible_ends
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.snap import CLEAR, Snap, best_snap
from semviz_core.base.classes import ElementClass
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.pole_axis import Axis
from semviz_core.subpixel.pole_ends import WEIGHTS, row_evidence
from semviz_core.subpixel.pole_fit import refine_axis

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
_SHORTEST_PX = 12.0


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
            [_followed(image, ends[1], ends[0], width), _followed(image, ends[0], ends[1], width)]
        )
        axis = refine_axis(image, Axis(ends, width, np.zeros(0), 0.0))
        width, ends = axis.width_px, axis.ends_px
    whole = clip_to_image(Mark(pixel(ends[0]), pixel(ends[1])), ends, image.view.camera)
    on_ends, _, _ = with_visible_ends(image, whole, width, _REACH_PX)
    if np.linalg.norm(on_ends.ends_px[1] - on_ends.ends_px[0]) < _SHORTEST_PX:
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


def _followed(
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
