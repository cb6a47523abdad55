"""The numbers of one element, as its card shows them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from semviz_annotation.labels import Observation
from semviz_annotation.stereo import epipolar_segment
from semviz_annotation.triangulate import Failed, Triangulated, View
from semviz_core.arrays import FloatArray
from semviz_core.camera import Rig

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


def epipolar_error_px(rig: Rig, here: Sequence[Observation]) -> float | None:
    """Largest distance of a known end in the right image from the left one's epipolar line, px.

    ``here`` is one element in one frame; None where it lacks an image, or no end is known in both,
    or the left one's line does not cross the right image.
    """
    by_side = {one.side: one for one in here}
    if len(by_side) < 2:
        return None
    left, right = by_side["left"], by_side["right"]
    pairs = [(left.anchor_px, right.anchor_px)] * (left.anchor_known and right.anchor_known)
    if left.end_px is not None and right.end_px is not None:
        pairs += [(left.end_px, right.end_px)] * (left.end_known and right.end_known)
    distances = [
        _distance(epipolar_segment(rig, "left", one, ANYWHERE_M), np.array(two))
        for one, two in pairs
    ]
    return max((one for one in distances if np.isfinite(one)), default=None)


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
