"""An element's place from the motion between frames: many views, near and far, of one thing.

A stereo pair sees a thing from one distance, so the linear place is as good as any. Over several
frames a click from far away says less in metres than one from near by, so there the place is the
one with the least reprojection error: Gauss-Newton from the linear one (Hartley & Zisserman, A6.1).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from semviz_annotation.labels import Observation
from semviz_annotation.triangulate import Failed, Triangulated, triangulate
from semviz_annotation.view import View
from semviz_core.arrays import BoolArray, FloatArray
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


def covariance_m2(
    views: Sequence[View],
    observations: Sequence[Observation],
    anchor_m: FloatArray,
    end_m: FloatArray,
    sigma_px: float = 1.0,
) -> FloatArray:
    """(6, 6) first-order covariance of an element at (anchor, end) seen in ``views``.

    The inverse of the information of all residuals: both image axes for signs (end NaN); across the
    line at both observed ends, and along it at the known ones, for poles.
    """
    result = np.zeros((6, 6))
    _, J = errors_px(views, observations, anchor_m, end_m)
    size = J.shape[1]
    result[:size, :size] = np.linalg.inv(J.T @ J) * sigma_px**2
    return result


def outermost(places: FloatArray, known: BoolArray, which: Literal["first", "last"]) -> float:
    """Where an end of a pole is: the mean of the places (k,) that show it.

    Where none does, the outermost place to which the pole was seen.
    """
    if known.any():
        return float(places[known].mean())
    return float(places.min() if which == "first" else places.max())


def errors_px(
    views: Sequence[View],
    observations: Sequence[Observation],
    anchor_m: FloatArray,
    end_m: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Residuals (rows,) of an element at (anchor, end), and how they move with it (rows, 3 or 6).

    Signs (end NaN): both image axes in each view. Poles: across the line at both observed ends, and
    along it at the known ones; an end that nobody saw is held along the line where it is.
    """
    seen = list(zip(views, observations, strict=True))
    if np.isnan(end_m).any():
        errors = [view.project(anchor_m)[0] - one.anchor_px for view, one in seen]
        return np.ravel(errors), np.concatenate([view.jacobian(anchor_m) for view in views])
    known = (any(one.anchor_known for one in observations), any(one.end_known for _, one in seen))
    rows = [_line_errors_px(view, one, anchor_m, end_m, known) for view, one in seen]
    return np.concatenate([row[0] for row in rows]), np.concatenate([row[1] for row in rows])


def _line_errors_px(
    view: View,
    one: Observation,
    anchor_m: FloatArray,
    end_m: FloatArray,
    known: tuple[bool, bool],
) -> tuple[FloatArray, FloatArray]:
    """As ``errors_px``, in one view; ``known`` are the ends that any view shows."""
    anchor_px, end_px = view.project(np.stack([anchor_m, end_m]))
    length = np.linalg.norm(end_px - anchor_px)
    along = (end_px - anchor_px) / length
    across = np.array([along[1], -along[0]])
    of_anchor, of_end = view.jacobian(anchor_m), view.jacobian(end_m)
    seen_px = _ends_px(one)
    errors = list((anchor_px - seen_px) @ across)
    shares = (seen_px - anchor_px) @ along / length
    rows = [_pair((1.0 - share) * across @ of_anchor, share * across @ of_end) for share in shares]
    if one.anchor_known or not known[0]:
        errors.append((anchor_px - seen_px[0]) @ along if known[0] else 0.0)
        rows.append(_pair(along @ of_anchor, np.zeros(3)))
    if one.end_known or not known[1]:
        errors.append((end_px - seen_px[1]) @ along if known[1] else 0.0)
        rows.append(_pair(np.zeros(3), along @ of_end))
    return np.array(errors), np.array(rows)


def _pair(of_anchor: FloatArray, of_end: FloatArray) -> FloatArray:
    return np.concatenate([of_anchor, of_end])


def _ends_px(one: Observation) -> FloatArray:
    return np.array([one.anchor_px, one.end_px])
