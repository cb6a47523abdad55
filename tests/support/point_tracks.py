"""Point tracks of a simulated drive past random points, without images."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.common.arrays import FloatArray
from semviz_core.pose_checks.tracks import PointTracks

Rng = np.random.Generator
K = np.array([[718.856, 0.0, 607.2], [0.0, 718.856, 185.2], [0.0, 0.0, 1.0]])
BASELINE_M = 0.54


def stereo_rig() -> Rig:
    camera = Camera(1241, 376, K)
    return Rig(camera, camera, Pose(np.eye(3), np.array([-BASELINE_M, 0.0, 0.0])))


def mono_rig() -> Rig:
    return Rig(Camera(1241, 376, K))


def driven(count: int, rng: Rng, driven_m: FloatArray | None = None) -> tuple[Frame, ...]:
    """Return frames of a winding, hilly drive, every 0.1 s; 1 m apart, or at ``driven_m`` (n,)."""
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    s = np.arange(count, dtype=np.float64)
    yaw = 0.12 * np.sin(0.35 * s + phase[0])
    pitch = 0.02 * np.sin(0.3 * s + phase[1])
    steps = np.column_stack([np.cos(yaw), np.sin(yaw), 0.05 * np.sin(0.15 * s + phase[2])])
    centers = np.cumsum(steps, axis=0) + np.array([10.0, -5.0, 2.0])
    if driven_m is not None:
        yaw, pitch = (np.interp(driven_m, s, angle) for angle in (yaw, pitch))
        centers = np.column_stack([np.interp(driven_m, s, axis) for axis in centers.T])
    poses = [
        Pose(so3_exp(np.array([0.0, 0.0, a])) @ ahead @ so3_exp(np.array([b, 0.0, 0.0])), c)
        for a, b, c in zip(yaw, pitch, centers, strict=True)
    ]
    return tuple(Frame(row, 0.1 * row, pose) for row, pose in enumerate(poses))


def tracks_between(
    before: Pose,
    now: Pose,
    rig: Rig,
    rng: Rng,
    *,
    count: int = 160,
    sigma_px: float = 0.15,
    moving: float = 0.0,
) -> PointTracks:
    """Return tracks of points in both frames' view; a share ``moving`` moves like one vehicle."""
    pixels = rng.uniform([0.0, 0.0], [1241.0, 376.0], (count, 2))
    depth = 1.0 / rng.uniform(1.0 / 60.0, 1.0 / 5.0, count)
    rays = np.column_stack([rig.left.normalize(pixels), np.ones(count)])
    points = before.apply(rays * depth[:, None])
    later = points.copy()
    vehicle = slice(0, int(moving * count))
    later[vehicle] += before.rotation @ np.array([0.4, 0.0, 0.9])
    views = [_seen(rig, before, points, "left"), _seen(rig, before, points, "right")]
    views += [_seen(rig, now, later, "left"), _seen(rig, now, later, "right")]
    noisy = [view + rng.normal(0.0, sigma_px, view.shape) for view in views]
    kept = np.isfinite(noisy[2][:, 0])
    return PointTracks(*(view[kept] for view in noisy))


def _seen(rig: Rig, pose: Pose, points_m: FloatArray, side: str) -> FloatArray:
    local = pose.inverse().apply(points_m)
    camera = rig.left
    if side == "right":
        if rig.right is None or rig.T_right_left is None:
            return np.full((len(points_m), 2), np.nan)
        local, camera = rig.T_right_left.apply(local), rig.right
    pixels = camera.project(local)
    return np.where(camera.contains(pixels)[:, None], pixels, np.nan)


def tracks_of_drive(
    frames: Sequence[Frame], rig: Rig, rng: Rng, *, moving: float = 0.1
) -> list[PointTracks]:
    """Return the tracks from each frame to the next."""
    poses = [frame.T_map_camera for frame in frames]
    return [
        tracks_between(before, now, rig, rng, moving=moving)
        for before, now in pairwise(poses)
        if before is not None and now is not None
    ]


def without_pose(frames: Sequence[Frame], rows: range) -> tuple[Frame, ...]:
    return tuple(
        replace(frame, T_map_camera=None) if row in rows else frame
        for row, frame in enumerate(frames)
    )
