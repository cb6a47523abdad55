"""Pieces cut out of labelled images, larger or smaller, in other light: no two are alike."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.detection.labelled import LabelledImage
from semviz_core.detection.maps import BORDER
from semviz_core.elements import Elements2D
from semviz_core.learning.street_images import IGNORED, paint

HEIGHT, WIDTH = 384, 352
"""A crop is as tall as images are, so that it holds whole poles."""
SCALES = 0.65, 1.6
SHORTEST_PX, SMALLEST_PX = 8.0, 5.0
"""Less of a pole is not learned, nor a smaller sign."""
MARGIN_PX = 16.0
"""So far around a sign that is cut off nothing is learned, if nobody knows its size."""
_PATCHES = 4


@dataclass(frozen=True, eq=False)
class Crop:
    """A piece of an image and what it shows."""

    image: ByteImage
    """(HEIGHT, WIDTH, 3) sRGB."""
    elements: Elements2D
    """(m,) poles as far as they are inside."""
    rows: ByteImage
    """(HEIGHT, WIDTH) 1 + the row of the element that a pixel shows, ``IGNORED`` where nothing is
    to be learned, 0 elsewhere."""
    has_masks: bool


def random_crop(labelled: LabelledImage, rng: np.random.Generator) -> Crop:
    """Any piece, at any scale, perhaps mirrored, in other colours, behind other eyes."""
    height, width = labelled.image.shape[:2]
    low, high = np.log(SCALES)
    scale = float(np.exp(rng.uniform(low, high)))
    corner = [_placed(rng, width * scale, WIDTH), _placed(rng, height * scale, HEIGHT)]
    crop = _cut(labelled, scale, corner, mirrored=bool(rng.random() < 0.5))
    image = _patched(crop, rng) if rng.random() < 0.4 else crop.image
    return replace(crop, image=_seen_otherwise(image, rng))


def middle_crop(labelled: LabelledImage, share: float) -> Crop:
    """An unchanged piece: from the left to the right end as ``share`` goes from 0 to 1."""
    height, width = labelled.image.shape[:2]
    return _cut(labelled, 1.0, [share * (width - WIDTH), (height - HEIGHT) / 2.0], mirrored=False)


def _placed(rng: np.random.Generator, there: float, wanted: int) -> float:
    """Where a crop begins in something longer, or before something shorter."""
    return float(rng.uniform(min(0.0, there - wanted), max(0.0, there - wanted)))


def _cut(labelled: LabelledImage, scale: float, corner: list[float], mirrored: bool) -> Crop:
    to_crop = _similarity(scale, corner, mirrored)
    size = WIDTH, HEIGHT
    image = _bytes(
        cv2.warpAffine(
            labelled.image, to_crop, size, flags=cv2.INTER_LINEAR, borderValue=(BORDER,) * 3
        )
    )
    rows: NDArray[np.uint8] = np.zeros(labelled.image.shape[:2], np.uint8)
    if labelled.ignored is not None:
        rows[labelled.ignored] = IGNORED
    paint(rows, labelled.regions or ())
    rows = _bytes(cv2.warpAffine(rows, to_crop, size, flags=cv2.INTER_NEAREST))
    has_masks = labelled.regions is not None
    elements, learned = _inside(labelled.elements, to_crop, rows if has_masks else None)
    return Crop(
        image, elements[learned], _renumbered(rows, elements, learned, has_masks), has_masks
    )


def _similarity(scale: float, corner: list[float], mirrored: bool) -> FloatArray:
    """(2, 3) from an image's pixels to a crop's, whose (0, 0) are centres of pixels."""
    shift = np.array([-corner[0], -corner[1]]) + (scale - 1.0) / 2.0
    if mirrored:
        return np.array([[-scale, 0.0, WIDTH - 1.0 - shift[0]], [0.0, scale, shift[1]]])
    return np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])


def _inside(
    elements: Elements2D, to_crop: FloatArray, rows: ByteImage | None
) -> tuple[Elements2D, BoolArray]:
    """The elements, poles cut off at the edges, and which of them can be learned."""
    anchor = elements.anchor_px @ to_crop[:, :2].T + to_crop[:, 2]
    end = elements.end_px @ to_crop[:, :2].T + to_crop[:, 2]
    from_anchor, to_end = _clipped(anchor, end)
    line, span = elements.is_line, end - anchor
    first = anchor + np.where(line, from_anchor, 0.0)[:, None] * np.where(line[:, None], span, 0.0)
    last = anchor + to_end[:, None] * span
    inside = (first >= 0.0).all(axis=1) & (first < (WIDTH, HEIGHT)).all(axis=1)
    large = np.linalg.norm(last - first, axis=1) >= SHORTEST_PX
    if rows is not None:
        shown = np.bincount(rows.ravel(), minlength=256)[1 : 1 + len(elements)]
        large |= ~line & (shown >= SMALLEST_PX**2 / 2.0)
    else:
        large |= ~line
    cut = replace(
        elements,
        anchor_px=first,
        end_px=last,
        anchor_known=elements.anchor_known & (~line | (from_anchor == 0.0)),
        end_known=elements.end_known & (to_end == 1.0),
    )
    return cut, np.where(line, to_end > from_anchor, inside) & large


def _clipped(anchor: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(m,) shares of the way from anchor to end where it enters and leaves a crop (Liang and
    Barsky); the first is larger where it never does."""
    span = end - anchor
    enter, leave = np.zeros(len(anchor)), np.ones(len(anchor))
    for axis, size in ((0, WIDTH), (1, HEIGHT)):
        with np.errstate(divide="ignore", invalid="ignore"):
            edges = (np.array([0.0, size - 1.0]) - anchor[:, axis, None]) / span[:, axis, None]
        edges = np.sort(np.nan_to_num(edges, nan=0.0, posinf=1e9, neginf=-1e9), axis=1)
        enter, leave = np.maximum(enter, edges[:, 0]), np.minimum(leave, edges[:, 1])
    return enter, leave


