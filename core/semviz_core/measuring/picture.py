"""An image, sampled between its pixels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import ByteImage, FloatArray

Samples = NDArray[np.float32]
"""(rows, columns, 3) colours, 0 to 255."""


@dataclass(frozen=True, eq=False)
class Picture:
    """One image."""

    image: ByteImage
    """(height, width, 3) sRGB; shared, not copied."""

    def sample(self, points_px: FloatArray) -> Samples:
        """(n, m, 3) colours at points (n, m, 2), bilinear; the border's colour beyond it."""
        import cv2

        height, width = self.image.shape[:2]
        points = np.clip(points_px, [-1.0, -1.0], [width, height])
        points = np.nan_to_num(points, nan=-1.0)
        low = np.floor(points.min(axis=(0, 1))).astype(int) - 1
        high = np.ceil(points.max(axis=(0, 1))).astype(int) + 2
        (x0, y0), (x1, y1) = np.maximum(low, 0), np.minimum(high, [width, height])
        x0, y0 = min(x0, width - 1), min(y0, height - 1)
        window = self.image[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)].astype(np.float32)
        u, v = np.moveaxis((points - [x0, y0]).astype(np.float32), -1, 0)
        found = cv2.remap(window, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found, dtype=np.float32)

    def shrunk(self, middle_px: FloatArray, scale: float, half: int) -> Samples:
        """(2 half + 1, 2 half + 1, 3) colours round a point, ``scale`` pixels each, smoothed."""
        import cv2

        height, width = self.image.shape[:2]
        reach = int(np.ceil((half + 2) * scale))
        x, y = np.round(middle_px).astype(int)
        x0, x1 = (int(np.clip(one, 0, width - 1)) for one in (x - reach, x + reach))
        y0, y1 = (int(np.clip(one, 0, height - 1)) for one in (y - reach, y + reach))
        window = self.image[y0 : y1 + 1, x0 : x1 + 1].astype(np.float32)
        smooth = cv2.GaussianBlur(window, (0, 0), 0.5 * scale)
        left, top = middle_px - half * scale - [x0, y0]
        matrix = np.array([[scale, 0.0, left], [0.0, scale, top]])
        size = (2 * half + 1, 2 * half + 1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        found = cv2.warpAffine(smooth, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found, dtype=np.float32)
