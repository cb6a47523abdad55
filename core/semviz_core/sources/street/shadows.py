"""The shadows that things throw on the ground, as polygons."""

import cv2
import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.sources.street.layout import Layout
from semviz_core.sources.street.road import Road
from semviz_core.sources.street.things import UP, Tree


def shadows(layout: Layout) -> list[FloatArray]:
    """Polygons (k, 3) on the ground, of everything on a street."""
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
    return [_thrown(points, layout) for points in solids]


def _rod(begin: FloatArray, end: FloatArray, radius: float, sun: FloatArray) -> FloatArray:
    """(4, 3) as wide as the rod when seen from the sun."""
    across = np.cross(end - begin, sun)
    across *= radius / np.linalg.norm(across)
    return np.array([begin - across, begin + across, end + across, end - across])


def _crown(tree: Tree) -> FloatArray:
    """(n, 3) points on a ball of leaves."""
    azimuth, elevation = np.meshgrid(np.linspace(0, 2 * np.pi, 10)[:-1], np.linspace(-1.2, 1.2, 5))
    level = np.cos(elevation)
    ball = np.stack([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)], axis=-1)
    width, height = tree.crown_m
    middle = tree.root_m + (tree.trunk_m + 0.45 * height) * UP
    return np.asarray(middle + 0.42 * ball.reshape(-1, 3) * [width, width, height])


def _thrown(points_m: FloatArray, layout: Layout) -> FloatArray:
    """Outline (k, 3) of the shadow of a convex body with corners (n, 3)."""
    road: Road = layout.road
    slope = np.append(road.slope, 0.0)
    above = points_m[:, 2] - road.ground(points_m)[:, 2]
    fallen = points_m - above[:, None] * layout.sun / (layout.sun[2] - slope @ layout.sun)
    middle = fallen[:1, :2]  # float32 keeps its precision near zero
    hull = cv2.convexHull((fallen[:, :2] - middle).astype(np.float32)).reshape(-1, 2) + middle
    return road.ground(np.column_stack([hull, np.zeros(len(hull))]))
