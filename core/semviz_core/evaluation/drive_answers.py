"""Methods under test that localize a drive, frame after frame."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

from semviz_core.evaluation.answers import Answer
from semviz_core.evaluation.drives import Drive
from semviz_core.evaluation.problems import DETECTOR
from semviz_core.localization import Status
from semviz_core.localize import Localizer
from semviz_core.sequence.tracker import CROP_M, Tracker


class DriveMethod(Protocol):
    """Localizes the frames of a drive in their order."""

    @property
    def name(self) -> str: ...

    def answers(self, drive: Drive) -> Iterator[Answer]:
        """One for each frame, before it looks at the next; never from ``T_camera_map``."""
        ...


@dataclass(frozen=True)
class Tracking:
    """``Tracker`` with odometry; a frame is ``ok`` or ``cannot``: starting, or lost."""

    name: str = "tracking"

    def answers(self, drive: Drive) -> Iterator[Answer]:
        tracker = Tracker(drive.camera, drive.semantic_map, DETECTOR)
        for one in drive.frames:
            start = perf_counter()
            track = tracker.step(one.observed, one.odometry, one.prior)
            time_ms = {"step": (perf_counter() - start) * 1e3}
            status: Status = "cannot" if track.T_camera_map is None else "ok"
            yield Answer(track.T_camera_map, track.covariance, status, track.reason, time_ms)


@dataclass(frozen=True)
class EachFrame:
    """``search`` on each frame by itself: what odometry is compared with."""

    name: str = "search"

    def answers(self, drive: Drive) -> Iterator[Answer]:
        localizer = Localizer(detector=DETECTOR)
        for one in drive.frames:
            submap = drive.semantic_map.crop(one.prior.position_m, CROP_M)
            yield Answer.of(localizer.localize(one.observed, submap, drive.camera, one.prior))


DRIVE_METHODS: dict[str, Callable[[], DriveMethod]] = {
    "tracking": Tracking,
    "search": EachFrame,
}
