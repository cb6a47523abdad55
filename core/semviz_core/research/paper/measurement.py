"""Measure an element in a region as the paper does (section III-A): edges in a box.

The box is grown by 10 % and the mask's outside blanked. Canny edges are dilated and eroded. A
sign is the centre of the area they cover, a pole the line through them, given by peak and
direction.
"""

from collections.abc import Sequence

import numpy as np

from semviz_core.base.classes import POLE
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.detection.regions import PAPER, MeasuredElement, Region
from semviz_core.detection.sign_centers import class_by_mask, turn_of_mask
from semviz_core.subpixel.sampling import SampledImage

_GROWN = 0.1
_CANNY = (50, 150)
_KERNEL_PX = 3
_FEWEST = 4


def measure_as_in_paper(
    picture: SampledImage, region: Region, _signs: Sequence[Region] = ()
) -> MeasuredElement | None:
    """Return the element of a region; None if it has no edges."""
    points = edge_points(picture, region)
    if len(points) < _FEWEST:
        return None
    if region.class_id == POLE:
        ends = peak_and_bottom(points)
        known = region.ends_known or (True, True)
        return (
            None if ends is None else MeasuredElement(POLE, region.score, ends, PAPER, known, 1.0)
        )
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    size = float(np.ptp(points, axis=0).min()) / 2.0
    class_id = class_by_mask(region) if region.class_id is None else region.class_id
    sigma = (PAPER[0], PAPER[0])
    sixth = float(np.ptp(points[:, 1])) / 6.0 * (turn_of_mask(region) or 1)
    return MeasuredElement(
        class_id, region.score, middle[None], sigma, (True, False), size, to_centroid_px=sixth
    )


def edge_points(picture: SampledImage, region: Region) -> FloatArray:
    """Return the pixels (n, 2) on closed edges within a region."""
    import cv2

    height, width = picture.image.shape[:2]
    low, high = region.box_px[:2], region.box_px[2:]
    grown = _GROWN / 2.0 * (high - low)
    last = np.array([width - 1, height - 1])
    left, top = np.clip(np.floor(low - grown), 0, last).astype(int)
    right, bottom = np.clip(np.ceil(high + grown), 0, last).astype(int)
    window = picture.image[top : bottom + 1, left : right + 1]
    edges = cv2.Canny(_blanked(window, region, left, top), *_CANNY)
    kernel = np.ones((_KERNEL_PX, _KERNEL_PX), np.uint8)
    closed = cv2.erode(cv2.dilate(edges, kernel), kernel)
    rows, columns = np.nonzero(closed)
    return np.stack([columns + left, rows + top], axis=1).astype(np.float64)


def _blanked(window: ByteImage, region: Region, left: int, top: int) -> ByteImage:
    """Return a window in grey, black outside the region's mask."""
    import cv2

    gray = np.asarray(cv2.cvtColor(np.ascontiguousarray(window), cv2.COLOR_RGB2GRAY), np.uint8)
    if region.mask is None:
        return gray
    shown = np.zeros(gray.shape, bool)
    x, y = region.corner_px[0] - left, region.corner_px[1] - top
    rows = slice(max(0, -y), max(0, gray.shape[0] - y))
    piece = region.mask[rows, max(0, -x) : max(0, gray.shape[1] - x)]
    x, y = max(0, x), max(0, y)
    shown[y : y + piece.shape[0], x : x + piece.shape[1]] = piece
    return np.asarray(np.where(shown, gray, 0), np.uint8)


def peak_and_bottom(points: FloatArray) -> FloatArray | None:
    """Return the ends (2, 2) of the line through points (n, 2), upper first; None for a spot."""
    import cv2

    fitted = cv2.fitLine(points.astype(np.float32), cv2.DIST_L2, 0, 0.01, 0.01).reshape(4)
    along, middle = fitted[:2].astype(np.float64), fitted[2:].astype(np.float64)
    along = along if along[1] > 0.0 else -along
    positions = (points - middle) @ along
    if np.ptp(positions) < 1.0:
        return None
    return np.asarray(middle + np.outer([positions.min(), positions.max()], along))
