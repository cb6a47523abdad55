"""Paint the ground: meadow, road with markings, kerbs, pavements and shadows.

Shadows are polygons on the ground.
"""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.simulation import scenery
from semviz_core.simulation.drawing import PinholeView, fill, fill_mask, lit
from semviz_core.simulation.layout import (
    KERB_HEIGHT_M,
    KERB_M,
    LANE_M,
    PAVEMENT_M,
    Layout,
    RoadGeometry,
)
from semviz_core.simulation.objects import UP, Color, FloatPicture, Tree

GRASS: Color = (112, 132, 70)
ASPHALT: Color = (112, 112, 114)
TRACK: Color = (107, 107, 109)
PARKING: Color = (126, 123, 120)
PAVING: Color = (166, 160, 152)
KERB: Color = (182, 180, 174)
JOINT: Color = (138, 133, 126)
PAINT: Color = (226, 226, 222)

_SIGHT_M, _WEAR_SIGHT_M, _JOINT_SIGHT_M = 120.0, 50.0, 26.0
_CROSSING_EVERY_M = 85.0
_SHADOW = 0.46
_VEIL, _VEIL_M = 0.62, 150.0
"""Largest opacity of the haze over the ground, and its decay length."""
_FARTHEST_M = 220.0
_FINE_M, _COARSE_M, _TEXELS = 4.0, 60.0, 512
"""Sizes of the two noise tiles (one a multiple of the other), and their texels per side."""
_WEAR_EVERY_M = 7.0


class _Decal(NamedTuple):
    """A flat polygon on the ground."""

    s_m: float
    outline_m: FloatArray
    """(k, 3)"""
    color: Color


