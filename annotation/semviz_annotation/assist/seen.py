"""Whether an end of a pole that a detector found is where it says: the rows there are asked too."""

from collections.abc import Sequence

import numpy as np

from semviz_annotation.assist.look import width_of
from semviz_annotation.assist.shot import Mark, Shot
from semviz_core.arrays import FloatArray
from semviz_core.measuring.rows import end_by_rows

_UNSTATED_PX = 4.0
"""Sigma along a pole where the detector does not state it."""
_ROWS_PX = 4.0
"""Sigma of where the rows of a pole may end."""
_MOST_PX = 8.0


def end_evidence(
    shots: Sequence[Shot], marks: Sequence[Mark], which: int, sigma_along_px: float | None
) -> FloatArray:
    """(2,) of a pole's peak (0) or bottom (1), which all of ``marks``, one in each of ``shots``,
    say is seen: how sure the detector is along the pole, and how far off its rows end at most."""
    off_px = max(_off_px(shot, mark, which) for shot, mark in zip(shots, marks, strict=True))
    return np.log([sigma_along_px or _UNSTATED_PX, min(off_px, _MOST_PX) + 0.5])


def _off_px(shot: Shot, mark: Mark, which: int) -> float:
    """How far from its end the rows of a pole end; 0 where too few are in the image."""
    ends = mark.ends_px
    rows = end_by_rows(shot, ends[1 - which], ends[which], width_of(shot, ends), _ROWS_PX)
    return 0.0 if rows is None else abs(rows.off_px)
