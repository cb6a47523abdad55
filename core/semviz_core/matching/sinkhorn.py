"""Doubly normalized correspondence probabilities by matrix scaling (Sinkhorn & Knopp 1967).

With a dustbin row and column: a scaled kernel P_ij = a_i K_ij b_j whose rows and columns sum to 1
together with what falls into the dustbins, a_i and b_j. Uniform marginals without dustbins, as in
the paper's eq. 3-4, would force mass onto false pairs wherever n > m.
"""

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.compiled import compiled

TOLERANCE = 1e-7
MOST_ITERATIONS = 200
_LARGEST_NATS = 200.0  # surer pairs are as good as certain; more would overflow


@compiled
def sinkhorn_with_dustbin(log_kernel: FloatArray) -> FloatArray:
    """(m + 1, n + 1) probabilities of pairs with log-odds ``log_kernel`` (m, n) against no pair.

    -inf excludes a pair. Rows i < m and columns j < n sum to 1; the corner is 0. Both scalings move
    half way at once: taking turns converges only as 1/t where a dustbin is weak.
    """
    m, n = log_kernel.shape
    seen, mapped = np.nonzero(log_kernel > -np.inf)  # few: most pairs are impossible
    kernel = np.empty(len(seen))
    for k in range(len(seen)):
        kernel[k] = np.exp(min(log_kernel[seen[k], mapped[k]], _LARGEST_NATS))
    a, b = np.ones(m), np.ones(n)
    rows, columns = np.empty(m), np.empty(n)
    for _ in range(MOST_ITERATIONS):
        rows[:], columns[:] = a, b
        for k in range(len(seen)):
            mass = a[seen[k]] * kernel[k] * b[mapped[k]]
            rows[seen[k]] += mass
            columns[mapped[k]] += mass
        a /= np.sqrt(rows)
        b /= np.sqrt(columns)
        if max(np.abs(rows - 1.0).max(), np.abs(columns - 1.0).max()) < TOLERANCE:
            break
    return _closed(seen, mapped, kernel, a, b)


@compiled
def _closed(
    seen: IntArray, mapped: IntArray, kernel: FloatArray, a: FloatArray, b: FloatArray
) -> FloatArray:
    """The scaled kernel; what is left of the last digits goes to the dustbins."""
    m, n = len(a), len(b)
    probability = np.zeros((m + 1, n + 1))
    for k in range(len(seen)):
        probability[seen[k], mapped[k]] = a[seen[k]] * kernel[k] * b[mapped[k]]
    for i in range(m):
        probability[i, :n] /= max(probability[i, :n].sum(), 1.0)
    for j in range(n):
        probability[:m, j] /= max(probability[:m, j].sum(), 1.0)
        probability[m, j] = max(1.0 - probability[:m, j].sum(), 0.0)
    for i in range(m):
        probability[i, n] = max(1.0 - probability[i, :n].sum(), 0.0)
    return probability
