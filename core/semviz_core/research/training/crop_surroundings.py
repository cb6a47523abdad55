"""Give the elements of a crop other surroundings than those of rendered streets.

Bushes, woods, walls, boards and trunks are painted behind the elements; poles get a bright and a
dark side and other colours. Real images have all of this, rendered streets have little of it.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.research.training.crop_facades import letter, paint_fronts
from semviz_core.research.training.crop_light import Floats, as_bytes, fractal
from semviz_core.research.training.crop_paint import (
    NEAR_BLACK,
    any_color,
    lay_over,
    pole_color,
    pole_light,
    wide_and_high,
    window,
)
from semviz_core.research.training.detector_images import Crop

Painter = Callable[[Floats, BoolArray, np.random.Generator], None]
"""Paints into an image (height, width, 3) where a mask says that no element is."""


def in_other_surroundings(crop: Crop, rng: np.random.Generator) -> tuple[Crop, BoolArray]:
    """Return the crop, which must have masks, with other things behind and other light on its
    elements, and (height, width) where it shows fronts of houses: no pole stands on them."""
    image = crop.image.astype(np.float32)
    behind = crop.rows == 0
    _paint_some(_FAR, image, behind, rng)
    fronts = np.zeros(behind.shape, bool)
    if rng.random() < _FRONTS_SHARE:
        feet_px = crop.elements.end_px[crop.elements.is_line]
        fronts = paint_fronts(image, behind, feet_px, rng)
    _paint_some(_NEAR, image, behind, rng)
    _relight(image, crop, rng)
    return replace(crop, image=as_bytes(image)), fronts


def _paint_some(
    shares: dict[Painter, float], image: Floats, behind: BoolArray, rng: np.random.Generator
) -> None:
    for paint, share in shares.items():
        if rng.random() < share:
            paint(image, behind, rng)


def _leaf_color(rng: np.random.Generator) -> FloatArray:
    """Return a colour (3,) of leaves or dry grass, mostly dark; sometimes any."""
    if rng.random() < 0.25:
        return any_color(rng) * 0.7
    level = np.exp(rng.uniform(np.log(NEAR_BLACK), np.log(150.0)))
    return np.asarray(level * np.array([rng.uniform(0.55, 1.1), 1.0, rng.uniform(0.3, 0.8)]))


def _woods(image: Floats, behind: BoolArray, rng: np.random.Generator) -> None:
    """Paint bushes, woods or high grass: from a ragged skyline down, or from above."""
    height, width = behind.shape
    for _ in range(rng.integers(1, 4)):
        relief = fractal(rng, (1, width), rng.uniform(20.0, 200.0), 1.0, 0.55)[0]
        skyline = rng.uniform(0.0, 0.9) * height + rng.uniform(3.0, 50.0) * relief
        rows = np.arange(height, dtype=np.float32)[:, None]
        hanging = rng.random() < 0.35
        inside = behind & (rows < skyline if hanging else rows > skyline)
        if rng.random() < 0.5:  # a bush is not as wide as the crop
            left = rng.uniform(-0.3, 0.9) * width
            columns = np.arange(width)
            inside &= (columns > left) & (columns < left + rng.uniform(0.2, 0.8) * width)
        leaves = fractal(rng, behind.shape, rng.uniform(6.0, 60.0), rng.uniform(0.5, 3.0))
        middle, change = _leaf_color(rng), rng.uniform(0.15, 0.7)
        shade = np.clip(1.0 + change * leaves, 0.05, 2.5)
        image[inside] = shade[inside][:, None] * middle
        if rng.random() < 0.4:  # the sky, or lit leaves, shows between
            holes = inside & (leaves > rng.uniform(1.3, 3.0))
            image[holes] = rng.uniform(60.0, 255.0) * np.array((1.0, 1.0, rng.uniform(0.6, 1.1)))


def _walls(image: Floats, behind: BoolArray, rng: np.random.Generator) -> None:
    """Paint plain quadrilaterals with upright sides: houses, doors, windows, cars' panels."""
    height, width = behind.shape
    for _ in range(rng.integers(1, 6)):
        left, top = rng.uniform(-0.2, 1.0) * width, rng.uniform(-0.2, 0.8) * height
        wide, high = wide_and_high(10.0, 250.0, rng)
        slant = rng.normal(0.0, 0.1 * high, 2)
        corners = np.array([(0, slant[0]), (wide, slant[1]), (wide, high), (0, high)])
        corners += np.array([left, top])
        part, corner = window(corners.min(axis=0), corners.max(axis=0))
        shown = behind[part]
        if min(shown.shape) < 2:
            continue
        cover: NDArray[np.uint8] = np.zeros(shown.shape, np.uint8)
        outline = np.round((corners - corner) * 16).astype(np.int32)
        cv2.fillPoly(cover, [outline], 255, cv2.LINE_AA, 4)
        alpha = (cover * shown / 255.0).astype(np.float32)
        grain = 1.0 + rng.uniform(0.0, 0.15) * fractal(rng, shown.shape, rng.uniform(4.0, 80.0))
        lay_over(image[part], alpha, grain[..., None] * any_color(rng))


