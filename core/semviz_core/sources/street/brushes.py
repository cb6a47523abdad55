"""Brushes: what puts polygons, textures and round poles on a picture, smooth to a sub-pixel."""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.sources.street.things import Color, FloatPicture
from semviz_core.sources.street.view import View

_EDGE_ON_PX = 0.8  # thinner than this a texture is not to be seen
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


def fixed(polygon_px: FloatArray) -> NDArray[np.int32]:
    """Pixels in OpenCV's fixed-point coordinates, for ``shift=SHIFT``."""
    return np.round(polygon_px * (1 << _SHIFT)).astype(np.int32)


def fill(picture: ByteImage, polygon_px: FloatArray, color: Color) -> None:
    """A smooth-edged polygon (n, 2)."""
    cv2.fillPoly(picture, [fixed(polygon_px)], color, cv2.LINE_AA, _SHIFT)


def fill_mask(
    mask: NDArray[np.uint8] | NDArray[np.int32], polygon_px: FloatArray, value: float
) -> None:
    """A hard-edged polygon (n, 2) in an image of one channel."""
    cv2.fillPoly(mask, [fixed(polygon_px)], value, cv2.LINE_8, _SHIFT)


def mixed(color: Color, other: Color, share: float) -> Color:
    """``share`` of the other colour in this one."""
    a, b, c = (one + share * (two - one) for one, two in zip(color, other, strict=True))
    return (a, b, c)


def lit(color: Color, gain: float) -> Color:
    """A colour brighter (or darker) by a factor."""
    a, b, c = (min(255.0, gain * one) for one in color)
    return (a, b, c)


def halved(picture: NDArray[np.generic], size: tuple[int, int]) -> FloatPicture:
    """Averaged down to (width, height)."""
    pixels = np.asarray(picture, dtype=np.float32)
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture with transparency, and its halvings."""

    levels: tuple[tuple[ByteImage, FloatPicture], ...]
    """Colours (height, width, 3) and opacity (height, width) in 0..1."""

    @classmethod
    def of(cls, colors: FloatPicture, opacity: FloatPicture | None = None) -> "Texture":
        """From (height, width, 3) in 0..255 and (height, width) in 0..1, opaque by default."""
        if opacity is None:
            opacity = np.ones(colors.shape[:2], np.float32)
        levels = []
        while True:
            levels.append((_bytes(colors), opacity))
            height, width = opacity.shape
            if min(height, width) <= 6:
                return cls(tuple(levels))
            size = (width // 2, height // 2)
            colors, opacity = halved(colors, size), halved(opacity, size)

    def level_for(self, width_px: float, height_px: float) -> tuple[ByteImage, FloatPicture]:
        """The halving with about one texel per pixel."""
        height, width = self.levels[0][1].shape
        shrink = max(width / width_px, 1.0) * max(height / height_px, 1.0)
        return self.levels[min(int(0.5 * math.log2(shrink) + 0.3), len(self.levels) - 1)]


@dataclass(frozen=True)
class Air:
    """Light and haze over what is drawn: ``gain`` on its colour, then ``haze`` of the sky's."""

    gain: float
    haze: float
    haze_color: Color

    def table(self) -> ByteImage:
        """(256, 1, 3) what becomes of each colour."""
        levels = np.arange(256.0)[:, None, None] * (self.gain * (1.0 - self.haze))
        return _bytes(levels + np.array(self.haze_color) * self.haze)


