"""Paints what stands behind the pavements and hides no element: houses, hedges, trees."""

from functools import cache

import numpy as np

from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.sources.street import textures
from semviz_core.sources.street.brushes import Texture, fill, lit, mixed, stamp
from semviz_core.sources.street.furniture import air_at, paint_rod
from semviz_core.sources.street.layout import Layout
from semviz_core.sources.street.things import UP, Color, Hedge, House, Tree
from semviz_core.sources.street.view import View

_SIGHT_M = 150.0
_DETAIL_M = 50.0
_EAVES_M = 0.45
_CROWN = ((0.22, 1.0, 0.0), (0.0, 0.86, 0.03), (-0.2, 0.66, 0.1))
"""Of a crown's pictures: how far back (widths), how large, how much higher (heights)."""
_BARK: Color = (92, 76, 60)


class Scenery:
    """Houses, hedges and trees of one street."""

    def __init__(self, layout: Layout, rng: np.random.Generator, haze: Color) -> None:
        self._things: list[House | Hedge | Tree] = [*layout.houses, *layout.hedges, *layout.trees]
        self._middles = np.array([_middle(one) for one in self._things]).reshape(-1, 3)
        self._haze = haze
        self._sun = layout.sun
        sun_left = float(layout.road.left(0.0) @ layout.sun) > 0
        self._crowns = textures.crowns(rng, sun_left)
        self._leaves = [textures.leaves(rng) for _ in range(3)]
        self._stones = textures.stones(rng)
        self._walls = cache(_house_textures)

    def paint(self, picture: ByteImage, view: View) -> None:
        """Far ones first."""
        distance = np.linalg.norm(self._middles - view.center_m, axis=1)
        rows = np.flatnonzero(distance < _SIGHT_M)
        for row in rows[np.argsort(-distance[rows], kind="stable")]:
            thing = self._things[row]
            if isinstance(thing, House):
                self._paint_house(picture, view, thing)
            elif isinstance(thing, Hedge):
                self._paint_hedge(picture, view, thing)
            else:
                self._paint_tree(picture, view, thing)

    def _paint_house(self, picture: ByteImage, view: View, house: House) -> None:
        """The walls in sight, then the roof's front slope."""
        front, gable, roof, color = self._walls(house)
        distance = view.distance(_middle(house))
        rise = house.height_m * UP
        ends = [
            (house.corner_m, -house.front_m, house.depth_m),
            (house.corner_m + house.front_m, house.front_m, house.depth_m),
        ]
        for corner, outward, depth in ends:
            if outward @ (view.center_m - corner) > 0:
                air = air_at(distance, self._haze, self._light(outward))
                stamp(picture, view, gable, corner + rise, depth, -rise, air)
                peak = corner + depth / 2 + rise + house.roof_m * UP
                polygon = view.polygon(np.array([corner + rise, peak, corner + depth + rise]))
                if polygon is not None:
                    fill(picture, polygon, mixed(lit(color, air.gain), self._haze, air.haze))
        air = air_at(distance, self._haze, self._light(-house.depth_m))
        stamp(picture, view, front, house.corner_m + rise, house.front_m, -rise, air)
        unit = house.depth_m / np.linalg.norm(house.depth_m)
        over = _EAVES_M * house.front_m / np.linalg.norm(house.front_m)
        ridge = house.corner_m + rise + house.depth_m / 2 + house.roof_m * UP - over
        eaves = house.corner_m + rise - _EAVES_M * unit - 0.25 * UP - over
        slope = np.cross(house.front_m, ridge - eaves)
        air = air_at(distance, self._haze, self._light(slope * np.sign(slope[2])))
        stamp(picture, view, roof, ridge, house.front_m + 2 * over, eaves - ridge, air)

    def _paint_hedge(self, picture: ByteImage, view: View, hedge: Hedge) -> None:
        """Its front, its near end and, for a wall, its top."""
        texture = self._stones
        if hedge.leafy:
            texture = self._leaves[int(hedge.height_m * 100) % len(self._leaves)]
        rise, along = hedge.height_m * UP, hedge.end_m - hedge.begin_m
        distance = view.distance(_middle(hedge))
        if distance < _DETAIL_M and along @ (hedge.begin_m - view.center_m) > 0:
            air = air_at(distance, self._haze, 0.85 * self._light(-along))
            stamp(picture, view, texture, hedge.begin_m + rise, hedge.depth_m, -rise, air)
        top = [hedge.begin_m + rise, hedge.end_m + rise]
        polygon = view.polygon(np.array([*top, top[1] + hedge.depth_m, top[0] + hedge.depth_m]))
        air = air_at(distance, self._haze, self._light(-hedge.depth_m))
        if polygon is not None and not hedge.leafy:
            fill(picture, polygon, mixed((188, 184, 176), self._haze, air.haze))
        stamp(picture, view, texture, hedge.begin_m + rise, along, -rise, air)

    def _paint_tree(self, picture: ByteImage, view: View, tree: Tree) -> None:
        """A trunk, and up to three pictures of a crown one behind the other."""
        if view.depth(tree.root_m) < 1.0:
            return
        distance = view.distance(tree.root_m)
        air = air_at(distance, self._haze)
        width, height = tree.crown_m
        if tree.trunk_m:
            light = float(self._sun @ view.T_map_camera.rotation[:, 0])
            ends = np.array([tree.root_m, tree.root_m + (tree.trunk_m + 0.4 * height) * UP])
            bark = mixed(_BARK, self._haze, air.haze)
            paint_rod(picture, view, ends, 0.035 * width + 0.03, bark, light)
        back = np.cross(UP, tree.across_m)  # against the traffic's direction, or along it
        back = back if back @ view.T_map_camera.rotation[:, 2] > 0 else -back
        right = np.cross(back, UP)
        base = tree.root_m + tree.trunk_m * UP
        kind = self._crowns[tree.sprite % len(self._crowns)]
        pieces = _CROWN if distance < _DETAIL_M else _CROWN[:1]
        for i, (offset, size, lift) in enumerate(pieces):
            crown = kind[(tree.sprite // 16 + i) % len(kind)]
            middle = base + offset * width * back + (0.5 + lift) * height * UP
            middle = middle + (0.12 * (i - 1)) * width * right
            corner = middle + 0.58 * size * (height * UP - width * right)
            span = 1.16 * size
            stamp(picture, view, crown, corner, span * width * right, -span * height * UP, air)

    def _light(self, outward: FloatArray) -> float:
        """Of a wall that faces a direction (3,)."""
        facing = float(outward @ self._sun) / float(np.linalg.norm(outward))
        return 0.68 + 0.42 * max(0.0, facing)


def _middle(thing: House | Hedge | Tree) -> FloatArray:
    """(3,) of the ground it stands on."""
    if isinstance(thing, House):
        return thing.corner_m + 0.5 * (thing.front_m + thing.depth_m)
    return 0.5 * (thing.begin_m + thing.end_m) if isinstance(thing, Hedge) else thing.root_m


def _house_textures(house: House) -> tuple[Texture, Texture, Texture, Color]:
    """Front, gable end, roof and the walls' colour."""
    rng = np.random.default_rng(house.style)
    color = textures.wall_color(rng)
    width, depth = (float(np.linalg.norm(one)) for one in (house.front_m, house.depth_m))
    return (
        textures.wall(rng, width, house.height_m, color, door=True),
        textures.wall(rng, depth, house.height_m, color, door=False),
        textures.tiles(rng, width),
        color,
    )
