"""Shapes of what is matched that fix no pose, whatever the noise."""

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray

ONE_LINE_M = 0.1
"""Points that lie nearer to one straight line than this count as collinear."""
PARALLEL_RAD = float(np.deg2rad(2.0))
"""Lines closer to one direction than poles lean count as parallel."""


def why_degenerate(anchor_m: FloatArray, end_m: FloatArray, known: BoolArray) -> str:
    """Why mapped elements (k, 3) fix no pose, in one sentence; empty where they may.

    ``known`` (k, 2) says whether anchor and end are points known on both sides. A point's end is
    its anchor.
    """
    points = np.concatenate([anchor_m, end_m])
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[1] < ONE_LINE_M * np.sqrt(len(points)):
        return (
            "All matched elements lie on one straight line, such as one post: "
            "the camera could be anywhere around it."
        )
    if not known.any() and _parallel(end_m - anchor_m):
        return (
            "All matches are parallel lines without a peak or bottom known on both sides: "
            "the camera's height is not fixed."
        )
    return ""


def _parallel(directions: FloatArray) -> bool:
    unit = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    return bool((np.abs(unit @ unit[0]) > np.cos(PARALLEL_RAD)).all())
