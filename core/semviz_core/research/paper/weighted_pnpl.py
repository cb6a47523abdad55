"""Weighted PnPL (eq. 6-7) to second order, for many frames, and the optimum's gradient by P.

The objective is that of `semviz_core.localization.matched.p3p_ransac`. Its L-BFGS needs some
fifty evaluations; Newton's method with the exact Hessian needs about six, and the gradient of
the optimum needs that Hessian anyway. Where the slope g is 0 and stays 0, d pose = -H^-1 dg
(Gould et al. 2021). Tangents are left perturbations of T_camera_map.

The sums over i and j of eq. 7 are large but simple: points are summed over i first, since f_p
is linear in the rays. Arrays may have leading frame axes. Lines have a lower end of their own;
all other elements have theirs at the anchor.
"""

from typing import NamedTuple, TypeAlias

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.common.jit import compiled
from semviz_core.common.linalg import cholesky, rotate_left, solve_cholesky

ITERATIONS = 50
STEP_TOLERANCE = 1e-6
"""Converged if the step (m or rad) is smaller; each Newton step squares the error."""
LEAST_CURVATURE = 1e-7
"""Least curvature of the objective (1/m^2 or 1/rad^2) for weights that sum to 1. Below, the optimum
moves by metres if a hundred-thousandth of the weights changes."""
_MOST_DAMPING, _LITTLE_DAMPING, _LEAST_DAMPING = 1e8, 1e-4, 1e-9
_ROUNDING = 1e-14  # of costs, relative to the sum of the weights
_LEAST_SINE2 = 1e-12  # of a line's plane and a point at right angles to it, as in ``p3p_ransac``
_TINY_M = 1e-9
Vector: TypeAlias = tuple[float, float, float]


class Weighted(NamedTuple):
    """The sums of eq. 7 for b frames with up to m observed and n mapped elements; weights >= 0."""

    ray: FloatArray  # (b, m, 3) f
    point_m: FloatArray  # (b, n, 3) p
    point_weight: FloatArray  # (b, m, n) P_p
    normal: FloatArray  # (b, m, 3) unit f x v_2d
    line_point_m: FloatArray  # (b, n, 3) p + v_3d
    line_weight: FloatArray  # (b, m, n) P_l


class Optimum(NamedTuple):
    """The optimal poses; the start pose where not ``ok``."""

    rotation: FloatArray  # (b, 3, 3)
    translation: FloatArray  # (b, 3)
    hessian: FloatArray  # (b, 6, 6)
    ok: BoolArray  # (b,) converged to a minimum that the weights fix
    iterations: IntArray  # (b,)


@compiled
def minimize_weighted(sums: Weighted, rotation: FloatArray, translation: FloatArray) -> Optimum:
    """Minimize eq. 6 from poses (b, 3, 3) and (b, 3)."""
    b = len(rotation)
    optimum = Optimum(
        rotation.copy(),
        translation.copy(),
        np.zeros((b, 6, 6)),
        np.zeros(b, np.bool_),
        np.zeros(b, np.int64),
    )
    for k in range(b):
        terms = _terms(sums, k)
        total = terms.point_weight.sum() + terms.line_weight.sum()
        if not 0.0 < total < np.inf:  # NaN is not
            continue
        R, t, converged, optimum.iterations[k] = _minimized(terms, rotation[k], translation[k])
        if not converged:
            continue
        local = _new_local()
        _evaluate(terms, R, t, local)
        optimum.ok[k] = np.linalg.eigvalsh(local.hessian)[0] > LEAST_CURVATURE * total
        if optimum.ok[k]:
            optimum.rotation[k], optimum.translation[k], optimum.hessian[k] = R, t, local.hessian
    return optimum


