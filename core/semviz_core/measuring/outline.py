"""Find a sign's outline round a click on its face, and from it the sign's middle.

Outlines of all sizes and some proportions are tried on the directions of the image's edges; the
best are fitted to the edges beside them, at sub-pixel accuracy. A sign's border and pictures have
edges of the same shape inside of the outline, so what is well seen further out wins.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import FloatArray
from semviz_core.measuring.picture import Picture

_CORNERS = {
    "triangle": [(0.0, -1.0), (1.0, 1.0), (-1.0, 1.0)],
    "square": [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)],
    "diamond": [(0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)],
    "pentagon": [(0.0, -1.0), (1.0, -0.24), (0.62, 1.0), (-0.62, 1.0), (-1.0, -0.24)],
}
_ASPECTS = {"square": (0.55, 0.75, 1.0, 1.4, 2.0)}
"""Width over height."""
_FORESHORTENED = (0.8, 1.0)
_HALF_PX = 4.0 * 1.25 ** np.arange(13)
"""Half sizes that are tried."""
_WORK_PX = 8.0
"""Half size to which the image is scaled to try one."""
_OFF = 5
"""How far the click is from the middle at most, in these pixels."""
_NEAR = (0.8, 1.0)
"""Of a size that is about known, what is tried; borders lead further out."""
_EDGE = 12.0
_PER_SIDE = 12


WEIGHTS = np.array([0.0, 3.73, 4.1, -4.11, -1.0, 3.03])
"""Of evidence: one; edges; weakest side; varied inside and outside; log size."""


@dataclass(frozen=True, eq=False)
class Outline:
    """A candidate for a sign's outline."""

    middle_px: FloatArray
    """(2,)"""
    half_px: FloatArray
    """(2,) half its width and height."""
    evidence: FloatArray
    score: float


@lru_cache(maxsize=8)
def _unit(shape: str, per_side: int) -> tuple[FloatArray, FloatArray]:
    """(sides, per_side, 2) points of an outline in [-1, 1], y down, and their outward normals."""
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


