"""The frames of a run, or of many runs, as the rows of an Arrow table, for Parquet.

Columns, as far as both have them, are those of ``semviz evaluate --csv``; null where unknown.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from semviz.runs.frame_table import STATUSES, FrameTable
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.metrics.pose_errors import FrameFigures

RUN = "run"


def arrow_table(table: FrameTable, run: str) -> Any:
    """Return a row for each frame of the run of this name."""
    inliers = np.bincount(table.frame_of_pair()[table.pair_inlier], minlength=len(table))
    return pa.table(
        {
            RUN: pa.DictionaryArray.from_arrays(np.zeros(len(table), np.int32), [run]),
            "frame": table.index,
            "time_s": table.time_s,
            "status": _texts(table.status, STATUSES),
            "rte_m": _known(table.distance_m),
            "rre_deg": _known(table.angle_deg),
            "seen": table.detections,
            "matched": inliers,
            "time_ms": _known(np.where(table.solve_ms > 0.0, table.solve_ms, np.nan)),
            "reason": _texts(table.reason, table.texts),
            "diagnosis": _texts(table.diagnosis, table.texts),
            "noticed": _texts(table.noticed, table.texts),
            "overconfident": table.is_overconfident,
            **_positions("", table.estimate_m),
            **_positions("true_", table.truth_m),
            **_positions("prior_", table.prior_m),
        }
    )


def _texts(rows: IntArray, texts: tuple[str, ...]) -> Any:
    return pa.DictionaryArray.from_arrays(rows.astype(np.int32), list(texts) or [""])


def _known(values: FloatArray) -> Any:
    return pa.array(values, mask=np.isnan(values))


def _positions(start: str, at_m: FloatArray) -> dict[str, Any]:
    return {f"{start}{axis}_m": _known(at_m[:, column]) for column, axis in enumerate("xyz")}


@dataclass(frozen=True, eq=False)
class FrameRows:
    """The rows of such a table."""

    table: Any

    def __len__(self) -> int:
        return int(self.table.num_rows)

    @property
    def figures(self) -> FrameFigures:
        """What is summarized of the frames."""
        errors = np.stack([self._numbers("rte_m"), self._numbers("rre_deg")], axis=1)
        has_truth = np.isfinite(self._numbers("true_x_m"))
        status = np.array(self.table["status"].to_pylist(), dtype=np.str_)
        return FrameFigures(status, errors, has_truth, self._numbers("time_ms"))

    @property
    def overconfident(self) -> int:
        """Number of frames whose status is ok, but whose pose is more than 1 m off."""
        return int(np.asarray(self.table["overconfident"]).sum())

    @property
    def diagnoses(self) -> dict[str, int]:
        """Number of frames of each diagnosis, most frequent first, then by name."""
        found = self.table["diagnosis"].value_counts().to_pylist()
        counts: dict[str, int] = {one["values"]: one["counts"] for one in found}
        return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))

    def of_run(self, run: str) -> "FrameRows":
        """Return the rows of one run."""
        import pyarrow.compute as pc

        return FrameRows(self.table.filter(pc.equal(self.table[RUN], run)))

    def _numbers(self, name: str) -> FloatArray:
        """Return a column; NaN for null."""
        return np.asarray(self.table[name].to_numpy(zero_copy_only=False), dtype=np.float64)
