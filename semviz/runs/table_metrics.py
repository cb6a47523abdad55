"""Metrics and diagnoses of a run, counted in its table: no frame is read."""

from collections import Counter
from typing import get_args

import numpy as np

from semviz.runs.diagnosis import STARTING_OR_LOST
from semviz.runs.frame_table import STATUSES, frame_table
from semviz.runs.metrics import DIAGNOSED, Metrics
from semviz.runs.run import Run
from semviz_core.common.arrays import IntArray
from semviz_core.diagnosis.fault import FaultKind
from semviz_core.metrics.pose_errors import FrameFigures


def metrics_of(run: Run, rows: IntArray | None = None) -> Metrics:
    """Return the metrics of a run, or of its frames at some positions.

    Errors are of the frames with a pose and a true one, ``share_below_...`` and
    ``share_sure_and_wrong`` of all frames with a true pose, other shares of all frames.
    """
    table = frame_table(run)
    of = slice(None) if rows is None else rows
    figures = FrameFigures(
        np.array(STATUSES)[table.status[of]],
        np.stack([table.distance_m[of], table.angle_deg[of]], axis=1),
        table.has_truth[of],
        np.where(table.solve_ms > 0.0, table.solve_ms, np.nan)[of],
    )
    summary, frames = figures.summary(), len(figures.status)
    accuracy = summary.accuracy
    status = {name: group.frames for name, group in summary.by_status.items()}
    wrong, with_truth = int(table.is_overconfident[of].sum()), int(figures.has_truth.sum())
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


def _share(count: int, total: int) -> float | None:
    return count / total if total else None


def found_diagnoses(run: Run, rows: IntArray | None = None) -> dict[str, int]:
    """Return the diagnoses of a run, or of its frames at some positions, with the number of frames
    of each, most frequent first."""
    table = frame_table(run)
    names = table.texts_of(table.diagnosis if rows is None else table.diagnosis[rows])
    return dict(Counter(names).most_common())


def diagnosis_counts(run: Run, rows: IntArray) -> Metrics:
    """Return the number of frames of each diagnosis as metrics, 0 for those that none has."""
    found, kinds = found_diagnoses(run, rows), (*get_args(FaultKind), STARTING_OR_LOST)
    return {f"{DIAGNOSED}{kind.replace(' ', '_')}": float(found.get(kind, 0)) for kind in kinds}
