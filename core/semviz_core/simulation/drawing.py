"""Draw polygons, textures and round poles, anti-aliased, through a pinhole camera.

The camera has no distortion. Light and haze modify colours with distance.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.camera import Camera
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.simulation.objects import Color, FloatPicture

NEAR_M = 0.25
"""Polygons are cut off this close to the camera."""


@dataclass(frozen=True, eq=False)
class PinholeView:
    """A pinhole camera without distortion, at a pose in the map."""

    camera: Camera
    T_map_camera: Pose
    T_camera_map: Pose = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_camera_map", self.T_map_camera.inverse())

    @property
    def center_m(self) -> FloatArray:
        """(3,) in the map frame."""
        return self.T_map_camera.translation

    def project(self, points_m: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of points (n, 3) in the map frame; NaN behind the camera."""
        return self.camera.project(self.T_camera_map.apply(points_m))

    def depth(self, points_m: FloatArray) -> FloatArray:
        """Return (...) metres along the optical axis of points (..., 3)."""
        return np.asarray(self.T_camera_map.apply(points_m)[..., 2])

    def distance(self, points_m: FloatArray) -> float:
        """Return metres to the nearest of points (n, 3), or to a point (3,)."""
        return float(np.linalg.norm(points_m - self.center_m, axis=-1).min())

    def polygon(self, points_m: FloatArray) -> FloatArray | None:
        """Return the pixels (k, 2) of a polygon (n, 3), cut at the near plane; None if outside."""
        points = self.T_camera_map.apply(points_m)
        depth = points[:, 2]
        if depth.min() <= NEAR_M:
            if depth.max() <= NEAR_M:
                return None
            points = _cut(points, depth > NEAR_M)
            depth = points[:, 2]
        camera = self.camera
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        pixels = np.empty((len(points), 2))
        u, v = pixels.T
        u[:] = points[:, 0] * (fx / depth) + cx
        v[:] = points[:, 1] * (fy / depth) + cy
        if u.max() < -1 or v.max() < -1 or u.min() > camera.width or v.min() > camera.height:
            return None
        return pixels

    def plane(self, origin_m: FloatArray, right_m: FloatArray, down_m: FloatArray) -> FloatArray:
        """Return the (3, 3) homography to pixels of points ``origin + u right + v down``."""
        axes = self.T_camera_map.rotation @ np.stack([right_m, down_m], axis=1)
        columns = np.column_stack([axes, self.T_camera_map.apply(origin_m)])
        homography: FloatArray = self.camera.K @ columns
        return homography

    def rays(self, direction: FloatArray) -> FloatPicture:
        """Return (height, width) the component along a direction (3,) of each ray of depth 1."""
        weights = direction @ self.T_map_camera.rotation @ np.linalg.inv(self.camera.K)
        u = np.arange(self.camera.width) * weights[0] + weights[2]
        v = np.arange(self.camera.height)[:, None] * weights[1]
        return np.asarray(u + v, dtype=np.float32)


def _cut(points: FloatArray, ahead: BoolArray) -> FloatArray:
    """Clip a polygon (n, 3) at the near plane (Sutherland and Hodgman)."""
    kept: list[FloatArray] = []
    for i in range(len(points)):
        begin, end = points[i], points[(i + 1) % len(points)]
        if ahead[i]:
            kept.append(begin)
        if ahead[i] != ahead[(i + 1) % len(points)]:
            t = (NEAR_M - begin[2]) / (end[2] - begin[2])
            kept.append(begin + t * (end - begin))
    return np.array(kept)


_EDGE_ON_PX = 0.8  # thinner textures are not drawn
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


def fixed(polygon_px: FloatArray) -> NDArray[np.int32]:
    """Return pixels in OpenCV's fixed-point coordinates, for ``shift=_SHIFT``."""
    return np.round(polygon_px * (1 << _SHIFT)).astype(np.int32)


def fill(image: ByteImage, polygon_px: FloatArray, color: Color) -> None:
    """Fill an anti-aliased polygon (n, 2)."""
    cv2.fillPoly(image, [fixed(polygon_px)], color, cv2.LINE_AA, _SHIFT)


def fill_mask(
    mask: NDArray[np.uint8] | NDArray[np.int32], polygon_px: FloatArray, value: float
) -> None:
    """Fill a polygon (n, 2) with hard edges in an image of one channel."""
    cv2.fillPoly(mask, [fixed(polygon_px)], value, cv2.LINE_8, _SHIFT)


def mixed(color: Color, other: Color, share: float) -> Color:
    """Return a mix of two colours with ``share`` of the second."""
    a, b, c = (x + share * (y - x) for x, y in zip(color, other, strict=True))
    return (a, b, c)


