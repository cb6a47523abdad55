"""Sample an image between its pixels, bilinearly, and downsample patches of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.jit import compiled

Samples = NDArray[np.float32]
"""(rows, columns, 3) colours, 0 to 255."""


@compiled
def _mixed(
    image: ByteImage,
    x: np.uint32,
    y: np.uint32,
    right: np.uint32,
    down: np.uint32,
    du: float,
    dv: float,
    channel: np.uint32,
) -> float:
    """Return a channel's bilinear mean of four pixels at shares of the way right and down."""
    upper = image[y, x, channel] * (1.0 - du) + image[y, right, channel] * du
    lower = image[down, x, channel] * (1.0 - du) + image[down, right, channel] * du
    return float(upper + dv * (lower - upper))


@compiled
def color_at(image: ByteImage, u: float, v: float) -> tuple[float, float, float]:
    """Return the colour at a point, bilinearly; the border is extended, also to NaN."""
    height, width = image.shape[:2]
    u = min(max(0.0, u), width - 1.0)  # 0 for NaN, which is not larger
    v = min(max(0.0, v), height - 1.0)
    x, y = np.uint32(u), np.uint32(v)  # unsigned: no index counts from the end
    right, down = np.uint32(min(x + 1, width - 1)), np.uint32(min(y + 1, height - 1))
    du, dv = u - x, v - y
    return (  # a tuple, so that no array is allocated
        _mixed(image, x, y, right, down, du, dv, np.uint32(0)),
        _mixed(image, x, y, right, down, du, dv, np.uint32(1)),
        _mixed(image, x, y, right, down, du, dv, np.uint32(2)),
    )


@compiled
def _colors_at(image: ByteImage, points_px: FloatArray) -> Samples:
    """Return (n, 3) colours at points (n, 2)."""
    colors = np.empty((len(points_px), 3), np.float32)
    for k in range(len(points_px)):
        color = color_at(image, points_px[k, 0], points_px[k, 1])
        for channel in range(3):
            colors[k, channel] = color[channel]
    return colors


@dataclass(frozen=True, eq=False)
class SampledImage:
    """An image that can be sampled between its pixels."""

    image: ByteImage
    """(height, width, 3) sRGB; shared, and copied only if its pixels are not contiguous."""

    def __post_init__(self) -> None:
        """Give all images one type: functions are compiled anew for each."""
        image = np.ascontiguousarray(self.image).view()
        image.flags.writeable = False
        object.__setattr__(self, "image", image)

    def sample(self, points_px: FloatArray) -> Samples:
        """Return (n, m, 3) colours at points (n, m, 2), bilinearly; the border is extended."""
        places = np.ascontiguousarray(points_px, dtype=np.float64)
        colors = _colors_at(self.image, places.reshape(-1, 2))
        return colors.reshape(*places.shape[:-1], 3)

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
