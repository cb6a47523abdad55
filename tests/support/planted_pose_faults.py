"""Faults of poses, planted into healthy drives; for tests and ``bench/pose_faults.py``."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.common.arrays import FloatArray
from semviz_core.pose_checks.faults import FaultKind
from semviz_core.pose_checks.tracks import PointTracks

Frames: TypeAlias = tuple[Frame, ...]
Rng: TypeAlias = np.random.Generator


@dataclass(frozen=True)
class PlantedFault:
    """Frames with a fault, and where it is: None for the whole drive."""

    frames: Frames
    first: int | None = None
    last: int | None = None


def moved(frames: Sequence[Frame], move: Callable[[int, Pose], Pose]) -> Frames:
    """Return frames with the poses ``move(row, T_map_camera)``."""
    return tuple(
        frame
        if frame.T_map_camera is None
        else replace(frame, T_map_camera=move(row, frame.T_map_camera))
        for row, frame in enumerate(frames)
    )


def noisy(frames: Sequence[Frame], sigma_m: float, sigma_deg: float, rng: Rng) -> Frames:
    """Return frames with independent pose errors."""
    sigma = np.repeat([sigma_m, np.deg2rad(sigma_deg)], 3)
    return moved(frames, lambda row, pose: pose @ Pose.exp(rng.normal(0.0, sigma)))


def _place(count: int, length: int, rng: Rng) -> int:
    """Return the first row of a fault, with healthy frames on both sides."""
    return int(rng.integers(4, max(count - length - 4, 5)))


def _turned(yaw_deg: float) -> Pose:
    return Pose(so3_exp(np.array([0.0, np.deg2rad(yaw_deg), 0.0])), np.zeros(3))


def _local(
    frames: Frames, length: int, rng: Rng, move: Callable[[int, Pose], Pose]
) -> PlantedFault:
    """Return ``move(step, pose)`` of ``length`` frames, step 0 first."""
    first = _place(len(frames), length, rng)
    rows = range(first, first + length)
    planted = moved(frames, lambda row, pose: move(row - first, pose) if row in rows else pose)
    return PlantedFault(planted, frames[rows[0]].index, frames[rows[-1]].index)


def yaw_drift(frames: Frames, rng: Rng) -> PlantedFault:
    """0.1 deg a frame over 8 frames, then right again."""
    side = float(rng.choice([-1.0, 1.0]))
    return _local(frames, 8, rng, lambda step, pose: pose @ _turned(side * 0.1 * (step + 1)))


def jump(frames: Frames, rng: Rng) -> PlantedFault:
    """6 frames turned by 0.7 deg about any axis."""
    turn = rng.normal(size=3)
    turn *= np.deg2rad(0.7) / np.linalg.norm(turn)
    return _local(frames, 6, rng, lambda step, pose: pose @ Pose(so3_exp(turn), np.zeros(3)))


def turned_start(frames: Frames, rng: Rng) -> PlantedFault:
    """The first 12 frames turned, by 0.7 deg at first and ever less."""
    side = float(rng.choice([-1.0, 1.0]))
    planted = moved(
        frames,
        lambda row, pose: pose @ _turned(side * 0.7 * (12 - row) / 12) if row < 12 else pose,
    )
    return PlantedFault(planted, frames[0].index, frames[11].index)


def shift(frames: Frames, rng: Rng) -> PlantedFault:
    """6 frames shifted by 0.3 m, in any direction."""
    offset = rng.normal(size=3)
    offset *= 0.3 / np.linalg.norm(offset)
    return _local(frames, 6, rng, lambda step, pose: Pose(pose.rotation, pose.translation + offset))


def frozen(frames: Frames, rng: Rng) -> PlantedFault:
    """5 frames with the pose of the frame before."""
    first = _place(len(frames), 5, rng)
    still = frames[first - 1].T_map_camera
    assert still is not None
    rows = range(first, first + 5)
    planted = moved(frames, lambda row, pose: still if row in rows else pose)
    return PlantedFault(planted, frames[rows[0]].index, frames[rows[-1]].index)


def one_frame_late(frames: Frames, rng: Rng) -> PlantedFault:
    """Each frame has the pose of the frame before."""
    poses = [frame.T_map_camera for frame in frames]
    rows = [max(row - 1, 0) for row in range(len(frames))]
    return PlantedFault(
        tuple(
            replace(frame, T_map_camera=poses[row]) for frame, row in zip(frames, rows, strict=True)
        )
    )


def flat(frames: Frames, rng: Rng) -> PlantedFault:
    """All z are 0."""
    return PlantedFault(
        moved(frames, lambda row, pose: Pose(pose.rotation, pose.translation * [1.0, 1.0, 0.0]))
    )


def exchanged_axes(frames: Frames, rng: Rng) -> PlantedFault:
    """x and y of the positions exchanged."""
    return PlantedFault(
        moved(frames, lambda row, pose: Pose(pose.rotation, pose.translation[[1, 0, 2]]))
    )


def with_baseline(rig: Rig, ratio: float) -> Rig:
    """Return the rig with a wrong baseline."""
    assert rig.T_right_left is not None
    wrong = Pose(rig.T_right_left.rotation, rig.T_right_left.translation * ratio)
    return replace(rig, T_right_left=wrong)


def with_right_image_moved(tracks: PointTracks, offset_px: FloatArray) -> PointTracks:
    """Return the tracks that a right image shifted by (2,) px gives."""
    return replace(
        tracks,
        before_right_px=tracks.before_right_px + offset_px,
        now_right_px=tracks.now_right_px + offset_px,
    )


POSE_FAULTS: dict[str, tuple[Callable[[Frames, Rng], PlantedFault], tuple[FaultKind, ...]]] = {
    "yaw drift, 0.1 deg a frame": (yaw_drift, ("turned",)),
    "first 12 frames turned, 0.7 deg": (turned_start, ("turned",)),
    "jump, 0.7 deg": (jump, ("turned",)),
    "shift, 0.3 m": (shift, ("shifted",)),
    "frozen for five frames": (frozen, ("frozen",)),
    "one frame late": (one_frame_late, ("time",)),
    "z set to 0": (flat, ("heights",)),
    "x and y exchanged": (exchanged_axes, ("axes",)),
}
"""How to plant each fault of poses, and the kinds by which it is rightly named."""
