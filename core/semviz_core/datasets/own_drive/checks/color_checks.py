"""Check that red and blue are not swapped in the images of a drive, by its sky and its leaves.

A blue sky turns orange, as in the evening. Leaves tell the two apart: they have more red than blue
in any light, and more blue than red if these are swapped. Without a blue sky, or without leaves,
nobody can tell.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.base.frame import Dataset
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.common.errors import SemvizError

COLOR_IMAGES = 8
ORANGE = -30.0
"""Of the sky, blue minus red, in levels of 256; a grey sky has 0, a blue one 15 to 130."""
LEAST_BLUISH = 2.0
"""Of leaves, if red and blue are swapped; else they have -4 to -30."""
_SIZE = (160, 90)
_LEAST_PIXELS = 200
"""Of sky and of leaves, in all images, at that size."""
_BRIGHT, _SMOOTH = 120.0, 6.0
_GREENER = 8.0


@dataclass(frozen=True)
class ColorCheck:
    """Median of blue minus red, in levels of 256; NaN where too little is seen."""

    images: int
    sky: float
    leaves: float

    @property
    def is_swapped(self) -> bool | None:
        """Whether red and blue are swapped; None if that cannot be told."""
        is_bluish = self.leaves >= LEAST_BLUISH
        if self.sky >= -ORANGE and not is_bluish:
            return False
        return True if self.sky <= ORANGE and is_bluish else None


def check_colors(dataset: Dataset) -> ColorCheck:
    """Compare blue and red in up to ``COLOR_IMAGES`` left images; damaged ones are left out."""
    import cv2

    count = min(COLOR_IMAGES, len(dataset.frames))
    rows = np.linspace(0, len(dataset.frames) - 1, count).round().astype(int)
    sky, leaves, images = [np.zeros(0)], [np.zeros(0)], 0
    for row in rows.tolist():
        try:
            image = dataset.image(dataset.frames[row].index, "left")
        except SemvizError:  # raised again when this image is shown
            continue
        small = np.asarray(cv2.resize(image, _SIZE, interpolation=cv2.INTER_AREA), np.float64)
        bluer = small[:, :, 2] - small[:, :, 0]
        sky.append(bluer[_is_sky(small)])
        leaves.append(bluer[small[:, :, 1] > small[:, :, [0, 2]].max(axis=2) + _GREENER])
        images += 1
    return ColorCheck(images, _median(np.concatenate(sky)), _median(np.concatenate(leaves)))


def _is_sky(image: FloatArray) -> BoolArray:
    """Return which pixels of an image are above, bright and smooth."""
    import cv2

    gray = image.mean(axis=2)
    is_sky = (gray > _BRIGHT) & (np.abs(cv2.Laplacian(gray, cv2.CV_64F)) < _SMOOTH)
    is_sky[len(gray) // 3 :] = False
    return np.asarray(is_sky, dtype=np.bool_)


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) >= _LEAST_PIXELS else float("nan")