class GroundRenderer:
    """The ground of one street; textures are made once."""

    def __init__(self, road: RoadGeometry, rng: np.random.Generator) -> None:
        self._road = road
        fine = scenery.noise(rng, (_TEXELS, _TEXELS), 0.15)
        # blurred, not halved: every level keeps its coordinates
        self._fine = [_blur_tile(fine, 0.6 * 4**level) for level in range(4)]
        self._coarse = scenery.noise(rng, (_TEXELS, _TEXELS), 1.1)
        wear, markings, joints = self._wear(rng), self._markings(rng), self._joints()
        self._decals = [(_WEAR_SIGHT_M, wear), (_SIGHT_M, markings), (_JOINT_SIGHT_M, joints)]

    def paint(
        self, image: ByteImage, view: PinholeView, shadows: list[FloatArray], haze: Color
    ) -> None:
        """Paint all below the horizon; ``shadows`` are polygons (k, 3) on the ground."""
        rise = np.ones(image.shape[:2], np.uint8)  # 1 where the ground is at kerb height
        flat = np.empty_like(image)
        flat[:] = GRASS
        for points, color, raised in self._polygons(view):
            polygon = view.polygon(points)
            if polygon is not None:
                fill(flat, polygon, color)
                if raised is not None:
                    fill_mask(rise, polygon, raised)
        shadow = np.zeros(image.shape[:2], np.uint8)
        for points in shadows:
            polygon = view.polygon(points)
            if polygon is not None:
                fill_mask(shadow, polygon, 255)
        self._finish(image, flat, view, rise, shadow, haze)

    def _finish(
        self,
        image: ByteImage,
        flat: ByteImage,
        view: PinholeView,
        rise: NDArray[np.uint8],
        shadow: NDArray[np.uint8],
        haze: Color,
    ) -> None:
        """Add texture, shadow and haze, by each pixel's position on the ground."""
        below = self._rays_up(view) < 0
        rows = np.flatnonzero(below.any(axis=1))
        if not len(rows):
            return
        part = slice(int(rows[0]), image.shape[0])
        reach = self._reach(view, rise, part)
        grain = self._grain(view, reach, part) * (0.65 + 0.9 * _green(flat[part]))
        soft = cv2.GaussianBlur(shadow[part], (0, 0), 0.8).astype(np.float32)
        gain = (1.0 + grain) * (1.0 - np.float32(_SHADOW / 255.0) * soft)
        veil = np.float32(_VEIL) * (1.0 - np.exp(reach * np.float32(-1.0 / _VEIL_M)))
        colors = flat[part] * (gain * (1.0 - veil))[..., None]
        colors += veil[..., None] * np.array(haze, np.float32)
        cv2.copyTo(cv2.convertScaleAbs(colors), below[part].view(np.uint8), image[part])

    def _reach(self, view: PinholeView, rise: NDArray[np.uint8], part: slice) -> FloatPicture:
        """Return (h, w) depths (m) of the ground in some rows, at most ``_FARTHEST_M``."""
        height = np.float32(self._height(view)) - np.float32(KERB_HEIGHT_M) * rise[part]
        reach = height / -np.minimum(self._rays_up(view)[part], np.float32(-1e-5))
        return np.asarray(np.minimum(reach, np.float32(_FARTHEST_M)), dtype=np.float32)

    def _grain(self, view: PinholeView, reach: FloatPicture, part: slice) -> FloatPicture:
        """Return (h, w) texture of the ground, blurred by each pixel's footprint."""
        # relative to a corner of the tiles near the camera: float32 keeps its precision
        x, y = (
            np.float32(view.center_m[i] % _COARSE_M) + reach * view.rays(axis)[part]
            for i, axis in enumerate(np.eye(3)[:2])
        )
        per_metre = np.float32(_TEXELS / _FINE_M)
        footprint = reach * np.float32(0.6 * per_metre / view.camera.K[0, 0])
        footprint *= np.sqrt(np.maximum(reach, 1.65) / np.float32(1.65))  # foreshortened
        level = np.clip(0.5 * np.log2(np.maximum(footprint, 1.0)), 0.0, len(self._fine) - 1.0)
        grain = np.zeros_like(x)
        column, row = per_metre * x, per_metre * y
        for i, texture in enumerate(self._fine):
            used = np.flatnonzero((np.abs(level - i) < 1.0).any(axis=1))
            if len(used):
                band = slice(used[0], used[-1] + 1)
                weight = np.maximum(1.0 - np.abs(level[band] - i), 0.0)
                # a blurred texture needs no interpolation
                interpolation = cv2.INTER_LINEAR if i == 0 else cv2.INTER_NEAREST
                grain[band] += (
                    0.1 * weight * _lookup(texture, column[band], row[band], interpolation)
                )
        scale = np.float32(_TEXELS / _COARSE_M)
        sparse = (slice(None, None, 3), slice(None, None, 3))
        coarse = _lookup(self._coarse, scale * x[sparse], scale * y[sparse], cv2.INTER_LINEAR)
        return np.asarray(grain + 0.05 * cv2.resize(coarse, x.shape[::-1]), dtype=np.float32)

    def _height(self, view: PinholeView) -> float:
        """Return the camera's height above the road's plane, vertically."""
        return float(view.center_m[2] - self._road.slope @ view.center_m[:2])

    def _rays_up(self, view: PinholeView) -> FloatPicture:
        """Return (height, width) the rise over the ground's plane of each ray at depth 1."""
        normal = np.array([-self._road.slope[0], -self._road.slope[1], 1.0])
        return view.rays(normal)

    def _polygons(self, view: PinholeView) -> Iterator[tuple[FloatArray, Color, int | None]]:
        """Yield polygons (k, 3) in the order of painting, and whether they are at kerb height."""
        here = self.nearest(view.center_m)
        s = here + np.concatenate([np.arange(-6.0, 30.0, 1.0), np.arange(30.0, _SIGHT_M, 3.0)])
        s = s[(s >= self._road.s_m[0]) & (s <= self._road.s_m[-1])]
        top = KERB_HEIGHT_M
        for side in (-1, 1):
            yield self._strip(s, side * KERB_M, side * PAVEMENT_M, top), PAVING, 1
        yield self._strip(s, -KERB_M, KERB_M), PARKING, 0
        yield self._strip(s, -LANE_M, LANE_M), ASPHALT, 0
        for d in (-LANE_M / 2 - 0.75, -LANE_M / 2 + 0.75, LANE_M / 2 - 0.75, LANE_M / 2 + 0.75):
            yield self._strip(s, d - 0.24, d + 0.24), TRACK, None
        for side in (-1, 1):
            d = side * (LANE_M - 0.02)
            yield self._strip(s, d - 0.05, d + 0.05), PAINT, None
        for sight, decals in self._decals:
            for decal in decals:
                if here - 6.0 < decal.s_m < here + sight:
                    yield decal.outline_m, decal.color, None
        for side in (-1, 1):
            edge, inner = self._road.at(s, side * KERB_M, 0.0), self._road.at(s, side * KERB_M, top)
            yield np.concatenate([edge, inner[::-1]]), (150, 148, 143), None
            yield self._strip(s, side * KERB_M, side * (KERB_M + 0.14), top), KERB, 1

    def _wear(self, rng: np.random.Generator) -> list[_Decal]:
        """Return patches and manholes in the road."""
        decals: list[_Decal] = []
        for s in np.arange(self._road.s_m[0], self._road.s_m[-1] - 15.0, _WEAR_EVERY_M):
            begin = float(s + rng.uniform(0.0, _WEAR_EVERY_M))
            d = rng.uniform(-LANE_M, LANE_M - 1.0)
            if rng.random() < 0.3:
                rim, lid = lit(ASPHALT, 0.82), lit(ASPHALT, 0.62)
                decals.append(self._decal(begin, begin + 0.74, d - 0.06, d + 0.68, rim))
                decals.append(self._decal(begin + 0.06, begin + 0.68, d, d + 0.62, lid))
            else:
                length, width = rng.uniform((0.8, 0.4), (4.5, 1.1))
                color = lit(ASPHALT, rng.uniform(0.86, 1.06))
                decals.append(self._decal(begin, begin + length, d, d + width, color))
        return decals

    def _markings(self, rng: np.random.Generator) -> list[_Decal]:
        """Return dashes along the centreline, and zebra crossings."""
        decals: list[_Decal] = []
        first, last = self._road.s_m[0], self._road.s_m[-1]
        crossings = np.arange(rng.uniform(25.0, 60.0), last - 5.0, _CROSSING_EVERY_M)
        for begin in np.arange(first, last - 3.0, 6.0):
            if np.abs(crossings - begin - 1.5).min(initial=99.0) > 5.0:
                decals.append(self._decal(begin, begin + 3.0, -0.06, 0.06, PAINT))
        for crossing in crossings:
            for d in np.arange(-LANE_M + 0.5, LANE_M - 0.5, 1.0):
                decals.append(self._decal(crossing - 1.6, crossing + 1.6, d, d + 0.5, PAINT))
        return decals

    def _joints(self) -> list[_Decal]:
        """Return the joints between the slabs of the pavements."""
        decals: list[_Decal] = []
        for s in np.arange(self._road.s_m[0], self._road.s_m[-1] - 1.0, 1.0):
            for side in (-1, 1):
                ends = side * (KERB_M + 0.14), side * PAVEMENT_M
                decals.append(self._decal(s, s + 0.015, *ends, JOINT, KERB_HEIGHT_M))
        return decals

    def _decal(
        self, begin: float, end: float, d0: float, d1: float, color: Color, h: float = 0.0
    ) -> _Decal:
        s = np.linspace(begin, end, 2 if end - begin < 2.0 else 4)
        return _Decal(begin, self._strip(s, d0, d1, h), color)

    def _strip(self, s: FloatArray, d0: float, d1: float, h: float = 0.0) -> FloatArray:
        """Return the outline (2 n, 3) of the ground between two lines along the road."""
        return np.concatenate([self._road.at(s, d0, h), self._road.at(s[::-1], d1, h)])

    def nearest(self, point_m: FloatArray) -> float:
        """Return metres along the road to the position nearest to a point."""
        distance = np.linalg.norm(self._road.xy_m - point_m[:2], axis=1)
        return float(self._road.s_m[np.argmin(distance)])


