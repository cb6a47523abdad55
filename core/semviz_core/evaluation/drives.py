"""Drives with known answers: a stretch of a road, frame after frame, with odometry and blackouts.

Made of problems that share a world and its map, so that the map's errors stay the same from frame
to frame. Frames with few elements, or none, are part of a drive.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.camera import Camera
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.errors import SemvizError
from semviz_core.evaluation.metrics import pose_error
from semviz_core.evaluation.problems import Problem
from semviz_core.frame import Prior
from semviz_core.pose import Pose
from semviz_core.semantic_map import MapFrame, SemanticMap
from semviz_core.sequence.odometry import Odometry, OdometryNoise
from semviz_core.sequence.tracker import Track

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


@dataclass(frozen=True)
class DriveSummary:
    """A drive in numbers. Times from its start; errors over the frames with status ``ok``."""

    frames: int
    few_elements: float
    """Share of frames with fewer than four."""
    commit_s: float | None
    """When the first pose was answered; None: never."""
    rte_mean_m: float | None
    rte_max_m: float | None
    rre_mean_deg: float | None
    below_1m: float | None
    """Share of the frames answered."""
    answered: float
    """Share of the frames from the first answer on."""
    lost_s: tuple[float, ...]
    """When it was declared lost, and each time, in ``recovered_s``, when a pose was back."""
    recovered_s: tuple[float, ...]
    nees: float | None
    """Mean squared error over the stated covariance; 6 where that is honest."""

    def as_text(self) -> str:
        """One line for people."""
        if self.commit_s is None:
            return f"{self.frames} frames, no pose"
        text = (
            f"{self.frames} frames ({self.few_elements:.0%} with few elements), "
            f"pose after {self.commit_s:.1f} s, {self.answered:.1%} answered since; "
            f"RTE mean {self.rte_mean_m:.3f} m, max {self.rte_max_m:.2f} m, "
            f"{self.below_1m:.1%} below 1 m; RRE mean {self.rre_mean_deg:.2f} deg; "
            f"NEES {self.nees:.2f}"
        )
        if not self.lost_s:
            return text
        lost = ", ".join(f"{one:.1f}" for one in self.lost_s)
        back = ", ".join(f"{one:.1f}" for one in self.recovered_s) or "-"
        return f"{text}; lost at {lost} s, back at {back} s"


def summarize_drive(drive: Drive, tracks: tuple[Track, ...]) -> DriveSummary:
    """Errors, times and consistency of ``tracks``, one for each frame of ``drive``."""
    if len(tracks) != len(drive.frames):
        raise SemvizError(f"{len(tracks)} tracks but {len(drive.frames)} frames")
    errors = np.array(
        [_errors(track, one) for track, one in zip(tracks, drive.frames, strict=True)]
    )
    ok = np.isfinite(errors[:, 0])
    found = errors[ok]
    first = int(ok.argmax()) if ok.any() else len(ok)
    turned = np.flatnonzero(np.diff(ok.astype(int))) + 1
    turned = turned[turned > first]
    return DriveSummary(
        frames=len(tracks),
        few_elements=float(np.mean([len(one.observed) < 4 for one in drive.frames])),
        commit_s=first * INTERVAL_S if ok.any() else None,
        rte_mean_m=_mean(found[:, 0]),
        rte_max_m=float(found[:, 0].max()) if len(found) else None,
        rre_mean_deg=_mean(found[:, 1]),
        below_1m=_mean(found[:, 0] < 1.0),
        answered=float(ok[first:].mean()) if ok.any() else 0.0,
        lost_s=tuple(float(one) * INTERVAL_S for one in turned if not ok[one]),
        recovered_s=tuple(float(one) * INTERVAL_S for one in turned if ok[one]),
        nees=_mean(found[:, 2]),
    )


def _errors(track: Track, frame: DriveFrame) -> tuple[float, float, float]:
    """RTE (m), RRE (deg) and NEES; NaN without a pose."""
    if track.T_camera_map is None or track.covariance is None:
        return np.nan, np.nan, np.nan
    error = (frame.T_camera_map @ track.T_camera_map.inverse()).log()
    nees = float(error @ np.linalg.solve(track.covariance, error))
    return (*pose_error(track.T_camera_map, frame.T_camera_map), nees)


def _mean(values: FloatArray | BoolArray) -> float | None:
    return float(np.mean(values)) if len(values) else None


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
