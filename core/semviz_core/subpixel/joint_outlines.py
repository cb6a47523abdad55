"""Find the outline of one sign jointly in several images.

A sign has one size in metres and stays where it is, so its outlines in all images agree up to
scale. Together they show which of many rectangles around a mark is the sign, and where its middle
is. Edges are summed over the images first, then the best outlines are fitted in each.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_core.base.classes import TriangleCenter
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.sampling import SampledImage
from semviz_core.subpixel.sign_outline import (
    HALF_PX,
    OFF_STEPS,
    WORK_PX,
    OutlineStart,
    edge_directions,
    fit_from,
    fit_scores,
    middle_below_box,
    turns_of,
)

_FORESHORTENED = (0.8, 1.0)
_EQUILATERAL = 2.0 / np.sqrt(3.0)
_ASPECTS = {
    "square": (0.4, 0.55, 0.75, 1.0, 1.4, 2.0, 3.0, 4.5),
    "triangle": tuple(_EQUILATERAL * share for share in _FORESHORTENED),
}
"""Ratios of width to height, if those of a foreshortened circle are not meant; planks and street
names are wide."""
_PULL, _MOST_PULL = 0.12, 25.0
"""Weight and bound of the squared distance from the mark, in its sigmas."""
_LEVEL = float(np.log(HALF_PX[1] / HALF_PX[0]))
_EXAMINED = 600

EdgeProfile = NDArray[np.float32]
"""(levels, kinds, rows, columns) edge scores of outlines around a mark, see ``edge_profile``."""


class OutlineView(NamedTuple):
    """One image of the sign."""

    image: SampledImage
    profile: EdgeProfile
    middle_px: FloatArray
    """(2,) the mark."""
    scale: float
    """Size of the sign in this image, in any unit."""
    sigma_px: float
    """Of the mark: outlines far from it are of something else."""


@dataclass(frozen=True, eq=False)
class JointOutline:
    """One outline in v images."""

    moves: FloatArray
    """(v, 2) px in the first image from the mark to the middle, as fitted in each image."""
    half_px: FloatArray
    """(2,) half size in the first image."""
    edges: float
    """Mean edge score over the images, 0 to 2."""
    fits: FloatArray
    """(v,) log-odds of the outline in each image."""

    @property
    def move(self) -> FloatArray:
        """Return (2,) px in the first image from the mark to the middle."""
        return np.asarray(np.median(self.moves, axis=0))

    @property
    def fit(self) -> float:
        """Return the median log-odds over the images."""
        return float(np.median(self.fits))

    @property
    def spread_px(self) -> float:
        """Return the median distance of the fits from ``move``, px in the first image."""
        return float(np.median(np.linalg.norm(self.moves - self.move, axis=1)))


def edge_profile(image: SampledImage, middle_px: FloatArray, shape: str) -> EdgeProfile:
    """Return the edge scores of outlines of all sizes, kinds and offsets around a mark."""
    kinds = _kinds(shape)
    maps = edge_directions(image, middle_px, max(np.sqrt(aspect) for _, aspect in kinds) + 0.05)
    scores = [fit_scores(maps, *kind) for kind in kinds]
    return np.stack(scores, axis=1).astype(np.float32)


def joint_outlines(
    views: Sequence[OutlineView], shape: str, triangle_center: TriangleCenter, count: int = 3
) -> list[JointOutline]:
    """Return up to ``count`` outlines, the one with the best edges first."""
    kinds = _kinds(shape)
    scores = _summed(views, _away(kinds, triangle_center))
    result: list[JointOutline] = []
    chosen: list[tuple[int, int, FloatArray]] = []
    order = np.argsort(-scores.reshape(-1), kind="stable")[:_EXAMINED]
    for level, kind, row, column in zip(*np.unravel_index(order, scores.shape), strict=True):
        steps = np.array([column - OFF_STEPS, row - OFF_STEPS], dtype=np.float64)
        if any(
            kind == other and abs(level - size) < 2 and np.abs(steps - place).max() < 3
            for size, other, place in chosen
        ):
            continue
        chosen.append((int(level), int(kind), steps))
        edges = float(scores[level, kind, row, column])
        result.append(_fitted(views, kinds[kind], HALF_PX[level], steps, edges, triangle_center))
        if len(result) == count:
            break
    return result


def _kinds(shape: str) -> list[tuple[str, float]]:
    return [
        (turned, aspect)
        for turned in turns_of(shape)
        for aspect in _ASPECTS.get(shape, _FORESHORTENED)
    ]


def _away(kinds: Sequence[tuple[str, float]], triangle_center: TriangleCenter) -> FloatArray:
    """Return (kinds, rows, columns) the squared distance of the middle from the mark, in steps."""
    steps = np.arange(-OFF_STEPS, OFF_STEPS + 1)
    below = [
        middle_below_box(turned, WORK_PX / np.sqrt(aspect), triangle_center)
        for turned, aspect in kinds
    ]
    return np.asarray((steps[:, None] + np.array(below)[:, None, None]) ** 2 + steps**2)


def _summed(views: Sequence[OutlineView], away: FloatArray) -> FloatArray:
    """Return mean scores (levels, kinds, rows, columns) at the sizes of the first view.

    ``away`` as ``_away``.
    """
    total, count = np.zeros(views[0].profile.shape), np.zeros(len(HALF_PX))
    for view in views:
        relative = view.scale / views[0].scale
        shifted, seen = _at_sizes(view.profile, np.log(relative) / _LEVEL)
        in_sigmas = HALF_PX[:, None, None, None] * relative / WORK_PX / view.sigma_px
        shifted -= _PULL * np.minimum(away * in_sigmas**2, _MOST_PULL)
        total[seen] += shifted[seen]
        count += seen
    enough = count >= max(1.0, 0.5 * len(views))
    mean = total / np.maximum(count, 1.0)[:, None, None, None]
    return np.where(enough[:, None, None, None], mean, -np.inf)


def _at_sizes(profile: EdgeProfile, levels: float) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return a profile, its sizes shifted by ``levels``, and (levels,) which of them it has."""
    at = np.arange(len(profile)) + levels
    seen = (at >= 0.0) & (at <= len(profile) - 1)
    low = np.clip(np.floor(at).astype(int), 0, len(profile) - 2)
    share = (at - low)[:, None, None, None]
    return (1.0 - share) * profile[low] + share * profile[low + 1], seen


def _fitted(
    views: Sequence[OutlineView],
    kind: tuple[str, float],
    half_px: float,
    steps: FloatArray,
    edges: float,
    triangle_center: TriangleCenter,
) -> JointOutline:
    """Return an outline of the first image, fitted to the edges of each."""
    turned, aspect = kind
    root = np.sqrt(aspect)
    moves, halves, fits = [], [], []
    for view in views:
        relative = view.scale / views[0].scale
        size = half_px * relative
        start = OutlineStart(
            turned,
            view.middle_px + steps * size / WORK_PX,
            np.maximum(size * np.array([root, 1.0 / root]), 2.0),
            float(np.clip(0.2 * size, 1.2, 6.0)),
        )
        (outline,) = fit_from(view.image, [start])
        moves.append((outline.middle_px(triangle_center) - view.middle_px) / relative)
        halves.append(outline.half_px / relative)
        fits.append(outline.score)
    return JointOutline(np.array(moves), np.median(np.array(halves), axis=0), edges, np.array(fits))
