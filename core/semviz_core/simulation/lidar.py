"""Scan a street with a spinning lidar like an HDL-64, and merge scans to a cloud.

The street's surfaces are drawn into depth images of four pinhole views around the scanner; beams
look their pixels up. Depth is exact at each pixel, so points lie on the surfaces but for the noise
of the range. What the renderer shows as flat pictures is flat here too: poles, trunks and crowns
face the scanner, and half of the beams pass a crown.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from semviz_core.base.camera import Camera
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.simulation.drawing import PinholeView, fill_mask
from semviz_core.simulation.furniture import patches
from semviz_core.simulation.layout import KERB_HEIGHT_M, KERB_M, Layout
from semviz_core.simulation.objects import UP, FloatPicture
from semviz_core.simulation.sign_faces import outline

REACH_M = 60.0
"""Of the scanner, whose returns from further away are few."""
BEAMS, COLUMNS = 64, 500
"""An HDL-64 has four times as many columns."""
ELEVATION_RAD = (np.deg2rad(-24.8), np.deg2rad(2.0))
RANGE_SIGMA_M = 0.02
LOST, LOST_GRAZING = 0.07, 0.5
"""Shares of beams without a return: anywhere, and further ones as beams touch a surface at a flat
angle."""
VOXEL_M = 0.3
NEIGHBOURS = 16
"""Points that a normal is fitted to."""
_MEADOW_M = 45.0
_VIEW = Camera(512, 192, np.array([[256.0, 0.0, 255.5], [0.0, 256.0, 16.0], [0.0, 0.0, 1.0]]))
_CIRCLE = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
_EDGE_ON = 1e-3


class Surface(NamedTuple):
    """A flat polygon."""

    corners_m: FloatArray
    """(k, 3) in the map frame."""
    intensity: float
    """Of its returns, in [0, 1]."""
    leaves_m: float = 0.0
    """Standard deviation of leaves about it, which let half of the beams pass; 0 if solid."""


def surfaces(layout: Layout, center_m: FloatArray) -> list[Surface]:
    """Return what a scanner or camera at ``center_m`` (3,) may see of a street."""
    found = [*_ground(layout), *_houses(layout), *_hedges(layout), *_trees(layout, center_m)]
    for car in layout.cars:
        found += [Surface(patch.corners_m, 0.3) for patch in patches(car, center_m, layout.sun)]
    for pole in layout.poles:
        found.append(_upright(pole.bottom_m, pole.peak_m, pole.radius_m, center_m, 0.6))
    for sign in layout.signs:
        plate = outline(sign.class_id)
        corners = sign.middle_m + plate[:, :1] * sign.right_m - plate[:, 1:] * sign.up_m
        found.append(Surface(corners, 0.95))
    near = [np.linalg.norm(one.corners_m - center_m, axis=1).min() < REACH_M for one in found]
    return [one for one, is_near in zip(found, near, strict=True) if is_near]


def _ground(layout: Layout) -> Iterator[Surface]:
    road = layout.road
    s = np.arange(road.s_m[0], road.s_m[-1], 4.0)
    for near, far, height, intensity in (
        (-KERB_M, KERB_M, 0.0, 0.15),
        (KERB_M, _MEADOW_M, KERB_HEIGHT_M, 0.35),
        (-KERB_M, -_MEADOW_M, KERB_HEIGHT_M, 0.35),
    ):
        edges = road.at(s, near, height), road.at(s, far, height)[::-1]
        yield Surface(np.concatenate(edges), intensity)


def _houses(layout: Layout) -> Iterator[Surface]:
    for house in layout.houses:
        rise, front, depth = house.height_m * UP, house.front_m, house.depth_m
        intensity = 0.4 + 0.3 * (house.style % 100) / 100.0
        ridge = house.corner_m + rise + depth / 2 + house.roof_m * UP
        for corner, along in (
            (house.corner_m, front), (house.corner_m + depth, front),
            (house.corner_m, depth), (house.corner_m + front, depth),
        ):  # fmt: skip
            yield Surface(_parallelogram(corner, along, rise), intensity)
        yield Surface(_parallelogram(ridge, front, house.corner_m + rise - ridge), 0.3)


def _hedges(layout: Layout) -> Iterator[Surface]:
    for hedge in layout.hedges:
        rise, along, depth = hedge.height_m * UP, hedge.end_m - hedge.begin_m, hedge.depth_m
        for corner, right, up in (
            (hedge.begin_m, along, rise), (hedge.begin_m, depth, rise),
            (hedge.end_m, depth, rise), (hedge.begin_m + rise, along, depth),
        ):  # fmt: skip
            yield Surface(_parallelogram(corner, right, up), 0.45 if hedge.leafy else 0.55)


def _trees(layout: Layout, center_m: FloatArray) -> Iterator[Surface]:
    for tree in layout.trees:
        (width, height), top = tree.crown_m, tree.root_m + tree.trunk_m * UP
        if tree.trunk_m:
            yield _upright(
                tree.root_m, top + 0.4 * height * UP, 0.035 * width + 0.03, center_m, 0.3
            )
        across = _across(UP, tree.root_m - center_m)
        crown = np.cos(_CIRCLE)[:, None] * 0.5 * width * across
        crown = crown + np.sin(_CIRCLE)[:, None] * 0.5 * height * UP
        yield Surface(top + 0.5 * height * UP + crown, 0.5, 0.15 * width)


def _parallelogram(corner: FloatArray, right: FloatArray, up: FloatArray) -> FloatArray:
    return np.array([corner, corner + right, corner + right + up, corner + up])


def _upright(
    bottom: FloatArray, top: FloatArray, radius: float, center_m: FloatArray, intensity: float
) -> Surface:
    side = radius * _across(top - bottom, bottom - center_m)
    return Surface(np.array([bottom - side, bottom + side, top + side, top - side]), intensity)


def _across(axis: FloatArray, sight: FloatArray) -> FloatArray:
    across = np.cross(axis, sight)
    return np.asarray(across / max(float(np.linalg.norm(across)), 1e-9))


class DepthImage(NamedTuple):
    """What each pixel of a view sees."""

    inverse_depth: FloatPicture
    """(height, width) 1/m; 0 for the sky."""
    surface: IntArray
    """(height, width) row of the surface; -1 for the sky."""


def depth_image(
    found: Sequence[Surface], view: PinholeView, rng: np.random.Generator
) -> DepthImage:
    """Draw surfaces into a depth image; ``rng`` draws the leaves."""
    shape = view.camera.height, view.camera.width
    inverse, seen = np.zeros(shape, np.float32), np.full(shape, -1, np.int64)
    K_inverse = np.linalg.inv(view.camera.K)
    for row, (corners_m, _, leaves_m) in enumerate(found):
        outline_px = view.polygon(corners_m)
        if outline_px is None:
            continue
        low = np.maximum(np.floor(outline_px.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(outline_px.max(axis=0)).astype(int) + 1, shape[::-1])
        if (low >= high).any():
            continue
        points = view.T_camera_map.apply(corners_m)
        normal = _normal(points)
        offset = float(normal @ points[0])
        if abs(offset) < _EDGE_ON:
            continue
        mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
        fill_mask(mask, outline_px - low, 1)
        slope = normal @ K_inverse / offset
        plane = slope[0] * np.arange(low[0], high[0]) + slope[2]
        plane = plane + slope[1] * np.arange(low[1], high[1])[:, None]
        if leaves_m:
            mask &= rng.random(mask.shape) < 0.5
            plane = plane / (1.0 + leaves_m * plane * rng.standard_normal(mask.shape))
        window = slice(low[1], high[1]), slice(low[0], high[0])
        is_nearest = (mask > 0) & (plane > inverse[window])
        inverse[window][is_nearest] = plane[is_nearest]
        seen[window][is_nearest] = row
    return DepthImage(inverse, seen)


def _normal(points: FloatArray) -> FloatArray:
    """Return the unit normal (3,) of a flat polygon (k, 3), by Newell's sum."""
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    return np.asarray(normal / max(float(np.linalg.norm(normal)), 1e-9))


