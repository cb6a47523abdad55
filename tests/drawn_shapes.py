"""Poles and signs drawn into images with smooth borders, at known sub-pixel places."""

import cv2
import numpy as np

from semviz_core.base.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.common.arrays import ByteImage, FloatArray

SHARP = 8
"""Shapes are drawn this much larger, and shrunk: their borders are smooth."""
LENS_PX = 0.4
"""Sigma of what a lens blurs."""
SKY, GROUND, METAL = (150, 180, 220), (110, 105, 100), (60, 62, 60)
OUTLINES = {
    TRIANGULAR: np.array([[0.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),
    RECTANGULAR: np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),
    ROUNDED: np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0.0, 6.2, 60)]),
}


def background(rng: np.random.Generator, height: int = 160, width: int = 200) -> ByteImage:
    """Sky over ground, with patches and noise."""
    image = np.empty((height, width, 3), np.float64)
    image[:] = SKY
    image[int(0.7 * height) :] = GROUND
    patches = cv2.resize(rng.normal(0.0, 10.0, (6, 8)), (width, height))
    return np.clip(image + patches[..., None] + rng.normal(0.0, 2.0, image.shape), 0, 255).astype(
        np.uint8
    )


def drawn(image: ByteImage, polygon: FloatArray, color: tuple[int, int, int]) -> ByteImage:
    """A filled polygon (n, 2) in px, with smooth borders."""
    height, width = image.shape[:2]
    large = np.zeros((height * SHARP, width * SHARP), np.uint8)
    points = (polygon + 0.5) * SHARP - 0.5
    cv2.fillPoly(large, [np.round(points * 16).astype(np.int32)], 255, cv2.LINE_8, 4)
    small = cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA) / 255.0
    share = cv2.GaussianBlur(small, (5, 5), LENS_PX)[..., None]
    return np.asarray(np.round(image * (1.0 - share) + share * np.array(color)), np.uint8)


def pole_polygon(ends: FloatArray, width_px: float) -> FloatArray:
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    half = width_px / 2.0 * np.array([along[1], -along[0]])
    return np.array([ends[0] - half, ends[0] + half, ends[1] + half, ends[1] - half])
