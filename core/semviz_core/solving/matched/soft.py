"""The paper's P as its pose estimators take it: the surest pairs, and the sums of eq. 7.

Arrays may have leading axes for frames. Lines are told by a lower end of their own; all others have
theirs at the anchor.
"""

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.solving.matched.weighted import Weighted

PAIRS_PER_SEEN = 1.5
"""The paper's K, which it does not give, per seen element (as Campbell et al. 2020)."""


def surest_pairs(P: FloatArray, seen: int) -> IntArray:
    """(k, 2) rows and columns of the largest entries of P (m, n), above 0, of ``seen`` elements."""
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
    """(..., m, n) whether pairs count in f_p, with known peaks, and whether in f_l, as lines."""
    seen_line, mapped_line = (ray != bottom_ray).any(axis=-1), (point_m != bottom_m).any(axis=-1)
    points = seen_known[..., :, None, 0] & mapped_known[..., None, :, 0]
    return np.asarray(points), np.asarray(seen_line[..., :, None] & mapped_line[..., None, :])


def weighted_sums(
    ray: FloatArray, bottom_ray: FloatArray, point_m: FloatArray, bottom_m: FloatArray
) -> Weighted:
    """Rays and points (b, m, 3), (b, n, 3) of eq. 7, with weights still to come."""
    none = np.zeros((0, 0, 0))
    return Weighted(
        ray=ray,
        point_m=point_m,
        point_weight=none,
        normal=_unit(np.cross(ray, bottom_ray)),
        line_point_m=point_m + _unit(bottom_m - point_m),
        line_weight=none,
    )


def _unit(vectors: FloatArray) -> FloatArray:
    """Of length 1; zeros stay zeros."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-9))
