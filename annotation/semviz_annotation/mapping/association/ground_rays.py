"""Detections as rays on the ground plane, and those that are no landmark although they agree.

A pole's ray points at its axis at the height of the camera, so neither its ends nor its lean
matter; a sign's ray points at its centre. Rays of one landmark meet where it stands.

A detector often takes a pole for longer or shorter than it is, by far more than it says. So an end
counts only where it fits the height that most detections of the pole give it (``agreed_ends``).

No landmarks are marks on the camera and moving objects. Dirt on the lens and the car's own parts
stay at one pixel while the camera moves; in a bend, their rays nearly meet. An object that comes
along looks to one camera like something nearer that stands still; the other camera then sees it
elsewhere.
"""

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.placement.linear import end_rays
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.common.jit import compiled

_LEAST_UPRIGHT = 0.5
"""Sine of the least angle between a pole's line and the horizontal."""
_BEYOND = 2.0
"""A pole's axis is extended to the horizon by at most so many times its own length."""
_AGREE_SIGMAS, _AGREE_M = 3.0, 0.1
"""An end fits a height within so many of its sigmas, and so many metres."""
_LEAST_SHARE, _LEAST_ENDS = 0.5, 2
"""At least so many of the known ends must fit, or else none counts."""


@dataclass(frozen=True, eq=False)
class GroundRays:
    """k rays of detections; rows in the order of the observations."""

    origin_m: FloatArray
    """(k, 3) camera centres"""
    direction: FloatArray
    """(k, 2) unit vectors on the ground plane"""
    sigma_rad: FloatArray
    """(k,) of the direction"""
    slope: FloatArray
    """(k, 2) rise per metre on the ground of the rays through anchor and end; NaN for the end of a
    sign"""
    slope_sigma: FloatArray
    """(k,) of the slopes"""
    known: BoolArray
    """(k, 2) whether anchor and end are known"""
    sound: BoolArray
    """(k,) False for a line in the image that is no upright pole"""

    @classmethod
    def of(
        cls, views: ViewArray, observations: ObservationArray, sigma_px: float = 1.0
    ) -> "GroundRays":
        """Return the rays of ``observations``, whose common sigma is ``sigma_px``."""
        is_line = observations.is_line
        ends = end_rays(views, observations)
        ends[~is_line, 1] = np.nan
        flat = np.linalg.norm(ends[:, :, :2], axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = ends[:, :, 2] / flat
            share = np.where(is_line, slope[:, 0] / (slope[:, 0] - slope[:, 1]), 0.0)
        share = np.clip(np.nan_to_num(share), -_BEYOND, 1.0 + _BEYOND)
        direction, sound = _towards(ends, is_line)
        forward = unit_vectors(views.R[observations.view, 2, :2])
        cosine = np.clip((forward * direction).sum(axis=1), 0.1, 1.0)
        px_rad = sigma_px * observations.sigma_ratio / views.K[observations.view, 0, 0][:, None]
        return cls(
            origin_m=views.center_m[observations.view],
            direction=direction,
            sigma_rad=px_rad[:, 0] * cosine**2 * np.hypot(share, 1.0 - share),
            slope=slope,
            slope_sigma=px_rad[:, 1] * cosine,
            known=np.stack([observations.anchor_known, observations.end_known], axis=1),
            sound=sound & np.isfinite(slope[:, 0]),
        )

    def taken(self, rows: IntArray) -> "GroundRays":
        """Return the rays in rows (m,)."""
        return GroundRays(*(getattr(self, column.name)[rows] for column in fields(GroundRays)))


def _towards(ends: FloatArray, is_line: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return the directions (k, 2) of rays through anchor and end (k, 2, 3), and which are
    sound."""
    middle = np.where(is_line[:, None], np.nan_to_num(ends.sum(axis=1)), ends[:, 0])[:, :2]
    normal = np.nan_to_num(np.cross(ends[:, 0], ends[:, 1]))
    level = np.linalg.norm(normal[:, :2], axis=1)
    upright = level > _LEAST_UPRIGHT * np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    across = np.stack([normal[:, 1], -normal[:, 0]], axis=1)
    across *= np.where((across * middle).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    direction = np.where(is_line[:, None], across, middle)
    length = np.linalg.norm(direction, axis=1)
    sound = (length > 1e-9) & (upright | ~is_line)
    return direction / np.maximum(length, 1e-9)[:, None], sound


@dataclass(frozen=True, eq=False)
class DriveImages:
    """v images along a drive, in the order of ``ViewArray``."""

    path_m: FloatArray
    """(v,) distance driven until then"""
    center_m: FloatArray
    """(v, 2)"""
    forward: FloatArray
    """(v, 2) unit vectors on the ground plane"""
    edges: FloatArray
    """(v, 2) tangents of the angles at which the image ends to its left and right"""
    focal_px: FloatArray
    """(v,)"""
    size_px: FloatArray
    """(v, 2) width and height"""
    keyframe: IntArray
    """(v,) number of the position that an image was taken at; images nearer than ``step_m`` to the
    last position count as taken there too"""
    is_key: BoolArray
    """(v,) whether the image is of the first frame at its position"""

    @classmethod
    def of(cls, views: ViewArray, size_px: FloatArray, step_m: float) -> "DriveImages":
        """Return the images of ``views``, which are in the order of frames, with sizes (v, 2)."""
        center = views.center_m
        frames, first, frame = np.unique(views.frame_index, return_index=True, return_inverse=True)
        moved = np.linalg.norm(np.diff(center[first], axis=0), axis=1)
        path = np.concatenate([[0.0], np.cumsum(moved)])[: len(frames)]
        forward = views.R[:, 2, :2]
        K = views.K
        keyframe = _keyframes(path, step_m)
        left = -(K[:, 0, 2] + 0.5) / K[:, 0, 0]
        right = (size_px[:, 0] - 0.5 - K[:, 0, 2]) / K[:, 0, 0]
        return cls(
            path_m=path[frame],
            center_m=np.ascontiguousarray(center[:, :2]),
            forward=unit_vectors(forward),
            edges=np.stack([left, right], axis=1),
            focal_px=K[:, 0, 0].copy(),
            size_px=size_px,
            keyframe=keyframe[frame],
            is_key=(np.diff(keyframe, prepend=-1) > 0)[frame],
        )


def _keyframes(path_m: FloatArray, step_m: float) -> IntArray:
    """Return the number (f,) of the position that each frame belongs to, ascending."""
    result = np.zeros(len(path_m), dtype=np.int64)
    at_m = path_m[0] if len(path_m) else 0.0
    for row in range(1, len(path_m)):
        new = path_m[row] - at_m >= step_m
        at_m = path_m[row] if new else at_m
        result[row] = result[row - 1] + new
    return result


class AgreedEnds(NamedTuple):
    """Which ends of k detections count."""

    known: BoolArray
    """(k, 2) anchor, end"""
    spread: FloatArray
    """(k,) by how much the ends scatter more than their sigma says, 1 or more"""


def agreed_ends(rays: GroundRays, track: IntArray, at_m: FloatArray) -> AgreedEnds:
    """Return the ends of poles that agree in height; ``track`` (k,) is a row of ``at_m`` (n, 2), or
    negative. Ends of signs, and those outside all tracks, stay as they are."""
    result, spread = rays.known.copy(), np.ones(len(track))
    on_pole = (track >= 0) & np.isfinite(rays.slope[:, 1])
    n = len(at_m)
    worst = np.ones(n)
    for which in range(2):
        rows = np.flatnonzero(on_pole & rays.known[:, which])
        of = track[rows]
        distance = np.linalg.norm(at_m[of] - rays.origin_m[rows, :2], axis=1)
        height = rays.origin_m[rows, 2] + rays.slope[rows, which] * distance
        sigma = np.hypot(distance * rays.slope_sigma[rows], _AGREE_M / _AGREE_SIGMAS)
        middle = _weighted_medians(of, height, 1.0 / sigma, n)
        off = np.abs(height - middle[of]) / sigma
        fits = off <= _AGREE_SIGMAS
        several = np.bincount(of, minlength=n)
        agreeing = np.bincount(of[fits], minlength=n)
        agreed = (agreeing >= _LEAST_ENDS) & (agreeing >= _LEAST_SHARE * several)
        result[rows, which] = fits & agreed[of]
        worst = np.maximum(worst, _weighted_medians(of, off, np.ones(len(of)), n) / 0.6745)
    spread[on_pole] = worst[track[on_pole]]
    return AgreedEnds(result, spread)


def _weighted_medians(
    group: IntArray, values: FloatArray, weights: FloatArray, count: int
) -> FloatArray:
    """Return the weighted median (count,) of the values (m,) of each group; 0 without any."""
    order = np.lexsort((values, group))
    group, values, weights = group[order], values[order], weights[order]
    total = np.bincount(group, weights, minlength=count)
    before = np.cumsum(total) - total
    share = np.cumsum(weights) - before[group]
    upper = np.flatnonzero(share >= 0.5 * total[group] * (1.0 - 1e-9))
    result = np.zeros(count)
    result[group[upper][::-1]] = values[upper][::-1]
    return result


_REACH_M = 30.0
"""A mark on the camera is searched for in images this far before and after, along the drive."""
_MARK_SHARE, _MARK_IMAGES = 0.55, 8
"""A detection is a mark if at least this share and number of them have it at the same pixel."""
_SAME_SIGMAS = 3.0
_USUAL, _CHANCE = 0.75, 0.01
"""A moving object is what both cameras see together a quarter as often as is usual (this quantile
of all tracks), or less; and the chance of giving up a landmark that they see that often."""
_MOVED_M = 30.0
"""Within less of a drive nothing is a mark: what is far ahead hardly moves, either."""


def marks_on_camera(
    observations: ObservationArray, rows: IntArray, kind: IntArray, views: ViewArray,
    images: DriveImages, sigma_px: float,
) -> BoolArray:  # fmt: skip
    """Return which observations in rows (m,), of classes ``kind`` (m,), stay at one pixel.

    ``sigma_px`` is the common sigma of observations.
    """
    result = np.zeros(len(rows), dtype=np.bool_)
    is_line = observations.is_line[rows]
    pixels = np.concatenate([observations.anchor_px[rows], observations.end_px[rows]], axis=1)
    pixels[~is_line, 2:] = pixels[~is_line, :2]
    sigma = sigma_px * observations.sigma_ratio[rows]
    view = observations.view[rows]
    for is_right in (False, True):
        shown = np.flatnonzero((views.is_right == is_right) & images.is_key)
        number = np.full(len(views), -1)
        number[shown] = np.arange(len(shown))
        some = np.flatnonzero(number[view] >= 0)
        some = some[np.argsort(number[view[some]], kind="stable")]
        image = number[view[some]]
        begin = np.searchsorted(image, np.arange(len(shown) + 1))
        result[some] = _stay(
            pixels[some], sigma[some], kind[some], image, begin, images.path_m[shown]
        )
    return result


@compiled
def _stay(
    pixels: FloatArray,
    sigma: FloatArray,
    kind: IntArray,
    image: IntArray,
    begin: IntArray,
    path: FloatArray,
) -> BoolArray:
    """Return which detections (m,) are at the same pixels in most images (v,) around; rows by
    image."""
    result = np.zeros(len(image), np.bool_)
    for i in range(len(image)):
        first = np.searchsorted(path, path[image[i]] - _REACH_M)
        last = np.searchsorted(path, path[image[i]] + _REACH_M)
        if path[last - 1] - path[first] < _MOVED_M:
            continue
        count = 0
        for other in range(first, last):
            for j in range(begin[other], begin[other + 1]):
                off = np.abs(pixels[j] - pixels[i])
                across = _SAME_SIGMAS * np.hypot(sigma[i, 0], sigma[j, 0])
                along = _SAME_SIGMAS * np.hypot(sigma[i, 1], sigma[j, 1])
                same = max(off[0], off[2]) < across and max(off[1], off[3]) < along
                if same and kind[i] == kind[j]:
                    count += 1
                    break
        result[i] = count >= _MARK_IMAGES and count >= _MARK_SHARE * (last - first)
    return result


def moving_tracks(
    views: ViewArray,
    images: DriveImages,
    searched: BoolArray,
    view: IntArray,
    track: IntArray,
    at_m: FloatArray,
) -> BoolArray:
    """Return which tracks at (t, 2) only one of two cameras sees, although both should.

    ``track`` (k,) of observations in ``view`` (k,) may be negative; ``searched`` (v,) tells images
    that a detector has processed. One camera alone cannot tell.
    """
    from scipy.stats import binom

    partner = _partners(views)
    rows = np.flatnonzero((track >= 0) & (partner[view] >= 0))
    other = partner[view[rows]]
    rows, other = rows[searched[other]], other[searched[other]]
    in_view = _in_view(images, other, at_m[track[rows]])
    rows, other = rows[in_view], other[in_view]
    cell = track[rows] * len(views)
    seen_by_both = np.isin(cell + other, track[track >= 0] * len(views) + view[track >= 0])
    count = np.bincount(track[rows], minlength=len(at_m))
    both = np.bincount(track[rows[seen_by_both]], minlength=len(at_m))
    alone = count - both
    frames = alone + both // 2
    shares = (both // 2)[frames > 0] / frames[frames > 0]
    usual = float(np.quantile(shares, _USUAL)) if len(shares) else 0.0
    return np.asarray((frames > 0) & (binom.cdf(both // 2, frames, usual / 4.0) < _CHANCE))


def _partners(views: ViewArray) -> IntArray:
    """Return the other image (v,) of the same frame; -1 if there is none."""
    result = np.full(len(views), -1)
    pairs = np.flatnonzero(np.diff(views.frame_index) == 0)
    result[pairs], result[pairs + 1] = pairs + 1, pairs
    return result


def _in_view(images: DriveImages, image: IntArray, at_m: FloatArray) -> BoolArray:
    """Return whether positions (m, 2) are between the left and right edges of images (m,)."""
    away = at_m - images.center_m[image]
    forward = images.forward[image]
    ahead = (away * forward).sum(axis=1)
    aside = away[:, 0] * forward[:, 1] - away[:, 1] * forward[:, 0]
    edges = images.edges[image]
    return np.asarray((ahead > 0.0) & (aside > ahead * edges[:, 0]) & (aside < ahead * edges[:, 1]))
