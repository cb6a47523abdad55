"""Check that straight edges of the world are straight in the images of a drive.

What is left of a radial distortion moves a point at radius r by k r^2 of it, in units of the focal
length. An edge at a distance d from the middle of the image then bends by k d l^2 over its half
length l: towards the middle or away from it, by one k in all images. Edges that are curved in the
world, such as kerbs, bend either way, so the weighted median tells k. Every edge is followed as far
as it goes, in pieces that bend with it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.frame import Dataset
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.common.errors import SemvizError

LINE_IMAGES = 12
LEAST_IMAGES, LEAST_EDGES = 3, 20
"""With edges that would bend, for a check."""
LEAST_K = 0.03
"""A smaller remainder is not named."""
SIGMAS = 4.0
_LEAST_SEGMENT_PX, _MOST_SEGMENTS = 25.0, 200
_LEAST_LENGTH = 0.1
"""Of an edge, as a share of the image's width."""
_MOST_ROUGH_PX = 0.7
"""RMS of an edge from its parabola."""
_LEAST_LEVER_PX = 2.0
"""Bend (px) of an edge for k of 1: others tell nothing."""
_MOST_LEVER_PX = 60.0
"""So much does one edge count at most."""
_SCALE_PX = 100.0
_STEP_PX, _AHEAD = 2.0, 8
_REACH_PX = 3
_OFF_PX = 2.0
_LEAST_CONTRAST = 4.0
_MOST_K = 1.0
_APART_PX = 5
_RESAMPLED, _ONE_SIGMA = 200, (0.1587, 0.8413)


class BentEdge(NamedTuple):
    """An edge in an image as a parabola, and what it says about the distortion."""

    first_px: tuple[float, float]
    middle_px: tuple[float, float]
    last_px: tuple[float, float]
    bend_px: float
    """Its middle from the line between its ends; positive away from the middle of the image."""
    lever_px: float
    """Bend for k of 1: below 0, as its ends then lie farther out."""


@dataclass(frozen=True)
class LineCheck:
    """What is left of the distortion, by the edges of some images."""

    edges: int
    k: float
    """Of k r^2: below 0 lines bend as in a barrel. NaN with too few edges or images."""
    sigma: float
    bent_px: float
    """Median bend of the edges that k explains."""
    limit_px: float
    """The same at the limit."""

    @property
    def is_known(self) -> bool:
        return bool(np.isfinite(self.k))

    @property
    def is_straight(self) -> bool:
        """Whether lines are straight; True if nothing is known."""
        return not self.is_known or self.bent_px <= self.limit_px


def check_lines(dataset: Dataset) -> LineCheck:
    """Measure edges in up to ``LINE_IMAGES`` images along the drive; damaged images, not."""
    found = [_levers(edges) for edges in _edges_of_images(dataset)]
    found = [one for one in found if len(one)]
    values = np.concatenate([np.zeros((0, 2)), *found])
    if len(found) < LEAST_IMAGES or len(values) < LEAST_EDGES:
        return LineCheck(len(values), *([float("nan")] * 4))
    k = _median_k(values)
    rng = np.random.default_rng(0)
    again = [
        _median_k(np.concatenate([_resampled(found[row], rng) for row in rows]))
        for rows in rng.integers(0, len(found), (_RESAMPLED, len(found)))
    ]
    low, high = np.quantile(again, _ONE_SIGMA)
    sigma = float(high - low) / 2.0
    usual_px = float(np.median(np.abs(values[:, 1])))
    limit_px = max(LEAST_K, SIGMAS * sigma) * usual_px
    return LineCheck(len(values), k, sigma, abs(k) * usual_px, limit_px)


