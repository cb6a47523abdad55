"""Dense depth of a rectified stereo pair by semi-global matching (Hirschmüller 2008), with OpenCV.

A depth is kept only where left and right agree, the match is clearly the best of its row, and
the depth lies within limits: its standard deviation grows with its square. Near the border of
what is matched it needs texture, too; otherwise poles and trees would wear a halo of sky.
"""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.camera import Rig
from semviz_core.common.arrays import BoolArray, ByteImage
from semviz_core.common.errors import SemvizError

DepthImage = NDArray[np.float32]
"""(height, width) depth along the optical axis of the left camera, metres; NaN if unknown."""

NEAREST_M = 4.0
"""Nearer surfaces are not matched. The road enters KITTI's images at 6 m."""
BLOCK_PX = 5
_MATCHING: Mapping[str, int] = {
    "P1": 8 * BLOCK_PX**2,
    "P2": 32 * BLOCK_PX**2,
    "disp12MaxDiff": 1,
    "uniquenessRatio": 10,
    "speckleWindowSize": 120,
    "speckleRange": 1,
    "preFilterCap": 31,
}
_TEXTURE = 1.5
"""Least horizontal gradient near a depth at a border, in shades of 255 per pixel."""
_BORDER_PX = 17
"""Width of the window in which all pixels must have a depth where there is no texture."""
_STEPS_PER_PX = 16.0
"""OpenCV's disparities are whole numbers of sixteenths of a pixel."""
_LARGEST_OFFSET_PX = 1.0
"""Rows of a rectified pair differ by less, at ``NEAREST_M``."""


class StereoDepth:
    """Depths of one rig's images, up to ``farthest_m``.

    Raises SemvizError for a rig with one camera, and for one whose images are not rectified.
    """

    def __init__(self, rig: Rig, farthest_m: float) -> None:
        if rig.right is None or rig.T_right_left is None:
            raise SemvizError("one camera: stereo depth needs a left and a right camera")
        K, K_right = rig.left.K, rig.right.K
        self.length_px = float(K[0, 0])
        """Focal length."""
        self.baseline_m = -float(rig.T_right_left.translation[0])
        self._farthest_m = farthest_m
        self._offset_px = float(K[0, 2] - K_right[0, 2])
        """Disparity at infinity."""
        down_m = abs(float(rig.T_right_left.translation[1]))
        rows_px = abs(K[1, 2] - K_right[1, 2]) + self.length_px * down_m / NEAREST_M
        if (
            rig.left.distortion.any()
            or rig.right.distortion.any()
            or rows_px > _LARGEST_OFFSET_PX
            or not np.allclose(K[:2, :2], K_right[:2, :2], rtol=1e-4)
            or not np.allclose(rig.T_right_left.rotation, np.eye(3), atol=1e-4)
        ):
            raise SemvizError("the stereo images are not rectified; rectify them first")

    def disparity_px(self, depth_m: DepthImage) -> DepthImage:
        """Return the disparities of depths, without that of infinity."""
        return np.asarray(self.length_px * self.baseline_m / depth_m, dtype=np.float32)

    def depth_m(self, left: ByteImage, right: ByteImage) -> DepthImage:
        """Return the depth of each pixel of the left image; both are (height, width, 3) sRGB."""
        grey, grey_right = _grey(left), _grey(right)
        steps = self._matcher.compute(grey, grey_right)
        disparity = steps.astype(np.float32) / _STEPS_PER_PX - np.float32(self._offset_px)
        least_px = self.length_px * self.baseline_m / self._farthest_m
        is_matched = (steps >= 0) & (disparity >= least_px)
        disparity[~(is_matched & (_inside(is_matched) | _is_textured(grey)))] = np.nan
        return np.asarray(self.length_px * self.baseline_m / disparity, dtype=np.float32)

    @cached_property
    def _matcher(self) -> Any:
        largest_px = self.length_px * self.baseline_m / NEAREST_M + max(self._offset_px, 0.0)
        return cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=16 * int(np.ceil(largest_px / 16.0)),
            blockSize=BLOCK_PX,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
            **_MATCHING,
        )


def _grey(image: ByteImage) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _inside(is_matched: BoolArray) -> BoolArray:
    """Return the pixels around which all are matched; beyond the image's border all are."""
    window = np.ones((_BORDER_PX, _BORDER_PX), np.uint8)
    return np.asarray(cv2.erode(is_matched.view(np.uint8), window) > 0)


def _is_textured(grey: NDArray[np.uint8]) -> BoolArray:
    """Return the pixels near which the image changes along its rows: there a match is unique."""
    gradient = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=0.125))
    largest = cv2.dilate(gradient, np.ones((BLOCK_PX, BLOCK_PX), np.uint8))
    return np.asarray(largest >= _TEXTURE)