def _renumbered(
    rows: ByteImage, elements: Elements2D, learned: BoolArray, has_masks: bool
) -> ByteImage:
    """``rows`` with those numbers that remain, and nothing learned where the others are."""
    numbers = np.arange(256)
    numbers[1 : 1 + len(learned)] = np.where(learned, np.cumsum(learned), IGNORED)
    found = numbers.astype(np.uint8)[rows]
    if not has_masks:
        for x, y in elements.anchor_px[~learned & ~elements.is_line]:
            left, top = int(x - MARGIN_PX), int(y - MARGIN_PX)
            right, bottom = int(x + MARGIN_PX), int(y + MARGIN_PX)
            found[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = IGNORED
    return found


def _patched(crop: Crop, rng: np.random.Generator) -> ByteImage:
    """Areas behind the elements in another colour: what stands there says nothing of them."""
    image = crop.image.copy()
    for _ in range(rng.integers(1, _PATCHES + 1)):
        top, left = int(rng.integers(HEIGHT)), int(rng.integers(WIDTH))
        height, width = rng.integers(8, 160, 2)
        window = image[top : top + height, left : left + width]
        grain = rng.normal(0.0, rng.uniform(0.0, 20.0), (*window.shape[:2], 1))
        window[:] = np.clip(rng.uniform(0, 255, 3) + grain, 0, 255).astype(np.uint8)
    shown = crop.rows > 0
    image[shown] = crop.image[shown]
    return image if crop.has_masks else crop.image


def _seen_otherwise(image: ByteImage, rng: np.random.Generator) -> ByteImage:
    """Other light, another lens, another camera, another file."""
    seen = _bytes(cv2.LUT(image, _tones(rng)))
    if rng.random() < 0.4:
        seen = _tinted(seen, rng)
    if rng.random() < 0.35:
        seen = _bytes(cv2.GaussianBlur(seen, (0, 0), rng.uniform(0.3, 1.4)))
    elif rng.random() < 0.3:
        soft = cv2.GaussianBlur(seen, (0, 0), 1.5)
        more = rng.uniform(0.2, 1.2)
        seen = _bytes(cv2.addWeighted(seen, 1.0 + more, soft, -more, 0.0))
    if rng.random() < 0.4:
        seen = _noisy(seen, rng)
    if rng.random() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 96))]
        written = cv2.imencode(".jpg", seen, quality)[1]
        seen = _bytes(cv2.imdecode(written, cv2.IMREAD_COLOR))
    return seen


def _noisy(image: ByteImage, rng: np.random.Generator) -> ByteImage:
    noise: NDArray[np.int16] = np.empty(image.shape, np.int16)
    cv2.setRNGSeed(int(rng.integers(2**31)))
    cv2.randn(noise, np.zeros(3), np.full(3, rng.uniform(1.0, 12.0)))
    return _bytes(cv2.add(image, noise, dtype=cv2.CV_8U))


def _tones(rng: np.random.Generator) -> NDArray[np.uint8]:
    """(1, 256, 3) each channel's curve: gamma, contrast, brightness, white balance."""
    level = np.linspace(0.0, 1.0, 256)[:, None] ** np.exp(rng.uniform(-0.5, 0.5))
    gain = np.exp(rng.uniform(-0.35, 0.35)) * np.exp(rng.uniform(-0.12, 0.12, 3))
    curve = (level - 0.5) * gain + 0.5 + rng.uniform(-0.15, 0.15)
    return np.asarray(np.clip(curve * 255.0, 0.0, 255.0).astype(np.uint8)[None])


def _tinted(image: ByteImage, rng: np.random.Generator) -> ByteImage:
    """More or less colourful, colours turned a little."""
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    turned = np.arange(256, dtype=np.int64)
    turned[:180] = (turned[:180] + rng.integers(-8, 9)) % 180
    fuller = np.clip(np.arange(256) * rng.uniform(0.2, 1.5), 0, 255)
    curves = np.stack([turned, fuller, np.arange(256)], axis=1).astype(np.uint8)
    return _bytes(cv2.cvtColor(cv2.LUT(hsv, curves[None]), cv2.COLOR_HSV2RGB))


def _bytes(image: Any) -> ByteImage:
    """What OpenCV answers, whose types say less."""
    return np.asarray(image, dtype=np.uint8)
