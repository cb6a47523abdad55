"""Compiled linear algebra for matrices of a few rows.

A call into LAPACK would take longer than the arithmetic itself.
"""

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.common.jit import compiled, compiled_leaf


@compiled_leaf
def cholesky(matrix: FloatArray, size: int) -> bool:
    """Replace the lower triangle of ``matrix[:size, :size]`` by its Cholesky factor.

    Return False if the matrix is not positive definite.
    """
    for row in range(size):
        for column in range(row + 1):
            total = matrix[row, column]
            for k in range(column):
                total -= matrix[row, k] * matrix[column, k]
            if row == column:
                if not total > 0.0:
                    return False
                matrix[row, row] = np.sqrt(total)
            else:
                matrix[row, column] = total / matrix[column, column]
    return True


@compiled_leaf
def solve_cholesky(factor: FloatArray, vector: FloatArray) -> None:
    """Replace ``vector`` (s,) by the solution of L L^T x = vector, L the lower triangle."""
    size = len(vector)
    for row in range(size):
        for k in range(row):
            vector[row] -= factor[row, k] * vector[k]
        vector[row] /= factor[row, row]
    for row in range(size - 1, -1, -1):
        for k in range(row + 1, size):
            vector[row] -= factor[k, row] * vector[k]
        vector[row] /= factor[row, row]


@compiled
def rotate_left(R: FloatArray, t: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the pose (R, t) moved by the left perturbation ``step`` (6,): metres, then radians.

    First order in the translation, exact in the rotation (Rodrigues).
    """
    x, y, z = step[3], step[4], step[5]
    angle = np.sqrt(x * x + y * y + z * z)
    a, b = 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0
    if angle > 1e-4:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    turn = np.empty((3, 3))
    turn[0, 0] = 1.0 - b * (y * y + z * z)
    turn[0, 1] = b * x * y - a * z
    turn[0, 2] = b * x * z + a * y
    turn[1, 0] = b * x * y + a * z
    turn[1, 1] = 1.0 - b * (x * x + z * z)
    turn[1, 2] = b * y * z - a * x
    turn[2, 0] = b * x * z - a * y
    turn[2, 1] = b * y * z + a * x
    turn[2, 2] = 1.0 - b * (x * x + y * y)
    new_R, new_t = np.zeros((3, 3)), np.empty(3)
    for row in range(3):
        new_t[row] = step[row]
        for k in range(3):
            new_t[row] += turn[row, k] * t[k]
            for column in range(3):
                new_R[row, column] += turn[row, k] * R[k, column]
    return new_R, new_t


@compiled
def inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a (6, 6) matrix; zeros if the matrix is not positive definite."""
    factor, out = matrix.copy(), np.zeros((6, 6))
    if cholesky(factor, 6):
        for column in range(6):
            out[column, column] = 1.0
            solve_cholesky(factor, out[column])
    return out