def lit(color: Color, gain: float) -> Color:
    """Return a colour made brighter or darker by a factor."""
    a, b, c = (min(255.0, gain * level) for level in color)
    return (a, b, c)


def halved(image: NDArray[np.generic], size: tuple[int, int]) -> FloatPicture:
    """Return an image averaged down to (width, height)."""
    pixels = np.asarray(image, dtype=np.float32)
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Texture:
    """An image with transparency, and its mipmap levels."""

    levels: tuple[tuple[ByteImage, FloatPicture], ...]
    """Colours (height, width, 3) and opacity (height, width) in 0..1."""

    @classmethod
    def of(cls, colors: FloatPicture, opacity: FloatPicture | None = None) -> "Texture":
        """Return the texture of colours (h, w, 3) in 0..255 and opacity (h, w); default: opaque."""
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
        """Return the level with about one texel per pixel."""
        height, width = self.levels[0][1].shape
        shrink = max(width / width_px, 1.0) * max(height / height_px, 1.0)
        return self.levels[min(int(0.5 * math.log2(shrink) + 0.3), len(self.levels) - 1)]


@dataclass(frozen=True)
class Air:
    """Light and haze: a ``gain`` on the colour, then a share ``haze`` of the sky's colour."""

    gain: float
    haze: float
    haze_color: Color

    def table(self) -> ByteImage:
        """Return the lookup table (256, 1, 3) of colours."""
        levels = np.arange(256.0)[:, None, None] * (self.gain * (1.0 - self.haze))
        return _bytes(levels + np.array(self.haze_color) * self.haze)


def stamp(
    image: ByteImage,
    view: PinholeView,
    texture: Texture,
    corner_m: FloatArray,
    right_m: FloatArray,
    down_m: FloatArray,
    air: Air,
) -> None:
    """Draw a texture on a parallelogram in the map: its top-left corner and both edges (3,)."""
    corners = np.array(
        [corner_m, corner_m + right_m, corner_m + right_m + down_m, corner_m + down_m]
    )
    outline = view.polygon(corners)
    window = None if outline is None else _window(image, outline)
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
    if len(outline) != 4:  # cut at the near plane: the rest would be mirrored
        mask = np.zeros(cover.shape, np.uint8)
        fill_mask(mask, outline - [x0, y0], 1)
        cover = cover * mask
    lay(image[y0:y1, x0:x1], cv2.LUT(warped, air.table()), np.asarray(cover, np.float32))


def lay(target: ByteImage, colors: NDArray[Any], cover: FloatPicture) -> None:
    """Blend colours (h, w, 3) over a part of an image, with opacity ``cover`` (h, w)."""
    target[...] = cv2.blendLinear(colors, np.ascontiguousarray(target), cover, 1.0 - cover)


def rod(
    image: ByteImage,
    ends_px: FloatArray,
    radii_px: tuple[float, float],
    color: Color,
    light: float,
) -> None:
    """Draw a round rod between two pixels (2, 2), shaded across.

    Coverage is computed for each pixel from its distance to the axis, so rods much thinner than a
    pixel stay in place. ``light`` in [-1, 1] is the side the light comes from.
    """
    reach = max(radii_px) + 1.5
    box = np.array([ends_px.min(axis=0) - reach, ends_px.max(axis=0) + reach])
    window = _window(image, box)
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
    lay(image[y0:y1, x0:x1], colors, cover.astype(np.float32))


def _bytes(colors: NDArray[np.floating[Any]]) -> ByteImage:
    return np.asarray(np.clip(colors + 0.5, 0.0, 255.0), dtype=np.uint8)


def _extent(outline_px: FloatArray) -> tuple[float, float]:
    """Return the mean lengths of a quadrangle's edges along its width and its height."""
    corners = outline_px.tolist()
    edges = [math.dist(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    if len(edges) != 4:
        return max(edges), max(edges)
    return (edges[0] + edges[2]) / 2.0, (edges[1] + edges[3]) / 2.0


def _window(image: ByteImage, points_px: FloatArray) -> tuple[int, int, int, int] | None:
    """Return left, top, right, bottom of the image part around points; None if empty."""
    height, width = image.shape[:2]
    (left, top), (right, bottom) = points_px.min(axis=0).tolist(), points_px.max(axis=0).tolist()
    x0, y0 = max(math.floor(left), 0), max(math.floor(top), 0)
    x1, y1 = min(math.ceil(right) + 1, width), min(math.ceil(bottom) + 1, height)
    return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None
