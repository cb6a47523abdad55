"""Camera poses from three points (P3P), compiled.

The unknowns are the depths l of the points along their rays. The law of cosines gives
l_i^2 + l_j^2 - 2 b_ij l_i l_j = a_ij; two combinations without a constant are cones. Where the
cubic determinant of the pencil they span is 0, its member is a pair of planes (Persson and
Nordberg 2018, "Lambda Twist"). The planes follow from the adjugate (Richter-Gebert 2011, section
11.1). Each plane meets a cone in up to two lines: the depths up to scale. Non-existing solutions
are NaN on the way and give no pose.
"""

from typing import TypeAlias

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.common.jit import compiled

MOST_POSES = 4
_NEWTON_STEPS = 2
Vector: TypeAlias = tuple[float, float, float]
Symmetric: TypeAlias = tuple[float, float, float, float, float, float]
"""Elements 00, 01, 02, 11, 12, 22 of a (3, 3) matrix."""


@compiled
def solve_p3p(
    ray: FloatArray, point_m: FloatArray, rotation: FloatArray, translation: FloatArray
) -> int:
    """Fill ``rotation`` (4, 3, 3) and ``translation`` (4, 3) of T_camera_map; return the count.

    ``ray`` (3, 3) holds unit rays in its rows, ``point_m`` (3, 3) the points seen along them.
    Points on a line give poses that are not finite, or none.
    """
    f0, f1, f2 = _row(ray, 0), _row(ray, 1), _row(ray, 2)
    p0, p1, p2 = _row(point_m, 0), _row(point_m, 1), _row(point_m, 2)
    edges = _difference(p1, p0), _difference(p2, p0), _difference(p2, p1)
    a = _dot(edges[0], edges[0]), _dot(edges[1], edges[1]), _dot(edges[2], edges[2])
    b = _dot(f0, f1), _dot(f0, f2), _dot(f1, f2)
    first = (a[2], -a[2] * b[0], 0.0, a[2] - a[0], a[0] * b[2], -a[0])
    second = (a[2], 0.0, -a[2] * b[1], -a[1], a[1] * b[2], a[2] - a[1])
    if abs(_determinant(second)) < abs(_determinant(first)):
        first, second = second, first
    count = 0
    for plane in _planes(_singular(first, second)):
        for direction in _directions(plane, second):
            l0, l1, l2 = _depths(direction, a, b)
            if l0 > 0.0 and l1 > 0.0 and l2 > 0.0:
                start = _scaled(f0, l0)
                across = _difference(_scaled(f1, l1), start), _difference(_scaled(f2, l2), start)
                _fill_rotation(edges[0], edges[1], across[0], across[1], rotation[count])
                for k in range(3):
                    translation[count, k] = start[k] - _dot(_row(rotation[count], k), p0)
                count += 1
    return count


@compiled
def _singular(first: Symmetric, second: Symmetric) -> Symmetric:
    """Return first + g second, g chosen so that the determinant is 0, and small."""
    adjugates = _adjugate(first), _adjugate(second)
    c = 1.0 / _determinant(second)
    g = _root(
        c * _trace(adjugates[1], first), c * _trace(adjugates[0], second), c * _determinant(first)
    )
    return (
        first[0] + g * second[0],
        first[1] + g * second[1],
        first[2] + g * second[2],
        first[3] + g * second[3],
        first[4] + g * second[4],
        first[5] + g * second[5],
    )


