"""Paint the background, which hides no element: houses, hedges, trees, sky; and make textures.

Noise is tileable, with mean 0 and standard deviation 1.
"""

from functools import cache

import cv2
import numpy as np

from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.simulation.drawing import PinholeView, Texture, fill, lit, mixed, stamp
from semviz_core.simulation.furniture import air_at, paint_rod
from semviz_core.simulation.layout import Layout
from semviz_core.simulation.objects import UP, Color, FloatPicture, Hedge, House, Tree

SKY_ELEVATION_RAD = (-0.06, 0.36)
"""Elevation of the panorama's bottom and top."""

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
    """Return tileable noise of mean 0 and standard deviation 1.

    Its spectrum falls as 1/f^falloff from ``lowest`` cycles per width on; ``stretch`` elongates it
    along the rows.
    """
    fy = np.fft.fftfreq(shape[0])[:, None] * shape[1] / stretch
    fx = np.fft.rfftfreq(shape[1])[None, :] * shape[1]
    frequency = np.maximum(np.hypot(fx, fy), lowest)
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal(shape)) / frequency**falloff
    field = np.fft.irfft2(spectrum, shape)
    return np.asarray(field / field.std(), dtype=np.float32)


def sky(rng: np.random.Generator, haze: Color) -> ByteImage:
    """Return a panorama (height, width, 3) of sky, clouds and far woods.

    Row 0 is the top; columns are headings from 0 to 2 pi.
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
    """Add hills and tree lines at the horizon, nearer ones darker."""
    width = colors.shape[1]
    step = float(elevation[0, 0] - elevation[1, 0])
    for share, height, rough, falloff in ((0.66, 0.030, 0.012, 1.5), (0.46, 0.012, 0.006, 0.8)):
        crest = height + rough * noise(rng, (1, width), falloff, lowest=10.0)
        cover = np.clip((crest - elevation) / step + 0.5, 0.0, 1.0)[..., None]
        leaves = 1.0 + 0.05 * noise(rng, (elevation.shape[0], width), 0.5)[..., None]
        color = np.array(mixed((76, 98, 62), haze, share), np.float32)
        colors += cover * (color * leaves - colors)


def crowns(rng: np.random.Generator, sun_left: bool) -> list[list[Texture]]:
    """Return a few crowns for each kind of tree."""
    return [[_crown(rng, np.array(base), sun_left) for _ in range(2)] for base in _LEAVES]


def _crown(rng: np.random.Generator, base: FloatArray, sun_left: bool) -> Texture:
    """Return a tree's crown: leaves in clumps, lit from above and from the sun's side."""
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
    """Draw dabs of colour within a disc: first the shadow side, then lighter ones."""
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
    """Return (count, 2) points spread evenly over the unit disc."""
    angle, radius = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.uniform(0, 1, count))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def leaves(rng: np.random.Generator) -> Texture:
    """Return the face of a hedge, 3 m by 1 m."""
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
    """Return the face of a low wall, 3 m by 1 m."""
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
    """Return a roof slope seen from the front."""
    shape = (96, int(24 * width_m))
    base = np.array(_ROOFS[rng.integers(len(_ROOFS))], np.float32)
    rows = np.linspace(0.0, 14.0, shape[0])[:, None] % 1.0
    pattern = 1.0 + 0.07 * noise(rng, shape, 0.4) + 0.06 * noise(rng, shape, 1.2)
    colors = base * (pattern * np.where(rows < 0.15, 0.8, 1.0))[..., None]
    return Texture.of(colors.astype(np.float32))


def wall(
    rng: np.random.Generator, width_m: float, height_m: float, base: Color, door: bool
) -> Texture:
    """Return a house's wall with windows in each storey."""
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
    """Return the colour of one house's walls."""
    return _WALLS[rng.integers(len(_WALLS))]


def _window(
    colors: FloatPicture,
    x: float,
    y: float,
    scale: float,
    shutters: Color | None,
    rng: np.random.Generator,
) -> None:
    """Draw a window with frame, sash bars, sill and the sky in its panes."""
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


_SIGHT_M = 150.0
_DETAIL_M = 50.0
_EAVES_M = 0.45
_CROWN = ((0.22, 1.0, 0.0), (0.0, 0.86, 0.03), (-0.2, 0.66, 0.1))
"""Layers of a crown: offset to the back (widths), size, offset upwards (heights)."""
_BARK: Color = (92, 76, 60)