def scan(layout: Layout, T_map_scanner: Pose, rng: np.random.Generator) -> FloatArray:
    """Return the returns (n, 4) of one turn: a point in the map frame (m) and its intensity.

    The scanner's axes are those of a camera: z ahead, y down.
    """
    found = surfaces(layout, T_map_scanner.translation)
    low, high = ELEVATION_RAD
    elevation = np.linspace(low, high, BEAMS)[:, None]
    azimuth = np.linspace(-np.pi / 4, np.pi / 4, COLUMNS // 4, endpoint=False)
    column = np.broadcast_to(np.tan(azimuth), (BEAMS, COLUMNS // 4))
    row = -np.tan(elevation) / np.cos(azimuth)
    pixel = np.stack([column, row, np.ones_like(row)], axis=-1).reshape(-1, 3) @ _VIEW.K.T
    u, v = np.round(pixel[:, :2]).astype(int).T
    rays = np.column_stack([u, v, np.ones(len(u))]) @ np.linalg.inv(_VIEW.K).T
    returns = []
    for quarter in range(4):
        turn = Pose.from_rotvec([0.0, quarter * np.pi / 2, 0.0], np.zeros(3))
        view = PinholeView(_VIEW, T_map_scanner @ turn)
        image = depth_image(found, view, rng)
        inverse, seen = image.inverse_depth[v, u], image.surface[v, u]
        hit = np.flatnonzero(inverse > 1.0 / REACH_M)
        normals = np.array([_normal(one.corners_m) for one in found])[seen[hit]]
        directions = rays[hit] @ view.T_map_camera.rotation.T
        kept = ~_is_lost(directions, normals, rng)
        hit, directions = hit[kept], directions[kept]
        depth = 1.0 / inverse[hit] + RANGE_SIGMA_M * rng.standard_normal(len(hit))
        intensity = np.array([one.intensity for one in found])[seen[hit]]
        points = view.center_m + depth[:, None] * directions
        returns.append(np.column_stack([points, intensity + rng.normal(0.0, 0.05, len(hit))]))
    return np.concatenate(returns)


def _is_lost(directions: FloatArray, normals: FloatArray, rng: np.random.Generator) -> BoolArray:
    cos = np.abs((directions * normals).sum(axis=1)) / np.linalg.norm(directions, axis=1)
    return np.asarray(rng.random(len(cos)) < LOST + LOST_GRAZING * (1.0 - cos) ** 8)


def merged(scans: Sequence[FloatArray]) -> FloatArray:
    """Return the cloud (n, 7) of scans (k, 4): point, intensity and unit normal.

    One point is kept in each voxel. Normals follow from the nearest points, and point upwards.
    """
    points = np.concatenate(scans)
    cell = np.floor(points[:, :3] / VOXEL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    size = cell.max(axis=0) + 1
    _, first = np.unique((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], True)
    points = points[first]
    place = points[:, :3]
    _, near = cKDTree(place).query(place, min(NEIGHBOURS, len(place)))
    around = place[near] - place[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normal = axes[..., 0]
    return np.column_stack([points, normal * np.where(normal[:, 2:] < 0.0, -1.0, 1.0)])
