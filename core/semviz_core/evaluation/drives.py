"""Drives with known answers: a stretch of a road, frame after frame, with odometry and blackouts.

Made of problems that share a world and its map, so that the map's errors stay the same from frame
to frame. Frames with few elements, or none, are part of a drive.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from semviz_core.camera import Camera
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.errors import SemvizError
from semviz_core.evaluation.problems import Problem
from semviz_core.frame import Prior
from semviz_core.pose import Pose
from semviz_core.semantic_map import MapFrame, SemanticMap
from semviz_core.sequence.odometry import Odometry, OdometryNoise

INTERVAL_S = 0.1
"""KITTI's rate; a simulated road has a pose each metre, so it is driven at 10 m/s."""


@dataclass(frozen=True)
class Blackout:
    """A time without detections."""

    start_s: float
    length_s: float = 3.0
    with_odometry: bool = True

    def covers(self, time_s: float) -> bool:
        return self.start_s <= time_s < self.start_s + self.length_s


@dataclass(frozen=True, eq=False)
class DriveFrame:
    """What a tracker is given, and the answer."""

    observed: Elements2D
    odometry: Odometry | None
    prior: Prior
    T_camera_map: Pose


@dataclass(frozen=True, eq=False)
class Drive:
    """Frames ``INTERVAL_S`` apart, and the map of their road."""

    camera: Camera
    semantic_map: SemanticMap
    frames: tuple[DriveFrame, ...]


def make_drive(
    problems: Sequence[Problem],
    seed: int,
    noise: OdometryNoise | None = None,
    blackout: Blackout | None = None,
) -> Drive:
    """A drive through ``problems``, consecutive frames of one road, world and map (``driving``).

    ``seed`` draws the odometry's errors.
    """
    if not problems:
        raise SemvizError("a drive needs at least one frame")
    steps = _odometry(problems, noise or OdometryNoise(), np.random.default_rng(seed))
    frames = tuple(
        DriveFrame(one.observed, odometry, one.prior, one.T_camera_map)
        for one, odometry in zip(problems, steps, strict=True)
    )
    if blackout is not None:
        frames = tuple(
            _blinded(one, blackout) if blackout.covers(row * INTERVAL_S) else one
            for row, one in enumerate(frames)
        )
    return Drive(problems[0].camera, _whole_map(problems), frames)


def _blinded(frame: DriveFrame, blackout: Blackout) -> DriveFrame:
    none = frame.observed[np.zeros(len(frame.observed), dtype=bool)]
    odometry = frame.odometry if blackout.with_odometry else None
    return replace(frame, observed=none, odometry=odometry)


def _odometry(
    problems: Sequence[Problem], noise: OdometryNoise, rng: np.random.Generator
) -> list[Odometry | None]:
    poses = [one.T_camera_map for one in problems]
    steps = [now @ before.inverse() for before, now in pairwise(poses)]
    return [None, *(noise.measure(one, rng) for one in steps)]


def _whole_map(problems: Sequence[Problem]) -> SemanticMap:
    """The map of which the problems hold parts."""
    parts = [one.submap for one in problems]
    _, first = np.unique(np.concatenate([one.id for one in parts]), return_index=True)
    names = [one.name for one in fields(Elements3D)]
    columns = {name: np.concatenate([getattr(one, name) for one in parts])[first] for name in names}
    return SemanticMap(Elements3D(**columns), MapFrame("drive"))
