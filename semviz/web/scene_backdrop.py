"""Draw a drive's backdrop behind the map: dim, nearly grey, so that poles and signs stand out."""

import numpy as np
from numpy.typing import NDArray

from semviz.web.scene import SceneDrawer
from semviz.web.shapes import PALETTES, Theme, rgb
from semviz_annotation.mapping.backdrop.backdrop import Backdrop
from semviz_core.common.arrays import FloatArray

NAME = "/backdrop"
STRENGTH = {"dark": 0.5, "light": 0.42}
"""Share of the points' colours; the rest is the ground's."""
BRIGHTENING = {"dark": 0.7, "light": 1.0}
"""Exponent of the points' colours: shadows must differ from a dark ground."""
SATURATION = 0.45
SIZE = 1.15
"""Of a point, as a share of the distance between points. Near ones are larger on the screen."""
LUMA = np.array([0.299, 0.587, 0.114])
"""ITU-R BT.601"""


class BackdropLayer:
    """The backdrop in one scene. It is sent once, and again in the colours of another theme."""

    def __init__(self, scene: SceneDrawer) -> None:
        self._scene = scene
        self._backdrop: Backdrop | None = None
        self._colors: dict[Theme, NDArray[np.uint8]] = {}

    def use(self, backdrop: Backdrop | None) -> None:
        """Which one it is from here on; ``draw`` shows it."""
        if backdrop is self._backdrop:
            return
        self._scene.remove_under(NAME)
        self._backdrop = backdrop
        self._colors = {}

    def draw(self, shown: bool) -> None:
        """Shows or hides it."""
        if self._backdrop is None or not shown:
            self._scene.clear(NAME)
            return
        theme = self._scene.theme
        if theme not in self._colors:
            self._colors[theme] = muted(self._backdrop.colors, theme)
        size_m = SIZE * self._backdrop.spacing_m
        self._scene.draw_points(NAME, self._backdrop.points_m, self._colors[theme], size_m)


def muted(colors: NDArray[np.uint8], theme: Theme) -> NDArray[np.uint8]:
    """Return sRGB colours (n, 3) nearer to grey, and to the ground of ``theme``."""
    wanted = 255.0 * (colors.astype(np.float32) / 255.0) ** BRIGHTENING[theme]
    grey = (wanted @ LUMA)[:, None]
    plain = grey + SATURATION * (wanted - grey)
    strength, ground = STRENGTH[theme], np.array(rgb(PALETTES[theme].scene))
    mixed: FloatArray = strength * plain + (1.0 - strength) * ground
    return np.rint(mixed).astype(np.uint8)
