"""Detections of what is no landmark, although they agree: marks on the camera, and moving objects.

Dirt on the lens and the car's own parts stay at one pixel while the camera moves; in a bend, their
rays nearly meet. An object that comes along looks to one camera like something nearer that stands
still; the other camera then sees it elsewhere.
"""

import numpy as np

from semviz_annotation.mapping.association.ground_rays import DriveImages
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled

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
