"""Whether left and right images are what they are called, as the images themselves show."""

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.camera import Rig
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Source

PAIRS_READ = 2
CORNERS = 150
PATCH_PX = 9
"""At half size."""
SAME = 0.9
"""Normalized cross-correlation of a patch with its partner."""
CLEARLY = 0.1
"""By so much the better side wins."""
FEWEST_VOTES = 15
MAJORITY = 6
"""So many corners must speak for swapped images, and so many times those that speak against."""


def check_sides(source: Source) -> None:
    """Refuses pairs whose left and right images are swapped, as a few of them show.

    Corners of the left image are looked for along their epipolar lines, ahead of the cameras and
    behind them: in swapped images nearly all that are found are behind.
    """
    if source.rig.right is None:
        return
    ahead = behind = 0
    frames = source.frames
    for place in np.linspace(0, len(frames) - 1, PAIRS_READ + 2)[1:-1]:
        index = frames[round(place)].index
        try:
            left, right = source.image(index, "left"), source.image(index, "right")
        except SemvizError:  # whoever wants to see this image will be told
            continue
        votes = _votes(source.rig, left, right)
        ahead, behind = ahead + votes[0], behind + votes[1]
    if behind >= max(FEWEST_VOTES, MAJORITY * ahead):
        raise SemvizError(
            f"left and right images are swapped: baseline is {-source.rig.baseline_m:.2f} m by "
            f"{behind} of {ahead + behind} corners found in both. Nothing was loaded; exchange "
            "the two image folders"
        )


def _votes(rig: Rig, left: ByteImage, right: ByteImage) -> tuple[int, int]:
    """How many corners are clearly found ahead of the cameras, and behind them."""
    corners, places = _candidates(rig, left)
    if not len(corners):
        return 0, 0
    scores = _correlations(_half(left), _half(right), corners, places)
    middle = scores.shape[1] // 2
    at_infinity = scores[:, middle - 1 : middle + 2].max(axis=1)
    behind, ahead = scores[:, : middle - 1].max(axis=1), scores[:, middle + 2 :].max(axis=1)
    best = np.maximum(ahead, behind)
    clear = (best > SAME) & (np.abs(ahead - behind) > CLEARLY) & (best > at_infinity)
    return int((clear & (ahead > behind)).sum()), int((clear & (behind > ahead)).sum())


def _candidates(rig: Rig, left: ByteImage) -> tuple[IntArray, IntArray]:
    """Corners (n, 2) of the left image, and where each may be in the right one (n, k, 2).

    Both in px at half size; the k places go from behind the cameras over infinity to ahead.
    """
    import cv2

    assert rig.right is not None
    assert rig.T_right_left is not None
    reach = rig.left.width // 10  # px of disparity; KITTI's is 4 m ahead
    half = _half(left)
    mask = np.zeros(half.shape, np.uint8)
    mask[PATCH_PX:-PATCH_PX, reach // 2 + PATCH_PX : -(reach // 2 + PATCH_PX)] = 1
    found = cv2.goodFeaturesToTrack(half, CORNERS, 0.02, 8.0, mask=mask)
    if found is None or reach < PATCH_PX:
        return np.zeros((0, 2), np.int64), np.zeros((0, 0, 2), np.int64)
    corners = np.rint(found.reshape(-1, 2)).astype(np.int64)
    full_size_px = corners.astype(np.float64) * 2.0 + 0.5
    rays = np.column_stack([rig.left.normalize(full_size_px), np.ones(len(corners))])
    steps = np.arange(-reach, reach + 1, 2) / (rig.left.K[0, 0] * rig.baseline_m)
    towards = rays @ rig.T_right_left.rotation.T
    points = towards[:, None] + steps[None, :, None] * rig.T_right_left.translation
    pixels = rig.right.project(points.reshape(-1, 3)).reshape(len(corners), -1, 2)
    places = np.rint((np.nan_to_num(pixels, nan=-1e6) - 0.5) / 2.0)
    return corners, places.astype(np.int64)


def _half(image: ByteImage) -> ByteImage:
    """(h/2, w/2) grey."""
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return np.asarray(half, dtype=np.uint8)


def _correlations(
    left: ByteImage, right: ByteImage, corners: IntArray, places: IntArray
) -> FloatArray:
    """(n, k) normalized cross-correlation of each corner with each of its places; -1 outside."""
    patches = _patches(left, corners)
    inside = _inside(right, places)
    partners = _patches(right, np.where(inside[..., None], places, PATCH_PX))
    scores = np.einsum("np,nkp->nk", patches, partners)
    return np.where(inside, scores, -1.0).astype(np.float64)


def _patches(image: ByteImage, centers: IntArray) -> NDArray[np.float32]:
    """(..., patch) of mean 0 and length 1 (flat ones: all 0) round (..., 2) centers."""
    offsets = np.arange(PATCH_PX) - PATCH_PX // 2
    u = centers[..., 0, None, None] + offsets
    v = centers[..., 1, None, None] + offsets[:, None]
    patches = image[v, u].astype(np.float32).reshape(*centers.shape[:-1], -1)
    patches -= patches.mean(axis=-1, keepdims=True)
    lengths = np.linalg.norm(patches, axis=-1, keepdims=True)
    return np.asarray(patches / np.maximum(lengths, 1.0), dtype=np.float32)


def _inside(image: ByteImage, centers: IntArray) -> BoolArray:
    height, width = image.shape
    margin = PATCH_PX // 2
    u, v = centers[..., 0], centers[..., 1]
    inside = (u >= margin) & (u < width - margin) & (v >= margin) & (v < height - margin)
    return np.asarray(inside, dtype=np.bool_)