def _green(colors: ByteImage) -> FloatPicture:
    """Return (h, w) from 0 for paving to 1 for grass, whose texture is rougher."""
    green = colors[..., 1].astype(np.int16) - colors[..., 2]
    return np.asarray(np.clip(green, 0, 60) / np.float32(60.0), dtype=np.float32)


def _lookup(
    texture: FloatPicture, column: FloatPicture, row: FloatPicture, interpolation: int
) -> FloatPicture:
    texels = cv2.remap(texture, column, row, interpolation, borderMode=cv2.BORDER_WRAP)
    return np.asarray(texels, dtype=np.float32)


def _blur_tile(texture: FloatPicture, sigma: float) -> FloatPicture:
    """Blur a tile periodically."""
    frequency = np.hypot(np.fft.fftfreq(_TEXELS)[:, None], np.fft.rfftfreq(_TEXELS)[None, :])
    kernel = np.exp(-2.0 * (np.pi * frequency * sigma) ** 2)
    return np.asarray(np.fft.irfft2(np.fft.rfft2(texture) * kernel, texture.shape), np.float32)


def shadows(layout: Layout) -> list[FloatArray]:
    """Return the shadows of all objects of a street: polygons (k, 3) on the ground."""
    solids: list[FloatArray] = []
    for pole in layout.poles:
        solids.append(_rod(pole.bottom_m, pole.peak_m, pole.radius_m, layout.sun))
        if pole.arm_m.any():
            solids.append(_rod(pole.peak_m, pole.peak_m + pole.arm_m, 0.06, layout.sun))
    for sign in layout.signs:
        right, up = sign.right_m, sign.up_m
        corners = np.array([-right - up, right - up, right + up, up - right])
        solids.append(sign.middle_m + corners)
    for car in layout.cars:
        low = car.corners_m
        roof = 0.75 * low + 0.25 * car.middle_m + 1.4 * UP
        solids.append(np.concatenate([low, low + 0.8 * UP, roof]))
    solids += [_crown(tree) for tree in layout.trees]
    for hedge in layout.hedges:
        ends = np.array([hedge.begin_m, hedge.end_m])
        base = np.concatenate([ends, ends + hedge.depth_m])
        solids.append(np.concatenate([base, base + hedge.height_m * UP]))
    for house in layout.houses:
        corners = house.corner_m + np.array([0 * UP, house.front_m])
        ridge = corners + 0.5 * house.depth_m + (house.height_m + house.roof_m) * UP
        base = np.concatenate([corners, corners + house.depth_m])
        solids.append(np.concatenate([base, base + house.height_m * UP, ridge]))
    return [_cast_shadow(points, layout) for points in solids]


