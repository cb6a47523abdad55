"""Line work of the 3D scene: glyphs, frusta, circles, dashes; and the scene's colours.

Segments are (k, 2, 3) in metres. Ellipsoids show 1 sigma of covariances. Colours are adjusted
so that viser displays them as intended; their hexadecimal values are those of
``static/base.css``, and a test compares both.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from semviz.presentation import plots
from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements3D
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray

GLYPH_RADIUS_M = 0.45
CAP_HALF_WIDTH_M = 0.25

_CORNERS = {  # number of corners, angle of the first one from the right
    "triangle": (3, 90.0),
    "square": (4, 45.0),
    "circle": (20, 0.0),
    "diamond": (4, 0.0),
    "pentagon": (5, 90.0),
}


def pole_segments(poles: Elements3D) -> FloatArray:
    """Return each pole from its peak to its bottom, with a cap at the peak."""
    shafts = np.stack([poles.anchor_m, poles.end_m], axis=1)
    tips = [[[-1.0, 0, 0], [1.0, 0, 0]], [[0, -1.0, 0], [0, 1.0, 0]]]
    caps = poles.anchor_m[:, None, None, :] + CAP_HALF_WIDTH_M * np.array(tips)
    return np.concatenate([shafts, caps.reshape(-1, 2, 3)])


def sign_segments(signs: Elements3D, shape: str, facing_rad: FloatArray) -> FloatArray:
    """Return upright outlines of ``shape``, with normals at ``facing_rad`` (n,) about z from x."""
    count, first_deg = _CORNERS[shape]
    angles = np.deg2rad(first_deg) + 2 * np.pi * np.arange(count + 1) / count
    right = np.stack([-np.sin(facing_rad), np.cos(facing_rad), np.zeros(len(signs))], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    outline = np.cos(angles)[:, None] * right[:, None, :] + np.sin(angles)[:, None] * up
    corners = signs.anchor_m[:, None, :] + GLYPH_RADIUS_M * outline
    return np.stack([corners[:, :-1], corners[:, 1:]], axis=2).reshape(-1, 2, 3)


def element_segments(elements: Elements3D, classes: ClassSet, facing_rad: FloatArray) -> FloatArray:
    """Return the segments of poles, and of signs turned by ``facing_rad`` (n,)."""
    pieces = [np.zeros((0, 2, 3))]
    for class_ in classes:
        rows = np.flatnonzero(elements.class_id == class_.id)
        if len(rows) and class_.kind == "line":
            pieces.append(pole_segments(elements[rows]))
        elif len(rows):
            pieces.append(sign_segments(elements[rows], class_.shape, facing_rad[rows]))
    return np.concatenate(pieces)


def strokes(elements: Elements3D) -> FloatArray:
    """Return one segment for each element: a pole's shaft, or the height of a sign's glyph."""
    half = np.array([0.0, 0.0, GLYPH_RADIUS_M])
    line = elements.is_line[:, None]
    low = np.where(line, elements.end_m, elements.anchor_m - half)
    high = np.where(line, elements.anchor_m, elements.anchor_m + half)
    return np.stack([low, high], axis=1)


def ellipsoids(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return 1-sigma half axes (k, 3) and rotations (k, 4), wxyz, of covariances (k, 3, 3)."""
    from scipy.spatial.transform import Rotation

    variances, directions = np.linalg.eigh(covariances)
    directions[:, :, 2] *= np.sign(np.linalg.det(directions))[:, None]  # right-handed
    xyzw = Rotation.from_matrix(directions).as_quat() if len(directions) else np.zeros((0, 4))
    return np.sqrt(np.maximum(variances, 0.0)), np.roll(xyzw, 1, axis=1)


def facing(positions_m: FloatArray, trajectory_m: FloatArray) -> FloatArray:
    """Return the direction (n,), rad, of the road at each position: signs face the traffic."""
    if len(trajectory_m) < 2:
        return np.zeros(len(positions_m))
    from scipy.spatial import cKDTree

    steps = np.gradient(trajectory_m[:, :2], axis=0)
    nearest = cKDTree(trajectory_m[:, :2]).query(positions_m[:, :2])[1]
    heading: FloatArray = np.arctan2(steps[nearest, 1], steps[nearest, 0])
    return heading


