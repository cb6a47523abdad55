"""How the elements of a map fared in a run: how often each was used, and how well it fitted."""

from dataclasses import dataclass

import numpy as np

from semviz.recording.run import Run
from semviz_core.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Usage:
    """Of the n elements of a run's map."""

    times: IntArray
    """(n,) in how many frames the answer rests on it."""
    residual_px: FloatArray
    """(n,) median length of its residuals in those frames; NaN where there are none."""


def usage_of(run: Run) -> Usage:
    """Counts the pairs that fit, over all frames."""
    ids = run.semantic_map.elements.id
    order = np.argsort(ids)
    used, sizes = _pairs(run)
    rows = order[np.searchsorted(ids, used, sorter=order)]
    times = np.bincount(rows, minlength=len(ids)).astype(np.int64)
    residual_px = np.full(len(ids), np.nan)
    by_row = np.argsort(rows, kind="stable")
    starts = np.cumsum(times) - times
    for row in np.flatnonzero(times):
        own = by_row[starts[row] : starts[row] + times[row]]
        residual_px[row] = np.median(sizes[own])
    return Usage(times, residual_px)


def _pairs(run: Run) -> tuple[IntArray, FloatArray]:
    """Map element's id and length of the residual (px) of every pair that fits."""
    ids, sizes = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
    for one in run.localizations:
        fine = one.refinement
        if fine is not None:
            ids.append(one.submap.id[fine.pairs[fine.inlier, 1]])
            sizes.append(np.sqrt(np.nansum(fine.residual_px[fine.inlier] ** 2, axis=1)))
    return np.concatenate(ids), np.concatenate(sizes)
