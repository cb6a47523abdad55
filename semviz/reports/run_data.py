"""The data of a report: each run with its metrics, diagnoses, and worst frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from semviz.runs.diagnosis import diagnosis_name, run_diagnosis, run_elements
from semviz.runs.images import frame_image
from semviz.runs.metrics import Metrics, errors_of, is_overconfident, metrics_of
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run, run_names
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.element_statistics import ElementRecord
from semviz_core.diagnosis.run import RunDiagnosis
from semviz_core.metrics.pose_errors import Outcome, ProblemFacts, visible_rows

FAR_M = 1.0


@dataclass(frozen=True, eq=False)
class RunReport:
    """A run with everything that a report shows of it."""

    name: str
    """The name that ``semviz serve`` shows."""
    path: Path
    run: Run

    @cached_property
    def metrics(self) -> Metrics:
        return metrics_of(self.run)

    @cached_property
    def diagnoses(self) -> tuple[str, ...]:
        """Name of each frame's diagnosis."""
        return tuple(diagnosis_name(self.run, frame) for frame in self.run.frames)

    def image(self, row: int) -> bytes | None:
        """Return a frame's left image as JPEG or PNG; None if there is none."""
        return frame_image(self.run, self.path, row, "left")

    @cached_property
    def run_diagnosis(self) -> RunDiagnosis:
        """Recurring faults of map and camera."""
        return run_diagnosis(self.run)

    @cached_property
    def elements(self) -> tuple[ElementRecord, ...]:
        """Statistics of the map elements; outliers in most frames first."""
        return run_elements(self.run)

    @cached_property
    def outcomes(self) -> list[Outcome]:
        """Outcomes of the frames with a true pose, for plots."""
        return [
            _outcome(self, frame)
            for frame in self.run.frames
            if frame.frame.T_map_camera is not None
        ]

    def worst(self, count: int) -> list[int]:
        """Return the rows of the ``count`` worst frames, the worst first."""
        frames = self.run.frames
        rows = sorted(range(len(frames)), key=lambda row: _severity(frames[row]), reverse=True)
        return rows[:count]

    def worst_of_each_diagnosis(self, count: int) -> list[int]:
        """Return the worst frame's row of each diagnosis, at most ``count``, worst first."""
        first: dict[str, int] = {}
        for row in self.worst(len(self.run.frames)):
            first.setdefault(self.diagnoses[row], row)
        return list(first.values())[:count]


def load_reports(paths: Sequence[Path]) -> list[RunReport]:
    """Read runs. Raise SemvizError if one cannot be read, has no frames, or is named twice."""
    if len({path.resolve() for path in paths}) < len(paths):
        raise SemvizError("a run is named twice; name each run once")
    runs = [load_run(path) for path in paths]
    for path, run in zip(paths, runs, strict=True):
        if not run.frames:
            raise SemvizError(f"{path}: this run has no frames to report; localize again")
    return [
        RunReport(name, path, run)
        for name, path, run in zip(run_names(paths), paths, runs, strict=True)
    ]


def _severity(record: FrameRecord) -> tuple[int, float]:
    """Return a sort key: overconfident, wrong, no pose, ambiguous, ok; within each by error (m)."""
    errors, status = errors_of(record), record.localization.status
    error_m = 0.0 if errors is None else errors.distance_m
    if is_overconfident(record.localization, errors):
        return 4, error_m
    if error_m > FAR_M:
        return 3, error_m
    return {"cannot": 2, "ambiguous": 1, "ok": 0}[status], error_m


def _outcome(report: RunReport, record: FrameRecord) -> Outcome:
    result, errors = record.localization, errors_of(record)
    return Outcome(
        suite=report.run.semantic_map.frame.name,
        method=report.name,
        noise="",
        frame=record.frame.index,
        facts=ProblemFacts(detections=len(result.observed), recall=_recall(record)),
        status=result.status,
        rte_m=None if errors is None else errors.distance_m,
        rre_deg=None if errors is None else errors.angle_deg,
        nees=None,
        total_ms=sum(result.time_ms.values()),
    )


def _recall(record: FrameRecord) -> float | None:
    """Return the share of the mapped elements in view that were detected; None if unknown."""
    result, truth = record.localization, record.frame.T_map_camera
    if truth is None or not (record.element_id >= 0).any():
        return None
    visible = result.submap.id[visible_rows(result.submap, truth.inverse(), result.camera)]
    return float(np.isin(visible, record.element_id).mean()) if len(visible) else None
