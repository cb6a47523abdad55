"""The palette of the 3D scenes, and colours that come out of viser as they are meant.

The hexadecimal values are those of ``static/base.css``; a test holds the two together.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from semviz import palette
from semviz_core.arrays import FloatArray

Theme = Literal["dark", "light"]
Rgb = tuple[int, int, int]


@dataclass(frozen=True)
class Palette:
    """Colours of one theme, sRGB hex."""

    scene: str
    road: str
    grid: str
    faint: str
    accent: str
    truth: str
    estimate: str
    prior: str
    alternative: str
    residual: tuple[str, ...]
    """From good to bad; the limits between them are ``semviz.palette.RESIDUAL_LIMITS_PX``."""


def _palette(theme: Theme, scene: str, road: str, grid: str, faint: str, accent: str) -> Palette:
    def pick(tone: palette.Tone) -> str:
        return tone.dark if theme == "dark" else tone.light

    return Palette(
        scene=scene,
        road=road,
        grid=grid,
        faint=faint,
        accent=accent,
        truth=pick(palette.TRUTH),
        estimate=pick(palette.ESTIMATE),
        prior=pick(palette.PRIOR),
        alternative=pick(palette.ALTERNATIVE),
        residual=tuple(pick(tone) for tone in palette.RESIDUAL),
    )


PALETTES: dict[Theme, Palette] = {
    "dark": _palette("dark", "#17181A", "#26282B", "#2A2C30", "#7D828A", "#4DABF7"),
    "light": _palette("light", "#F7F8F9", "#E7E9EC", "#E4E6E9", "#767D86", "#1971C2"),
}


def rgb(color: str) -> Rgb:
    """``#RRGGBB`` as three bytes, for images and the background: viser shows those exactly."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def mix(color: str, ground: str, share: float) -> str:
    """``color`` at ``share`` of opacity over ``ground``: lines in viser have no opacity."""
    over = share * np.array(rgb(color)) + (1.0 - share) * np.array(rgb(ground))
    return "#" + "".join(f"{round(one):02X}" for one in over)


# three.js maps the light of lines and meshes to the screen by Stephen Hill's fit of the ACES
# filmic curve (BakingLab/ACES.hlsl), which viser leaves on: y = OUT . fit(IN . x / 0.6).
_ACES_IN = np.array(
    [[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]]
)
_ACES_OUT = np.array(
    [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]]
)


@lru_cache(maxsize=256)
def scene_rgb(color: str) -> Rgb:
    """What to give viser so that a line or mesh under white ambient light looks like ``color``.

    Undoes the tone mapping: exact within one step of 255 for what the curve can reach; brighter
    or more saturated colours (white gives 226) come out as near as they can.
    """
    y = np.linalg.solve(_ACES_OUT, _linear(np.array(rgb(color)) / 255.0))
    # fit(v) = (v (v + a) - b) / (v (c v + d) + e), solved for v
    a, b, c, d, e = 0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081
    p, q, r = 1.0 - c * y, a - d * y, -b - e * y
    v = (-q + np.sqrt(q * q - 4.0 * p * r)) / (2.0 * p)
    light = np.clip(np.linalg.solve(_ACES_IN, v) * 0.6, 0.0, 1.0)
    red, green, blue = np.round(255.0 * _encoded(light)).astype(int).tolist()
    return red, green, blue


def scene_light(color: str) -> FloatArray:
    """(3,) ``scene_rgb`` as shares of light, which is how glTF models have colours."""
    return _linear(np.array(scene_rgb(color)) / 255.0)


def _linear(encoded: FloatArray) -> FloatArray:
    low = encoded <= 0.04045
    return np.where(low, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _encoded(linear: FloatArray) -> FloatArray:
    low = linear <= 0.0031308
    return np.where(low, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
