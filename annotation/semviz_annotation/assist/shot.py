"""One image with its camera, what is marked in it, and what is proposed to be."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.labels import Observation, Pixel
from semviz_annotation.view import View
from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.errors import SemvizError

SURE = 0.8
"""Proposals of this score and more can be accepted by one key together."""
Samples = NDArray[np.float32]
"""(rows, columns, 3) colours, 0 to 255."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One image with its camera."""

    view: View
    image: ByteImage
    """(height, width, 3) sRGB; shared, not copied."""

    @classmethod
    def of(cls, view: View, rgb: ByteImage) -> "Shot":
        """SemvizError where the image is not of the camera's size."""
        expected = (view.camera.height, view.camera.width, 3)
        if rgb.shape != expected or rgb.dtype != np.uint8:
            raise SemvizError(
                f"image is {rgb.shape} of {rgb.dtype}; its camera has {expected} of uint8"
            )
        return cls(view, rgb)

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
        maps = (points - [x0, y0]).astype(np.float32)
        found = cv2.remap(window, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found, dtype=np.float32)


@dataclass(frozen=True)
class Mark:
    """Where a pole or a sign is in one image; an end that is not known is only on the line."""

    anchor_px: Pixel
    """Peak of a pole, middle of a sign."""
    end_px: Pixel | None = None
    """Bottom of a pole; None for signs."""
    anchor_known: bool = True
    end_known: bool = True

    @classmethod
    def of(cls, observation: Observation) -> "Mark":
        """Of a label."""
        one = observation
        return cls(one.anchor_px, one.end_px, one.anchor_known, one.end_known)

    @property
    def ends_px(self) -> FloatArray:
        """(2, 2) of a pole; (1, 2) of a sign."""
        return np.array([one for one in (self.anchor_px, self.end_px) if one is not None])


@dataclass(frozen=True)
class Proposed:
    """A mark that a machine made."""

    mark: Mark
    score: float
    """Estimated probability that it is within 2 px; see ``score``."""

    @property
    def sure(self) -> bool:
        return self.score >= SURE


def pixel(point: FloatArray) -> Pixel:
    return float(point[0]), float(point[1])