@compiled
def weight_gradient(
    sums: Weighted, optimum: Optimum, by_pose: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the gradients (b, m, n) by the weights of points and of lines.

    ``by_pose`` (b, 6) is the gradient by the left perturbation of the optimum. Gradients are 0 for
    optima that are not ok.
    """
    by_point, by_line = np.zeros_like(sums.point_weight), np.zeros_like(sums.line_weight)
    for k in range(len(by_pose)):
        if not optimum.ok[k]:
            continue
        factor, move = optimum.hessian[k].copy(), -by_pose[k]
        cholesky(factor, 6)
        solve_cholesky(factor, move)
        R, t = optimum.rotation[k], optimum.translation[k]
        for j in range(sums.point_m.shape[1]):
            x, y, z, distance, a, b, c = _moved(sums.point_m[k, j], R, t, move)
            for i in range(sums.ray.shape[1]):
                f = sums.ray[k, i]
                by_point[k, i, j] = -(f[0] * a + f[1] * b + f[2] * c) / distance
            x, y, z, distance, a, b, c = _moved(sums.line_point_m[k, j], R, t, move)
            for i in range(sums.normal.shape[1]):
                n = sums.normal[k, i]
                sine = n[0] * x + n[1] * y + n[2] * z
                norm = np.sqrt(max(1.0 - sine * sine, _LEAST_SINE2))
                along = (n[0] * a + n[1] * b + n[2] * c) / distance
                by_line[k, i, j] = sine / norm * along
    return by_point, by_line


class _Terms(NamedTuple):
    """The sums of a frame, without terms of weight 0."""

    point_m: FloatArray  # (p, 3)
    point_weight: FloatArray  # (p,) summed over i
    ray: FloatArray  # (p, 3) sum of P_ij f_i
    line_point_m: FloatArray  # (l, 3)
    first: IntArray  # (l + 1,) the first pair of each line point, and the end of the last
    normal: FloatArray  # (pairs, 3)
    line_weight: FloatArray  # (pairs,)


@compiled
def _terms(sums: Weighted, k: int) -> _Terms:
    weight = sums.point_weight[k].sum(axis=0)
    points = np.flatnonzero(weight)
    ray = sums.point_weight[k].T[points] @ sums.ray[k]
    mapped, seen = np.nonzero(sums.line_weight[k].T)
    first = np.flatnonzero(np.append(np.array([True]), mapped[1:] != mapped[:-1])[: len(mapped)])
    line_weight = np.empty(len(seen))
    for pair in range(len(seen)):
        line_weight[pair] = sums.line_weight[k, seen[pair], mapped[pair]]
    return _Terms(
        sums.point_m[k][points],
        weight[points],
        ray,
        sums.line_point_m[k][mapped[first]],
        np.append(first, len(mapped)),
        sums.normal[k][seen],
        line_weight,
    )


class _Local(NamedTuple):
    """The objective about a pose, to second order in the left perturbation."""

    slope: FloatArray  # (6,)
    hessian: FloatArray  # (6, 6)
    scale: FloatArray  # (6,) positive, of the size of the Hessian's diagonal


@compiled
def _new_local() -> _Local:
    return _Local(np.zeros(6), np.zeros((6, 6)), np.zeros(6))


@compiled
def _minimized(
    terms: _Terms, R: FloatArray, t: FloatArray
) -> tuple[FloatArray, FloatArray, bool, int]:
    """Run Newton's method, damped if the Hessian is indefinite or the cost rises."""
    local, trial = _new_local(), _new_local()
    cost, damping = _evaluate(terms, R, t, local), 1e-3
    rounding = _ROUNDING * (terms.point_weight.sum() + terms.line_weight.sum())
    for iteration in range(1, ITERATIONS + 1):
        factor, step = local.hessian.copy(), -local.slope
        for k in range(6):
            factor[k, k] += damping * local.scale[k]
        if cholesky(factor, 6):
            solve_cholesky(factor, step)
            new_R, new_t = rotate_left(R, t, step)
            if np.abs(step).max() < STEP_TOLERANCE and damping < _LITTLE_DAMPING:
                return new_R, new_t, True, iteration
            new = _evaluate(terms, new_R, new_t, trial)
            if new <= cost + rounding:
                R, t, cost = new_R, new_t, new
                local, trial = trial, local
                damping = max(0.1 * damping, _LEAST_DAMPING)
                continue
        damping *= 10.0
        if not damping < _MOST_DAMPING:
            break
    return R, t, False, ITERATIONS


@compiled
def _evaluate(terms: _Terms, R: FloatArray, t: FloatArray, local: _Local) -> float:
    """Return the cost of a pose; fill ``local``."""
    local.slope[:], local.hessian[:], local.scale[:] = 0.0, 0.0, 0.0
    cost, still = 0.0, np.zeros(6)
    by_q, curvature = np.empty(3), np.empty((3, 3))
    for row in range(len(terms.point_m)):
        x, y, z, distance, _, _, _ = _moved(terms.point_m[row], R, t, still)
        u = (x, y, z)
        cost += _point(terms.ray[row], terms.point_weight[row], u, distance, by_q, curvature)
        _add(u, distance, terms.point_weight[row], by_q, curvature, local)
    for row in range(len(terms.line_point_m)):
        x, y, z, distance, _, _, _ = _moved(terms.line_point_m[row], R, t, still)
        u, pairs = (x, y, z), slice(terms.first[row], terms.first[row + 1])
        cost += _line(terms.normal[pairs], terms.line_weight[pairs], u, distance, by_q, curvature)
        _add(u, distance, terms.line_weight[pairs].sum(), by_q, curvature, local)
    return cost


@compiled
def _point(
    ray: FloatArray,
    weight: float,
    u: Vector,
    distance: float,
    by_q: FloatArray,
    curvature: FloatArray,
) -> float:
    """Return weight - ray . q / |q| at q = distance * u; fill gradient and curvature."""
    cosine = ray[0] * u[0] + ray[1] * u[1] + ray[2] * u[2]
    for k in range(3):
        by_q[k] = -(ray[k] - cosine * u[k]) / distance
        for n in range(3):
            curvature[k, n] = ray[k] * u[n] + u[k] * ray[n] - 3.0 * cosine * u[k] * u[n]
        curvature[k, k] += cosine
    curvature /= distance**2
    return weight - cosine


@compiled
def _line(
    normals: FloatArray,
    weights: FloatArray,
    u: Vector,
    distance: float,
    by_q: FloatArray,
    curvature: FloatArray,
) -> float:
    """Return the sum of weight (1 - |normal x q| / |q|) at q = distance * u; fill gradient and
    curvature."""
    by_q[:], curvature[:] = 0.0, 0.0
    cost, both = 0.0, 0.0
    for normal, weight in zip(normals, weights):  # noqa: B905  # numba has no strict
        sine = normal[0] * u[0] + normal[1] * u[1] + normal[2] * u[2]
        norm = np.sqrt(max(1.0 - sine * sine, _LEAST_SINE2))
        cost += weight * (1.0 - norm)
        by_sine, twice = weight * sine / norm, weight / norm**3
        both += by_sine * sine
        for k in range(3):
            by_q[k] += by_sine * normal[k]
            for n in range(3):
                curvature[k, n] += twice * (normal[k] - sine * u[k]) * (normal[n] - sine * u[n])
    for k in range(3):
        for n in range(3):
            curvature[k, n] -= by_q[k] * u[n] + u[k] * by_q[n] - 3.0 * both * u[k] * u[n]
        curvature[k, k] -= both
    for k in range(3):
        by_q[k] = (by_q[k] - both * u[k]) / distance
    curvature /= distance**2
    return cost


@compiled
def _add(
    u: Vector,
    distance: float,
    weight: float,
    by_q: FloatArray,
    curvature: FloatArray,
    local: _Local,
) -> None:
    """Add a function of a moved point q by its slope h' (3,) and curvature h'' (3, 3).

    These are J^T h' and J^T h'' J with J = [I, -[q]x], and for the second order of the turn the
    symmetric part of h' q^T; no more, since h' is at right angles to q.
    """
    x, y, z = distance * u[0], distance * u[1], distance * u[2]
    q = (x, y, z)
    jacobian = np.zeros((3, 6))
    jacobian[0, 0] = jacobian[1, 1] = jacobian[2, 2] = 1.0
    jacobian[0, 4], jacobian[0, 5] = z, -y
    jacobian[1, 3], jacobian[1, 5] = -z, x
    jacobian[2, 3], jacobian[2, 4] = y, -x
    for a in range(6):
        for k in range(3):
            local.slope[a] += jacobian[k, a] * by_q[k]
            local.scale[a] += weight * (jacobian[k, a] / distance) ** 2
            half = 0.0
            for n in range(3):
                half += curvature[k, n] * jacobian[n, a]
            for b in range(6):
                local.hessian[b, a] += jacobian[k, b] * half
    for k in range(3):
        for n in range(3):
            local.hessian[3 + k, 3 + n] += 0.5 * (by_q[k] * q[n] + q[k] * by_q[n])


@compiled
def _moved(
    point_m: FloatArray, R: FloatArray, t: FloatArray, move: FloatArray
) -> tuple[float, float, float, float, float, float, float]:
    """Return the direction (3) of the moved point, its distance, and its shift (3) under the left
    perturbation ``move``, perpendicular to the direction."""
    x = R[0, 0] * point_m[0] + R[0, 1] * point_m[1] + R[0, 2] * point_m[2] + t[0]
    y = R[1, 0] * point_m[0] + R[1, 1] * point_m[1] + R[1, 2] * point_m[2] + t[1]
    z = R[2, 0] * point_m[0] + R[2, 1] * point_m[1] + R[2, 2] * point_m[2] + t[2]
    a = move[0] + move[4] * z - move[5] * y
    b = move[1] + move[5] * x - move[3] * z
    c = move[2] + move[3] * y - move[4] * x
    distance = max(np.sqrt(x * x + y * y + z * z), _TINY_M)
    x, y, z = x / distance, y / distance, z / distance
    along = a * x + b * y + c * z
    return x, y, z, distance, a - along * x, b - along * y, c - along * z


PAIRS_PER_SEEN = 1.5
"""The paper's K per observed element; the paper does not state it (as Campbell et al. 2020)."""


def most_probable_pairs(P: FloatArray, seen: int) -> IntArray:
    """Return (k, 2) the largest positive entries of P (m, n), for ``seen`` observed elements."""
    count = int(np.ceil(PAIRS_PER_SEEN * seen))
    order = np.argsort(-P, axis=None, kind="stable")[:count]
    pairs = np.column_stack(np.divmod(order, P.shape[1]))
    return np.asarray(pairs[P[tuple(pairs.T)] > 0.0])


def points_and_lines(
    ray: FloatArray,
    bottom_ray: FloatArray,
    point_m: FloatArray,
    bottom_m: FloatArray,
    seen_known: BoolArray,
    mapped_known: BoolArray,
) -> tuple[BoolArray, BoolArray]:
    """Return (..., m, n) whether pairs count in f_p (known peaks), and whether in f_l (lines)."""
    seen_line, mapped_line = (ray != bottom_ray).any(axis=-1), (point_m != bottom_m).any(axis=-1)
    points = seen_known[..., :, None, 0] & mapped_known[..., None, :, 0]
    return np.asarray(points), np.asarray(seen_line[..., :, None] & mapped_line[..., None, :])


def weighted_sums(
    ray: FloatArray, bottom_ray: FloatArray, point_m: FloatArray, bottom_m: FloatArray
) -> Weighted:
    """Return the terms of eq. 7 for rays (b, m, 3) and points (b, n, 3), without weights."""
    no_weight = np.zeros((0, 0, 0))
    return Weighted(
        ray=ray,
        point_m=point_m,
        point_weight=no_weight,
        normal=unit_vectors(np.cross(ray, bottom_ray)),
        line_point_m=point_m + unit_vectors(bottom_m - point_m),
        line_weight=no_weight,
    )