def _placed(shape: str, per_side: int, half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points and unit normals of an outline of half size (2,), round its middle."""
    points, normals = _unit(shape, per_side)
    turned = normals / half
    return points * half, turned / np.linalg.norm(turned, axis=-1, keepdims=True)


def find_outlines(
    picture: Picture, click_px: FloatArray, shape: str, count: int = 4
) -> list[Outline]:
    """Up to ``count`` outlines round a click on the inner half of a sign, likeliest first."""
    aspects = _ASPECTS.get(shape, _FORESHORTENED)
    maps = _directions(picture, click_px)
    scores = np.stack([_tried(maps, shape, aspect) for aspect in aspects], axis=1)
    found: list[Outline] = []
    flat = scores.reshape(-1)
    tried: list[tuple[int, FloatArray]] = []
    for at in np.argsort(-flat, kind="stable")[:400]:
        level, aspect, row, column = np.unravel_index(at, scores.shape)
        off = np.array([column - _OFF, row - _OFF])
        if any(abs(level - one) < 2 and np.abs(off - other).max() < 3 for one, other in tried):
            continue
        tried.append((int(level), off))
        scale = _HALF_PX[level] / _WORK_PX
        root = np.sqrt(aspects[aspect])
        half = _HALF_PX[level] * np.array([root, 1.0 / root])
        search = max(1.5, 0.14 * float(half.mean()))
        fitted = _fitted(picture, shape, click_px + off * scale, half, search)
        found += [fitted, *_further_out(picture, shape, fitted)]
        if len(tried) == count:
            break
    return sorted(found, key=lambda one: -one.score)


def fit_outlines(
    picture: Picture, middle_px: FloatArray, half_px: FloatArray, shape: str
) -> list[Outline]:
    """Outlines round a sign whose middle and half size (2,) are about known, likeliest first."""
    search = float(np.clip(0.35 * half_px.mean(), 2.0, 8.0))
    found: list[Outline] = []
    for scale in _NEAR:
        fitted = _fitted(picture, shape, middle_px, np.maximum(scale * half_px, 2.0), search)
        found += [fitted, *_further_out(picture, shape, fitted)]
    return sorted(found, key=lambda one: -one.score)


def _directions(picture: Picture, click_px: FloatArray) -> NDArray[np.float32]:
    """(levels, n, n, 2) the image's slope round the click at each size, its length below 1."""
    import cv2

    half = int(_OFF + _WORK_PX * 1.45 + 3)
    places = np.arange(-half, half + 1)
    grid = np.stack(np.meshgrid(places, places), axis=-1)
    maps = np.zeros((len(_HALF_PX), len(places), len(places), 2), np.float32)
    for level, size in enumerate(_HALF_PX):
        scale = size / _WORK_PX
        window = (
            picture.sample(click_px + grid * scale)
            if scale < 1.5
            else picture.shrunk(click_px, scale, half)
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


def _tried(maps: NDArray[np.float32], shape: str, aspect: float) -> FloatArray:
    """(levels, rows, columns) how well an outline fits at each size and place."""
    half = _WORK_PX * np.array([np.sqrt(aspect), 1.0 / np.sqrt(aspect)])
    points, normals = _placed(shape, 8, half)
    middle = maps.shape[1] // 2
    place = np.arange(-_OFF, _OFF + 1)
    x = np.round(points[..., 0] + middle).astype(int) + place[None, :, None, None]
    y = np.round(points[..., 1] + middle).astype(int) + place[:, None, None, None]
    at = maps[:, y, x]  # (levels, rows, columns, sides, points, 2)
    along = np.abs((at * normals.astype(np.float32)).sum(axis=-1)).mean(axis=-1)
    return np.asarray(along.mean(axis=-1) + along.min(axis=-1), dtype=np.float64)


def _fitted(
    picture: Picture, shape: str, middle: FloatArray, half: FloatArray, search_px: float
) -> Outline:
    """An outline moved and scaled to the edges beside it, at most ``search_px`` away at first."""
    for _ in range(4):
        points, normals = _placed(shape, _PER_SIDE, half)
        off, weight = _edges(picture, middle + points, normals, search_px)
        J = np.concatenate([normals, normals * points / half], axis=-1).reshape(-1, 4)
        moved, grown = _solved(J, off.reshape(-1), weight.reshape(-1), 0.3 * search_px)
        middle = middle + moved
        half = np.maximum(half + grown, 2.0)
        search_px = max(1.25, 0.6 * search_px)
    points, normals = _placed(shape, _PER_SIDE, half)
    off, weight = _edges(picture, middle + points, normals, 1.25)
    sides = (weight * (np.abs(off) < 0.8)).mean(axis=1)
    inner = picture.sample(middle + points - 1.5 * normals)
    outer = picture.sample(middle + points + 1.5 * normals)
    spread = [np.log(np.std(one.reshape(-1, 3), axis=0).mean() + 4.0) for one in (inner, outer)]
    evidence = np.array([1.0, sides.mean(), sides.min(), *spread, np.log(half.mean())])
    return Outline(middle, half, evidence, float(evidence @ WEIGHTS))


def _further_out(picture: Picture, shape: str, inner: Outline) -> list[Outline]:
    """The outline outside of a border whose inner edge was found, if there is one."""
    points, normals = _placed(shape, 8, inner.half_px)
    most = float(np.clip(0.7 * inner.half_px.min(), 3.0, 14.0))
    reach = np.arange(0.0, most + 1.5, 0.5)
    if len(reach) < 7:
        return []
    flat = (inner.middle_px + points).reshape(-1, 1, 2) + reach[:, None] * normals.reshape(-1, 1, 2)
    colors = picture.sample(flat)
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
    return [_fitted(picture, shape, inner.middle_px + grown[:2], inner.half_px + grown[2:], 1.25)]


def _edges(
    picture: Picture, points: FloatArray, normals: FloatArray, search_px: float
) -> tuple[FloatArray, FloatArray]:
    """Where the strongest edge is along each normal (sides, points), px, and its weight 0..1."""
    step = search_px / 5.0
    reach = np.arange(-6, 7) * step
    flat = points.reshape(-1, 1, 2) + reach[:, None] * normals.reshape(-1, 1, 2)
    colors = picture.sample(flat)
    slope: FloatArray = np.zeros(colors.shape[:2])
    slope[:, 1:-1] = np.sqrt(((colors[:, 2:] - colors[:, :-2]) ** 2).mean(axis=2))
    near = slope * np.exp(-0.5 * (reach / (0.7 * search_px)) ** 2)
    at = np.clip(near.argmax(axis=1), 1, len(reach) - 2)
    mid = slope[np.arange(len(at)), at]
    # the centre of mass: sampling between pixels does not move it, as it moves the maximum
    mass = slope * (np.abs(reach - reach[at][:, None]) < 1.05)
    off = (mass @ reach) / (mass.sum(axis=1) + 1e-6)
    weight = mid**2 / (mid**2 + _EDGE**2)
    return off.reshape(points.shape[:2]), weight.reshape(points.shape[:2])


def _solved(
    J: FloatArray, off: FloatArray, weight: FloatArray, scale_px: float
) -> tuple[FloatArray, FloatArray]:
    """How far the middle moves and the half sizes grow (2,) each; far edges count little."""
    robust = weight
    for _ in range(3):
        A = J * robust[:, None]
        solution = np.asarray(np.linalg.solve(J.T @ A + 1e-3 * np.eye(4), A.T @ off), np.float64)
        robust = np.asarray(weight / (1.0 + ((off - J @ solution) / scale_px) ** 2), np.float64)
    return solution[:2], solution[2:]
