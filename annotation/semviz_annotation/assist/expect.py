"""Where a mapped element should be in images of one moment, and how surely."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz_annotation.triangulate import Triangulated
from semviz_annotation.view import View
from semviz_core.arrays import FloatArray

SIGMA_PX = 1.5
"""What slightly wrong poses add to an expected place."""
_UPRIGHT_RAD = 0.02
_APART_PX = 0.4
"""What calibrated cameras of one moment differ by, beyond what both are off."""


def expected_px(element: Triangulated, view: View) -> FloatArray | None:
    """(1 or 2, 2) an element's projection; None where it is out of the image."""
    points = np.stack([element.anchor_m, element.end_m])[: 1 + element.is_line]
    pixels = view.project(points)
    if not np.isfinite(pixels).all():
        return None
    along = np.linspace(0.0, 1.0, 9)[:, None]
    return (
        pixels if view.camera.contains(pixels[0] + along * (pixels[-1] - pixels[0])).any() else None
    )


def upright(element: Triangulated) -> Triangulated:
    """A pole with what is known of all poles: they stand upright, to about ``_UPRIGHT_RAD``.

    One stereo pair tells little of how a pole leans towards it, and other frames see that from
    aside. The update of a Gaussian by one more measurement (Kalman); z is up in the map frame.
    """
    if not element.is_line:
        return element
    ends = np.concatenate([element.anchor_m, element.end_m])
    length = float(np.linalg.norm(element.end_m - element.anchor_m))
    H = np.array([[-1.0, 0, 0, 1.0, 0, 0], [0, -1.0, 0, 0, 1.0, 0]])
    P = element.covariance_m2
    S = H @ P @ H.T + (_UPRIGHT_RAD * length) ** 2 * np.eye(2)
    gain = P @ H.T @ np.linalg.inv(S)
    ends = ends - gain @ (H @ ends)
    return replace(element, anchor_m=ends[:3], end_m=ends[3:], covariance_m2=P - gain @ H @ P)


def spread_px2(element: Triangulated, views: Sequence[View], sigma_px: float) -> FloatArray:
    """(v, e, 2, v, e, 2) px^2 covariance of the projections of an element's e ends in v views.

    What is wrong with the pose of the moment, ``sigma_px``, moves all of them alike; so does what
    is wrong with the element's place across the views, but its depth moves them apart.
    """
    points = (element.anchor_m, element.end_m)[: 1 + element.is_line]
    size = len(points)
    blocks = np.zeros((len(views), size, 2, size, 3))
    for v, view in enumerate(views):
        for k, point in enumerate(points):
            blocks[v, k, :, k] = view.jacobian(point)
    J = blocks.reshape(-1, 3 * size)
    covariance = J @ element.covariance_m2[: 3 * size, : 3 * size] @ J.T
    alike = np.tile(np.eye(2), (len(views) * size, len(views) * size))
    own = np.kron(np.eye(len(views)), np.tile(np.eye(2), (size, size)))
    covariance += sigma_px**2 * alike + _APART_PX**2 * own
    return covariance.reshape(len(views), size, 2, len(views), size, 2)
