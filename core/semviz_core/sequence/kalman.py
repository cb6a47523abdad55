"""Kalman's update in plain loops.

The products are so small that the threads of BLAS cost ten times what they save.
"""

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.sequence.rows import PairRows


def kalman_update(
    covariance: FloatArray, rows: PairRows, element: IntArray, around: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The step (6 + 6k,) that ``rows`` ask for, and the covariance after them.

    ``element`` (p,): which of the k elements in the state each pair is of. ``around`` (6 + 6k,):
    the step at which the rows were linearized.
    """
    return _absorbed(
        covariance, rows.used, rows.residual_px, rows.by_pose, rows.by_element, rows.variance_px2,
        6 + 6 * element, around,
    )  # fmt: skip


@compiled
def _absorbed(
    covariance: FloatArray,
    used: BoolArray,
    residual: FloatArray,
    by_pose: FloatArray,
    by_element: FloatArray,
    variance: FloatArray,
    first: IntArray,
    around: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Row after row, as their noise is independent: each knows what those before it told."""
    P, size = covariance.copy(), len(covariance)
    step, column = np.zeros(size), np.empty(size)
    for pair in range(len(first)):
        at = first[pair]
        for row in range(4):
            if not used[pair, row]:
                continue
            pose, own = by_pose[pair, row], by_element[pair, row]
            for i in range(size):
                column[i] = 0.0
                for k in range(6):
                    column[i] += P[i, k] * pose[k] + P[i, at + k] * own[k]
            off, expected = residual[pair, row], variance[pair, row]
            for k in range(6):
                off += pose[k] * (step[k] - around[k]) + own[k] * (step[at + k] - around[at + k])
                expected += pose[k] * column[k] + own[k] * column[at + k]
            for i in range(size):
                gain = column[i] / expected
                step[i] -= gain * off
                for j in range(size):
                    P[i, j] -= gain * column[j]
    return step, P
