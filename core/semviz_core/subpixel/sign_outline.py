"""Find a sign's outline around a point on its face, and from it the sign's centre.

Outlines of all sizes and several aspect ratios are scored against the directions of the image's
edges. The best are fitted to the edges near them at sub-pixel accuracy. A sign's border and
pictograms have edges of the same shape inside the outline, so the outermost clear outline is
preferred.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import BoolArray, FloatArray
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

    shape: str
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


def outline_polygon(outline: Outline) -> FloatArray:
    """Return the corners (n, 2) of an outline; of a circle, points on it."""
    if outline.shape == "circle":
        return np.asarray(
            outline.center_px + _unit("circle", 8)[0].reshape(-1, 2) * outline.half_px
        )
    return np.asarray(outline.center_px + np.array(_CORNERS[outline.shape]) * outline.half_px)


def find_outlines(
    image: SampledImage, click_px: FloatArray, shape: str, count: int = 4
) -> list[Outline]:
    """Return up to ``count`` outlines around a click on the inner half of a sign, best first."""
    aspects = _ASPECTS.get(shape, _FORESHORTENED)
    maps = _edge_directions(image, click_px)
    scores = np.stack([_fit_scores(maps, shape, aspect) for aspect in aspects], axis=1)
    flat = scores.reshape(-1)
    chosen: list[tuple[int, FloatArray]] = []
    starts: list[_Start] = []
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
        starts.append(_Start(shape, click_px + off * scale, half, search))
        if len(chosen) == count:
            break
    return sorted(_with_outer(image, starts), key=lambda outline: -outline.score)


def fit_outlines(
    image: SampledImage, middle_px: FloatArray, half_px: FloatArray, shapes: Sequence[str]
) -> list[Outline]:
    """Return outlines of a sign with about known centre and half size (2,), best first.

    ``shapes`` are those that are tried.
    """
    search = float(np.clip(0.35 * half_px.mean(), 2.0, 8.0))
    starts = [
        _Start(shape, middle_px, np.maximum(scale * half_px, 2.0), search)
        for shape in shapes
        for scale in _NEAR
    ]
    return sorted(_with_outer(image, starts), key=lambda outline: -outline.score)


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


def _with_outer(image: SampledImage, starts: list["_Start"]) -> list[Outline]:
    """Return the outlines fitted from each start, and those outside of borders."""
    fitted = _fit(image, starts)
    return [*fitted, *_fit(image, _outside_borders(image, fitted))]


class _Start(NamedTuple):
    """Where the fit of an outline begins."""

    shape: str
    middle_px: FloatArray
    half_px: FloatArray
    search_px: float


class _Shapes(NamedTuple):
    """The outlines of n shapes, padded to the same number of sides."""

    points: FloatArray
    normals: FloatArray
    """(n, sides, k, 2) as ``_unit``."""
    used: BoolArray
    """(n, sides) False for padding."""

    @classmethod
    def of(cls, shapes: Sequence[str], per_side: int) -> "_Shapes":
        units = [_unit(shape, per_side) for shape in shapes]
        sides = max(len(points) for points, _ in units)
        padded = [
            np.stack([np.resize(part, (sides, *part.shape[1:])) for part in parts])
            for parts in zip(*units, strict=True)
        ]
        used = np.arange(sides) < np.array([[len(points)] for points, _ in units])
        return cls(padded[0], padded[1], used)

    def sized(self, half: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points and unit normals of outlines of half sizes (n, 2), as ``points``."""
        half = half[:, None, None]
        turned = self.normals / half
        return self.points * half, turned / np.linalg.norm(turned, axis=-1, keepdims=True)


def _fit(image: SampledImage, starts: Sequence[_Start]) -> list[Outline]:
    """Return outlines fitted to the edges near them, at first within each start's search."""
    if not starts:
        return []
    shapes = _Shapes.of([start.shape for start in starts], _PER_SIDE)
    middle = np.array([start.middle_px for start in starts])
    half = np.array([start.half_px for start in starts])
    search = np.array([start.search_px for start in starts])
    for _ in range(4):
        points, normals = shapes.sized(half)
        off, weight = _edges(image, middle[:, None, None] + points, normals, search)
        weight = weight * shapes.used[..., None]
        moved, grown = _solve(_jacobian(points, normals, half), off, weight, 0.3 * search)
        middle = middle + moved
        half = np.maximum(half + grown, 2.0)
        search = np.maximum(1.25, 0.6 * search)
    evidence = _evidence(image, shapes, middle, half)
    return [
        Outline(start.shape, middle[k], half[k], evidence[k], float(evidence[k] @ WEIGHTS))
        for k, start in enumerate(starts)
    ]


def _jacobian(points: FloatArray, normals: FloatArray, half: FloatArray) -> FloatArray:
    """Return (n, points, 4) of the distances along the normals, by centre and half size."""
    J = np.concatenate([normals, normals * points / half[:, None, None]], axis=-1)
    return J.reshape(len(J), -1, 4)


