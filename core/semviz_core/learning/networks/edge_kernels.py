"""Sums over the edges of a KNN graph, compiled: edges themselves are never in memory.

Of each element ``ends`` (r, 2 c) holds the numbers it has as an anchor and those it has as a
neighbour, ``near`` (r, k) the rows of its neighbours. float32 or float64.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import IntArray
from semviz_core.compiled import compiled

Floats = NDArray[np.floating[Any]]


@compiled
def mean_of_edges(ends: Floats, near: IntArray) -> Floats:
    """(r, c) mean over q of max(0, anchor_i + neighbour_j), j = near[i, q]."""
    rows, count = near.shape
    channels = ends.shape[1] // 2
    zero, share = ends.dtype.type(0.0), ends.dtype.type(1.0 / count)
    mean = np.zeros((rows, channels), ends.dtype)
    for i in range(rows):
        for j in near[i]:
            for c in range(channels):
                edge = ends[i, c] + ends[j, channels + c]
                mean[i, c] += edge if edge > zero else zero
        for c in range(channels):
            mean[i, c] *= share
    return mean


@compiled
def slope_of_edges(ends: Floats, near: IntArray, by_mean: Floats) -> Floats:
    """(r, 2 c) the gradient by ``ends``, given that by the mean (r, c)."""
    rows, count = near.shape
    channels = ends.shape[1] // 2
    zero, share = ends.dtype.type(0.0), ends.dtype.type(1.0 / count)
    slope = np.zeros_like(ends)
    for i in range(rows):
        for j in near[i]:
            for c in range(channels):
                edge = ends[i, c] + ends[j, channels + c]
                by_edge = by_mean[i, c] * share if edge > zero else zero
                slope[i, c] += by_edge
                slope[j, channels + c] += by_edge
    return slope