def _boards(image: Floats, behind: BoolArray, rng: np.random.Generator) -> None:
    """Paint advert and notice boards: pictures in a frame. They are no traffic signs."""
    height, width = behind.shape
    for _ in range(rng.integers(1, 3)):
        wide, high = wide_and_high(14.0, 110.0, rng)
        left, top = int(rng.integers(-20, width)), int(rng.integers(-20, height - 40))
        part = np.s_[max(0, top) : top + high, max(0, left) : left + wide]
        shown = behind[part].astype(np.float32)
        if min(shown.shape) < 6:
            continue
        picture = [
            as_bytes(any_color(rng) * (1.0 + rng.uniform(0.0, 0.6) * each[..., None]))
            for each in (fractal(rng, shown.shape, rng.uniform(4.0, 60.0)) for _ in range(2))
        ]
        which = fractal(rng, shown.shape, rng.uniform(8.0, 80.0))[..., None] > rng.normal(0.0, 0.5)
        frame = int(rng.integers(1, max(2, min(9, min(shown.shape) // 4))))
        lay_over(image[part], shown, any_color(rng))
        inner = np.zeros_like(shown)
        inner[frame:-frame, frame:-frame] = shown[frame:-frame, frame:-frame]
        if rng.random() < 0.5:
            letter(picture[0], rng)
        lay_over(image[part], inner, np.where(which, *picture))


def _trunks(image: Floats, behind: BoolArray, rng: np.random.Generator) -> None:
    """Paint trunks of trees: wide, rough, of uneven width, some with crowns. They are no poles."""
    height, width = behind.shape
    for _ in range(rng.integers(1, 4)):
        thick = np.exp(rng.uniform(np.log(5.0), np.log(45.0)))
        bottom = np.array([rng.uniform(0, width), rng.uniform(0.4, 1.1) * height])
        length, lean = rng.uniform(4.0, 16.0) * thick, rng.normal(0.0, 0.07)
        reach = 1.5 * thick + abs(lean) * length
        low, high = bottom - np.array([reach, length]), bottom + np.array([reach, 0.0])
        part, corner = window(low, np.minimum(high, behind.shape[::-1]))
        shown = behind[part]
        if min(shown.shape) < 2:
            continue
        above = bottom[1] - corner[1] - np.arange(len(shown), dtype=np.float32)[:, None]
        columns = np.arange(shown.shape[1], dtype=np.float32) + corner[0] - bottom[0]
        sway = fractal(rng, (2, len(shown)), rng.uniform(60.0, 250.0), 1.0, 0.4)[..., None]
        half = 0.5 * thick * (1.0 + 0.08 * sway[1] + 0.5 * np.exp(-np.maximum(above, 0) / thick))
        off = np.abs(columns - lean * above - 0.15 * thick * sway[0])
        alpha = np.clip(half - off + 0.5, 0.0, 1.0) * ((above > 0.0) & (above < length)) * shown
        bark = np.clip(1.0 + 0.4 * fractal(rng, shown.shape, thick / 2.0, 4.0), 0.1, 2.0)
        round_ = 1.0 - 0.4 * np.clip(off / half, 0.0, 1.0) ** 2
        brown = rng.uniform(8.0, 130.0) * np.array((1.0, 0.88, 0.75))
        lay_over(image[part], alpha.astype(np.float32), (bark * round_)[..., None] * brown)
        if rng.random() < 0.6:
            top = bottom + length * np.array([lean, -1.0])
            _crown(image, behind, top, thick * rng.uniform(2.0, 6.0), rng)


def _crown(
    image: Floats, behind: BoolArray, middle_px: FloatArray, radius: float, rng: np.random.Generator
) -> None:
    """Paint the leaves around the top of a trunk."""
    part, corner = window(middle_px - 1.5 * radius, middle_px + 1.5 * radius)
    shown = behind[part]
    if min(shown.shape) < 2:
        return
    v, u = np.indices(shown.shape, np.float32)
    off = np.hypot(u + (corner[0] - middle_px[0]), v + (corner[1] - middle_px[1])) / radius
    leaves = fractal(rng, shown.shape, max(3.0, 0.5 * radius))
    inside = shown & (off + 0.25 * leaves < 1.0)
    shade = np.clip(1.0 + rng.uniform(0.15, 0.6) * leaves, 0.05, 2.5)[inside][:, None]
    image[part][inside] = shade * _leaf_color(rng)


def _relight(image: Floats, crop: Crop, rng: np.random.Generator) -> None:
    """Light and paint the poles otherwise, and soil the signs."""
    elements = crop.elements
    for row in np.flatnonzero(rng.random(len(elements)) < 0.6).tolist():
        v, u = np.nonzero(crop.rows == row + 1)
        if not len(v):
            continue
        if not elements.is_line[row]:
            grain = fractal(rng, crop.rows.shape, rng.uniform(4.0, 40.0))[v, u, None]
            image[v, u] *= rng.uniform(0.3, 1.3) * np.clip(1.0 + 0.12 * grain, 0.3, 2.0)
            continue
        peak, span = elements.anchor_px[row], elements.end_px[row] - elements.anchor_px[row]
        length = float(np.linalg.norm(span))
        places = np.stack([u, v], axis=1) - peak
        across = places @ np.array([span[1], -span[0]]) / length
        half = max(0.5, len(v) / length / 2.0)
        light = pole_light(
            rng, (across / half).astype(np.float32), (places @ span / length**2).astype(np.float32)
        )
        aside = np.clip(u + round(2.0 * half + 3.0) * rng.choice([-1, 1]), 0, image.shape[1] - 1)
        beside = image[v, aside].mean(axis=0)
        own = image[v, u] if rng.random() < 0.4 else pole_color(beside, rng)
        image[v, u] = own * light[:, None]


_FAR: dict[Painter, float] = {_woods: 0.4, _walls: 0.3}
_NEAR: dict[Painter, float] = {_boards: 0.45, _trunks: 0.5}
"""Shares of crops in which each is painted, in this order: behind fronts and before them."""
_FRONTS_SHARE = 0.5