def _evidence(
    image: SampledImage, shapes: _Shapes, middle: FloatArray, half: FloatArray
) -> FloatArray:
    """Return (n, k) the features of outlines that ``WEIGHTS`` weights."""
    points, normals = shapes.sized(half)
    places = middle[:, None, None] + points
    off, weight = _edges(image, places, normals, np.full(len(half), 1.25))
    sides = (weight * (np.abs(off) < 0.8)).mean(axis=2)
    count = shapes.used.sum(axis=1)
    mean = (sides * shapes.used).sum(axis=1) / count
    weakest = np.where(shapes.used, sides, np.inf).min(axis=1)
    spread = [
        _log_spread(image, places + side * 1.5 * normals, shapes.used) for side in (-1.0, 1.0)
    ]
    size = np.log(half.mean(axis=1))
    return np.stack([np.ones(len(half)), mean, weakest, *spread, size], axis=1)


def _log_spread(image: SampledImage, places: FloatArray, used: BoolArray) -> FloatArray:
    """Return (n,) the logarithm of the colours' standard deviation at places of used sides."""
    flat = places.reshape(len(places), -1, 2)
    colors = image.sample(flat).astype(np.float64)
    counts = np.repeat(used, places.shape[2], axis=1)[..., None]
    total = counts.sum(axis=1)
    mean = (colors * counts).sum(axis=1) / total
    square = ((colors - mean[:, None]) ** 2 * counts).sum(axis=1) / total
    return np.asarray(np.log(np.sqrt(square).mean(axis=1) + 4.0))


def _outside_borders(image: SampledImage, inner: Sequence[Outline]) -> list[_Start]:
    """Return where outlines begin that are outside a border, whose inner edge was found."""
    shapes = _Shapes.of([outline.shape for outline in inner], 8)
    half = np.array([outline.half_px for outline in inner])
    middle = np.array([outline.center_px for outline in inner])
    points, normals = shapes.sized(half)
    most = np.clip(0.7 * half.min(axis=1), 3.0, 14.0)
    reach = np.arange(0.0, float(most.max()) + 1.5, 0.5)
    places = (middle[:, None, None] + points)[..., None, :] + reach[:, None] * normals[..., None, :]
    colors = image.sample(places.reshape(-1, len(reach), 2))
    slope = np.zeros(colors.shape[:2])
    slope[:, 1:-1] = np.sqrt(((colors[:, 2:] - colors[:, :-2]) ** 2).mean(axis=2))
    vote = (slope**2 / (slope**2 + _EDGE**2)).reshape(*points.shape[:3], -1).mean(axis=2)
    count = shapes.used.sum(axis=1)[:, None]
    mean = (vote * shapes.used[..., None]).sum(axis=1) / count
    total = mean + np.where(shapes.used[..., None], vote, np.inf).min(axis=1)
    total[:, :3] = 0.0
    total[reach >= most[:, None] + 1.0] = 0.0  # the last step has no slope
    at = total.argmax(axis=1)
    found = np.flatnonzero(total[np.arange(len(at)), at] >= 0.5).tolist()
    J = _jacobian(points, normals, half)
    used = np.repeat(shapes.used, points.shape[2], axis=1)
    starts = []
    for k in found:
        grown = np.linalg.lstsq(J[k, used[k]], np.full(used[k].sum(), reach[at[k]]), rcond=None)[0]
        starts.append(
            _Start(
                inner[k].shape, middle[k] + grown[:2], np.maximum(half[k] + grown[2:], 2.0), 1.25
            )
        )
    return starts


def _edges(
    image: SampledImage, points: FloatArray, normals: FloatArray, search_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the offset (px) and weight (0 to 1) of the strongest edge along each normal.

    Both are (n, sides, k), as the points (n, sides, k, 2); ``search_px`` is (n,).
    """
    reach = np.arange(-6, 7) * (search_px / 5.0)[:, None]  # (n, 13)
    each = points.shape[1] * points.shape[2]
    flat = points.reshape(-1, 1, 2)
    reaches = np.repeat(reach, each, axis=0)
    colors = image.sample(flat + reaches[..., None] * normals.reshape(-1, 1, 2))
    slope = np.zeros(colors.shape[:2])
    step = colors[:, 2:] - colors[:, :-2]
    slope[:, 1:-1] = np.sqrt(np.einsum("ijk,ijk->ij", step, step) / 3.0)
    sharpness = np.exp(-0.5 * (np.arange(-6, 7) / (5.0 * 0.7)) ** 2)
    at = np.clip((slope * sharpness).argmax(axis=1), 1, reach.shape[1] - 2)
    rows = np.arange(len(at))
    mid = slope[rows, at]
    # the centre of mass: unlike the maximum, it is not biased by sampling between pixels
    mass = slope * (np.abs(reaches - reaches[rows, at][:, None]) < 1.05)
    off = (mass * reaches).sum(axis=1) / (mass.sum(axis=1) + 1e-6)
    weight = mid**2 / (mid**2 + _EDGE**2)
    return off.reshape(points.shape[:3]), weight.reshape(points.shape[:3])


def _solve(
    J: FloatArray, off: FloatArray, weight: FloatArray, scale_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return shifts of the centres (n, 2) and growth of the half sizes; robust to outliers."""
    off, weight = off.reshape(len(J), -1), weight.reshape(len(J), -1)
    robust = weight
    for _ in range(3):
        A = (J * robust[..., None]).swapaxes(1, 2)
        right = A @ off[..., None]
        solution = np.linalg.solve(A @ J + 1e-3 * np.eye(4), right)[..., 0]
        left = off - (J @ solution[..., None])[..., 0]
        robust = weight / (1.0 + (left / scale_px[:, None]) ** 2)
    return np.asarray(solution[:, :2]), np.asarray(solution[:, 2:])
