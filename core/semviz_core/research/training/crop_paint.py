"""Colours and light of what is painted into crops, and how it is laid over them."""

from typing import Any

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.research.training.crop_light import Floats, fractal

NEAR_BLACK, NEAR_WHITE = 12.0, 245.0
_LEAST_CONTRAST = 6.0, 22.0
"""Limits of the least difference, in grey levels, of a pole from what is beside it."""
_LEAST_RATIO = 0.35
"""The same as a share of the level beside it: in deep shade a few levels can be seen."""

_LEAST_ASPECT = 0.45
"""Least width over height of walls, fronts and boards."""


def lay_over(image: Floats, alpha: Floats, color: Any) -> None:
    """Blend a colour, of one pixel or of all, over the image with the opacity ``alpha``."""
    image += alpha[..., None] * (np.asarray(color, np.float32) - image)


def any_color(rng: np.random.Generator) -> FloatArray:
    """Return a colour (3,): grey, green or brown, or any."""
    level = rng.uniform(NEAR_BLACK, NEAR_WHITE)
    tint = (
        (1.0, 1.0, 1.0), (0.75, 1.0, 0.45), (1.0, 0.85, 0.6), (1.0, 0.45, 0.35),
        tuple(rng.uniform(0.4, 1.0, 3)),
    )[rng.integers(5)]  # fmt: skip
    return np.asarray(level * np.array(tint))


def wide_and_high(low: float, high: float, rng: np.random.Generator) -> tuple[int, int]:
    """Draw the sides of something that is too wide for a pole, between two limits in px."""
    wide, tall = np.exp(rng.uniform(np.log(low), np.log(high), 2))
    return int(max(wide, _LEAST_ASPECT * tall)), int(tall)


def window(low_px: FloatArray, high_px: FloatArray) -> tuple[tuple[slice, slice], FloatArray]:
    """Return the pixels from a corner (2,) to another, with a margin, and the first of them."""
    first = np.floor(low_px - 2.0).astype(int).clip(0)
    last = np.ceil(high_px + 3.0).astype(int).clip(0)
    return np.s_[first[1] : last[1], first[0] : last[0]], first.astype(np.float64)


def pole_light(rng: np.random.Generator, across: Floats, along: Floats) -> Floats:
    """Return the brightness of a pole at places across it (-1 to 1) and along it (0 to 1).

    The sun lights one side of it; stripes, or shade of leaves, change it along.
    """
    edge, contrast, soft = rng.uniform(-0.7, 0.7), rng.normal(0.0, 0.5), rng.uniform(2.0, 12.0)
    sides = 1.0 + np.clip(contrast, -0.8, 0.8) * np.tanh(soft * (across - edge))
    if rng.random() < 0.35:
        patches = fractal(rng, (1, 64), rng.uniform(4.0, 40.0))[0]
        sides *= np.clip(1.0 + 0.5 * patches[(np.clip(along, 0.0, 1.0) * 63.0).astype(int)], 0.2, 2)
    elif rng.random() < 0.1:
        sides *= np.where(np.sin(along * rng.uniform(10.0, 60.0)) > 0.0, 1.0, rng.uniform(0.2, 2.0))
    return np.asarray(sides, np.float32)


def pole_color(beside: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the colour (3,) of a pole: any, or one like what is ``beside`` it, as of grey steel or
    old wood in the shade, that can be told from it."""
    color = any_color(rng)
    if rng.random() < 0.4:
        tint = np.array((1.0, rng.uniform(0.85, 1.05), rng.uniform(0.65, 1.1)))
        color = beside.mean() * np.exp(rng.choice([-1, 1]) * rng.uniform(0.3, 1.0)) * tint
    return unlike(np.clip(color, 0.0, 255.0), beside, rng)


def unlike(color: FloatArray, beside: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the colour (3,), or a brighter or darker one if it is too much like ``beside``."""
    level = float(beside.mean())
    least = float(np.clip(_LEAST_RATIO * level, *_LEAST_CONTRAST))
    if np.abs(color - beside).mean() >= least:
        return color
    brighter = level < rng.uniform(60.0, 190.0)
    step = rng.uniform(1.2, 4.0) * least * (1.0 if brighter else -1.0)
    return np.asarray(np.clip(color + step, 0.0, 255.0))
