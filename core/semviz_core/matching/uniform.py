"""The paper's transport (eq. 3-4) of one frame: uniform priors, no dustbins.

By Sinkhorn's scaling, which serves for costs up to 2 and mu = 0.1; ``learning.transport`` is the
same for batches, with gradients.
"""

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.compiled import compiled

MU = 0.1
"""Weight of the entropy in eq. 3."""
TOLERANCE = 1e-9
"""Converged when no row's total is off by a larger part; columns are exact."""
MOST_SWEEPS = 5000


def uniform_transport(cost: FloatArray, possible: BoolArray, mu: float = MU) -> FloatArray:
    """(m, n) the P of ``cost`` (m, n); 0 for pairs that are not ``possible`` (m, n).

    Those are blocks in which every row goes with every column: classes, or all. The P of each block
    sums to 1.
    """
    P = np.zeros(cost.shape)
    left: BoolArray = np.asarray(possible.any(axis=1))
    while left.any():
        columns = np.flatnonzero(possible[np.argmax(left)])
        rows = np.flatnonzero(possible[:, columns[0]])
        block = np.ix_(rows, columns)
        P[block] = _scaled(np.exp(cost[block] / -mu))
        left[rows] = False
    return P


@compiled
def _scaled(kernel: FloatArray) -> FloatArray:
    m, n = kernel.shape
    a, b = np.full(m, 1.0 / m), np.full(n, 1.0 / n)
    for _ in range(MOST_SWEEPS):
        b[:] = 1.0 / (n * (a @ kernel))
        totals = kernel @ b
        if np.abs(a * totals * m - 1.0).max() < TOLERANCE:
            break
        a[:] = 1.0 / (m * totals)
    return a[:, None] * kernel * b
