"""Textures made of noise and simple shapes: ground, sky, leaves and walls."""

import cv2
import numpy as np

from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.sources.street.brushes import Texture, lit, mixed
from semviz_core.sources.street.things import Color, FloatPicture

SKY_ELEVATION_RAD = (-0.06, 0.36)
"""What the panorama shows, from its bottom to its top."""

_WALLS: tuple[Color, ...] = (
    (226, 214, 190),
    (214, 196, 160),
    (196, 186, 176),
    (232, 226, 214),
    (206, 168, 136),
    (178, 108, 84),
    (190, 198, 196),
)
_ROOFS: tuple[Color, ...] = ((146, 76, 56), (122, 70, 58), (92, 88, 90), (108, 84, 72))
_LEAVES: tuple[Color, ...] = ((86, 120, 52), (104, 134, 60), (70, 104, 56), (122, 132, 58))


def noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    falloff: float,
    stretch: float = 1.0,
    lowest: float = 1.0,
) -> FloatPicture:
    """Tileable noise of mean 0 and standard deviation 1.

    Its spectrum falls as 1/f^falloff from ``lowest`` cycles per width on; ``stretch`` makes it
    longer along the rows.
    """
    fy = np.fft.fftfreq(shape[0])[:, None] * shape[1] / stretch
    fx = np.fft.rfftfreq(shape[1])[None, :] * shape[1]
    frequency = np.maximum(np.hypot(fx, fy), lowest)
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal(shape)) / frequency**falloff
    field = np.fft.irfft2(spectrum, shape)
    return np.asarray(field / field.std(), dtype=np.float32)


def sky(rng: np.random.Generator, haze: Color) -> ByteImage:
    """Panorama (height, width, 3) of sky, clouds and far woods; all headings by elevation.

    Row 0 is its top; columns go with the heading from 0 to 2 pi.
    """
    height, width = 300, 4096
    low, high = SKY_ELEVATION_RAD
    elevation = np.linspace(high, low, height, dtype=np.float32)[:, None]
    rise = np.clip(elevation / 0.75, 0.0, 1.0)[..., None] ** 0.6
    zenith = np.array(mixed((84, 138, 205), (110, 160, 212), rng.random()), np.float32)
    colors = np.array(haze, np.float32) * (1 - rise) + zenith * rise
    colors = np.broadcast_to(colors, (height, width, 3)).copy()
    puffs = noise(rng, (height, width), 1.6, 2.6, 12.0)
    cover = rng.uniform(0.1, 0.7)
    clouds = np.clip((puffs - cover) / 1.3, 0.0, 1.0)[..., None]
    shade = cv2.GaussianBlur(np.roll(clouds[..., 0], 9, axis=0), (0, 0), 6)[..., None]
    white = np.array((252, 252, 252), np.float32) - shade * np.array((34, 30, 24), np.float32)
    opacity = 0.92 * clouds * (3.0 - 2.0 * clouds) * np.clip(elevation / 0.1, 0.15, 1.0)[..., None]
    colors += np.clip(opacity, 0, 1) * (white - colors)
    _far_woods(rng, colors, elevation, haze)
    return np.asarray(cv2.convertScaleAbs(colors), dtype=np.uint8)


def _far_woods(
    rng: np.random.Generator, colors: FloatPicture, elevation: FloatPicture, haze: Color
) -> None:
    """Hills and tree lines at the horizon, the nearer the darker."""
    width = colors.shape[1]
    step = float(elevation[0, 0] - elevation[1, 0])
    for share, height, rough, falloff in ((0.66, 0.030, 0.012, 1.5), (0.46, 0.012, 0.006, 0.8)):
        crest = height + rough * noise(rng, (1, width), falloff, lowest=10.0)
        cover = np.clip((crest - elevation) / step + 0.5, 0.0, 1.0)[..., None]
        leaves = 1.0 + 0.05 * noise(rng, (elevation.shape[0], width), 0.5)[..., None]
        color = np.array(mixed((76, 98, 62), haze, share), np.float32)
        colors += cover * (color * leaves - colors)


