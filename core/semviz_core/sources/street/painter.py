"""Paints what a camera sees of a street: far things first, near things over them."""

from functools import cached_property

import cv2
import numpy as np

from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.sources.street import textures
from semviz_core.sources.street.furniture import paint_standing, standing_in_order
from semviz_core.sources.street.ground import Ground
from semviz_core.sources.street.layout import Layout
from semviz_core.sources.street.scenery import Scenery
from semviz_core.sources.street.shadows import shadows
from semviz_core.sources.street.things import Color
from semviz_core.sources.street.view import View

HAZE: Color = (206, 220, 232)
SHADOW_SIGHT_M = 80.0


class Painter:
    """Paints one street. Textures are made when the first picture is."""

    def __init__(self, layout: Layout, seed: int) -> None:
        self._layout = layout
        self._seed = seed

    def paint(self, view: View) -> ByteImage:
        """(height, width, 3) sRGB."""
        picture = self._paint_sky(view)
        self._ground.paint(picture, view, self._shadows_near(view), HAZE)
        self._scenery.paint(picture, view)
        for thing in standing_in_order(self._layout, view):
            paint_standing(picture, view, thing, self._layout.sun, HAZE)
        return picture

    @cached_property
    def _shadows(self) -> list[FloatArray]:
        return shadows(self._layout)

    @cached_property
    def _shadow_middles(self) -> FloatArray:
        return np.array([one.mean(axis=0) for one in self._shadows]).reshape(-1, 3)

    def _shadows_near(self, view: View) -> list[FloatArray]:
        distance = np.linalg.norm(self._shadow_middles - view.center_m, axis=1)
        return [self._shadows[row] for row in np.flatnonzero(distance < SHADOW_SIGHT_M)]

    @cached_property
    def _sky(self) -> ByteImage:
        return textures.sky(np.random.default_rng([self._seed, 2]), HAZE)

    @cached_property
    def _ground(self) -> Ground:
        return Ground(self._layout.road, np.random.default_rng([self._seed, 3]))

    @cached_property
    def _scenery(self) -> Scenery:
        return Scenery(self._layout, np.random.default_rng([self._seed, 4]), HAZE)

    def _paint_sky(self, view: View) -> ByteImage:
        """From the panorama, by the direction of each pixel's ray."""
        x, y, z = (view.rays(axis) for axis in np.eye(3))
        level, azimuth = cv2.cartToPolar(x, y)
        low, high = textures.SKY_ELEVATION_RAD
        height, width = self._sky.shape[:2]
        column = azimuth * np.float32(width / (2.0 * np.pi))
        row = (np.float32(high) - np.arctan(z / level)) * np.float32((height - 1) / (high - low))
        row = np.clip(row, 0.0, height - 1.0)
        sky = cv2.remap(self._sky, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return np.asarray(sky, dtype=np.uint8)