def _edges_of_images(dataset: Dataset) -> Iterator[list[BentEdge]]:
    sides = dataset.rig.sides
    count = min(LINE_IMAGES // len(sides), len(dataset.frames))
    rows = np.linspace(0, len(dataset.frames) - 1, count).round().astype(int)
    for row in rows.tolist():
        for side in sides:
            try:
                image = dataset.image(dataset.frames[row].index, side)
            except SemvizError:  # raised again when this image is shown
                continue
            camera = dataset.rig.left if side == "left" else dataset.rig.right
            assert camera is not None
            yield bent_edges(image, camera)


def _levers(edges: list[BentEdge]) -> FloatArray:
    """Return bend and lever (n, 2) of the edges that tell k."""
    values = np.array([(edge.bend_px, edge.lever_px) for edge in edges]).reshape(-1, 2)
    return np.asarray(values[np.abs(values[:, 1]) >= _LEAST_LEVER_PX])


def _resampled(values: FloatArray, rng: np.random.Generator) -> FloatArray:
    return np.asarray(values[rng.integers(0, len(values), len(values))])


def _median_k(values: FloatArray) -> float:
    """Return the median of bend over lever, weighted by the lever."""
    k = np.clip(values[:, 0] / values[:, 1], -_MOST_K, _MOST_K)
    weights = np.minimum(np.abs(values[:, 1]), _MOST_LEVER_PX)
    order = np.argsort(k)
    total = np.cumsum(weights[order])
    return float(k[order][np.searchsorted(total, total[-1] / 2.0)])


def bent_edges(image: ByteImage, camera: Camera) -> list[BentEdge]:
    """Return the long smooth edges of an image, each once."""
    import cv2

    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    segments = cv2.createLineSegmentDetector().detect(gray)[0]
    if segments is None:
        return []
    segments = np.asarray(segments, dtype=np.float64).reshape(-1, 2, 2)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    longest = np.argsort(-length)[:_MOST_SEGMENTS]
    smooth = np.asarray(cv2.GaussianBlur(gray, (0, 0), 1.0), dtype=np.float32)
    edges: list[BentEdge] = []
    taken = np.zeros(gray.shape, dtype=np.uint8)
    for segment in segments[longest[length[longest] > _LEAST_SEGMENT_PX]]:
        column, row = segment.mean(axis=0).round().astype(int)
        if taken[min(row, len(gray) - 1), min(column, gray.shape[1] - 1)]:
            continue
        followed = _followed(smooth, segment)
        if followed is not None:
            edge, path = _as_edge(*followed, camera)
            cv2.polylines(taken, [path.round().astype(np.int32)], False, 1, _APART_PX)
            edges.append(edge)
    return edges


class _Axes(NamedTuple):
    """Coordinates along a segment and across it, from its middle."""

    origin_px: FloatArray
    along: FloatArray
    across: FloatArray

    def pixels(self, along_px: FloatArray, across_px: FloatArray) -> FloatArray:
        """(n, 2)"""
        return np.asarray(
            self.origin_px + np.outer(along_px, self.along) + np.outer(across_px, self.across)
        )


def _followed(
    smooth: np.ndarray, segment: FloatArray
) -> tuple[_Axes, FloatArray, FloatArray] | None:
    """Return a segment's axes and the points (n,), (n,) of its edge; None if it is short or rough.

    From both ends, the next points are looked for where the parabola of those found leads.
    """
    length = float(np.linalg.norm(segment[1] - segment[0]))
    along = (segment[1] - segment[0]) / length
    axes = _Axes(segment.mean(axis=0), along, np.array([-along[1], along[0]]))
    places = np.arange(-length / 2.0 + 2.0, length / 2.0 - 2.0, _STEP_PX)
    sides = [
        _sampled(smooth, axes.pixels(places, np.full(len(places), off))) for off in (2.0, -2.0)
    ]
    sign = 1.0 if float((sides[0] - sides[1]).mean()) > 0.0 else -1.0
    off, found = _nearest_edge(smooth, axes, places, np.zeros(len(places)), sign)
    if found.sum() < 10:
        return None
    points = np.array([places[found], off[found]])
    for direction in (-1.0, 1.0):
        while (more := _next_points(smooth, axes, points, direction, sign)) is not None:
            points = np.hstack([points, more])
    points = points[:, np.argsort(points[0])]
    apart = _off_parabola(points)
    points = points[:, np.abs(apart) < 3.0 * max(float(np.median(np.abs(apart))), 0.3)]
    apart = _off_parabola(points)
    is_long = np.ptp(points[0]) >= _LEAST_LENGTH * smooth.shape[1]
    is_smooth = np.sqrt(np.mean(apart**2)) <= _MOST_ROUGH_PX
    return (axes, points[0], points[1]) if is_long and is_smooth else None


def _polynomial(along_px: FloatArray, across_px: FloatArray, degree: int) -> FloatArray:
    """Return what np.polyfit does, several times as fast for few points and a low degree."""
    powers = np.vander(along_px / _SCALE_PX, degree + 1)
    found = np.linalg.solve(powers.T @ powers, powers.T @ across_px)
    return np.asarray(found / _SCALE_PX ** np.arange(degree, -1, -1))


def _off_parabola(points: FloatArray) -> FloatArray:
    """Return how far (n,) points (2, n) are off the parabola through them."""
    path = _polynomial(points[0], points[1], 2)
    return np.asarray(points[1] - np.polyval(path, points[0]), dtype=np.float64)


def _next_points(
    smooth: np.ndarray, axes: _Axes, points: FloatArray, direction: float, sign: float
) -> FloatArray | None:
    """Return the next points (2, n) of an edge; None at its end."""
    end = points[0].max() if direction > 0.0 else points[0].min()
    places = end + direction * _STEP_PX * np.arange(1, _AHEAD + 1)
    path = _polynomial(points[0], points[1], 2 if np.ptp(points[0]) > 60.0 else 1)
    expected = np.asarray(np.polyval(path, places), dtype=np.float64)
    pixels = axes.pixels(places, expected)
    height, width = smooth.shape
    inside = (pixels > 4.0).all(axis=1) & (pixels < [width - 5.0, height - 5.0]).all(axis=1)
    off, found = _nearest_edge(smooth, axes, places, expected, sign)
    found &= inside & (np.abs(off - expected) < _OFF_PX)
    if found.sum() < 0.75 * _AHEAD:
        return None
    return np.array([places[found], off[found]])


def _nearest_edge(
    smooth: np.ndarray, axes: _Axes, places: FloatArray, expected: FloatArray, sign: float
) -> tuple[FloatArray, BoolArray]:
    """Return where (n,) the strongest edge of that sign crosses, to a fraction of a pixel, and
    whether there is one."""
    reach = np.arange(-_REACH_PX - 1, _REACH_PX + 2, dtype=np.float64)
    across = expected[:, None] + reach
    pixels = axes.pixels(np.repeat(places, len(reach)), across.ravel())
    values = _sampled(smooth, pixels).reshape(across.shape)
    slopes = sign * (values[:, 2:] - values[:, :-2]) / 2.0
    rows, best = np.arange(len(slopes)), slopes.argmax(axis=1)
    inner = best.clip(1, slopes.shape[1] - 2)
    before, here, after = (slopes[rows, inner + step] for step in (-1, 0, 1))
    curvature = np.minimum(before - 2.0 * here + after, -1e-6)
    off = inner - _REACH_PX + np.clip((before - after) / (2.0 * curvature), -0.5, 0.5)
    return expected + off, (best == inner) & (slopes[rows, best] > _LEAST_CONTRAST)


def _sampled(smooth: np.ndarray, pixels: FloatArray) -> FloatArray:
    import cv2

    u, v = pixels.T.astype(np.float32)[:, None]
    return np.asarray(cv2.remap(smooth, u, v, cv2.INTER_LINEAR)[0], dtype=np.float64)


def _as_edge(
    axes: _Axes, along_px: FloatArray, across_px: FloatArray, camera: Camera
) -> tuple[BentEdge, FloatArray]:
    """Return an edge, and pixels (n, 2) along it."""
    path = _polynomial(along_px, across_px, 2)
    ends = np.array([along_px[0], (along_px[0] + along_px[-1]) / 2.0, along_px[-1]])
    first, middle, last = axes.pixels(ends, np.asarray(np.polyval(path, ends), dtype=np.float64))
    chord = last - first
    length = float(np.linalg.norm(chord))
    across = np.array([-chord[1], chord[0]]) / length
    focal_px, center_px = float(camera.K[0, 0]), camera.K[:2, 2]
    distance_px = float((first - center_px) @ across)
    outwards_px = float((middle - (first + last) / 2.0) @ across * np.sign(distance_px))
    lever_px = -abs(distance_px) * (length / 2.0 / focal_px) ** 2
    pixels = [(float(u), float(v)) for u, v in (first, middle, last)]
    edge = BentEdge(pixels[0], pixels[1], pixels[2], outwards_px, lever_px)
    every = np.linspace(along_px[0], along_px[-1], 20)
    return edge, axes.pixels(every, np.asarray(np.polyval(path, every), dtype=np.float64))