def _rod(begin: FloatArray, end: FloatArray, radius: float, sun: FloatArray) -> FloatArray:
    """Return a rectangle (4, 3) as wide as the rod seen from the sun."""
    across = np.cross(end - begin, sun)
    across *= radius / np.linalg.norm(across)
    return np.array([begin - across, begin + across, end + across, end - across])


def _crown(tree: Tree) -> FloatArray:
    """Return points (n, 3) on the crown, a ball."""
    azimuth, elevation = np.meshgrid(np.linspace(0, 2 * np.pi, 10)[:-1], np.linspace(-1.2, 1.2, 5))
    level = np.cos(elevation)
    ball = np.stack([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)], axis=-1)
    width, height = tree.crown_m
    middle = tree.root_m + (tree.trunk_m + 0.45 * height) * UP
    return np.asarray(middle + 0.42 * ball.reshape(-1, 3) * [width, width, height])


def _cast_shadow(points_m: FloatArray, layout: Layout) -> FloatArray:
    """Return the outline (k, 3) of the shadow of a convex body with corners (n, 3)."""
    road: RoadGeometry = layout.road
    slope = np.append(road.slope, 0.0)
    above = points_m[:, 2] - road.ground(points_m)[:, 2]
    fallen = points_m - above[:, None] * layout.sun / (layout.sun[2] - slope @ layout.sun)
    middle = fallen[:1, :2]  # float32 keeps its precision near zero
    hull = cv2.convexHull((fallen[:, :2] - middle).astype(np.float32)).reshape(-1, 2) + middle
    return road.ground(np.column_stack([hull, np.zeros(len(hull))]))
