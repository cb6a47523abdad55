"""What a report tells of a run: its metrics, the verdict on each frame, the worst frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from semviz.comparing.metrics import Metrics, metrics_of
from semviz.pose_errors import errors_of, sure_and_wrong
from semviz.recording.pictures import picture
from semviz.recording.reader import load_run
from semviz.recording.run import FrameRecord, Run
from semviz.run_names import run_names
from semviz.run_verdict import run_elements, run_verdict
from semviz.verdicts import verdict
from semviz_core.errors import SemvizError
from semviz_core.evaluation.outcomes import Facts, Outcome, visible_rows
from semviz_core.explaining.per_element import ElementRecord
from semviz_core.explaining.run_verdict import RunVerdict

FAR_M = 1.0


@dataclass(frozen=True, eq=False)
class Reported:
    """A run, and what is told of it."""

    name: str
    """As ``semviz serve`` calls it."""
    path: Path
    run: Run

    @cached_property
    def metrics(self) -> Metrics:
        return metrics_of(self.run)

    @cached_property
    def verdicts(self) -> tuple[str, ...]:
        """On each frame."""
        return tuple(verdict(self.run, one) for one in self.run.frames)

    def image(self, row: int) -> bytes | None:
        """A frame's left image, JPEG or PNG, wherever it is."""
        return picture(self.run, self.path, row, "left")

    @cached_property
    def over_the_run(self) -> RunVerdict:
        """On its map and camera."""
        return run_verdict(self.run)

    @cached_property
    def elements(self) -> tuple[ElementRecord, ...]:
        """Of the map, as the frames saw them; outliers in most frames first."""
        return run_elements(self.run)

    @cached_property
    def outcomes(self) -> list[Outcome]:
        """Of the frames with a true pose, as plots of benchmarks take them."""
        return [
            _outcome(self, one) for one in self.run.frames if one.frame.T_map_camera is not None
        ]

    def worst(self, count: int) -> list[int]:
        """Positions of the ``count`` worst frames, the worst first."""
        frames = self.run.frames
        rows = sorted(range(len(frames)), key=lambda row: _badness(frames[row]), reverse=True)
        return rows[:count]

    def worst_of_each_verdict(self, count: int) -> list[int]:
        """Positions of the worst frame of each verdict; so many at most, the worst first."""
        first: dict[str, int] = {}
        for row in self.worst(len(self.run.frames)):
            first.setdefault(self.verdicts[row], row)
        return list(first.values())[:count]


def load_reported(paths: Sequence[Path]) -> list[Reported]:
    """Read runs. Raises SemvizError where one cannot be read, has no frames, or comes twice."""
    if len({path.resolve() for path in paths}) < len(paths):
        raise SemvizError("a run is named twice; name each run once")
    runs = [load_run(path) for path in paths]
    for path, run in zip(paths, runs, strict=True):
        if not run.frames:
            raise SemvizError(f"{path}: no frame is in this run, so there is nothing to report")
    return [
        Reported(name, path, run)
        for name, path, run in zip(run_names(paths), paths, runs, strict=True)
    ]


def _badness(record: FrameRecord) -> tuple[int, float]:
    """As the inspector sorts: sure and wrong, then wrong, then no answer, then doubt, by error."""
    errors, status = errors_of(record), record.localization.status
    off_m = 0.0 if errors is None else errors.distance_m
    if sure_and_wrong(record.localization, errors):
        return 4, off_m
    if off_m > FAR_M:
        return 3, off_m
    return {"cannot": 2, "ambiguous": 1, "ok": 0}[status], off_m


def _outcome(reported: Reported, record: FrameRecord) -> Outcome:
    one, errors = record.localization, errors_of(record)
    return Outcome(
        suite=reported.run.semantic_map.frame.name,
        method=reported.name,
        noise="",
        frame=record.frame.index,
        facts=Facts(detections=len(one.observed), recall=_recall(record)),
        status=one.status,
        rte_m=None if errors is None else errors.distance_m,
        rre_deg=None if errors is None else errors.angle_deg,
        nees=None,
        total_ms=sum(one.time_ms.values()),
    )


def _recall(record: FrameRecord) -> float | None:
    """Share of the mapped elements in view that were detected; None where that is not known."""
    one, truth = record.localization, record.frame.T_map_camera
    if truth is None or not (record.element_id >= 0).any():
        return None
    visible = one.submap.id[visible_rows(one.submap, truth.inverse(), one.camera)]
    return float(np.isin(visible, record.element_id).mean()) if len(visible) else None
