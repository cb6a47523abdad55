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

from semviz_core.base.classes import TriangleCenter
from semviz_core.common.arrays import ByteImage, FloatArray, unit_vectors
from semviz_core.common.jit import compiled
from semviz_core.common.linalg import cholesky, solve_cholesky
from semviz_core.subpixel.sampling import SampledImage, Samples, color_at

_CORNERS = {
    "triangle": [(0.0, -1.0), (1.0, 1.0), (-1.0, 1.0)],
    "triangle down": [(0.0, 1.0), (-1.0, -1.0), (1.0, -1.0)],
    "square": [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)],
    "diamond": [(0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)],
    "pentagon": [(0.0, -1.0), (1.0, -0.24), (0.62, 1.0), (-0.62, 1.0), (-1.0, -0.24)],
}
_TRIANGLES = ("triangle", "triangle down")
"""Upright, and upside down like give way."""
_ASPECTS = {"square": (0.55, 0.75, 1.0, 1.4, 2.0)}
"""Ratios of width to height."""
_FORESHORTENED = (0.8, 1.0)
HALF_PX = 4.0 * 1.25 ** np.arange(13)
"""Half sizes that are scored."""
WORK_PX = 8.0
"""Half size to which the image is scaled for scoring."""
OFF_STEPS = 5
"""Largest distance of the click from the centre, in scaled pixels."""
_NEAR = (0.8, 1.0)
"""Initial sizes relative to an approximately known size."""
_EDGE, _PER_SIDE = 12.0, 12
WEIGHTS = np.array([0.0, 3.73, 4.1, -4.11, -1.0, 3.03])
"""Weights of evidence: constant; edges; weakest side; variation inside and outside; log size."""


@dataclass(frozen=True, eq=False)
class Outline:
    """A candidate for a sign's outline."""

    shape: str
    """Its class's; ``triangle down`` for a triangle upside down."""
    center_px: FloatArray
    """(2,) of its box."""
    half_px: FloatArray
    """(2,) half its width and height."""
    evidence: FloatArray
    """(k,) the features that ``WEIGHTS`` weights."""
    score: float
    """Log-odds of being a sign's outline."""

    @property
    def to_centroid_px(self) -> float:
        """Rows from the middle of a triangle's box to the centroid; NaN for other shapes."""
        return middle_below_box(self.shape, float(self.half_px[1]), "centroid") or float("nan")

    def middle_px(self, triangle_center: TriangleCenter) -> FloatArray:
        """Return the sign's middle (2,), of a triangle as defined."""
        below = middle_below_box(self.shape, float(self.half_px[1]), triangle_center)
        return np.asarray(self.center_px + np.array([0.0, below]))

    def is_of(self, shape: str) -> bool:
        """Whether it is an outline of a class's shape, upright or upside down."""
        return self.shape in turns_of(shape)


def middle_below_box(shape: str, half_height: float, triangle_center: TriangleCenter) -> float:
    """Return by how much a sign's middle is below that of its outline's box."""
    side = {"triangle": 1.0, "triangle down": -1.0}.get(shape, 0.0)
    return 0.0 if triangle_center == "box" else side * half_height / 3.0


def turns_of(shape: str) -> tuple[str, ...]:
    """Return the outlines of a class's shape: of a triangle upright and upside down."""
    return _TRIANGLES if shape == "triangle" else (shape,)


@lru_cache(maxsize=16)
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
    return points, np.repeat(normals[:, None], per_side, axis=1)


