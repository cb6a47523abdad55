"""Doubly normalized correspondence probabilities by matrix scaling (Sinkhorn & Knopp 1967).

With a dustbin row and column: a scaled kernel P_ij = a_i K_ij b_j whose rows and columns sum to 1
together with what falls into the dustbins, a_i and b_j. Uniform marginals without dustbins, as in
the paper's eq. 3-4, would force mass onto false pairs wherever n > m.
"""

import numpy as np

from semviz_core.arrays import FloatArray

TOLERANCE = 1e-7
MOST_ITERATIONS = 200


def sinkhorn_with_dustbin(log_kernel: FloatArray) -> FloatArray:
    """(m + 1, n + 1) probabilities of pairs with log-odds ``log_kernel`` (m, n) against no pair.

    -inf excludes a pair. Rows i < m and columns j < n sum to 1; the corner is 0. Both scalings move
    half way at once, in logs: taking turns converges only as 1/t where a dustbin is weak.
    """
    m, n = log_kernel.shape
    extended = np.zeros((m + 1, n + 1))
    extended[:m, :n] = log_kernel
    a, b = np.zeros(m + 1), np.zeros(n + 1)
    for _ in range(MOST_ITERATIONS):
        row_error = _log_sum(extended[:m] + b, axis=1) + a[:m]
        column_error = _log_sum(extended[:, :n] + a[:, None], axis=0) + b[:n]
        a[:m] -= 0.5 * row_error
        b[:n] -= 0.5 * column_error
        worst = max(np.abs(row_error).max(initial=0.0), np.abs(column_error).max(initial=0.0))
        if worst < TOLERANCE:
            break
    inner = np.exp(log_kernel + a[:m, None] + b[None, :n])
    # what is left of the last digits goes to the dustbins
    inner /= np.maximum(inner.sum(axis=1, keepdims=True), 1.0)
    inner /= np.maximum(inner.sum(axis=0, keepdims=True), 1.0)
    probability = np.zeros((m + 1, n + 1))
    probability[:m, :n] = inner
    probability[:m, n] = np.maximum(1.0 - inner.sum(axis=1), 0.0)
    probability[m, :n] = np.maximum(1.0 - inner.sum(axis=0), 0.0)
    return probability


def _log_sum(values: FloatArray, axis: int) -> FloatArray:
    """log(sum(exp)); scipy's is as exact and ten times slower on small arrays."""
    top = values.max(axis=axis, keepdims=True)  # finite: the dustbin's entry always is
    total: FloatArray = np.log(np.exp(values - top).sum(axis=axis)) + np.squeeze(top, axis=axis)
    return total
