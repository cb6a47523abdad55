"""Give crops another light and another camera: shade, tones, colours, blur, noise, compression."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import ByteImage

_OCTAVES = 5
Floats = NDArray[np.float32]


def fractal(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    coarsest_px: float,
    stretch: float = 1.0,
    fading: float | None = None,
) -> Floats:
    """Return a random texture (height, width) of mean 0 and sigma of about 1, like vegetation.

    Its coarsest structures are ``coarsest_px`` wide and ``stretch`` times as high; each finer
    octave is weaker by ``fading``, or by a random factor.
    """
    height, width = shape
    texture: Floats = np.zeros((height, width), np.float32)
    total, fading = 0.0, rng.uniform(0.6, 1.05) if fading is None else fading
    for octave in range(_OCTAVES):
        cell = max(1.0, coarsest_px / 2.0**octave)
        rows, columns = (
            int(np.ceil(height / max(1.0, cell * stretch))) + 2,
            int(np.ceil(width / cell)) + 2,
        )
        grains = rng.standard_normal((rows, columns)).astype(np.float32)
        scaled = cv2.resize(grains, (width, height), interpolation=cv2.INTER_LINEAR)
        texture += np.float32(fading**octave) * scaled
        total += (fading**octave) ** 2
    return texture / np.float32(np.sqrt(0.45 * total))


def with_shade(image: ByteImage, rng: np.random.Generator) -> ByteImage:
    """Return the image with parts in the shade of trees or houses."""
    height, width = image.shape[:2]
    place = fractal(rng, (height, width), rng.uniform(20.0, 300.0), rng.uniform(0.3, 3.0))
    if rng.random() < 0.4:  # the far side of a straight edge instead
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        angle = rng.uniform(0.0, 2.0 * np.pi)
        across = np.cos(angle) * (x - rng.uniform(0, width)) + np.sin(angle) * (
            y - rng.uniform(0, height)
        )
        place = (across / 20.0 + 0.5 * place).astype(np.float32)
    soft = rng.uniform(2.0, 12.0)
    lit = 1.0 / (1.0 + np.exp(np.clip(-soft * (place - rng.uniform(-0.8, 0.8)), -30.0, 30.0)))
    dark = np.exp(rng.uniform(np.log(0.15), np.log(0.8)))
    gain = (dark + (1.0 - dark) * lit).astype(np.float32)
    return as_bytes(image * gain[..., None])


def as_taken(image: ByteImage, rng: np.random.Generator) -> ByteImage:
    """Return the image as another camera takes it."""
    taken = as_bytes(cv2.LUT(image, _tones(rng)))
    if rng.random() < 0.4:
        taken = _tinted(taken, rng)
    elif rng.random() < 0.2:
        taken = np.repeat(cv2.cvtColor(taken, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    taken = _focused(taken, rng)
    if rng.random() < 0.4:
        taken = _noisy(taken, rng)
    if rng.random() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 96))]
        written = cv2.imencode(".jpg", taken, quality)[1]
        taken = as_bytes(cv2.imdecode(written, cv2.IMREAD_COLOR))
    return taken


def _focused(image: ByteImage, rng: np.random.Generator) -> ByteImage:
    """Return the image blurred, moved, enlarged from fewer pixels, sharpened, or as it is."""
    how = rng.random()
    if how < 0.3:
        return as_bytes(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.4)))
    if how < 0.4:
        return _moved(image, rng)
    if how < 0.5:
        height, width = image.shape[:2]
        scale = rng.uniform(0.5, 0.9)
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        return as_bytes(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC))
    if how < 0.7:
        soft = cv2.GaussianBlur(image, (0, 0), 1.5)
        strength = rng.uniform(0.2, 1.2)
        return as_bytes(cv2.addWeighted(image, 1.0 + strength, soft, -strength, 0.0))
    return image


def _moved(image: ByteImage, rng: np.random.Generator) -> ByteImage:
    """Return the image with the blur of a short motion."""
    size, length, angle = 7, rng.uniform(1.5, 6.0), rng.uniform(0.0, np.pi)
    steps = np.linspace(-length / 2.0, length / 2.0, 41)
    column = np.round(3.0 + steps * np.cos(angle)).astype(int)
    row = np.round(3.0 + steps * np.sin(angle)).astype(int)
    kernel = np.zeros((size, size), np.float32)
    np.add.at(kernel, (row, column), 1.0 / len(steps))
    return as_bytes(cv2.filter2D(image, -1, kernel))


def _noisy(image: ByteImage, rng: np.random.Generator) -> ByteImage:
    noise: NDArray[np.int16] = np.empty(image.shape, np.int16)
    cv2.setRNGSeed(int(rng.integers(2**31)))
    cv2.randn(noise, np.zeros(3), np.full(3, rng.uniform(1.0, 12.0)))
    return as_bytes(cv2.add(image, noise, dtype=cv2.CV_8U))


def _tones(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Draw each channel's curve (1, 256, 3): gamma, exposure, white balance, haze or flare.

    Dark levels stay apart, as in a camera: what is labelled can be seen.
    """
    level = np.linspace(0.0, 1.0, 256)[:, None] ** np.exp(rng.uniform(-0.5, 0.5))
    gain = np.exp(rng.uniform(-0.6, 0.45)) * np.exp(rng.uniform(-0.12, 0.12, 3))
    curve = level * gain + max(0.0, rng.uniform(-0.1, 0.15))
    return np.asarray(np.clip(curve * 255.0, 0.0, 255.0).astype(np.uint8)[None])


def _tinted(image: ByteImage, rng: np.random.Generator) -> ByteImage:
    """Return the image with random saturation and a small random hue shift."""
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    turned = np.arange(256, dtype=np.int64)
    turned[:180] = (turned[:180] + rng.integers(-8, 9)) % 180
    fuller = np.clip(np.arange(256) * rng.uniform(0.2, 1.5), 0, 255)
    curves = np.stack([turned, fuller, np.arange(256)], axis=1).astype(np.uint8)
    return as_bytes(cv2.cvtColor(cv2.LUT(hsv, curves[None]), cv2.COLOR_HSV2RGB))


def as_bytes(image: Any) -> ByteImage:
    """Return an image with values clipped to bytes; narrows the type of OpenCV's results."""
    return np.asarray(np.clip(image, 0, 255), np.uint8)
