"""An element's place from the motion between frames: many views, near and far, of one thing.

A stereo pair sees a thing from one distance, so the linear place is as good as any. Over several
frames a click from far away says less in metres than one from near by, so there the place is the
one with the least reprojection error: Gauss-Newton from the linear one (Hartley & Zisserman, A6.1).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz_annotation.labels import Observation
from semviz_annotation.triangulate import (
    Failed,
    Triangulated,
    covariance_m2,
    errors_px,
    triangulate,
)
from semviz_annotation.view import View
from semviz_core.camera import MIN_DEPTH_M

_STEPS = 10
_DONE_M = 1e-6
_MISFIT = 5.0
"""Clicks further off than so many standard deviations (rms) are of different things."""


def place_by_motion(
    views: Sequence[View],
    observations: Sequence[Observation],
    sigma_px: float,
    min_angle_rad: float,
) -> Triangulated | Failed:
    """As ``triangulate``, but with the least reprojection error, and refused where that is large.

    The views' poses are taken as exact: the covariance is that of the clicks alone.
    """
    linear = triangulate(views, observations, sigma_px, min_angle_rad)
    if isinstance(linear, Failed):
        return linear
    place = _least_squares(views, observations, linear, sigma_px)
    if place is None:
        return Failed("the frames do not agree on a place: are these different things?")
    if place.rms_px > _MISFIT * sigma_px:
        return Failed(f"the frames disagree by {place.rms_px:.1f} px: are these different things?")
    return place


def _least_squares(
    views: Sequence[View],
    observations: Sequence[Observation],
    linear: Triangulated,
    sigma_px: float,
) -> Triangulated | None:
    """The best place near ``linear``; None where the steps do not settle ahead of all views."""
    size = 6 if linear.is_line else 3
    values = np.concatenate([linear.anchor_m, linear.end_m])
    for _ in range(_STEPS):
        errors, J = errors_px(views, observations, values[:3], values[3:])
        step = np.linalg.lstsq(J, -errors, rcond=None)[0]
        values[:size] += step
        ends = values[:size].reshape(-1, 3)
        if any((view.depth_m(ends) < MIN_DEPTH_M).any() for view in views):
            return None
        if np.abs(step).max() < _DONE_M:
            break
    else:
        return None
    anchor, end = values[:3], values[3:]
    errors, _ = errors_px(views, observations, anchor, end)
    return replace(
        linear,
        anchor_m=anchor,
        end_m=end,
        covariance_m2=covariance_m2(views, observations, anchor, end, sigma_px),
        rms_px=float(np.sqrt(np.square(errors).mean())),
    )