@compiled
def _root(b: float, c: float, d: float) -> float:
    """Return a real root of x^3 + b x^2 + c x + d: the only one, or the smallest by magnitude."""
    shift = b / 3.0
    p, q = c / 3.0 - shift * shift, 0.5 * (d - shift * c) + shift**3  # y^3 + 3 p y + 2 q
    inside = p**3 + q * q
    if inside >= 0.0:
        larger = -np.sign(q + (q == 0.0)) * np.cbrt(abs(q) + np.sqrt(inside))
        x = larger - p / larger - shift if larger != 0.0 else -shift
    else:
        radius, third = 2.0 * np.sqrt(-p), np.arccos(max(-1.0, min(1.0, -q / (-p) ** 1.5))) / 3.0
        x = radius * np.cos(third) - shift
        for turn in (2.0 * np.pi / 3.0, 4.0 * np.pi / 3.0):
            y = radius * np.cos(third + turn) - shift
            x = y if abs(y) < abs(x) else x
    for _ in range(_NEWTON_STEPS):
        slope = (3.0 * x + 2.0 * b) * x + c
        if slope != 0.0:
            x -= (((x + b) * x + c) * x + d) / slope
    return x


@compiled
def _planes(cone: Symmetric) -> tuple[Vector, Vector]:
    """Return the normals of the two planes that a singular cone consists of."""
    adjugate = _adjugate(cone)
    diagonal = -adjugate[0], -adjugate[3], -adjugate[5]
    if diagonal[0] >= diagonal[1] and diagonal[0] >= diagonal[2]:
        column = adjugate[0], adjugate[1], adjugate[2]
    elif diagonal[1] >= diagonal[2]:
        column = adjugate[1], adjugate[3], adjugate[4]
    else:
        column = adjugate[2], adjugate[4], adjugate[5]
    x, y, z = _scaled(column, 1.0 / np.sqrt(max(diagonal[0], diagonal[1], diagonal[2])))
    rows = (
        (cone[0], cone[1] - z, cone[2] + y),
        (cone[1] + z, cone[3], cone[4] - x),
        (cone[2] - y, cone[4] + x, cone[5]),
    )
    i, j, largest = 0, 0, -1.0
    for k in range(3):
        for n in range(3):
            if abs(rows[k][n]) > largest:
                i, j, largest = k, n, abs(rows[k][n])
    return rows[i], (rows[0][j], rows[1][j], rows[2][j])


@compiled
def _directions(plane: Vector, cone: Symmetric) -> tuple[Vector, Vector]:
    """Return the two directions in which a plane through the origin meets a cone."""
    size = abs(plane[0]), abs(plane[1]), abs(plane[2])
    if size[0] <= size[1] and size[0] <= size[2]:
        u = _cross(plane, (1.0, 0.0, 0.0))
    elif size[1] <= size[2]:
        u = _cross(plane, (0.0, 1.0, 0.0))
    else:
        u = _cross(plane, (0.0, 0.0, 1.0))
    u = _scaled(u, 1.0 / np.sqrt(_dot(u, u)))
    v = _cross(_scaled(plane, 1.0 / np.sqrt(_dot(plane, plane))), u)
    by_u, by_v = _product(cone, u), _product(cone, v)
    a, b, c = _dot(u, by_u), _dot(u, by_v), _dot(v, by_v)  # a s^2 + 2 b s t + c t^2
    q = -b - np.sqrt(b * b - a * c) if b > 0.0 else -b + np.sqrt(b * b - a * c)
    return _sum(_scaled(u, q), _scaled(v, a)), _sum(_scaled(u, c), _scaled(v, q))


@compiled
def _depths(direction: Vector, a: Vector, b: Vector) -> Vector:
    """Return the depths along ``direction``, improved by Newton steps on the law of cosines."""
    x, y, z = direction
    square = 2.0 * (x * x + y * y + z * z - b[0] * x * y - b[1] * x * z - b[2] * y * z)
    scale = np.sqrt((a[0] + a[1] + a[2]) / square)
    if x + y + z < 0.0:
        scale = -scale
    x, y, z = scale * x, scale * y, scale * z
    for _ in range(_NEWTON_STEPS):
        r0 = x * x + y * y - 2.0 * b[0] * x * y - a[0]
        r1 = x * x + z * z - 2.0 * b[1] * x * z - a[1]
        r2 = y * y + z * z - 2.0 * b[2] * y * z - a[2]
        # rows (xy, yx, 0), (xz, 0, zx), (0, yz, zy) of half the Jacobian
        xy, yx, xz = x - b[0] * y, y - b[0] * x, x - b[1] * z
        zx, yz, zy = z - b[1] * x, y - b[2] * z, z - b[2] * y
        determinant = -2.0 * (xy * zx * yz + yx * xz * zy)
        if determinant != 0.0:
            step = (
                (-zx * yz * r0 - yx * zy * r1 + yx * zx * r2) / determinant,
                (-xz * zy * r0 + xy * zy * r1 - xy * zx * r2) / determinant,
                (xz * yz * r0 - xy * yz * r1 - yx * xz * r2) / determinant,
            )
            x, y, z = x - step[0], y - step[1], z - step[2]
    return x, y, z


