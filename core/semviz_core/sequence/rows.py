"""Residuals of pairs as in ``solving.residuals``, with their derivatives by pose AND by element."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.pose import Pose
from semviz_core.solving.residuals import bottom_is_given, fill_rows, new_rows
from semviz_core.solving.scene import Scene


@dataclass(frozen=True, eq=False)
class PairRows:
    """Rows of k pairs under one pose; those not used are 0, with variance 1."""

    residual_px: FloatArray
    """(k, 4) detection minus projection; none used where nothing projects."""
    used: BoolArray
    """(k, 4)"""
    is_bottom: BoolArray
    """(k, 4) True for the row, always the last one used, of a bottom that may be hidden."""
    by_pose: FloatArray
    """(k, 4, 6) by the left perturbation of T_camera_map."""
    by_element: FloatArray
    """(k, 4, 6) by the mapped anchor and end, map axes."""
    variance_px2: FloatArray
    """(k, 4) of the detection."""
    clutter: FloatArray
    """(k, 4) log density (per px) of a false detection."""
    length_px: FloatArray
    """(k,) of a pole as projected."""


def pair_rows(scene: Scene, T_camera_map: Pose, pairs: IntArray) -> PairRows:
    """Rows of ``pairs`` (k, 2) of rows observed and mapped."""
    pairs = np.ascontiguousarray(pairs)
    count, bottom, residual, by_pose, by_element, length = _fill(
        scene, T_camera_map.rotation, T_camera_map.translation, pairs
    )
    index = np.arange(4)
    seen = scene.seen[pairs[:, 0]]
    across = (index == 0) | ((index == 1) & seen["is_line"][:, None])
    variance = np.where(across, seen["variance_px2"][:, :1], seen["variance_px2"][:, 1:])
    used = index < count[:, None]
    return PairRows(
        residual_px=residual,
        used=used,
        is_bottom=bottom[:, None] & (index == count[:, None] - 1),
        by_pose=by_pose,
        by_element=by_element,
        variance_px2=np.where(used, variance, 1.0),
        clutter=seen["clutter"][:, np.minimum(index, 2)],
        length_px=np.maximum(length, 1.0),
    )


@compiled
def _fill(
    scene: Scene, R: FloatArray, t: FloatArray, pairs: IntArray
) -> tuple[IntArray, BoolArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    k = len(pairs)
    count, bottom, length = np.zeros(k, np.int64), np.zeros(k, np.bool_), np.zeros(k)
    residual, by_pose, by_element = np.zeros((k, 4)), np.zeros((k, 4, 6)), np.zeros((k, 4, 6))
    rows = new_rows()
    for pair in range(k):
        i, j = pairs[pair, 0], pairs[pair, 1]
        n = fill_rows(scene, R, t, i, j, rows)
        count[pair], bottom[pair] = n, n > 0 and bottom_is_given(scene, i, j, n)
        length[pair] = rows.length_px if scene.seen[i].is_line else 0.0
        residual[pair, :n] = rows.residual[:n]
        by_pose[pair, :n] = rows.jacobian[:n]
        by_element[pair, :n] = rows.by_map[:n]
    return count, bottom, residual, by_pose, by_element, length
