"""Tables of runs: one row per frame."""

from collections.abc import Sequence
from pathlib import Path

from semviz.runs.diagnosis import diagnosis_name, noticed_faults
from semviz.runs.run import FrameRecord, Run
from semviz_core.base.pose import Pose
from semviz_core.common.files import csv_text, replacing
from semviz_core.metrics.pose_errors import pose_error

Row = dict[str, str | int | float | None]


def frame_row(run: Run, record: FrameRecord) -> Row:
    """Return the figures of a frame; errors are None without a pose or a true one.

    The pose is that of the camera in the map frame, as in TUM files: its centre and quaternion.
    """
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
        "diagnosis": diagnosis_name(run, record),
        "noticed": noticed_faults(run, record),
        **_pose_columns(result.T_camera_map),
    }


def _pose_columns(T_camera_map: Pose | None) -> Row:
    names = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    if T_camera_map is None:
        return dict.fromkeys(names)
    pose = T_camera_map.inverse()
    values = (*pose.translation.tolist(), *pose.as_quaternion())
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def frame_rows(run: Run) -> list[Row]:
    """Return the figures of all frames."""
    return [frame_row(run, record) for record in run.frames]


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write rows of frames below a header."""
    header = list(rows[0]) if rows else ["run", "frame"]
    table = csv_text([header, *(list(row.values()) for row in rows)], line_end="\r\n")
    with replacing(path) as temporary:
        temporary.write_text(table, encoding="utf-8", newline="")
