"""Find a sign's outline around a point on its face, and from it the sign's centre.

Outlines of all sizes and several aspect ratios are scored against the directions of the image's
edges. The best are fitted to the edges near them at sub-pixel accuracy. A sign's border and
pictograms have edges of the same shape inside the outline, so the outermost clear outline is
preferred.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.sampling import SampledImage

_CORNERS = {
    "triangle": [(0.0, -1.0), (1.0, 1.0), (-1.0, 1.0)],
    "square": [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)],
    "diamond": [(0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)],
    "pentagon": [(0.0, -1.0), (1.0, -0.24), (0.62, 1.0), (-0.62, 1.0), (-1.0, -0.24)],
}
_ASPECTS = {"square": (0.55, 0.75, 1.0, 1.4, 2.0)}
"""Ratios of width to height."""
_FORESHORTENED = (0.8, 1.0)
_HALF_PX = 4.0 * 1.25 ** np.arange(13)
"""Half sizes that are scored."""
_WORK_PX = 8.0
"""Half size to which the image is scaled for scoring."""
_OFF = 5
"""Largest distance of the click from the centre, in scaled pixels."""
_NEAR = (0.8, 1.0)
"""Initial sizes relative to an approximately known size."""
_EDGE = 12.0
_PER_SIDE = 12


WEIGHTS = np.array([0.0, 3.73, 4.1, -4.11, -1.0, 3.03])
"""Weights of evidence: constant; edges; weakest side; variation inside and outside; log size."""


@dataclass(frozen=True, eq=False)
class Outline:
    """A candidate for a sign's outline."""

    center_px: FloatArray
    """(2,)"""
    half_px: FloatArray
    """(2,) half its width and height."""
    evidence: FloatArray
    """(k,) the features that ``WEIGHTS`` weights."""
    score: float
    """Log-odds of being a sign's outline."""


@lru_cache(maxsize=8)
def _unit(shape: str, per_side: int) -> tuple[FloatArray, FloatArray]:
    """Return points (sides, per_side, 2) of an outline in [-1, 1], y down, and outward normals."""
    if shape == "circle":
        angles = (np.arange(4 * per_side) + 0.5) * (2.0 * np.pi / (4 * per_side))
        points = np.stack([np.cos(angles), np.sin(angles)], axis=1).reshape(4, per_side, 2)
        return points, points
    corners = np.array(_CORNERS[shape])
    after = np.roll(corners, -1, axis=0)
    share = np.linspace(0.1, 0.9, per_side)[:, None]
    points = corners[:, None] * (1.0 - share) + after[:, None] * share
    along = after - corners
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1)
    return points, np.asarray(np.broadcast_to(normals[:, None], points.shape))


