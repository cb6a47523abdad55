"""The frames of a run for its lists and plots, column by column: a long run has 100,000 rows."""

import numpy as np

from semviz.runs.frame_table import STATUSES, FrameTable
from semviz.web.protocol import Part
from semviz_core.common.arrays import FloatArray


class FrameColumns(Part):
    """Columns over all frames. Errors are null without a pose or ground truth."""

    index: tuple[int, ...]
    status: tuple[int, ...]
    """Rows of ``statuses``."""
    statuses: tuple[str, ...]
    texts: tuple[str, ...]
    """All different texts; the next three columns are rows of it."""
    reason: tuple[int, ...]
    diagnosis: tuple[int, ...]
    noticed: tuple[int, ...]
    overconfident: tuple[int, ...]
    """Positions of these frames."""
    error_m: tuple[float | None, ...]
    error_deg: tuple[float | None, ...]
    ms: tuple[float, ...]


def frame_columns(table: FrameTable) -> FrameColumns:
    """Return the columns of a run's table that the page lists and draws."""
    return FrameColumns.model_construct(  # unchecked: a check of each value takes seconds
        index=tuple(table.index.tolist()),
        status=tuple(table.status.tolist()),
        statuses=STATUSES,
        texts=table.texts,
        reason=tuple(table.reason.tolist()),
        diagnosis=tuple(table.diagnosis.tolist()),
        noticed=tuple(table.noticed.tolist()),
        overconfident=tuple(np.flatnonzero(table.is_overconfident).tolist()),
        error_m=_numbers(table.distance_m),
        error_deg=_numbers(table.angle_deg),
        ms=tuple(table.solve_ms.round(2).tolist()),
    )


def _numbers(column: FloatArray) -> tuple[float | None, ...]:
    """Return a column with null for unknown values, to a tenth of a millimetre."""
    values: list[float | None] = column.round(4).tolist()
    for position in np.flatnonzero(np.isnan(column)).tolist():
        values[position] = None
    return tuple(values)
