"""Carry pixels of one view into another at supposed depths."""

import numpy as np

from semviz_annotation.stereo import PLAUSIBLE_DEPTH_M
from semviz_annotation.view import View
from semviz_core.arrays import FloatArray


def transfer(here: View, there: View, pixels_px: FloatArray, depths_m: FloatArray) -> FloatArray:
    """(d, n, 2) px in ``there`` of pixels (n, 2) of ``here`` at depths (d,) or (d, n) in ``here``.

    NaN behind the camera.
    """
    T = there.T_camera_map @ here.T_camera_map.inverse()
    plane = here.camera.normalize(pixels_px)
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    depths = np.broadcast_to(
        depths_m if depths_m.ndim == 2 else depths_m[:, None], (len(depths_m), len(plane))
    )
    points = T.apply(rays * depths[..., None])
    return there.camera.project(points.reshape(-1, 3)).reshape(*depths.shape, 2)


def inverse_depths(
    here: View, there: View, pixel_px: FloatArray, depth_m: tuple[float, float], step_px: float
) -> FloatArray:
    """Depths (d,) in ``here``, near first, about ``step_px`` apart in ``there``."""
    many = 1.0 / np.linspace(1.0 / depth_m[0], 1.0 / depth_m[1], 65)
    places = transfer(here, there, pixel_px[None], many)[:, 0]
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    ok = np.isfinite(steps)
    if not ok.any():
        return np.zeros(0)
    length = np.concatenate([[0.0], np.cumsum(np.where(ok, steps, 0.0))])
    count = int(np.ceil(length[-1] / step_px)) + 1
    return np.asarray(1.0 / np.interp(np.linspace(0.0, length[-1], count), length, 1.0 / many))


def depth_on_line(
    here: View, there: View, pixel_px: FloatArray, line_px: FloatArray, depth_m: float
) -> FloatArray | None:
    """(2,) px in ``there`` where a pixel's epipolar line crosses a line (2, 2), near a depth.

    None where it runs along it.
    """
    along = line_px[1] - line_px[0]
    across = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    inverse = 1.0 / depth_m
    for _ in range(3):
        step = 0.02 * inverse
        depths = 1.0 / (inverse + np.array([-step, 0.0, step]))
        places = transfer(here, there, pixel_px[None], depths)[:, 0]
        off = (places - line_px[0]) @ across
        moved = float(np.linalg.norm(places[2] - places[0]))
        slope = off[2] - off[0]
        if not np.isfinite(slope) or abs(slope) < 0.2 * moved or moved < 1e-6:
            return None
        inverse = max(inverse - 2.0 * step * off[1] / slope, 0.2 * inverse)
    return np.asarray(transfer(here, there, pixel_px[None], np.array([1.0 / inverse]))[0, 0])


def end_on_line(
    here: View, there: View, ends_px: FloatArray, line_px: FloatArray, end: int
) -> FloatArray | None:
    """(2,) px in ``there`` of one end of a pole (2, 2) whose line there is (2, 2), wherever on it.

    None where the images do not tell.
    """
    depths = inverse_depths(here, there, ends_px[end], PLAUSIBLE_DEPTH_M, 4.0)
    if not len(depths):
        return None
    along = line_px[1] - line_px[0]
    across = np.array([along[1], -along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
    places = transfer(here, there, ends_px[end][None], depths)[:, 0]
    off = np.abs((places - line_px[0]) @ across)
    if not np.isfinite(off).any():
        return None
    nearest = float(depths[int(np.nanargmin(off))])
    return depth_on_line(here, there, ends_px[end], line_px, nearest)