def stamp(
    picture: ByteImage,
    view: View,
    texture: Texture,
    corner_m: FloatArray,
    right_m: FloatArray,
    down_m: FloatArray,
    air: Air,
) -> None:
    """A texture on a parallelogram in the map: its top-left corner and both edges (3,)."""
    corners = np.array(
        [corner_m, corner_m + right_m, corner_m + right_m + down_m, corner_m + down_m]
    )
    outline = view.polygon(corners)
    window = None if outline is None else _window(picture, outline)
    if outline is None or window is None:
        return
    x0, y0, x1, y1 = window
    width_px, height_px = _extent(outline)
    area_px2 = cv2.contourArea(outline.astype(np.float32))
    if area_px2 < _EDGE_ON_PX * max(width_px, height_px):
        return
    colors, opacity = texture.level_for(width_px, height_px)
    rows, columns = opacity.shape
    # texel i has its centre at (i + 0.5) / columns of the edge
    scale = np.array([[1 / columns, 0, 0.5 / columns], [0, 1 / rows, 0.5 / rows], [0, 0, 1.0]])
    shift = np.array([[1.0, 0, -x0], [0, 1.0, -y0], [0, 0, 1.0]])
    homography = shift @ view.plane(corner_m, right_m, down_m) @ scale
    size = (x1 - x0, y1 - y0)
    warped = cv2.warpPerspective(colors, homography, size, borderMode=cv2.BORDER_REPLICATE)
    cover = cv2.warpPerspective(opacity, homography, size)
    if len(outline) != 4:  # cut at the near plane: the rest would show mirrored
        mask = np.zeros(cover.shape, np.uint8)
        fill_mask(mask, outline - [x0, y0], 1)
        cover = cover * mask
    lay(picture[y0:y1, x0:x1], cv2.LUT(warped, air.table()), np.asarray(cover, np.float32))


def lay(target: ByteImage, colors: NDArray[Any], cover: FloatPicture) -> None:
    """Lay colours (h, w, 3) over a part of the picture, as far as they cover (h, w) it."""
    target[...] = cv2.blendLinear(colors, np.ascontiguousarray(target), cover, 1.0 - cover)


def rod(
    picture: ByteImage,
    ends_px: FloatArray,
    radii_px: tuple[float, float],
    color: Color,
    light: float,
) -> None:
    """A round rod between two pixels (2, 2), shaded across.

    Coverage is computed for each pixel from its distance to the axis, so that rods much thinner
    than a pixel stay where they are. ``light`` in [-1, 1] is the side the light comes from.
    """
    reach = max(radii_px) + 1.5
    box = np.array([ends_px.min(axis=0) - reach, ends_px.max(axis=0) + reach])
    window = _window(picture, box)
    length = float(np.linalg.norm(ends_px[1] - ends_px[0]))
    if window is None or length < 1e-6:
        return
    x0, y0, x1, y1 = window
    along = (ends_px[1] - ends_px[0]) / length
    x = np.arange(x0, x1)[None, :] - ends_px[0, 0]
    y = np.arange(y0, y1)[:, None] - ends_px[0, 1]
    t = x * along[0] + y * along[1]
    across = -x * along[1] + y * along[0]
    radius = radii_px[0] + (radii_px[1] - radii_px[0]) * np.clip(t / length, 0.0, 1.0)
    cover = np.clip(np.minimum(across + 0.5, radius) - np.maximum(across - 0.5, -radius), 0.0, 1.0)
    cover *= np.clip(np.minimum(t + 0.5, length) - np.maximum(t - 0.5, 0.0), 0.0, 1.0)
    side = np.clip(across / np.maximum(radius, 0.7), -1.0, 1.0) * np.sign(-along[1] or 1.0)
    shade = 0.72 + 0.3 * np.sqrt(1.0 - 0.9 * side**2) + 0.22 * light * side
    colors = _bytes(shade[..., None] * np.array(color))
    lay(picture[y0:y1, x0:x1], colors, cover.astype(np.float32))


def _bytes(colors: NDArray[np.floating[Any]]) -> ByteImage:
    return np.asarray(np.clip(colors + 0.5, 0.0, 255.0), dtype=np.uint8)


def _extent(outline_px: FloatArray) -> tuple[float, float]:
    """Mean lengths of a quadrangle's edges: those along its width, those along its height."""
    corners = outline_px.tolist()
    edges = [math.dist(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    if len(edges) != 4:
        return max(edges), max(edges)
    return (edges[0] + edges[2]) / 2.0, (edges[1] + edges[3]) / 2.0


def _window(picture: ByteImage, points_px: FloatArray) -> tuple[int, int, int, int] | None:
    """The part of the picture round some points: left, top, right, bottom; None if empty."""
    height, width = picture.shape[:2]
    (left, top), (right, bottom) = points_px.min(axis=0).tolist(), points_px.max(axis=0).tolist()
    x0, y0 = max(math.floor(left), 0), max(math.floor(top), 0)
    x1, y1 = min(math.ceil(right) + 1, width), min(math.ceil(bottom) + 1, height)
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None