class Scenery:
    """Houses, hedges and trees of one street."""

    def __init__(self, layout: Layout, rng: np.random.Generator, haze: Color) -> None:
        self._objects: list[House | Hedge | Tree] = [*layout.houses, *layout.hedges, *layout.trees]
        self._middles = np.array([_middle(item) for item in self._objects]).reshape(-1, 3)
        self._haze = haze
        self._sun = layout.sun
        sun_left = float(layout.road.left(0.0) @ layout.sun) > 0
        self._crowns = crowns(rng, sun_left)
        self._leaves = [leaves(rng) for _ in range(3)]
        self._stones = stones(rng)
        self._walls = cache(_house_textures)

    def paint(self, image: ByteImage, view: PinholeView) -> None:
        """Paint all in sight, far ones first."""
        distance = np.linalg.norm(self._middles - view.center_m, axis=1)
        rows = np.flatnonzero(distance < _SIGHT_M)
        for row in rows[np.argsort(-distance[rows], kind="stable")]:
            item = self._objects[row]
            if isinstance(item, House):
                self._paint_house(image, view, item)
            elif isinstance(item, Hedge):
                self._paint_hedge(image, view, item)
            else:
                self._paint_tree(image, view, item)

    def _paint_house(self, image: ByteImage, view: PinholeView, house: House) -> None:
        """Paint the visible walls, then the roof's front slope."""
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
                stamp(image, view, gable, corner + rise, depth, -rise, air)
                peak = corner + depth / 2 + rise + house.roof_m * UP
                polygon = view.polygon(np.array([corner + rise, peak, corner + depth + rise]))
                if polygon is not None:
                    fill(image, polygon, mixed(lit(color, air.gain), self._haze, air.haze))
        air = air_at(distance, self._haze, self._light(-house.depth_m))
        stamp(image, view, front, house.corner_m + rise, house.front_m, -rise, air)
        unit = house.depth_m / np.linalg.norm(house.depth_m)
        over = _EAVES_M * house.front_m / np.linalg.norm(house.front_m)
        ridge = house.corner_m + rise + house.depth_m / 2 + house.roof_m * UP - over
        eaves = house.corner_m + rise - _EAVES_M * unit - 0.25 * UP - over
        slope = np.cross(house.front_m, ridge - eaves)
        air = air_at(distance, self._haze, self._light(slope * np.sign(slope[2])))
        stamp(image, view, roof, ridge, house.front_m + 2 * over, eaves - ridge, air)

    def _paint_hedge(self, image: ByteImage, view: PinholeView, hedge: Hedge) -> None:
        """Paint the front, the near end and, for a wall, the top."""
        texture = self._stones
        if hedge.leafy:
            texture = self._leaves[int(hedge.height_m * 100) % len(self._leaves)]
        rise, along = hedge.height_m * UP, hedge.end_m - hedge.begin_m
        distance = view.distance(_middle(hedge))
        if distance < _DETAIL_M and along @ (hedge.begin_m - view.center_m) > 0:
            air = air_at(distance, self._haze, 0.85 * self._light(-along))
            stamp(image, view, texture, hedge.begin_m + rise, hedge.depth_m, -rise, air)
        top = [hedge.begin_m + rise, hedge.end_m + rise]
        polygon = view.polygon(np.array([*top, top[1] + hedge.depth_m, top[0] + hedge.depth_m]))
        air = air_at(distance, self._haze, self._light(-hedge.depth_m))
        if polygon is not None and not hedge.leafy:
            fill(image, polygon, mixed((188, 184, 176), self._haze, air.haze))
        stamp(image, view, texture, hedge.begin_m + rise, along, -rise, air)

    def _paint_tree(self, image: ByteImage, view: PinholeView, tree: Tree) -> None:
        """Paint a trunk, and up to three layers of a crown."""
        if view.depth(tree.root_m) < 1.0:
            return
        distance = view.distance(tree.root_m)
        air = air_at(distance, self._haze)
        width, height = tree.crown_m
        if tree.trunk_m:
            light = float(self._sun @ view.T_map_camera.rotation[:, 0])
            ends = np.array([tree.root_m, tree.root_m + (tree.trunk_m + 0.4 * height) * UP])
            bark = mixed(_BARK, self._haze, air.haze)
            paint_rod(image, view, ends, 0.035 * width + 0.03, bark, light)
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
            stamp(image, view, crown, corner, span * width * right, -span * height * UP, air)

    def _light(self, outward: FloatArray) -> float:
        """Return the light on a wall that faces a direction (3,)."""
        facing = float(outward @ self._sun) / float(np.linalg.norm(outward))
        return 0.68 + 0.42 * max(0.0, facing)


def _middle(item: House | Hedge | Tree) -> FloatArray:
    """Return the centre (3,) of an object's footprint."""
    if isinstance(item, House):
        return item.corner_m + 0.5 * (item.front_m + item.depth_m)
    return 0.5 * (item.begin_m + item.end_m) if isinstance(item, Hedge) else item.root_m


def _house_textures(house: House) -> tuple[Texture, Texture, Texture, Color]:
    """Return front, gable end, roof and the walls' colour."""
    rng = np.random.default_rng(house.style)
    color = wall_color(rng)
    width, depth = (float(np.linalg.norm(edge_m)) for edge_m in (house.front_m, house.depth_m))
    return (
        wall(rng, width, house.height_m, color, door=True),
        wall(rng, depth, house.height_m, color, door=False),
        tiles(rng, width),
        color,
    )