def _outline_points(shape: str, per_side: int, half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points and unit normals of an outline of half size (2,), relative to its centre."""
    points, normals = _unit(shape, per_side)
    turned = normals / half
    return points * half, turned / np.linalg.norm(turned, axis=-1, keepdims=True)


def find_outlines(
    image: SampledImage, click_px: FloatArray, shape: str, count: int = 4
) -> list[Outline]:
    """Return up to ``count`` outlines around a click on the inner half of a sign, best first."""
    aspects = _ASPECTS.get(shape, _FORESHORTENED)
    maps = _edge_directions(image, click_px)
    scores = np.stack([_fit_scores(maps, shape, aspect) for aspect in aspects], axis=1)
    outlines: list[Outline] = []
    flat = scores.reshape(-1)
    chosen: list[tuple[int, FloatArray]] = []
    for at in np.argsort(-flat, kind="stable")[:400]:
        level, aspect, row, column = np.unravel_index(at, scores.shape)
        off = np.array([column - _OFF, row - _OFF])
        if any(abs(level - other) < 2 and np.abs(off - place).max() < 3 for other, place in chosen):
            continue
        chosen.append((int(level), off))
        scale = _HALF_PX[level] / _WORK_PX
        root = np.sqrt(aspects[aspect])
        half = _HALF_PX[level] * np.array([root, 1.0 / root])
        search = max(1.5, 0.14 * float(half.mean()))
        fitted = _fit(image, shape, click_px + off * scale, half, search)
        outlines += [fitted, *_outer_outline(image, shape, fitted)]
        if len(chosen) == count:
            break
    return sorted(outlines, key=lambda outline: -outline.score)


def fit_outlines(
    image: SampledImage, middle_px: FloatArray, half_px: FloatArray, shape: str
) -> list[Outline]:
    """Return outlines of a sign with about known centre and half size (2,), best first."""
    search = float(np.clip(0.35 * half_px.mean(), 2.0, 8.0))
    outlines: list[Outline] = []
    for scale in _NEAR:
        fitted = _fit(image, shape, middle_px, np.maximum(scale * half_px, 2.0), search)
        outlines += [fitted, *_outer_outline(image, shape, fitted)]
    return sorted(outlines, key=lambda outline: -outline.score)


def _edge_directions(image: SampledImage, click_px: FloatArray) -> NDArray[np.float32]:
    """Return (levels, n, n, 2) the gradient around the click at each size, of length below 1."""
    import cv2

    half = int(_OFF + _WORK_PX * 1.45 + 3)
    places = np.arange(-half, half + 1)
    grid = np.stack(np.meshgrid(places, places), axis=-1)
    maps = np.zeros((len(_HALF_PX), len(places), len(places), 2), np.float32)
    for level, size in enumerate(_HALF_PX):
        scale = size / _WORK_PX
        window = (
            image.sample(click_px + grid * scale)
            if scale < 1.5
            else image.shrunk(click_px, scale, half)
        )
        smooth = cv2.GaussianBlur(window, (3, 3), 0.7)
        x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
        y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
        best = np.argmax(x**2 + y**2, axis=2)[..., None]
        slope = np.concatenate(
            [np.take_along_axis(x, best, 2), np.take_along_axis(y, best, 2)], axis=2
        )
        maps[level] = slope / (np.linalg.norm(slope, axis=2, keepdims=True) + _EDGE)
    return maps


def _fit_scores(maps: NDArray[np.float32], shape: str, aspect: float) -> FloatArray:
    """Return (levels, rows, columns) scores of an outline at each size and position."""
    half = _WORK_PX * np.array([np.sqrt(aspect), 1.0 / np.sqrt(aspect)])
    points, normals = _outline_points(shape, 8, half)
    middle = maps.shape[1] // 2
    place = np.arange(-_OFF, _OFF + 1)
    x = np.round(points[..., 0] + middle).astype(int) + place[None, :, None, None]
    y = np.round(points[..., 1] + middle).astype(int) + place[:, None, None, None]
    at = maps[:, y, x]  # (levels, rows, columns, sides, points, 2)
    along = np.abs((at * normals.astype(np.float32)).sum(axis=-1)).mean(axis=-1)
    return np.asarray(along.mean(axis=-1) + along.min(axis=-1), dtype=np.float64)


def _fit(
    image: SampledImage, shape: str, middle: FloatArray, half: FloatArray, search_px: float
) -> Outline:
    """Return an outline fitted to the edges near it, at first within ``search_px``."""
    for _ in range(4):
        points, normals = _outline_points(shape, _PER_SIDE, half)
        off, weight = _edges(image, middle + points, normals, search_px)
        J = np.concatenate([normals, normals * points / half], axis=-1).reshape(-1, 4)
        moved, grown = _solve(J, off.reshape(-1), weight.reshape(-1), 0.3 * search_px)
        middle = middle + moved
        half = np.maximum(half + grown, 2.0)
        search_px = max(1.25, 0.6 * search_px)
    points, normals = _outline_points(shape, _PER_SIDE, half)
    off, weight = _edges(image, middle + points, normals, 1.25)
    sides = (weight * (np.abs(off) < 0.8)).mean(axis=1)
    inner = image.sample(middle + points - 1.5 * normals)
    outer = image.sample(middle + points + 1.5 * normals)
    spread = [
        np.log(np.std(colors.reshape(-1, 3), axis=0).mean() + 4.0) for colors in (inner, outer)
    ]
    evidence = np.array([1.0, sides.mean(), sides.min(), *spread, np.log(half.mean())])
    return Outline(middle, half, evidence, float(evidence @ WEIGHTS))


def _outer_outline(image: SampledImage, shape: str, inner: Outline) -> list[Outline]:
    """Return the outline outside a border whose inner edge was found; empty without one."""
    points, normals = _outline_points(shape, 8, inner.half_px)
    most = float(np.clip(0.7 * inner.half_px.min(), 3.0, 14.0))
    reach = np.arange(0.0, most + 1.5, 0.5)
    if len(reach) < 7:
        return []
    flat = (inner.center_px + points).reshape(-1, 1, 2) + reach[:, None] * normals.reshape(-1, 1, 2)
    colors = image.sample(flat)
    slope: FloatArray = np.zeros(colors.shape[:2])
    slope[:, 1:-1] = np.sqrt(((colors[:, 2:] - colors[:, :-2]) ** 2).mean(axis=2))
    vote = (slope**2 / (slope**2 + _EDGE**2)).reshape(*points.shape[:2], -1).mean(axis=1)
    total = vote.mean(axis=0) + vote.min(axis=0)
    total[:3] = 0.0
    at = int(np.argmax(total))
    if total[at] < 0.5:
        return []
    J = np.concatenate([normals, normals * points / inner.half_px], axis=-1).reshape(-1, 4)
    grown = np.linalg.lstsq(J, np.full(len(J), reach[at]), rcond=None)[0]
    return [_fit(image, shape, inner.center_px + grown[:2], inner.half_px + grown[2:], 1.25)]


def _edges(
    image: SampledImage, points: FloatArray, normals: FloatArray, search_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return the offset (px) and weight (0 to 1) of the strongest edge along each normal.

    Both are (sides, points).
    """
    step = search_px / 5.0
    reach = np.arange(-6, 7) * step
    flat = points.reshape(-1, 1, 2) + reach[:, None] * normals.reshape(-1, 1, 2)
    colors = image.sample(flat)
    slope: FloatArray = np.zeros(colors.shape[:2])
    slope[:, 1:-1] = np.sqrt(((colors[:, 2:] - colors[:, :-2]) ** 2).mean(axis=2))
    near = slope * np.exp(-0.5 * (reach / (0.7 * search_px)) ** 2)
    at = np.clip(near.argmax(axis=1), 1, len(reach) - 2)
    mid = slope[np.arange(len(at)), at]
    # the centre of mass: unlike the maximum, it is not biased by sampling between pixels
    mass = slope * (np.abs(reach - reach[at][:, None]) < 1.05)
    off = (mass @ reach) / (mass.sum(axis=1) + 1e-6)
    weight = mid**2 / (mid**2 + _EDGE**2)
    return off.reshape(points.shape[:2]), weight.reshape(points.shape[:2])


def _solve(
    J: FloatArray, off: FloatArray, weight: FloatArray, scale_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return the shift of the centre (2,) and growth of the half size (2,); robust to outliers."""
    robust = weight
    for _ in range(3):
        A = J * robust[:, None]
        solution = np.asarray(np.linalg.solve(J.T @ A + 1e-3 * np.eye(4), A.T @ off), np.float64)
        robust = np.asarray(weight / (1.0 + ((off - J @ solution) / scale_px) ** 2), np.float64)
    return solution[:2], solution[2:]
