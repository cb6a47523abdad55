"""The numbers of one element, as its card shows them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from semviz_annotation.labels import Observation
from semviz_annotation.stereo import epipolar_segment
from semviz_annotation.triangulate import Failed, Triangulated
from semviz_annotation.view import View
from semviz_core.arrays import FloatArray

ANYWHERE_M = (0.1, float("inf"))
THIN_DEG = 1.0
"""Ray angles below this make depth unsure; the card says so."""


def card(place: Triangulated | Failed, view: View, views: int) -> dict[str, Any]:
    """Depth and height with sigmas (m), ray angle (deg), rms (px); or the reason for none.

    ``view`` is the left camera of the frame on screen, in the frame of ``place``; ``views`` counts
    observations.
    """
    if isinstance(place, Failed):
        return {"views": views, "reason": place.reason}
    axis = view.T_camera_map.rotation[2]
    numbers = {
        "views": views,
        "depth_m": float(view.depth_m(place.anchor_m[None])[0]),
        "depth_sigma_m": _sigma(place, np.append(axis, np.zeros(3))),
        "angle_deg": float(np.rad2deg(place.angle_rad)),
        "is_thin": bool(np.rad2deg(place.angle_rad) < THIN_DEG),
        "rms_px": place.rms_px,
    }
    if place.is_line:
        along = place.anchor_m - place.end_m
        height = float(np.linalg.norm(along))
        direction = along / height
        numbers |= {
            "height_m": height,
            "height_sigma_m": _sigma(place, np.append(direction, -direction)),
        }
    return numbers


def epipolar_error_px(pair: Sequence[tuple[View, Observation]]) -> float | None:
    """Largest distance of a known end of the second from the epipolar line of the first's, px.

    ``pair`` is one element in two images; None where there are not two, or no end is known in both,
    or the first one's line does not cross the second image.
    """
    if len(pair) != 2:
        return None
    (here, one), (there, two) = pair
    ends = [(one.anchor_px, two.anchor_px)] * (one.anchor_known and two.anchor_known)
    if one.end_px is not None and two.end_px is not None:
        ends += [(one.end_px, two.end_px)] * (one.end_known and two.end_known)
    distances = [
        _distance(epipolar_segment(here, there, from_px, ANYWHERE_M), np.array(to_px))
        for from_px, to_px in ends
    ]
    return max((gap for gap in distances if np.isfinite(gap)), default=None)


def _sigma(place: Triangulated, gradient: FloatArray) -> float:
    return float(np.sqrt(gradient @ place.covariance_m2 @ gradient))


def _distance(line_px: FloatArray, point_px: FloatArray) -> float:
    """From a point to a polyline; infinite where that has no points."""
    if len(line_px) < 2:
        return float("inf")
    start, step = line_px[:-1], np.diff(line_px, axis=0)
    along = ((point_px - start) * step).sum(axis=1) / (step**2).sum(axis=1)
    nearest = start + np.clip(along, 0.0, 1.0)[:, None] * step
    return float(np.linalg.norm(point_px - nearest, axis=1).min())
