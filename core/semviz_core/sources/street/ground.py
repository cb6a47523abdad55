"""Paints the ground: meadow, road with its markings, kerbs, pavements and shadows."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.sources.street import textures
from semviz_core.sources.street.brushes import fill, fill_mask
from semviz_core.sources.street.road import (
    KERB_HEIGHT_M,
    KERB_M,
    LANE_M,
    PAVEMENT_M,
    Road,
)
from semviz_core.sources.street.things import Color, FloatPicture
from semviz_core.sources.street.view import View

GRASS: Color = (112, 132, 70)
ASPHALT: Color = (112, 112, 114)
PARKING: Color = (126, 123, 120)
PAVING: Color = (166, 160, 152)
KERB: Color = (182, 180, 174)
JOINT: Color = (138, 133, 126)
PAINT: Color = (226, 226, 222)

_SIGHT_M = 130.0
_CROSSING_EVERY_M = 85.0
_SHADOW = 0.46
_FINE_M, _COARSE_M = 4.0, 60.0
"""Sizes of the two tiles of noise."""


class Ground:
    """The ground of one street; textures are made once."""

    def __init__(self, road: Road, rng: np.random.Generator) -> None:
        self._road = road
        fine = textures.noise(rng, (512, 512), 0.15)
        self._fine = [cv2.GaussianBlur(fine, (0, 0), 0.6)]
        self._coarse = textures.noise(rng, (512, 512), 1.1)
        self._crossings = np.arange(rng.uniform(25.0, 60.0), road.s_m[-1], _CROSSING_EVERY_M)
        for level in range(1, 6):  # blurred, not halved: every level keeps its coordinates
            blurred = _blur_tile(fine, 0.6 * 2**level)
            self._fine.append(blurred)

    def paint(self, picture: ByteImage, view: View, shadows: list[FloatArray], haze: Color) -> None:
        """Everything below the horizon; ``shadows`` are polygons (k, 3) on the ground."""
        rise = np.zeros(picture.shape[:2], np.uint8)  # 1 where the ground is at kerb height
        flat = picture.copy()
        rays_up = self._rays_up(view)
        flat[rays_up < 0] = GRASS
        rise[rays_up < 0] = 1
        for points, color, raised in self._polygons(view):
            polygon = view.polygon(points)
            if polygon is not None:
                fill(flat, polygon, color)
                if raised is not None:
                    fill_mask(rise, polygon, raised)
        shadow = np.zeros(picture.shape[:2], np.uint8)
        for points in shadows:
            polygon = view.polygon(points)
            if polygon is not None:
                fill_mask(shadow, polygon, 255)
        self._finish(picture, flat, view, rays_up, rise, shadow, haze)

    def _finish(
        self,
        picture: ByteImage,
        flat: ByteImage,
        view: View,
        rays_up: FloatPicture,
        rise: NDArray[np.uint8],
        shadow: NDArray[np.uint8],
        haze: Color,
    ) -> None:
        """Texture, shadow and haze, for each pixel by its place on the ground."""
        rows = np.flatnonzero((rays_up < 0).any(axis=1))
        if not len(rows):
            return
        part = slice(rows[0], picture.shape[0])
        up = np.minimum(rays_up[part], np.float32(-1e-4))
        height = np.float32(self._height(view)) - np.float32(KERB_HEIGHT_M) * rise[part]
        reach = -height / up  # along the ray whose depth is 1
        ray_x, ray_y = (view.rays(axis)[part] for axis in np.eye(3)[:2])
        x, y = view.center_m[0] + reach * ray_x, view.center_m[1] + reach * ray_y
        grain = self._grain(x, y, reach, view)
        soft = cv2.GaussianBlur(shadow[part], (0, 0), 0.8).astype(np.float32) / np.float32(255.0)
        gain = (1.0 + grain * (0.6 + 0.9 * _green(flat[part]))) * (1.0 - np.float32(_SHADOW) * soft)
        veil = (1.0 - np.exp(-np.minimum(reach, 4000.0) / np.float32(260.0)))[..., None]
        colors = flat[part] * (gain[..., None] * (1.0 - veil)) + veil * np.array(haze, np.float32)
        ground = cv2.convertScaleAbs(colors)
        below = rays_up[part] < 0
        picture[part][below] = ground[below]

    def _grain(
        self, x: FloatPicture, y: FloatPicture, reach: FloatPicture, view: View
    ) -> FloatPicture:
        """Texture of the ground, blurred as a pixel covers more of it."""
        size = 512
        texel_m = _FINE_M / size
        footprint = reach / np.float32(view.camera.K[0, 0]) / np.float32(texel_m)
        footprint *= np.sqrt(np.maximum(reach / np.float32(1.65), 1.0)) * np.float32(0.6)
        level = np.clip(np.log2(np.maximum(footprint, 1.0)), 0.0, len(self._fine) - 1.0)
        fine = np.zeros_like(x)
        column, row = _tile(x, _FINE_M, size), _tile(y, _FINE_M, size)
        for i, texture in enumerate(self._fine):
            weight = np.maximum(1.0 - np.abs(level - i), 0.0)
            used = np.flatnonzero(weight.any(axis=1))
            if len(used):
                band = slice(used[0], used[-1] + 1)
                fine[band] += weight[band] * _look_up(texture, column[band], row[band])
        coarse = _look_up(self._coarse, _tile(x, _COARSE_M, size), _tile(y, _COARSE_M, size))
        fade = np.exp(-reach / np.float32(90.0))
        return np.asarray(0.1 * fine + 0.035 * coarse * fade, dtype=np.float32)

    def _height(self, view: View) -> float:
        """Of the camera above the road's plane, vertically."""
        return float(view.center_m[2] - self._road.slope @ view.center_m[:2])

    def _rays_up(self, view: View) -> FloatPicture:
        """(height, width) rise of each pixel's ray above the ground's plane at depth 1."""
        normal = np.array([-self._road.slope[0], -self._road.slope[1], 1.0])
        return view.rays(normal)

    def _polygons(self, view: View) -> Iterator[tuple[FloatArray, Color, int | None]]:
        """Polygons (k, 3) in the order to paint them, and whether they are at kerb height."""
        here = self.nearest(view.center_m)
        s = here + np.concatenate([np.arange(-6.0, 30.0, 1.0), np.arange(30.0, _SIGHT_M, 3.0)])
        s = s[(s >= self._road.s_m[0]) & (s <= self._road.s_m[-1])]
        top = KERB_HEIGHT_M
        for side in (-1, 1):
            yield self._strip(s, side * KERB_M, side * PAVEMENT_M, top), PAVING, 1
        yield self._strip(s, -KERB_M, KERB_M), PARKING, 0
        yield self._strip(s, -LANE_M, LANE_M), ASPHALT, 0
        yield from self._markings(s, here)
        for side in (-1, 1):
            edge, inner = self._road.at(s, side * KERB_M, 0.0), self._road.at(s, side * KERB_M, top)
            yield np.concatenate([edge, inner[::-1]]), (150, 148, 143), None
            yield self._strip(s, side * KERB_M, side * (KERB_M + 0.14), top), KERB, 1
        joints = np.arange(np.ceil(here), here + 26.0, 1.0)
        for side in (-1, 1):
            for joint in joints:
                ends = np.array([joint, joint + 0.015])
                outer = side * (KERB_M + 0.14)
                yield self._strip(ends, outer, side * PAVEMENT_M, top), JOINT, None

    def _markings(self, s: FloatArray, here: float) -> Iterator[tuple[FloatArray, Color, None]]:
        """Dashes in the middle, lines along the parking lanes, zebra crossings."""
        for begin in np.arange(np.floor(here / 6.0) * 6.0 - 6.0, here + 95.0, 6.0):
            if np.abs(self._crossings - begin - 1.5).min(initial=99.0) > 5.0:
                yield self._strip(np.linspace(begin, begin + 3.0, 4), -0.06, 0.06), PAINT, None
        for side in (-1, 1):
            d = side * (LANE_M - 0.02)
            yield self._strip(s, d - 0.05, d + 0.05), PAINT, None
        for crossing in self._crossings[np.abs(self._crossings - here) < 90.0]:
            along = np.array([crossing - 1.6, crossing + 1.6])
            for d in np.arange(-LANE_M + 0.5, LANE_M - 0.5, 1.0):
                yield self._strip(along, d, d + 0.5), PAINT, None

    def _strip(self, s: FloatArray, d0: float, d1: float, h: float = 0.0) -> FloatArray:
        """(2 n, 3) outline of the ground between two lines along the road."""
        return np.concatenate([self._road.at(s, d0, h), self._road.at(s[::-1], d1, h)])

    def nearest(self, point_m: FloatArray) -> float:
        """Metres along the road of the place nearest to a point."""
        distance = np.linalg.norm(self._road.xy_m - point_m[:2], axis=1)
        return float(self._road.s_m[np.argmin(distance)])


def _green(colors: ByteImage) -> FloatPicture:
    """(h, w) from 0 for paving to 1 for grass: its texture is rougher."""
    green = colors[..., 1].astype(np.int16) - colors[..., 2]
    return np.asarray(np.clip(green, 0, 60) / np.float32(60.0), dtype=np.float32)


def _tile(place_m: FloatPicture, tile_m: float, size: int) -> FloatPicture:
    """Texel of a place; relative to the first, so that float32 keeps its precision."""
    return np.asarray((place_m % tile_m) * (size / tile_m), dtype=np.float32)


def _look_up(texture: FloatPicture, column: FloatPicture, row: FloatPicture) -> FloatPicture:
    found = cv2.remap(texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(found, dtype=np.float32)


def _blur_tile(texture: FloatPicture, sigma: float) -> FloatPicture:
    """Blurred as if it were repeated."""
    frequency = np.hypot(np.fft.fftfreq(512)[:, None], np.fft.rfftfreq(512)[None, :])
    kernel = np.exp(-2.0 * (np.pi * frequency * sigma) ** 2)
    return np.fft.irfft2(np.fft.rfft2(texture) * kernel, texture.shape).astype(np.float32)
