"""Compare patches of poles and signs between images, and align them at sub-pixel accuracy.

Similarity is normalized correlation. Alignment is Gauss-Newton over few parameters (Baker and
Matthews 2004); differing pixels get little weight. Pixels transfer to another view at assumed
depths.
"""

import numpy as np

from semviz_annotation.assist.marked_image import Mark, MarkedImage, pixel
from semviz_annotation.labels.views import PLAUSIBLE_DEPTH_M, PosedView
from semviz_core.base.classes import ElementClass
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.pole_axis import across, find_axes, shift_line
from semviz_core.subpixel.sampling import Samples
from semviz_core.subpixel.sign_outline import find_outlines

_ROWS, _COLUMNS = 24, 11
_BESIDE_PX = 1.5
_SIGN = 13
_HIDDEN_ROWS = 2
"""Fewer dissimilar rows at a pole's end may be due to a shadow."""
_VISIBLE_ROWS = 6
"""If fewer rows are similar, the pole looks different as a whole: nothing tells what hides it."""
_LEVELS = 20.0
"""Mean difference of colours at which a row counts less than half."""
SIMILARITY_WEIGHTS: FloatArray = np.array([1.0, 1.0, -0.3])
"""Weight of each measure of ``similarity`` in the comparison of positions."""


def pole_points(ends_px: FloatArray, width_px: float) -> FloatArray:
    """Return sample points (rows, columns, 2) px on a pole (2, 2) and slightly beside it."""
    share = (np.arange(_ROWS) + 0.5) / _ROWS
    offsets = np.linspace(-1.0, 1.0, _COLUMNS) * (width_px / 2.0 + _BESIDE_PX)
    points = ends_px[0] + share[:, None] * (ends_px[1] - ends_px[0])
    return np.asarray(points[:, None] + offsets[:, None] * across(ends_px))


def sign_points(middle_px: FloatArray, half_px: FloatArray) -> FloatArray:
    """Return sample points (n, n, 2) px on a sign and slightly beside it."""
    place = np.linspace(-1.15, 1.15, _SIGN)
    return np.asarray(middle_px + np.stack(np.meshgrid(place, place), axis=-1) * half_px)


def pole_patch(image: MarkedImage, ends_px: FloatArray, width_px: float) -> Samples:
    return image.sample(pole_points(ends_px, width_px))


