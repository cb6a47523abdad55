"""Sequences with known poses, odometry and blackouts, and the methods that localize them.

A sequence consists of problems that share a road and its map, so the map's errors stay constant
from frame to frame. Frames with few elements or none are part of it. A blackout is a time
without detections. The tracker is compared with the method ``search`` on each frame by itself.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from time import perf_counter
from typing import Protocol

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Odometry, OdometryNoise, Prior
from semviz_core.base.localization import Status
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.localization.localizer import Localizer
from semviz_core.research.evaluation.methods import MethodResult
from semviz_core.research.evaluation.problems import DETECTOR, LocalizationProblem
from semviz_core.tracking.tracker import CROP_M, Tracker

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
class SequenceFrame:
    """The input of a tracker, and the true pose."""

    observed: Elements2D
    odometry: Odometry | None
    prior: Prior
    T_camera_map: Pose


@dataclass(frozen=True, eq=False)
class SequenceProblem:
    """Frames ``INTERVAL_S`` apart, and the map of their road."""

    camera: Camera
    semantic_map: SemanticMap
    frames: tuple[SequenceFrame, ...]


def make_sequence(
    problems: Sequence[LocalizationProblem],
    seed: int,
    noise: OdometryNoise | None = None,
    blackout: Blackout | None = None,
) -> SequenceProblem:
    """Return a sequence of ``problems``, consecutive frames of one road and map (``driving``).

    ``seed`` draws the odometry's errors.
    """
    if not problems:
        raise SemvizError("a drive needs at least one frame")
    steps = _odometry(problems, noise or OdometryNoise(), np.random.default_rng(seed))
    frames = tuple(
        SequenceFrame(problem.observed, odometry, problem.prior, problem.T_camera_map)
        for problem, odometry in zip(problems, steps, strict=True)
    )
    if blackout is not None:
        frames = tuple(
            _blinded(frame, blackout) if blackout.covers(row * INTERVAL_S) else frame
            for row, frame in enumerate(frames)
        )
    return SequenceProblem(problems[0].camera, _whole_map(problems), frames)


def _blinded(frame: SequenceFrame, blackout: Blackout) -> SequenceFrame:
    no_elements = frame.observed[np.zeros(len(frame.observed), dtype=bool)]
    odometry = frame.odometry if blackout.with_odometry else None
    return replace(frame, observed=no_elements, odometry=odometry)


def _odometry(
    problems: Sequence[LocalizationProblem], noise: OdometryNoise, rng: np.random.Generator
) -> list[Odometry | None]:
    poses = [problem.T_camera_map for problem in problems]
    steps = [now @ before.inverse() for before, now in pairwise(poses)]
    return [None, *(noise.measure(step, rng) for step in steps)]


def _whole_map(problems: Sequence[LocalizationProblem]) -> SemanticMap:
    """Return the map of which the problems hold submaps."""
    parts = [problem.submap for problem in problems]
    _, first = np.unique(np.concatenate([part.id for part in parts]), return_index=True)
    names = [field.name for field in fields(Elements3D)]
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])[first] for name in names
    }
    return SemanticMap(Elements3D(**columns), MapFrame("drive"))


class SequenceMethod(Protocol):
    """A method that localizes the frames of a sequence in order."""

    @property
    def name(self) -> str: ...

    def solve(self, sequence: SequenceProblem) -> Iterator[MethodResult]:
        """Yield the result of each frame before reading the next; never use ``T_camera_map``."""
        ...


@dataclass(frozen=True)
class Tracking:
    """``Tracker`` with odometry; a frame is ``ok`` or ``cannot``: starting, or lost."""

    name: str = "tracking"

    def solve(self, sequence: SequenceProblem) -> Iterator[MethodResult]:
        tracker = Tracker(sequence.camera, sequence.semantic_map, DETECTOR)
        for frame in sequence.frames:
            start = perf_counter()
            track = tracker.step(frame.observed, frame.odometry, frame.prior)
            time_ms = {"step": (perf_counter() - start) * 1e3}
            status: Status = "cannot" if track.T_camera_map is None else "ok"
            yield MethodResult(track.T_camera_map, track.covariance, status, track.reason, time_ms)


@dataclass(frozen=True)
class FrameByFrame:
    """``search`` on each frame by itself, the baseline of tracking."""

    name: str = "search"

    def solve(self, sequence: SequenceProblem) -> Iterator[MethodResult]:
        localizer = Localizer(detector=DETECTOR)
        for frame in sequence.frames:
            submap = sequence.semantic_map.crop(frame.prior.position_m, CROP_M)
            yield MethodResult.of(
                localizer.localize(frame.observed, submap, sequence.camera, frame.prior)
            )


SEQUENCE_METHODS: dict[str, Callable[[], SequenceMethod]] = {
    "tracking": Tracking,
    "search": FrameByFrame,
}
