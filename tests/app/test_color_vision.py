"""Colours of one family stay apart for people who see two cones: simulated, and measured."""

import re
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from semviz import web
from semviz.presentation import plots
from semviz.presentation.plots import Tone
from semviz_annotation.labels.class_looks import PALETTE
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.common.arrays import FloatArray

LEAST = 12.0
"""CIEDE2000; about 1 is just noticeable side by side."""

# Machado, Oliveira, Fernandes (2009), severity 1, on linear RGB
SIMULATED = {
    "as it is": np.eye(3),
    "protan": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deutan": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritan": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
# IEC 61966-2-1, and the white of D65
WHITE = np.array([0.95047, 1.0, 1.08883])
XYZ_OF_RGB = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)

FAMILIES = {
    "classes": [Tone(class_.color, class_.color_light) for class_ in DEFAULT_CLASSES],
    "poses": [plots.TRUTH, plots.ESTIMATE, plots.PRIOR, plots.ALTERNATIVE],
    "status": list(plots.STATUS.values()),
}


def linear_rgb(color: str) -> FloatArray:
    encoded = np.array([int(color[at : at + 2], 16) / 255.0 for at in (1, 3, 5)])
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def simulated_lab(color: str, matrix: object) -> FloatArray:
    """CIELAB (D65) of ``#RRGGBB`` as it is seen through ``matrix``."""
    xyz = XYZ_OF_RGB @ np.clip(np.asarray(matrix) @ linear_rgb(color), 0.0, 1.0) / WHITE
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz * (29 / 6) ** 2 / 3 + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def ciede2000(first: FloatArray, second: FloatArray) -> float:
    """Difference of two CIELAB colours (CIE 142-2001, as Sharma et al. 2005 write it)."""
    chroma = np.mean([np.hypot(*first[1:]), np.hypot(*second[1:])])
    g = 0.5 * (1 - np.sqrt(chroma**7 / (chroma**7 + 25.0**7)))
    a = np.array([first[1], second[1]]) * (1 + g)
    b = np.array([first[2], second[2]])
    c, h = np.hypot(a, b), np.degrees(np.arctan2(b, a)) % 360
    gray = c.prod() == 0
    dh = 0.0 if gray else (h[1] - h[0] + 180) % 360 - 180
    mean_h = h.sum() if gray else (h[0] + dh / 2) % 360
    d_light, d_chroma = second[0] - first[0], c[1] - c[0]
    d_hue = 2 * np.sqrt(c.prod()) * np.sin(np.radians(dh / 2))
    light, chroma = (first[0] + second[0]) / 2, c.mean()
    cosines = np.cos(np.radians([mean_h - 30, 2 * mean_h, 3 * mean_h + 6, 4 * mean_h - 63]))
    t = 1 + np.array([-0.17, 0.24, 0.32, -0.20]) @ cosines
    turn = 30 * np.exp(-(((mean_h - 275) / 25) ** 2))
    r = -np.sin(np.radians(2 * turn)) * 2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7))
    d_light /= 1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2)
    d_chroma /= 1 + 0.045 * chroma
    d_hue /= 1 + 0.015 * chroma * t
    return float(np.sqrt(d_light**2 + d_chroma**2 + d_hue**2 + r * d_chroma * d_hue))


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, -1.3802, -84.2814), (50.0, 0.0, -82.7485), 1.0000),
        ((50.0, 2.5, 0.0), (50.0, 0.0, -2.5), 4.3065),
        ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_the_difference_is_that_of_the_published_pairs(
    first: tuple[float, ...], second: tuple[float, ...], expected: float
) -> None:
    assert ciede2000(np.array(first), np.array(second)) == pytest.approx(expected, abs=1e-4)
    assert ciede2000(np.array(second), np.array(first)) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("vision", SIMULATED)
@pytest.mark.parametrize("family", FAMILIES)
def test_colours_of_a_family_stay_apart(
    family: str, vision: str, theme: Literal["dark", "light"]
) -> None:
    colors = [getattr(tone, theme) for tone in FAMILIES[family]]
    seen = {color: simulated_lab(color, SIMULATED[vision]) for color in colors}
    least = {pair: ciede2000(*(seen[name] for name in pair)) for pair in combinations(colors, 2)}
    assert min(least.values()) >= LEAST, min(least, key=least.__getitem__)


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("vision", SIMULATED)
def test_colours_chosen_for_own_classes_mean_nothing_else(
    vision: str, theme: Literal["dark", "light"]
) -> None:
    """Least where six more of them are apart from four: not ``LEAST``, but never alike."""

    def seen(color: str) -> FloatArray:
        return simulated_lab(color, SIMULATED[vision])

    own = [seen(pair[theme == "light"]) for pair in PALETTE]
    usual = [seen(getattr(tone, theme)) for tone in FAMILIES["classes"]]
    estimate = seen(getattr(plots.ESTIMATE, theme))
    assert min(ciede2000(color, estimate) for color in own) >= LEAST
    assert min(ciede2000(*pair) for pair in combinations([*own, *usual], 2)) >= 0.75 * LEAST
    assert min(ciede2000(first, second) for first in own[:2] for second in usual) >= 0.9 * LEAST


def test_the_orange_that_own_classes_had_is_taken_for_an_estimate() -> None:
    pairs = [
        [simulated_lab(color, matrix) for color in ("#FF9F43", plots.ESTIMATE.dark)]
        for matrix in SIMULATED.values()
    ]
    assert min(ciede2000(*pair) for pair in pairs) < LEAST


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_text_stands_out_from_every_surface(theme: str) -> None:
    """Contrast of WCAG 2: 4.5 for text, 3 for what only adds to it."""
    dark, light = (dict(re.findall(r"--([\w-]+): (#\w{6});", theme)) for theme in themes())
    colors = dark if theme == "dark" else dark | light
    for text, least in (("text", 7.0), ("dim", 4.5), ("faint", 3.0)):
        for surface in ("page", "panel", "raised"):
            low, high = sorted(luminance(colors[name]) for name in (text, surface))
            assert (high + 0.05) / (low + 0.05) >= least, (text, surface)


def themes() -> list[str]:
    css = (Path(web.__file__).parent / "static" / "base.css").read_text(encoding="utf-8")
    return re.findall(r":root[^{]*\{([^}]*)\}", css)[:2]


def luminance(color: str) -> float:
    return float(XYZ_OF_RGB[1] @ linear_rgb(color))


def test_no_meaning_of_a_class_is_in_its_colour_alone() -> None:
    shapes = [class_.shape for class_ in DEFAULT_CLASSES]
    assert len(set(shapes)) == len(shapes)
