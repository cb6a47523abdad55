"""Sample an image between its pixels, bilinearly, and downsample patches of it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import ByteImage, FloatArray

Samples = NDArray[np.float32]
"""(rows, columns, 3) colours, 0 to 255."""


@dataclass(frozen=True, eq=False)
class SampledImage:
    """An image that can be sampled between its pixels."""

    image: ByteImage
    """(height, width, 3) sRGB; shared, not copied."""

    def sample(self, points_px: FloatArray) -> Samples:
        """Return (n, m, 3) colours at points (n, m, 2), bilinearly; the border is extended."""
        import cv2

        height, width = self.image.shape[:2]
        u, v = points_px[..., 0], points_px[..., 1]
        reach = (float(u.min()), float(v.min()), float(u.max()), float(v.max()))
        if not (min(reach) >= -1.0 and reach[2] <= width and reach[3] <= height):  # or NaN
            u = np.nan_to_num(np.clip(u, -1.0, width), nan=-1.0)
            v = np.nan_to_num(np.clip(v, -1.0, height), nan=-1.0)
            reach = (float(u.min()), float(v.min()), float(u.max()), float(v.max()))
        x0 = min(max(math.floor(reach[0]) - 1, 0), width - 1)
        y0 = min(max(math.floor(reach[1]) - 1, 0), height - 1)
        x1, y1 = max(math.ceil(reach[2]) + 2, x0 + 1), max(math.ceil(reach[3]) + 2, y0 + 1)
        window = self.image[y0:y1, x0:x1].astype(np.float32)
        x, y = (u - x0).astype(np.float32), (v - y0).astype(np.float32)
        sampled = cv2.remap(window, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(sampled, dtype=np.float32)

    def shrunk(self, middle_px: FloatArray, scale: float, half: int) -> Samples:
        """Return smoothed colours (2 half + 1, 2 half + 1, 3) at steps of ``scale`` px."""
        import cv2

        height, width = self.image.shape[:2]
        reach = int(np.ceil((half + 2) * scale))
        x, y = np.round(middle_px).astype(int)
        x0, x1 = (int(np.clip(edge, 0, width - 1)) for edge in (x - reach, x + reach))
        y0, y1 = (int(np.clip(edge, 0, height - 1)) for edge in (y - reach, y + reach))
        window = self.image[y0 : y1 + 1, x0 : x1 + 1].astype(np.float32)
        smooth = cv2.GaussianBlur(window, (0, 0), 0.5 * scale)
        left, top = middle_px - half * scale - [x0, y0]
        matrix = np.array([[scale, 0.0, left], [0.0, scale, top]])
        size = (2 * half + 1, 2 * half + 1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        patch = cv2.warpAffine(smooth, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(patch, dtype=np.float32)
