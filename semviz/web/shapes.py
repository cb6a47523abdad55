"""Line work of the 3D scene: glyphs, frusta, circles, dashes; segments are (k, 2, 3), metres."""

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.classes import ClassSet
from semviz_core.elements import Elements3D
from semviz_core.pose import Pose

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
    """Each pole from its peak to its bottom, with a cap at the peak."""
    shafts = np.stack([poles.anchor_m, poles.end_m], axis=1)
    tips = [[[-1.0, 0, 0], [1.0, 0, 0]], [[0, -1.0, 0], [0, 1.0, 0]]]
    caps = poles.anchor_m[:, None, None, :] + CAP_HALF_WIDTH_M * np.array(tips)
    return np.concatenate([shafts, caps.reshape(-1, 2, 3)])


def sign_segments(signs: Elements3D, shape: str, facing_rad: FloatArray) -> FloatArray:
    """Upright outlines of ``shape``, their normals turned by ``facing_rad`` (n,) about z from x."""
    count, first_deg = _CORNERS[shape]
    angles = np.deg2rad(first_deg) + 2 * np.pi * np.arange(count + 1) / count
    right = np.stack([-np.sin(facing_rad), np.cos(facing_rad), np.zeros(len(signs))], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    outline = np.cos(angles)[:, None] * right[:, None, :] + np.sin(angles)[:, None] * up
    corners = signs.anchor_m[:, None, :] + GLYPH_RADIUS_M * outline
    return np.stack([corners[:, :-1], corners[:, 1:]], axis=2).reshape(-1, 2, 3)


def element_segments(elements: Elements3D, classes: ClassSet, facing_rad: FloatArray) -> FloatArray:
    """Each element as its class is drawn: poles, and signs turned by ``facing_rad`` (n,)."""
    pieces = [np.zeros((0, 2, 3))]
    for one in classes:
        rows = np.flatnonzero(elements.class_id == one.id)
        if len(rows) and one.kind == "line":
            pieces.append(pole_segments(elements[rows]))
        elif len(rows):
            pieces.append(sign_segments(elements[rows], one.shape, facing_rad[rows]))
    return np.concatenate(pieces)


def strokes(elements: Elements3D) -> FloatArray:
    """One segment for each element: a pole's shaft, and one as high as the glyph of a sign."""
    half = np.array([0.0, 0.0, GLYPH_RADIUS_M])
    line = elements.is_line[:, None]
    low = np.where(line, elements.end_m, elements.anchor_m - half)
    high = np.where(line, elements.anchor_m, elements.anchor_m + half)
    return np.stack([low, high], axis=1)


def ellipsoids(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Half axes (k, 3) of 1 sigma, and rotations (k, 4) as w, x, y, z, of covariances (k, 3, 3)."""
    from scipy.spatial.transform import Rotation

    variances, directions = np.linalg.eigh(covariances)
    directions[:, :, 2] *= np.sign(np.linalg.det(directions))[:, None]  # right-handed
    xyzw = Rotation.from_matrix(directions).as_quat() if len(directions) else np.zeros((0, 4))
    return np.sqrt(np.maximum(variances, 0.0)), np.roll(xyzw, 1, axis=1)


def facing(positions_m: FloatArray, trajectory_m: FloatArray) -> FloatArray:
    """(n,) direction (rad) of the road where it passes each position: signs face the traffic."""
    if len(trajectory_m) < 2:
        return np.zeros(len(positions_m))
    from scipy.spatial import cKDTree

    steps = np.gradient(trajectory_m[:, :2], axis=0)
    nearest = cKDTree(trajectory_m[:, :2]).query(positions_m[:, :2])[1]
    heading: FloatArray = np.arctan2(steps[nearest, 1], steps[nearest, 0])
    return heading


def frustum_corners(T_map_camera: Pose, camera: Camera, depth_m: float) -> FloatArray:
    """(4, 3) corners of the image at ``depth_m``, clockwise from the top left one."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    pixels = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])
    rays = np.concatenate([camera.normalize(pixels), np.ones((4, 1))], axis=1)
    return T_map_camera.apply(depth_m * rays)


def frustum_segments(camera: Camera, depth_m: float) -> FloatArray:
    """Four rays from the camera centre, and the image's border, in the camera's frame."""
    corners = frustum_corners(Pose.identity(), camera, depth_m)
    rays = np.stack([np.zeros_like(corners), corners], axis=1)
    border = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    return np.concatenate([rays, border])


def ring_segments(low_m: FloatArray, high_m: FloatArray) -> FloatArray:
    """Rings at both ends (n, 3) and the middle of each pole; three crossed rings for a sign."""
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
    """A level circle."""
    angles = 2 * np.pi * np.arange(count + 1) / count
    level = np.stack([np.cos(angles), np.sin(angles), np.zeros(count + 1)], axis=1)
    points = np.asarray(center_m) + radius_m * level
    return np.stack([points[:-1], points[1:]], axis=1)


def dashed(segments: FloatArray, dash_m: float, gap_m: float) -> FloatArray:
    """Cuts each segment into dashes."""
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    pieces = []
    for segment, length in zip(segments, lengths, strict=True):
        starts = np.arange(0.0, max(length, 1e-9), dash_m + gap_m)
        ends = np.minimum(starts + dash_m, length)
        share = np.stack([starts, ends], axis=1)[:, :, None] / max(length, 1e-9)
        pieces.append(segment[0] + share * (segment[1] - segment[0]))
    return np.concatenate(pieces) if pieces else segments


def grid_segments(half_m: float, step_m: float) -> FloatArray:
    """A level square grid around the origin, each side of each square by itself: a hairline with an
    end behind the eye is not drawn at all."""
    at = np.arange(-half_m, half_m + step_m / 2, step_m)
    across, low = (one.ravel() for one in np.meshgrid(at, at[:-1]))
    along_y = np.stack([np.stack([across, low], 1), np.stack([across, low + step_m], 1)], axis=1)
    flat = np.concatenate([along_y, along_y[:, :, ::-1]])
    return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=2)


def ribbon(points_m: FloatArray, width_m: float) -> tuple[FloatArray, IntArray]:
    """Vertices (2k, 3) and faces (2k - 2, 3) of a level band along ``points_m`` (k, 3)."""
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
