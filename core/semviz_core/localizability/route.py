"""The way a camera takes: poses along a track, and places beside it where something could stand."""

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.classes import ClassSet
from semviz_core.elements import Elements3D
from semviz_core.pose import Pose
from semviz_core.sources.street.trajectory import CAMERA_HEIGHT_M

AXES: FloatArray = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns are the axes of a level camera that looks along x, z up."""
UP: FloatArray = np.array([0.0, 0.0, 1.0])
GAP_M = 20.0
"""Places further apart than this belong to different drives."""
SPACING_M, BESIDE_M = 10.0, 5.0
"""Between candidates along the route, and how far beside it they stand, on either side."""
CLEAR_M = 3.0
"""Candidates stand no nearer than this to the route, and to what stands there already."""
POLE_M, SIGN_M, SIGMA_M = 4.0, 2.3, 0.05
"""Height of a candidate pole, of a candidate sign's middle; sigma of either's place in the map."""


def poses_along(track_m: FloatArray) -> tuple[Pose, ...]:
    """T_map_camera at each of ``track_m`` (k, 3): looking along it, without roll.

    A gap of more than GAP_M begins a new drive; a drive of one place looks nowhere and is left out.
    """
    gaps = np.linalg.norm(np.diff(track_m, axis=0), axis=1) > GAP_M
    drives = np.split(track_m, np.flatnonzero(gaps) + 1)
    return tuple(pose for drive in drives if len(drive) > 1 for pose in _along(drive))


def thinned(centers_m: FloatArray, step_m: float) -> list[int]:
    """Rows of ``centers_m`` (k, 3), each at least ``step_m`` from the one before; the first one."""
    kept = [0] if len(centers_m) else []
    for row, center in enumerate(centers_m):
        if np.linalg.norm(center - centers_m[kept[-1]]) >= step_m:
            kept.append(row)
    return kept


def distance_along(centers_m: FloatArray) -> FloatArray:
    """(k,) metres driven up to each of ``centers_m`` (k, 3); gaps between drives don't count."""
    steps = np.linalg.norm(np.diff(centers_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.where(steps > GAP_M, 0.0, steps))])


def candidates_beside(
    poses: tuple[Pose, ...], standing: Elements3D, classes: ClassSet
) -> Elements3D:
    """Poles and signs that could be put up: every SPACING_M on both sides, where there is room.

    Of each kind the first class: all points tell a camera the same, and so do all lines.
    """
    foot = _free_places(poses, standing)
    kinds = {one.kind: one.id for one in reversed(tuple(classes))}
    nothing = np.full_like(foot, np.nan)
    anchor, end = {"line": foot + POLE_M * UP, "point": foot + SIGN_M * UP}, {"line": foot}
    ids = int(standing.id.max(initial=0)) + 1 + np.arange(len(kinds) * len(foot))
    return Elements3D.from_ends(
        ids,
        np.concatenate([anchor[kind] for kind in kinds]),
        np.concatenate([end.get(kind, nothing) for kind in kinds]),
        np.repeat(list(kinds.values()), len(foot)),
        SIGMA_M,
    )


def _free_places(poses: tuple[Pose, ...], standing: Elements3D) -> FloatArray:
    """(p, 3) on the ground beside the route, where nothing stands and nobody drives."""
    from scipy.spatial import cKDTree

    centers = np.array([pose.translation for pose in poses])
    rows = thinned(centers, SPACING_M)
    right = np.array([poses[row].rotation[:, 0] for row in rows]) * [1.0, 1.0, 0.0]
    middle = centers[rows] - CAMERA_HEIGHT_M * UP
    places = np.concatenate([middle + BESIDE_M * right, middle - BESIDE_M * right])
    taken = np.concatenate([centers[:, :2], standing.anchor_m[:, :2]])
    return np.asarray(places[cKDTree(taken).query(places[:, :2])[0] >= CLEAR_M])


def _along(track_m: FloatArray) -> list[Pose]:
    ahead = np.gradient(track_m, axis=0)
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    slope = np.arctan2(ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1]))
    poses = []
    for center, turn, rise in zip(track_m, heading, slope, strict=True):
        level = Pose.from_rotvec([0.0, 0.0, turn], center)
        uphill = Pose.from_rotvec([0.0, -rise, 0.0], np.zeros(3))
        poses.append(level @ uphill @ Pose(AXES, np.zeros(3)))
    return poses