def similarity(patch: Samples, patches: Samples) -> FloatArray:
    """Return the similarity (d, 3) of a patch (rows, columns, 3) to others (d, rows, columns, 3).

    Its measures: normalized correlation, the share of similar rows, and the logarithm of the
    typical difference of colours.
    """
    a = patch.reshape(-1) - patch.mean()
    b = patches.reshape(len(patches), -1)
    b = b - b.mean(axis=1, keepdims=True)
    correlation = (b @ a) / (np.linalg.norm(a) * np.linalg.norm(b, axis=1) + 1e-3)
    difference = np.abs(patches - patch).mean(axis=(2, 3))
    alike = 1.0 / (1.0 + (difference / _LEVELS) ** 2)
    middle = slice(patch.shape[1] // 3, patch.shape[1] - patch.shape[1] // 3)
    colors = np.abs(patches[:, :, middle] - patch[:, middle]).mean(axis=(2, 3))
    typical = np.log(np.median(colors, axis=1) + 2.0)
    return np.stack([correlation, alike.mean(axis=1), typical], axis=1).astype(np.float64)


def visible_rows(patch: Samples, other: Samples) -> tuple[float, float]:
    """Return where the similar part of a pole's patches (rows, columns, 3) begins and ends.

    Both as shares of its length: 0 and 1 if both ends are visible. A hidden end has only dissimilar
    rows, while the other rows are similar.
    """
    middle = slice(patch.shape[1] // 3, patch.shape[1] - patch.shape[1] // 3)
    # means across the pole: a thin one has other fringes of colour in each image
    difference = np.abs(other[:, middle].mean(axis=1) - patch[:, middle].mean(axis=1)).mean(axis=1)
    alike = 1.0 / (1.0 + (difference / _LEVELS) ** 2) - 0.5
    return _unlike(alike) / len(patch), 1.0 - _unlike(alike[::-1]) / len(patch)


def _unlike(alike: FloatArray) -> int:
    """Return how many of the first rows are dissimilar (negative); 0 if the others are, too."""
    split = np.concatenate([[0.0], -np.cumsum(alike)])  # evidence that the first n are hidden
    count = int(np.argmax(split))
    rest = alike[count:]
    is_hidden = count >= _HIDDEN_ROWS and len(rest) >= _VISIBLE_ROWS and rest.mean() > 0.15
    return count if is_hidden else 0


def pole_width(image: MarkedImage, ends_px: FloatArray) -> float:
    """Return the width of a marked pole, px; 3 if its edges are not clear."""
    key = Mark(pixel(ends_px[0]), pixel(ends_px[1]))
    if key not in image.sizes:
        axes = find_axes(image, ends_px, 1.5, 1)
        image.sizes[key] = np.clip([axes[0].width_px if axes else 3.0], 1.0, 40.0)
    return float(image.sizes[key][0])


_UNCLEAR_HALF_PX = 4.0
"""Half size of a sign whose outline is not clear. Most are small, and a larger patch would follow
what is beside them."""


def sign_half_size(
    image: MarkedImage, middle_px: FloatArray, element_class: ElementClass
) -> FloatArray:
    """Return half of a marked sign's width and height (2,) px, also if its outline is unclear."""
    key = Mark(pixel(middle_px))
    if key not in image.sizes:
        outlines = find_outlines(image, middle_px, element_class.shape, 2)
        center = image.triangle_center
        near = [
            outline
            for outline in outlines
            if np.linalg.norm(outline.middle_px(center) - middle_px) < 3.0
        ]
        half = near[0].half_px if near else np.full(2, _UNCLEAR_HALF_PX)
        image.sizes[key] = np.clip(half, 3.0, 60.0)
    return image.sizes[key]


_NOISE = 30.0
"""Colour noise in levels: the weight of image evidence against the prior."""
_OUTLIER = 15.0
"""Colour difference in levels at which a row has half its weight."""
_FURTHEST_PX = 3.0


def align_pole(
    patch: Samples,
    target: MarkedImage,
    start_px: FloatArray,
    width_px: float,
    lean_px: float,
    along_px: float = 0.0,
) -> FloatArray:
    """Return the line (2, 2) near ``start_px`` (2, 2) where a pole's patch fits best.

    Return ``start_px`` if the fit is too far away. The ends move across the pole; a prior keeps
    their difference at about ``lean_px``. They also move along it, by about ``along_px``, unless
    that is 0.
    """
    ends = start_px.copy()
    share = ((np.arange(len(patch)) + 0.5) / len(patch))[:, None, None]
    upright, rigid = (_NOISE / max(sigma_px, 0.05) for sigma_px in (lean_px, along_px))
    prior = np.array([[upright, -upright, 0.0], [0.0, 0.0, rigid if along_px else 1e4]])
    H_prior = prior.T @ prior + np.diag([10.0, 10.0, 10.0])
    total = np.zeros(3)
    for _ in range(6):
        points = pole_points(ends, width_px)
        normal = across(ends)
        along = np.array([-normal[1], normal[0]])
        now = target.sample(points)
        right, down = (
            target.sample(points + 0.5 * direction) - target.sample(points - 0.5 * direction)
            for direction in (normal, along)
        )
        off = patch - now
        weight = 1.0 / (1.0 + (off**2).mean(axis=(1, 2), keepdims=True) / _OUTLIER**2)
        J = np.stack([((1.0 - share) * right).ravel(), (share * right).ravel(), down.ravel()])
        A = J * np.broadcast_to(weight, off.shape).ravel()
        step = np.linalg.solve(A @ J.T + H_prior, A @ off.ravel() - prior.T @ (prior @ total))
        step = np.clip(step, -1.0, 1.0)
        total += step
        ends = shift_line(ends, step[0], step[1]) + step[2] * along
        if np.abs(step).max() < 0.02:
            break
    return ends if np.abs(total).max() <= _FURTHEST_PX else start_px


def align_sign(
    patch: Samples, target: MarkedImage, start_px: FloatArray, half_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the centre (2,) near ``start_px`` where a sign's patch fits best, and its similarity.

    Brightness may change: gain and offset are free. The similarity is (3,), see ``similarity``.
    """
    right_px, down_px = np.array([0.5, 0.0]), np.array([0.0, 0.5])
    place = start_px.copy()
    for _ in range(6):
        points = sign_points(place, half_px)
        now = target.sample(points).astype(np.float64)
        right = target.sample(points + right_px) - target.sample(points - right_px)
        down = target.sample(points + down_px) - target.sample(points - down_px)
        J = np.stack([right.ravel(), down.ravel(), -patch.ravel(), -np.ones(patch.size)], axis=1)
        step = np.linalg.lstsq(J, -now.ravel(), rcond=None)[0][:2]
        step = np.clip(step, -1.5, 1.5)
        place = place + step
        if np.abs(step).max() < 0.02:
            break
    if np.linalg.norm(place - start_px) > _FURTHEST_PX:
        place = start_px
    return place, similarity(patch, target.sample(sign_points(place, half_px))[None])[0]


def transfer(
    source: PosedView, target: PosedView, pixels_px: FloatArray, depths_m: FloatArray
) -> FloatArray:
    """Return pixels (d, n, 2) in ``target`` of pixels (n, 2) of ``source``; NaN behind the camera.

    ``depths_m`` are d depths in ``source``, (d,) or (d, n).
    """
    T = target.T_camera_map @ source.T_camera_map.inverse()
    plane = source.camera.normalize(pixels_px)
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    depths = np.broadcast_to(
        depths_m if depths_m.ndim == 2 else depths_m[:, None], (len(depths_m), len(plane))
    )
    points = T.apply(rays * depths[..., None])
    return target.camera.project(points.reshape(-1, 3)).reshape(*depths.shape, 2)


def inverse_depths(
    source: PosedView,
    target: PosedView,
    pixel_px: FloatArray,
    depth_m: tuple[float, float],
    step_px: float,
) -> FloatArray:
    """Return depths (d,) in ``source``, near first, ``step_px`` apart in ``target``."""
    many = 1.0 / np.linspace(1.0 / depth_m[0], 1.0 / depth_m[1], 65)
    places = transfer(source, target, pixel_px[None], many)[:, 0]
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    ok = np.isfinite(steps)
    if not ok.any():
        return np.zeros(0)
    length = np.concatenate([[0.0], np.cumsum(np.where(ok, steps, 0.0))])
    count = int(np.ceil(length[-1] / step_px)) + 1
    return np.asarray(1.0 / np.interp(np.linspace(0.0, length[-1], count), length, 1.0 / many))


def depth_on_line(
    source: PosedView, target: PosedView, pixel_px: FloatArray, line_px: FloatArray, depth_m: float
) -> FloatArray | None:
    """Return the pixel (2,) in ``target`` where an epipolar line crosses a line (2, 2).

    None if the two are nearly parallel.
    """
    along = line_px[1] - line_px[0]
    across = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    inverse = 1.0 / depth_m
    for _ in range(3):
        step = 0.02 * inverse
        depths = 1.0 / (inverse + np.array([-step, 0.0, step]))
        places = transfer(source, target, pixel_px[None], depths)[:, 0]
        off = (places - line_px[0]) @ across
        moved = float(np.linalg.norm(places[2] - places[0]))
        slope = off[2] - off[0]
        if not np.isfinite(slope) or abs(slope) < 0.2 * moved or moved < 1e-6:
            return None
        inverse = max(inverse - 2.0 * step * off[1] / slope, 0.2 * inverse)
    return np.asarray(transfer(source, target, pixel_px[None], np.array([1.0 / inverse]))[0, 0])


def end_on_line(
    source: PosedView, target: PosedView, ends_px: FloatArray, line_px: FloatArray, end: int
) -> FloatArray | None:
    """Return the pixel (2,) in ``target`` of an end of a pole (2, 2) whose line there is (2, 2).

    None if the images do not show it.
    """
    depths = inverse_depths(source, target, ends_px[end], PLAUSIBLE_DEPTH_M, 4.0)
    if not len(depths):
        return None
    along = line_px[1] - line_px[0]
    across = np.array([along[1], -along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
    places = transfer(source, target, ends_px[end][None], depths)[:, 0]
    off = np.abs((places - line_px[0]) @ across)
    if not np.isfinite(off).any():
        return None
    nearest = float(depths[int(np.nanargmin(off))])
    return depth_on_line(source, target, ends_px[end], line_px, nearest)