def _outline_points(shape: str, per_side: int, half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points and unit normals of an outline of half size (2,), relative to its centre."""
    points, normals = _unit(shape, per_side)
    turned = normals / half
    return points * half, unit_vectors(turned)


def outline_polygon(outline: Outline) -> FloatArray:
    """Return the corners (n, 2) of an outline; of a circle, points on it."""
    circle = outline.shape == "circle"
    corners = _unit("circle", 8)[0].reshape(-1, 2) if circle else _CORNERS[outline.shape]
    return np.asarray(outline.center_px + np.array(corners) * outline.half_px)


def find_outlines(
    image: SampledImage, click_px: FloatArray, shape: str, count: int = 4
) -> list[Outline]:
    """Return up to ``count`` outlines around a click on the inner half of a sign, best first."""
    kinds = [
        (turned, aspect)
        for turned in turns_of(shape)
        for aspect in _ASPECTS.get(shape, _FORESHORTENED)
    ]
    maps = edge_directions(image, click_px)
    scores = np.stack([fit_scores(maps, *kind) for kind in kinds], axis=1)
    flat = scores.reshape(-1)
    chosen: list[tuple[int, FloatArray]] = []
    starts: list[OutlineStart] = []
    for at in np.argsort(-flat, kind="stable")[:400]:
        level, kind, row, column = np.unravel_index(at, scores.shape)
        off = np.array([column - OFF_STEPS, row - OFF_STEPS])
        if any(abs(level - other) < 2 and np.abs(off - place).max() < 3 for other, place in chosen):
            continue
        chosen.append((int(level), off))
        scale = HALF_PX[level] / WORK_PX
        turned, aspect = kinds[kind]
        root = np.sqrt(aspect)
        half = HALF_PX[level] * np.array([root, 1.0 / root])
        search = max(1.5, 0.14 * float(half.mean()))
        starts.append(OutlineStart(turned, click_px + off * scale, half, search))
        if len(chosen) == count:
            break
    return _with_outer(image, fit_from(image, starts))


def fit_outlines(
    image: SampledImage, middle_px: FloatArray, half_px: FloatArray, shapes: Sequence[str]
) -> list[Outline]:
    """Return outlines of a sign with about known centre and half size (2,), best first.

    ``shapes`` are those that are tried, as in ``turns_of``. Of several, only the best outline of
    each may be the inner edge of a border.
    """
    search = float(np.clip(0.35 * half_px.mean(), 2.0, 8.0))
    starts = [
        OutlineStart(shape, middle_px, np.maximum(scale * half_px, 2.0), search)
        for shape in shapes
        for scale in _NEAR
    ]
    fitted = fit_from(image, starts)
    best = {outline.shape: outline for outline in sorted(fitted, key=lambda each: each.score)}
    return _with_outer(image, fitted, None if len(best) == 1 else list(best.values()))


def edge_directions(
    image: SampledImage, click_px: FloatArray, longest: float = 1.45
) -> NDArray[np.float32]:
    """Return (levels, n, n, 2) the gradient around the click at each size, of length below 1.

    ``longest`` is the largest half width or height of an outline of half size 1.
    """
    import cv2

    half = int(OFF_STEPS + WORK_PX * longest + 3)
    places = np.arange(-half, half + 1)
    grid = np.stack(np.meshgrid(places, places), axis=-1)
    maps = np.zeros((len(HALF_PX), len(places), len(places), 2), np.float32)
    for level, size in enumerate(HALF_PX):
        scale = size / WORK_PX
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


def fit_scores(maps: NDArray[np.float32], shape: str, aspect: float) -> FloatArray:
    """Return (levels, rows, columns) scores of an outline at each size and position."""
    half = WORK_PX * np.array([np.sqrt(aspect), 1.0 / np.sqrt(aspect)])
    points, normals = _outline_points(shape, 8, half)
    middle = maps.shape[1] // 2
    place = np.arange(-OFF_STEPS, OFF_STEPS + 1)
    x = np.round(points[..., 0] + middle).astype(int) + place[None, :, None, None]
    y = np.round(points[..., 1] + middle).astype(int) + place[:, None, None, None]
    at = maps[:, y, x]  # (levels, rows, columns, sides, points, 2)
    along = np.abs((at * normals.astype(np.float32)).sum(axis=-1)).mean(axis=-1)
    return np.asarray(along.mean(axis=-1) + along.min(axis=-1), dtype=np.float64)


def _with_outer(
    image: SampledImage, fitted: list[Outline], inner: list[Outline] | None = None
) -> list[Outline]:
    """Return outlines and those outside, best first; all, or ``inner``, may be inner edges."""
    outer = fit_from(image, _outside_borders(image, inner or fitted))
    return sorted([*fitted, *outer], key=lambda outline: -outline.score)


class OutlineStart(NamedTuple):
    """Where the fit of an outline begins."""

    shape: str
    middle_px: FloatArray
    half_px: FloatArray
    search_px: float


def fit_from(image: SampledImage, starts: Sequence[OutlineStart]) -> list[Outline]:
    """Return outlines fitted to the edges near them, at first within each start's search."""
    outlines = []
    for start in starts:
        unit = _unit(start.shape, _PER_SIDE)
        place = np.array([start.middle_px, start.half_px], np.float64)
        middle, half, evidence = _fitted(image.image, *unit, place[0], place[1], start.search_px)
        score = float(evidence @ WEIGHTS)
        outlines.append(Outline(start.shape, middle, half, evidence, score))
    return outlines


@compiled
def _fitted(
    image: ByteImage,
    unit_points: FloatArray,
    unit_normals: FloatArray,
    first_middle: FloatArray,
    first_half: FloatArray,
    search_px: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return centre, half size and evidence of an outline, given as ``_unit``."""
    middle, half = first_middle.copy(), first_half.copy()
    for _ in range(4):
        points, normals = _sized(unit_points, unit_normals, half)
        off, weight = _edges(image, middle, points, normals, search_px)
        change = _solve(_jacobian(points, normals, half), off, weight, 0.3 * search_px)
        for axis in range(2):
            middle[axis] += change[axis]
            half[axis] = max(half[axis] + change[2 + axis], 2.0)
        search_px = max(1.25, 0.6 * search_px)
    points, normals = _sized(unit_points, unit_normals, half)
    off, weight = _edges(image, middle, points, normals, 1.25)
    mean, weakest, each = 0.0, np.inf, unit_points.shape[1]
    for first in range(0, len(points), each):
        side = 0.0
        for k in range(first, first + each):
            if abs(off[k]) < 0.8:
                side += weight[k] / each
        mean += side * each / len(points)
        weakest = min(weakest, side)
    evidence = np.empty(6)
    evidence[0], evidence[1], evidence[2] = 1.0, mean, weakest
    evidence[3] = _log_spread(image, middle, points, normals, -1.5)
    evidence[4] = _log_spread(image, middle, points, normals, 1.5)
    evidence[5] = np.log((half[0] + half[1]) / 2.0)
    return middle, half, evidence


@compiled
def _sized(
    unit_points: FloatArray, unit_normals: FloatArray, half: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return points and unit normals (sides k, 2) of an outline of half size (2,)."""
    sides, each, _ = unit_points.shape
    points, normals = np.empty((sides * each, 2)), np.empty((sides * each, 2))
    for k in range(sides * each):
        side, at = k // each, k % each
        length = np.hypot(unit_normals[side, at, 0] / half[0], unit_normals[side, at, 1] / half[1])
        for axis in range(2):
            points[k, axis] = unit_points[side, at, axis] * half[axis]
            normals[k, axis] = unit_normals[side, at, axis] / half[axis] / length
    return points, normals


@compiled
def _jacobian(points: FloatArray, normals: FloatArray, half: FloatArray) -> FloatArray:
    """Return (points, 4) of the distances along the normals, by centre and half size."""
    J = np.empty((len(points), 4))
    for k in range(len(points)):
        for axis in range(2):
            J[k, axis] = normals[k, axis]
            J[k, 2 + axis] = normals[k, axis] * points[k, axis] / half[axis]
    return J


@compiled
def _log_spread(
    image: ByteImage, middle: FloatArray, points: FloatArray, normals: FloatArray, out_px: float
) -> float:
    """Return the logarithm of the colours' standard deviation, ``out_px`` outside an outline."""
    total, square = np.zeros(3), np.zeros(3)
    for k in range(len(points)):
        u = middle[0] + points[k, 0] + out_px * normals[k, 0]
        v = middle[1] + points[k, 1] + out_px * normals[k, 1]
        color = color_at(image, u, v)
        for channel in range(3):
            total[channel] += color[channel] / len(points)
            square[channel] += color[channel] ** 2 / len(points)
    spread = 0.0
    for channel in range(3):
        spread += np.sqrt(max(square[channel] - total[channel] ** 2, 0.0)) / 3.0
    return float(np.log(spread + 4.0))


def _outside_borders(image: SampledImage, inner: Sequence[Outline]) -> list[OutlineStart]:
    """Return where outlines begin that are outside a border, whose inner edge was found."""
    starts = []
    for outline in inner:
        unit = _unit(outline.shape, 8)
        away = _border_px(image.image, *unit, outline.center_px, outline.half_px)
        if away > 0.0:
            middle, half = _grown(*unit, outline.center_px, outline.half_px, away)
            starts.append(OutlineStart(outline.shape, middle, half, 1.25))
    return starts


@compiled
def _grown(
    unit_points: FloatArray, unit_normals: FloatArray, middle: FloatArray, half: FloatArray,
    away_px: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return centre and half size of an outline moved outwards on all sides."""
    J = _jacobian(*_sized(unit_points, unit_normals, half), half)
    normal, change = np.zeros((4, 4)), np.zeros(4)
    for i in range(4):
        normal[i, i] = 1e-9  # the fit of a very thin outline is singular
    for k in range(len(J)):
        for i in range(4):
            change[i] += away_px * J[k, i]
            for j in range(i + 1):
                normal[i, j] += J[k, i] * J[k, j]
    cholesky(normal, 4)
    solve_cholesky(normal, change)
    return middle + change[:2], np.maximum(half + change[2:], 2.0)


@compiled
def _border_px(
    image: ByteImage, unit_points: FloatArray, unit_normals: FloatArray, middle: FloatArray,
    half: FloatArray,
) -> float:  # fmt: skip
    """Return how far outside an outline another one has clear edges; 0 without."""
    points, normals = _sized(unit_points, unit_normals, half)
    most = min(max(0.7 * min(half[0], half[1]), 3.0), 14.0)
    reach = np.arange(0.0, most + 1.5, 0.5)
    sides, each, _ = unit_points.shape
    votes, slope = np.zeros((sides, len(reach))), np.zeros(len(reach))
    colors = np.empty((len(reach), 3), np.float32)
    for k in range(len(points)):
        _slopes(image, middle, points, normals, k, reach, colors, slope)
        for step in range(len(reach)):
            votes[k // each, step] += slope[step] ** 2 / (slope[step] ** 2 + _EDGE**2) / each
    best, away = 0.0, 0.0
    for step in range(3, len(reach) - 1):  # the last step has no slope
        total = votes[:, step].mean() + votes[:, step].min()
        if reach[step] < most + 1.0 and total > best:
            best, away = total, reach[step]
    return away if best >= 0.5 else 0.0


@compiled
def _slopes(
    image: ByteImage, middle: FloatArray, points: FloatArray, normals: FloatArray, which: int,
    reach: FloatArray, colors: Samples, slope: FloatArray,
) -> None:  # fmt: skip
    """Fill ``slope`` (m,) with changes of colour over two steps at distances (m,) along the normal
    of one of the points; ``colors`` (m, 3) is scratch space. Neither end has a slope."""
    u, v = middle[0] + points[which, 0], middle[1] + points[which, 1]
    for k in range(len(reach)):
        color = color_at(image, u + reach[k] * normals[which, 0], v + reach[k] * normals[which, 1])
        for channel in range(3):
            colors[k, channel] = color[channel]
    for k in range(1, len(reach) - 1):
        square = 0.0
        for channel in range(3):
            square += (colors[k + 1, channel] - colors[k - 1, channel]) ** 2
        slope[k] = np.sqrt(square / 3.0)


_STEPS = np.arange(-6.0, 7.0)
_SHARPNESS = np.exp(-0.5 * (_STEPS / (5.0 * 0.7)) ** 2)


@compiled
def _edges(
    image: ByteImage, middle: FloatArray, points: FloatArray, normals: FloatArray,
    search_px: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the offset (n,) in px and weight (0 to 1) of the strongest edge along each normal."""
    reach = _STEPS * (search_px / 5.0)
    off, weight = np.empty(len(points)), np.empty(len(points))
    colors, slope = np.empty((len(reach), 3), np.float32), np.zeros(len(reach))
    for k in range(len(points)):
        _slopes(image, middle, points, normals, k, reach, colors, slope)
        at, best = 1, 0.0  # neither end has a slope
        for j in range(1, len(reach) - 1):
            if slope[j] * _SHARPNESS[j] > best:
                at, best = j, slope[j] * _SHARPNESS[j]
        # the centre of mass: unlike the maximum, it is not biased by sampling between pixels
        total, mass = 1e-6, 0.0
        for j in range(len(reach)):
            if abs(reach[j] - reach[at]) < 1.05:
                total += slope[j]
                mass += slope[j] * reach[j]
        off[k] = mass / total
        weight[k] = slope[at] ** 2 / (slope[at] ** 2 + _EDGE**2)
    return off, weight


@compiled
def _solve(J: FloatArray, off: FloatArray, weight: FloatArray, scale_px: float) -> FloatArray:
    """Return the shift of the centre and growth of the half size (4,); robust to outliers."""
    robust = weight.copy()
    for _ in range(3):
        normal, solution = np.zeros((4, 4)), np.zeros(4)
        for i in range(4):
            normal[i, i] = 1e-3
        for k in range(len(J)):
            for i in range(4):
                solution[i] += robust[k] * J[k, i] * off[k]
                for j in range(i + 1):  # only the lower triangle is read
                    normal[i, j] += robust[k] * J[k, i] * J[k, j]
        cholesky(normal, 4)
        solve_cholesky(normal, solution)
        for k in range(len(J)):
            left = off[k]
            for i in range(4):
                left -= J[k, i] * solution[i]
            robust[k] = weight[k] / (1.0 + (left / scale_px) ** 2)
    return solution
