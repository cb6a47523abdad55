"""Runs in numbers: summaries, and one row a frame; and what they were made with."""

import csv
from collections.abc import Sequence
from pathlib import Path

from semviz.recording.run import FrameRecord, Run
from semviz_core.evaluation.metrics import Summary, pose_error, summarize
from semviz_core.files import replacing

Row = dict[str, str | int | float | None]


def summarize_run(run: Run) -> Summary:
    """Errors, status and time over all frames of a run."""
    truths = [one.frame.T_map_camera for one in run.frames]
    return summarize(
        [one.localization for one in run.frames],
        [None if truth is None else truth.inverse() for truth in truths],
    )


def settings_of(run: Run) -> dict[str, str]:
    """What a run was made with, by name, in words."""
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
    """One frame in numbers; None where there is no pose or no truth."""
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
    """One row a frame of every run, with a header."""
    rows = [frame_row(run, record) for run in runs for record in run.frames]
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else ["run", "frame"])
        writer.writeheader()
        writer.writerows(rows)
