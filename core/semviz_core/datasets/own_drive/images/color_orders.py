"""How recorded images hold their colours: red or blue first, or raw.

A raw image has a grey level for each pixel, behind red, green or blue in turn. Two pixels of four
are behind green, on one diagonal, so these two are alike. The other two are behind red and blue,
and differ over whole areas, as neighbours in a grey image never do.
"""

from typing import Literal, TypeAlias, get_args

import numpy as np

from semviz_core.common.arrays import ByteImage, FloatArray

BayerPattern: TypeAlias = Literal["rggb", "bggr", "gbrg", "grbg"]
"""The first two pixels of the first row, then of the second."""
BAYER_PATTERNS: tuple[BayerPattern, ...] = get_args(BayerPattern)
ColorOrder: TypeAlias = Literal["rgb", "bgr", BayerPattern]
EXCHANGED: dict[ColorOrder, ColorOrder] = {
    "rgb": "bgr", "bgr": "rgb", "rggb": "bggr", "bggr": "rggb", "gbrg": "grbg", "grbg": "gbrg",
}  # fmt: skip
"""The same with red and blue exchanged."""
_BLOCK = 32
_LEAST_DIFFERENCE, _LEAST_RATIO = 0.04, 2.5
"""Of the upper quarter of blocks: difference of red and blue as a share of the level, and over that
of the two greens. Grey real images have at most 0.027 and 1.2, mosaics at least 0.085 and 6."""


def demosaiced(image: ByteImage, pattern: BayerPattern) -> ByteImage:
    """Return (height, width, 3) sRGB of a raw image (height, width) or (height, width, 3)."""
    import cv2

    codes = {  # OpenCV names the second row's second and third pixel
        "rggb": cv2.COLOR_BayerBG2RGB,
        "bggr": cv2.COLOR_BayerRG2RGB,
        "gbrg": cv2.COLOR_BayerGR2RGB,
        "grbg": cv2.COLOR_BayerGB2RGB,
    }
    gray = np.ascontiguousarray(image if image.ndim == 2 else image[:, :, 0])
    return np.asarray(cv2.cvtColor(gray, codes[pattern]), np.uint8)


def mosaic_of(image: ByteImage) -> BayerPattern | None:
    """Return the pattern of a raw image (height, width, 3), red and blue perhaps exchanged.

    None for an image that is grey or in colour already.
    """
    gray = image[:, :, 0]
    if not (np.array_equal(gray, image[:, :, 1]) and np.array_equal(gray, image[:, :, 2])):
        return None
    height, width = (size // _BLOCK * _BLOCK for size in gray.shape)
    if not height or not width:
        return None
    pixels = gray[:height, :width].astype(np.float64)
    (first, second), (third, fourth) = (
        (pixels[row::2, ::2], pixels[row::2, 1::2]) for row in (0, 1)
    )
    level = _in_blocks(first + second + third + fourth) / 4.0 + 8.0  # black areas tell nothing
    outer, inner = (
        float(np.percentile(np.abs(_in_blocks(difference)) / level, 75.0))
        for difference in (first - fourth, second - third)
    )
    least, most = sorted((outer, inner))
    if most < _LEAST_DIFFERENCE or most < _LEAST_RATIO * least:
        return None
    return "gbrg" if inner > outer else "rggb"


def _in_blocks(quarter: FloatArray) -> FloatArray:
    """Return the means of blocks of an array with one value for four pixels."""
    size = _BLOCK // 2
    rows, columns = quarter.shape[0] // size, quarter.shape[1] // size
    return np.asarray(quarter.reshape(rows, size, columns, size).mean(axis=(1, 3)))