def crowns(rng: np.random.Generator, sun_left: bool) -> list[list[Texture]]:
    """For each kind of tree, a few crowns."""
    return [[_crown(rng, np.array(base), sun_left) for _ in range(2)] for base in _LEAVES]


def _crown(rng: np.random.Generator, base: FloatArray, sun_left: bool) -> Texture:
    """A tree's crown: leaves in clumps, lit from above and from the sun's side."""
    size, clumps = 256, 48
    canvas = np.zeros((size, size, 4), np.float32)  # red, green, blue, opacity
    canvas[..., :3] = 0.42 * base
    core = (*(0.5 * base), 1.0)
    cv2.circle(canvas, (size // 2, size // 2), int(0.27 * size), core, cv2.FILLED)
    places = _disc(rng, clumps)
    for x, y in size * (0.5 + 0.36 * places[np.argsort(-places[:, 1])]):  # the lowest first
        _clump(rng, canvas, (x, y), rng.uniform(0.07, 0.125) * size, base, sun_left)
    soft = np.asarray(cv2.GaussianBlur(canvas[..., 3], (0, 0), 0.8), dtype=np.float32)
    return Texture.of(canvas[..., :3], soft)


def _clump(
    rng: np.random.Generator,
    canvas: FloatPicture,
    middle: tuple[float, float],
    reach: float,
    base: FloatArray,
    sun_left: bool,
) -> None:
    """Dabs of colour within a disc; the shadow side first, lighter ones on the sun's side."""
    count = 110
    places = _disc(rng, count)
    toward = places @ [-0.55 if sun_left else 0.55, -0.85]
    places, toward = places[np.argsort(toward)], np.sort(toward)
    height = 0.35 * (0.5 - middle[1] / len(canvas))
    light = np.clip(0.72 + 0.42 * toward + height + rng.normal(0.0, 0.09, count), 0.25, 1.35)
    colors = np.column_stack([light[:, None] * base, np.ones(count)]).tolist()
    centers = np.round(16.0 * (np.array(middle) + reach * places)).astype(int).tolist()
    radii = (16.0 * rng.uniform(0.0065, 0.0145, count) * len(canvas)).astype(int).tolist()
    for center, radius, color in zip(centers, radii, colors, strict=True):
        cv2.circle(canvas, center, radius, color, cv2.FILLED, cv2.LINE_8, 4)


def _disc(rng: np.random.Generator, count: int) -> FloatArray:
    """(count, 2) points spread evenly over the unit disc."""
    angle, radius = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.uniform(0, 1, count))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def leaves(rng: np.random.Generator) -> Texture:
    """The face of a hedge, 3 m by 1 m."""
    shape = (112, 336)
    base = np.array(lit(_LEAVES[rng.integers(len(_LEAVES))], 0.82), np.float32)
    pattern = 0.16 * noise(rng, shape, 0.25) + 0.1 * noise(rng, shape, 0.9)
    fade = np.linspace(1.12, 0.62, shape[0], dtype=np.float32)[:, None]
    colors = base * np.clip(fade + pattern, 0.25, 1.5)[..., None]
    opacity = np.ones(shape, np.float32)
    ragged = 5 + 2.5 * noise(rng, (1, shape[1]), 0.4)
    opacity[np.arange(shape[0])[:, None] < ragged] = 0.0
    soft = np.asarray(cv2.GaussianBlur(opacity, (0, 0), 0.8), dtype=np.float32)
    return Texture.of(colors, soft)


def stones(rng: np.random.Generator) -> Texture:
    """The face of a low wall, 3 m by 1 m."""
    shape = (96, 288)
    base = np.array(_WALLS[rng.integers(len(_WALLS))], np.float32) * np.float32(0.8)
    colors = base * (1.0 + 0.05 * noise(rng, shape, 0.5))[..., None]
    for row, y in enumerate(range(0, shape[0], 16)):
        colors[y : y + 2] *= 0.72
        for x in range(18 * (row % 2), shape[1], 36):
            colors[y : y + 16, x : x + 36] *= rng.uniform(0.88, 1.08)
            colors[y : y + 16, x : x + 2] *= 0.75
    colors[:10] = base * 1.12
    return Texture.of(colors.astype(np.float32))


def tiles(rng: np.random.Generator, width_m: float) -> Texture:
    """A roof slope seen from the front."""
    shape = (96, int(24 * width_m))
    base = np.array(_ROOFS[rng.integers(len(_ROOFS))], np.float32)
    rows = np.linspace(0.0, 14.0, shape[0])[:, None] % 1.0
    pattern = 1.0 + 0.07 * noise(rng, shape, 0.4) + 0.06 * noise(rng, shape, 1.2)
    colors = base * (pattern * np.where(rows < 0.15, 0.8, 1.0))[..., None]
    return Texture.of(colors.astype(np.float32))


def wall(
    rng: np.random.Generator, width_m: float, height_m: float, base: Color, door: bool
) -> Texture:
    """A house's wall with windows in each storey."""
    scale = 30.0
    shape = (int(height_m * scale), int(width_m * scale))
    grain = 1.0 + 0.022 * noise(rng, shape, 0.3) + 0.03 * noise(rng, shape, 1.3)
    colors = (np.array(base, np.float32) * grain[..., None]).astype(np.float32)
    colors[-int(0.5 * scale) :] *= 0.72  # plinth
    colors[: int(0.25 * scale)] *= np.linspace(0.6, 1.0, int(0.25 * scale))[:, None, None]
    columns = max(1, round(width_m / 2.9))
    floors = max(1, round((height_m - 0.5) / 2.85))
    entrance = int(rng.integers(columns)) if door else -1
    shutters = lit(_ROOFS[rng.integers(len(_ROOFS))], 0.9) if rng.random() < 0.5 else None
    for floor in range(floors):
        for column in range(columns):
            x = (column + 0.5) * width_m / columns
            y = height_m - 0.5 - 2.85 * floor
            if floor == 0 and column == entrance:
                _door(colors, x * scale, y * scale, scale, rng)
            else:
                _window(colors, x * scale, (y - 1.55) * scale, scale, shutters, rng)
    return Texture.of(colors)


def wall_color(rng: np.random.Generator) -> Color:
    """Of one house."""
    return _WALLS[rng.integers(len(_WALLS))]


def _window(
    colors: FloatPicture,
    x: float,
    y: float,
    scale: float,
    shutters: Color | None,
    rng: np.random.Generator,
) -> None:
    """A window with frame, sash bars, sill and the sky in its panes."""
    w, h = 0.58 * scale, 0.68 * scale
    if shutters is not None:
        _box(colors, x - 1.75 * w, y - h, x + 1.75 * w, y + h, shutters)
    _box(colors, x - 1.15 * w, y - 1.12 * h, x + 1.15 * w, y + 1.1 * h, (236, 234, 228))
    glass = mixed((50, 60, 70), (120, 140, 156), float(rng.random()) * 0.6)
    _box(colors, x - w, y - h, x + w, y, mixed(glass, (160, 182, 200), 0.3))
    _box(colors, x - w, y, x + w, y + h, glass)
    _box(colors, x - 0.06 * w, y - h, x + 0.06 * w, y + h, (228, 226, 220))
    _box(colors, x - w, y - 0.36 * h, x + w, y - 0.28 * h, (228, 226, 220))
    _box(colors, x - 1.3 * w, y + 1.1 * h, x + 1.3 * w, y + 1.24 * h, (150, 146, 138))


def _door(colors: FloatPicture, x: float, y: float, scale: float, rng: np.random.Generator) -> None:
    choices: tuple[Color, ...] = ((96, 62, 42), (54, 74, 66), (60, 66, 86))
    color = choices[rng.integers(3)]
    foot = y + 0.1 * scale
    _box(colors, x - 0.62 * scale, y - 2.2 * scale, x + 0.62 * scale, foot, (224, 220, 212))
    _box(colors, x - 0.5 * scale, y - 2.08 * scale, x + 0.5 * scale, foot, color)
    _box(colors, x - 0.3 * scale, y - 1.9 * scale, x + 0.3 * scale, y - 1.2 * scale, (96, 108, 116))


def _box(
    colors: FloatPicture, left: float, top: float, right: float, bottom: float, color: Color
) -> None:
    cv2.rectangle(
        colors, (round(left), round(top)), (round(right), round(bottom)), color, cv2.FILLED
    )
