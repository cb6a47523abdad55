"""Brushes: what puts polygons, textures and round poles on a picture, smooth to a sub-pixel."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.sources.street.things import Color, FloatPicture
from semviz_core.sources.street.view import View

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
    """A picture with transparency and its halvings, colours premultiplied by opacity."""

    levels: tuple[FloatPicture, ...]
    """(height, width, 4) each: red, green, blue in 0..255, opacity in 0..1."""

    @classmethod
    def of(cls, colors: FloatPicture, opacity: FloatPicture | None = None) -> "Texture":
        """From (height, width, 3) in 0..255 and (height, width) in 0..1, opaque by default."""
        height, width = colors.shape[:2]
        alpha = np.ones((height, width), np.float32) if opacity is None else opacity
        level = np.dstack([colors * alpha[..., None], alpha]).astype(np.float32)
        levels = [level]
        while min(level.shape[:2]) > 6:
            size = (max(1, level.shape[1] // 2), max(1, level.shape[0] // 2))
            level = halved(level, size)
            levels.append(level)
        return cls(tuple(levels))

    def level_for(self, width_px: float, height_px: float) -> FloatPicture:
        """The halving that shows at most about one texel per pixel."""
        height, width = self.levels[0].shape[:2]
        shrink = max(min(width / max(width_px, 1.0), height / max(height_px, 1.0)), 1.0)
        shrink = np.sqrt(shrink * max(width / max(width_px, 1.0), height / max(height_px, 1.0)))
        return self.levels[int(np.clip(np.floor(np.log2(shrink) + 0.3), 0, len(self.levels) - 1))]


@dataclass(frozen=True)
class Air:
    """Light and haze over what is drawn: ``gain`` on its colour, then ``haze`` of the sky's."""

    gain: float
    haze: float
    haze_color: Color


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
    corners = [corner_m, corner_m + right_m, corner_m + right_m + down_m, corner_m + down_m]
    outline = view.polygon(np.array(corners))
    if outline is None:
        return
    window = _window(picture, outline)
    if window is None:
        return
    x0, y0, x1, y1 = window
    texels = texture.level_for(*_extent(outline))
    rows, columns = texels.shape[:2]
    # texel i has its centre at (i + 0.5) / columns of the edge
    scale = np.array([[1 / columns, 0, 0.5 / columns], [0, 1 / rows, 0.5 / rows], [0, 0, 1.0]])
    shift = np.array([[1.0, 0, -x0], [0, 1.0, -y0], [0, 0, 1.0]])
    homography = shift @ view.plane(corner_m, right_m, down_m) @ scale
    if abs(np.linalg.det(homography)) < 1e-9:
        return  # seen edge-on
    size = (x1 - x0, y1 - y0)
    warped: FloatPicture = np.asarray(cv2.warpPerspective(texels, homography, size), np.float32)
    if len(outline) != 4:  # cut at the near plane: the rest would show mirrored
        mask = np.zeros(warped.shape[:2], np.uint8)
        fill_mask(mask, outline - [x0, y0], 1)
        warped *= mask[..., None]
    lay(picture[y0:y1, x0:x1], warped, air)


def lay(target: ByteImage, source: FloatPicture, air: Air) -> None:
    """Lay premultiplied colours (h, w, 4) over a part of the picture (h, w, 3)."""
    alpha = source[..., 3:]
    haze = np.array(air.haze_color, np.float32) * np.float32(air.haze)
    colors = source[..., :3] * np.float32(air.gain * (1.0 - air.haze)) + haze * alpha
    result = target * (1.0 - alpha) + colors
    target[...] = cv2.convertScaleAbs(result)


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
    source = np.dstack([*(one * shade * cover for one in color), cover]).astype(np.float32)
    lay(picture[y0:y1, x0:x1], source, Air(1.0, 0.0, (0.0, 0.0, 0.0)))


def _extent(outline_px: FloatArray) -> tuple[float, float]:
    """Mean lengths of a quadrangle's edges: those along its width, those along its height."""
    edges = np.linalg.norm(np.roll(outline_px, -1, axis=0) - outline_px, axis=1)
    if len(edges) != 4:
        return float(edges.max()), float(edges.max())
    return float(edges[[0, 2]].mean()), float(edges[[1, 3]].mean())


def _window(picture: ByteImage, points_px: FloatArray) -> tuple[int, int, int, int] | None:
    """The part of the picture round some points: left, top, right, bottom; None if empty."""
    height, width = picture.shape[:2]
    x0, y0 = np.floor(points_px.min(axis=0)).astype(int)
    x1, y1 = np.ceil(points_px.max(axis=0)).astype(int) + 1
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, width), min(y1, height)
    return (int(x0), int(y0), int(x1), int(y1)) if x0 < x1 and y0 < y1 else None