@compiled
def _fill_rotation(
    u: Vector, v: Vector, u_camera: Vector, v_camera: Vector, rotation: FloatArray
) -> None:
    """Fill ``rotation`` (3, 3), which turns the triangle u, v into that of the camera."""
    first, second = _frame(u, v), _frame(u_camera, v_camera)
    for row in range(3):
        for column in range(3):
            rotation[row, column] = (
                second[0][row] * first[0][column]
                + second[1][row] * first[1][column]
                + second[2][row] * first[2][column]
            )


@compiled
def _frame(u: Vector, v: Vector) -> tuple[Vector, Vector, Vector]:
    """Return orthonormal axes: along u, in the plane of u and v, across it."""
    across = _cross(u, v)
    x = _scaled(u, 1.0 / np.sqrt(_dot(u, u)))
    z = _scaled(across, 1.0 / np.sqrt(_dot(across, across)))
    return x, _cross(z, x), z


@compiled
def _determinant(matrix: Symmetric) -> float:
    return (
        matrix[0] * (matrix[3] * matrix[5] - matrix[4] * matrix[4])
        - matrix[1] * (matrix[1] * matrix[5] - matrix[4] * matrix[2])
        + matrix[2] * (matrix[1] * matrix[4] - matrix[3] * matrix[2])
    )


@compiled
def _adjugate(matrix: Symmetric) -> Symmetric:
    return (
        matrix[3] * matrix[5] - matrix[4] * matrix[4],
        matrix[2] * matrix[4] - matrix[1] * matrix[5],
        matrix[1] * matrix[4] - matrix[2] * matrix[3],
        matrix[0] * matrix[5] - matrix[2] * matrix[2],
        matrix[1] * matrix[2] - matrix[0] * matrix[4],
        matrix[0] * matrix[3] - matrix[1] * matrix[1],
    )


@compiled
def _trace(first: Symmetric, second: Symmetric) -> float:
    """Return the trace of the product."""
    diagonal = first[0] * second[0] + first[3] * second[3] + first[5] * second[5]
    return diagonal + 2.0 * (first[1] * second[1] + first[2] * second[2] + first[4] * second[4])


@compiled
def _product(matrix: Symmetric, v: Vector) -> Vector:
    return (
        matrix[0] * v[0] + matrix[1] * v[1] + matrix[2] * v[2],
        matrix[1] * v[0] + matrix[3] * v[1] + matrix[4] * v[2],
        matrix[2] * v[0] + matrix[4] * v[1] + matrix[5] * v[2],
    )


@compiled
def _row(matrix: FloatArray, row: int) -> Vector:
    return matrix[row, 0], matrix[row, 1], matrix[row, 2]


@compiled
def _dot(u: Vector, v: Vector) -> float:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@compiled
def _cross(u: Vector, v: Vector) -> Vector:
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@compiled
def _scaled(v: Vector, factor: float) -> Vector:
    return factor * v[0], factor * v[1], factor * v[2]


@compiled
def _sum(u: Vector, v: Vector) -> Vector:
    return u[0] + v[0], u[1] + v[1], u[2] + v[2]


@compiled
def _difference(u: Vector, v: Vector) -> Vector:
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]
