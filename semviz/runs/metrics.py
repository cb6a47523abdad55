"""Measure a run: pose errors, named metrics, and one row per frame.

A frame is overconfident if its status is ok and it is more than 1 m off.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from semviz.runs.run import FrameRecord, Run
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose, angle_between
from semviz_core.common.csv_text import csv_text
from semviz_core.common.files import replacing
from semviz_core.metrics.pose_errors import Summary, pose_error, summarize

OVERCONFIDENT_M = 1.0


@dataclass(frozen=True)
class Errors:
    """Pose errors: distance of the camera centres, angle between the rotations."""

    distance_m: float
    angle_deg: float


def errors_of(record: FrameRecord) -> Errors | None:
    """Return the errors of a frame; None without a true pose or without an estimate."""
    truth, estimate = record.frame.T_map_camera, record.localization.T_camera_map
    if truth is None or estimate is None:
        return None
    return difference(estimate.inverse(), truth)


def difference(a: Pose, b: Pose) -> Errors:
    """Return the difference of two poses T_map_camera."""
    angle_deg = float(np.rad2deg(angle_between(a.rotation, b.rotation)))
    return Errors(float(np.linalg.norm(a.translation - b.translation)), angle_deg)


def is_overconfident(localization: Localization, errors: Errors | None) -> bool:
    """Whether the status is ok, but the pose is more than 1 m off."""
    error_m = 0.0 if errors is None else errors.distance_m
    return localization.status == "ok" and error_m > OVERCONFIDENT_M


Row = dict[str, str | int | float | None]


def summarize_run(run: Run) -> Summary:
    """Summarize errors, status and runtime over all frames of a run."""
    truths = [frame.frame.T_map_camera for frame in run.frames]
    return summarize(
        [frame.localization for frame in run.frames],
        [None if truth is None else truth.inverse() for truth in truths],
    )


def settings_of(run: Run) -> dict[str, str]:
    """Return the settings of a run as texts, by name."""
    info = run.info
    return {
        "method": info.method,
        "map": f"{info.map_name} ({run.semantic_map.digest[:12]})",
        "observations": info.observations,
        "seed": str(info.seed),
        "semviz": info.version,
        **{name: str(value) for name, value in info.options.items()},
    }


def frame_row(run: Run, record: FrameRecord) -> Row:
    """Return the figures of a frame; errors are None without a pose or a true one."""
    result, truth = record.localization, record.frame.T_map_camera
    rte_m = rre_deg = None
    if result.T_camera_map is not None and truth is not None:
        rte_m, rre_deg = pose_error(result.T_camera_map, truth.inverse())
    return {
        "run": run.info.name,
        "frame": record.frame.index,
        "time_s": record.frame.time_s,
        "status": result.status,
        "rte_m": rte_m,
        "rre_deg": rre_deg,
        "seen": len(result.observed),
        "mapped": len(result.submap),
        "matched": int(result.refinement.inlier.sum()) if result.refinement else 0,
        "time_ms": sum(result.time_ms.values()),
        "reason": result.reason,
    }


def write_csv(runs: Sequence[Run], path: Path) -> None:
    """Write one row per frame of every run, below a header."""
    rows = [frame_row(run, record) for run in runs for record in run.frames]
    header = list(rows[0]) if rows else ["run", "frame"]
    table = csv_text([header, *(list(row.values()) for row in rows)], line_end="\r\n")
    with replacing(path) as temporary:
        temporary.write_text(table, encoding="utf-8", newline="")


Metrics = dict[str, float | None]
"""Metrics by name; None if unknown, for example errors without true poses."""

Trend = Literal["better", "worse", "same"]
MORE_IS_BETTER = frozenset({"share_below_1m", "share_below_1deg", "coverage"})
NEITHER = frozenset({"frames", "share_ambiguous"})
"""Metrics of which neither more nor less is better. Ambiguous frames are better than failed ones,
and worse than located ones."""


def metrics_of(run: Run) -> Metrics:
    """Return the metrics of a run.

    Errors are of the frames with a pose and a true one, ``share_below_...`` and
    ``share_sure_and_wrong`` of all frames with a true pose, other shares of all frames.
    """
    summary, frames = summarize_run(run), len(run.frames)
    accuracy = summary.accuracy
    with_truth = sum(truth is not None for truth in run.truths)
    status = {name: group.frames for name, group in summary.by_status.items()}
    wrong = sum(is_overconfident(frame.localization, errors_of(frame)) for frame in run.frames)
    return {
        "frames": float(frames),
        "mean_rte_m": accuracy.rte_m.mean,
        "q1_rte_m": accuracy.rte_m.q1,
        "median_rte_m": accuracy.rte_m.q2,
        "q3_rte_m": accuracy.rte_m.q3,
        "mean_rre_deg": accuracy.rre_deg.mean,
        "q1_rre_deg": accuracy.rre_deg.q1,
        "median_rre_deg": accuracy.rre_deg.q2,
        "q3_rre_deg": accuracy.rre_deg.q3,
        "share_below_1m": accuracy.share_below_1m,
        "share_below_1deg": accuracy.share_below_1deg,
        "coverage": _share(status["ok"], frames),
        "share_ambiguous": _share(status["ambiguous"], frames),
        "share_cannot": _share(status["cannot"], frames),
        "share_sure_and_wrong": _share(wrong, with_truth),
        "median_time_ms": summary.time_ms_median,
        "p95_time_ms": summary.time_ms_p95,
    }


def trend(name: str, base: float | None, other: float | None) -> Trend:
    """Return whether the other run is better in a metric; ``same`` if that is unknown."""
    if base is None or other is None or base == other or name in NEITHER:
        return "same"
    return "better" if (other > base) == (name in MORE_IS_BETTER) else "worse"


def _share(count: int, total: int) -> float | None:
    return count / total if total else None