def frustum_corners(T_map_camera: Pose, camera: Camera, depth_m: float) -> FloatArray:
    """Return the corners (4, 3) of the image at ``depth_m``, clockwise from the top left."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    pixels = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])
    rays = np.concatenate([camera.normalize(pixels), np.ones((4, 1))], axis=1)
    return T_map_camera.apply(depth_m * rays)


def frustum_segments(camera: Camera, depth_m: float) -> FloatArray:
    """Return four rays from the camera centre and the image border, in camera coordinates."""
    corners = frustum_corners(Pose.identity(), camera, depth_m)
    rays = np.stack([np.zeros_like(corners), corners], axis=1)
    border = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    return np.concatenate([rays, border])


def ring_segments(low_m: FloatArray, high_m: FloatArray) -> FloatArray:
    """Return rings at the ends (n, 3) and the middle of poles; three crossed rings for a sign."""
    rings = []
    for low, high in zip(low_m, high_m, strict=True):
        if np.array_equal(low, high):
            level = circle_segments(np.zeros(3), 0.8, 40)
            rings += [low + level, low + level[:, :, [0, 2, 1]], low + level[:, :, [2, 0, 1]]]
        else:
            rings += [circle_segments(end, 0.8, 40) for end in (low, (low + high) / 2, high)]
            rings.append(np.stack([low, high])[None])
    return np.concatenate(rings) if rings else np.zeros((0, 2, 3))


def circle_segments(center_m: FloatArray, radius_m: float, count: int = 96) -> FloatArray:
    """Return a level circle of ``count`` segments."""
    angles = 2 * np.pi * np.arange(count + 1) / count
    level = np.stack([np.cos(angles), np.sin(angles), np.zeros(count + 1)], axis=1)
    points = np.asarray(center_m) + radius_m * level
    return np.stack([points[:-1], points[1:]], axis=1)


def dashed(segments: FloatArray, dash_m: float, gap_m: float) -> FloatArray:
    """Cut each segment into dashes."""
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    pieces = []
    for segment, length in zip(segments, lengths, strict=True):
        starts = np.arange(0.0, max(length, 1e-9), dash_m + gap_m)
        ends = np.minimum(starts + dash_m, length)
        share = np.stack([starts, ends], axis=1)[:, :, None] / max(length, 1e-9)
        pieces.append(segment[0] + share * (segment[1] - segment[0]))
    return np.concatenate(pieces) if pieces else segments


def grid_segments(half_m: float, step_m: float) -> FloatArray:
    """Return a level square grid around the origin, with a segment for each side of each square: a
    hairline with an end behind the eye is not drawn at all."""
    at = np.arange(-half_m, half_m + step_m / 2, step_m)
    across, low = (grid.ravel() for grid in np.meshgrid(at, at[:-1]))
    along_y = np.stack([np.stack([across, low], 1), np.stack([across, low + step_m], 1)], axis=1)
    flat = np.concatenate([along_y, along_y[:, :, ::-1]])
    return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=2)


def ribbon(points_m: FloatArray, width_m: float) -> tuple[FloatArray, IntArray]:
    """Return vertices (2k, 3) and faces (2k - 2, 3) of a level band along ``points_m`` (k, 3)."""
    along = np.gradient(points_m[:, :2], axis=0)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = along / np.maximum(length, 1e-9)
    sideways = np.stack([-along[:, 1], along[:, 0], np.zeros(len(along))], axis=1)
    left, right = points_m + width_m / 2 * sideways, points_m - width_m / 2 * sideways
    first = np.arange(len(points_m) - 1)[:, None]
    count = len(points_m)
    faces = np.concatenate(
        [
            np.concatenate([first, first + 1, first + count], axis=1),
            np.concatenate([first + 1, first + count + 1, first + count], axis=1),
        ]
    )
    return np.concatenate([left, right]), faces


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
    """From good to bad; the palette holds the limits, ``RESIDUAL_LIMITS_PX``."""


def _palette(theme: Theme, scene: str, road: str, grid: str, faint: str, accent: str) -> Palette:
    def pick(tone: plots.Tone) -> str:
        return tone.dark if theme == "dark" else tone.light

    return Palette(
        scene=scene,
        road=road,
        grid=grid,
        faint=faint,
        accent=accent,
        truth=pick(plots.TRUTH),
        estimate=pick(plots.ESTIMATE),
        prior=pick(plots.PRIOR),
        alternative=pick(plots.ALTERNATIVE),
        residual=tuple(pick(tone) for tone in plots.RESIDUAL),
    )


PALETTES: dict[Theme, Palette] = {
    "dark": _palette("dark", "#17181A", "#26282B", "#2A2C30", "#7D828A", "#4DABF7"),
    "light": _palette("light", "#F7F8F9", "#E7E9EC", "#E4E6E9", "#767D86", "#1971C2"),
}


def rgb(color: str) -> Rgb:
    """Return ``#RRGGBB`` as bytes, for images and the background: viser shows those exactly."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def mix(color: str, background: str, opacity: float) -> str:
    """Return ``color`` blended over ``background``: lines in viser have no opacity."""
    blend = opacity * np.array(rgb(color)) + (1.0 - opacity) * np.array(rgb(background))
    return "#" + "".join(f"{round(channel):02X}" for channel in blend)


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
    """Return the colour with which viser shows a line or mesh as ``color`` in white ambient light.

    It inverts the tone mapping, within one step of 255 in the curve's range. Brighter or more
    saturated colours (white gives 226) come as close as possible.
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
    """Return ``scene_rgb`` (3,) as linear light, for glTF models."""
    return _linear(np.array(scene_rgb(color)) / 255.0)


def _linear(encoded: FloatArray) -> FloatArray:
    low = encoded <= 0.04045
    return np.where(low, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _encoded(linear: FloatArray) -> FloatArray:
    low = linear <= 0.0031308
    return np.where(low, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
