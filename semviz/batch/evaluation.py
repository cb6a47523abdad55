"""Evaluate the runs of a batch: a table of frames for each drive, then figures over all of them."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from semviz.batch.batch import DriveBatch, DriveOutcome
from semviz.batch.work import told
from semviz.collection.collection import Collection, Drive
from semviz.presentation.terminal import Table, figure, percent
from semviz.runs.arrow_table import FrameRows, arrow_table
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing

if TYPE_CHECKING:
    from semviz_core.metrics.pose_errors import Summary


@dataclass(frozen=True)
class Tabulate:
    """Makes the table of frames of any drive's run; workers get it pickled."""

    where: str
    """The collection."""
    batch: str

    def __call__(self, drive: Drive) -> DriveOutcome:
        """Store the table of a drive, unless that is done. What fails is told, never raised."""
        return told(drive.name, lambda: self._done(drive.name))

    def _done(self, drive: str) -> DriveOutcome:
        batch = DriveBatch.open(Collection.open(self.where), self.batch)
        key = batch.output("frames", drive)
        if batch.store.exists(key):
            return DriveOutcome(drive, was_done=True)
        with tempfile.TemporaryDirectory(prefix="semviz-batch-") as folder:
            run, frames = Path(folder) / f"{drive}.rrd", Path(folder) / "frames.parquet"
            batch.store.fetch(batch.output("runs", drive), run)
            pq.write_table(_table_of(run), frames)
            batch.store.put_file_new(key, frames)
        return DriveOutcome(drive)


def _table_of(path: Path) -> Any:
    from semviz.runs.frame_table import frame_table
    from semviz.runs.stored_run import from_sound_frames

    return from_sound_frames(path, lambda run: arrow_table(frame_table(run), path.stem))


@dataclass(frozen=True, eq=False)
class BatchEvaluation:
    """The frames of all drives of a batch."""

    rows: FrameRows
    drives: tuple[str, ...]

    @classmethod
    def of(cls, batch: DriveBatch) -> "BatchEvaluation":
        """Read the tables of all drives that have one. Raise SemvizError if none has, or one is
        damaged."""
        drives = batch.drives_with("frames")
        if not drives:
            raise SemvizError(f"batch {batch.name}: no run could be evaluated")
        tables = [_read(batch, drive) for drive in drives]
        return cls(FrameRows(pa.concat_tables(tables).unify_dictionaries()), tuple(drives))

    @property
    def summary(self) -> "Summary":
        """Errors, shares and times over all frames."""
        return self.rows.figures.summary()

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        drives = [{"drive": name, **_as_dict(rows)} for name, rows in self._by_drive()]
        return {**_as_dict(self.rows), "drives": drives}

    def as_text(self) -> str:
        """Return the table of drives, then that over all frames."""
        cells = tuple(_cells(name, rows) for name, rows in self._by_drive())
        header = ("drive", "most frequent fault", "frames", "ok", "RTE m", "<1 m", "overconfident")
        counts = ", ".join(f"{kind} {n}" for kind, n in self.rows.diagnoses.items())
        drives = Table("", header, cells, words=2).as_text()
        return f"{drives}\n\n{self.summary.as_text()}\ndiagnoses: {counts}"

    def save(self, path: Path) -> None:
        """Write the rows of all drives to a Parquet file."""
        with replacing(path) as temporary:
            pq.write_table(self.rows.table, temporary)

    def _by_drive(self) -> Iterator[tuple[str, FrameRows]]:
        for name in self.drives:
            yield name, self.rows.of_run(name)


def _read(batch: DriveBatch, drive: str) -> Any:
    key = batch.output("frames", drive)
    try:
        return pq.read_table(pa.BufferReader(batch.store.read(key)))
    except pa.ArrowException as error:
        raise SemvizError(f"{batch.store.where}/{key}: damaged ({error}); delete it") from None


def _as_dict(rows: FrameRows) -> dict[str, Any]:
    return {**rows.figures.summary().as_json(), "diagnoses": rows.diagnoses}


def _cells(name: str, rows: FrameRows) -> tuple[str, ...]:
    summary = rows.figures.summary()
    faults = (f"{kind} {n}" for kind, n in rows.diagnoses.items() if kind != "healthy")
    return (
        name,
        next(faults, "none"),
        str(len(rows)),
        percent(summary.by_status["ok"].frames / max(len(rows), 1)),
        figure(summary.accuracy.rte_m.q2),
        percent(summary.accuracy.share_below_1m),
        str(rows.overconfident),
    )
