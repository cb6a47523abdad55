"""Read every sound frame of a run from its .rrd file, even an interrupted or damaged one.

Head, map and frames are compared with their checksums. A frame that differs is left out and
counted; without a sound head and map, the file is refused.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from semviz.runs import run
from semviz.runs.codec import DamagedRowError, Pools, decode, verify_row
from semviz.runs.columns import FRAME
from semviz.runs.rrd_file import RrdFile
from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import parsed_json, shown
from semviz_core.diagnosis.fault import FrameDiagnosis

_MAGIC = b"RRF"
Value = TypeVar("Value")
BROKEN = (LookupError, ValueError, TypeError, AttributeError, ArithmeticError)
"""What values of the wrong kind raise; Arrow's errors are among them."""


def load_run(path: Path | str) -> Run:
    """Read a run; of an interrupted or damaged one, every sound frame.

    Raise SemvizError if ``path`` is missing, no run of semviz, of a newer version, or its head or
    map are damaged.
    """
    path = Path(path)
    check_run_file(path)
    try:
        rows, damaged = read_rows(path)
    except OSError as error:
        raise SemvizError(f"{path}: cannot be read ({error.strerror})") from None
    return assemble(path, rows, damaged)


def check_run_file(path: Path) -> None:
    """Raise SemvizError if ``path`` is missing or no .rrd file, by its first bytes."""
    if not path.is_file():
        raise SemvizError(f"{path}: no such run; make one with 'semviz localize'")
    try:
        with path.open("rb") as file:
            start = file.read(len(_MAGIC))
    except OSError as error:
        raise SemvizError(f"{path}: cannot be read ({error.strerror})") from None
    if start != _MAGIC:
        raise SemvizError(f"{path}: not an .rrd file; runs are made by 'semviz localize'")


Row = tuple[int, Pools]
"""A frame number (0 for static data), and its components."""


def read_rows(path: Path) -> tuple[dict[str, list[Row]], bool]:
    """Return the rows of the exact values and the images, by entity; whether parts are damaged."""
    rows: dict[str, list[Row]] = {}
    file = RrdFile(path)
    for message in file.messages(is_exact):
        try:
            rows.setdefault(message.entity, []).extend(rows_of(message.batch))
        except BROKEN:  # columns of other types
            file.damaged = True
    return rows, file.damaged


def is_exact(entity: str) -> bool:
    """Whether an entity holds exact values or images."""
    return entity.startswith(f"{run.EXACT}/") or entity in (run.IMAGE, run.IMAGE_RIGHT)


def rows_of(batch: Any, number: int | None = None) -> list[Row]:
    """Return the rows of a record batch, or those of one frame, with their components."""
    kinds = [(field.metadata or {}).get(b"rerun:kind") for field in batch.schema]
    data = [column for column, kind in enumerate(kinds) if kind == b"data"]
    names = batch.schema.names
    return [
        (
            frame,
            {
                names[column]: batch.column(column)[row].values.to_numpy(zero_copy_only=False)
                for column in data
                if batch.column(column)[row].is_valid
            },
        )
        for row, frame in enumerate(numbers_of(batch))
        if number is None or frame == number
    ]


def numbers_of(batch: Any) -> list[int]:
    """Return the frame number of each row of a record batch; 0 for static data."""
    return list(batch[FRAME].to_pylist() if FRAME in batch.schema.names else [0] * batch.num_rows)


def assemble(path: Path, rows: dict[str, list[Row]], damaged: bool) -> Run:
    """Return the run of the rows of a file. Raise SemvizError as ``load_run`` does."""
    is_checked = any(run.CHECKSUM in row for entity in rows.values() for _, row in entity)
    head = read_head(path, rows, damaged, is_checked)
    of_frames: dict[int, FrameRows] = {}
    for entity, entity_rows in rows.items():
        for frame, row in entity_rows:
            of_frames.setdefault(frame, {}).setdefault(entity, {}).update(row)
    frames, damaged_frames, written = [], [], 0
    try:
        for number in sorted(number for number, row in of_frames.items() if run.FRAME in row):
            try:
                found = read_frame(of_frames[number], number, head)
            except DamagedRowError:
                damaged_frames.append(number)
            else:
                frames.append(found.record)
                written = max(written, found.ordinal + 1)
    except (*BROKEN, SemvizError) as error:
        raise broken_run(path, error) from None
    return head.run(tuple(frames), tuple(damaged_frames), written)


@dataclass(frozen=True, eq=False)
class FileHead:
    """What a run's file says besides its frames."""

    info: RunInfo
    semantic_map: SemanticMap
    written: int | None
    """Number of frames of a complete run; None for an interrupted one."""
    is_checked: bool

    @property
    def recalls(self) -> bool:
        """Whether the diagnoses in the file are those that this version of semviz makes."""
        return self.info.version == installed_version("semviz")

    def run(
        self, frames: Sequence[FrameRecord], damaged: tuple[int, ...], at_least: int = 0
    ) -> Run:
        """Return the run of its sound frames; ``at_least`` so many were written."""
        expected = at_least if self.written is None else self.written
        return Run(
            info=self.info,
            semantic_map=self.semantic_map,
            frames=frames,
            complete=self.written is not None,
            damaged=damaged,
            lost=max(expected - len(frames), len(damaged)),
            checked=self.is_checked,
        )


def read_head(
    path: Path, rows: Mapping[str, list[Row]], damaged: bool, is_checked: bool
) -> FileHead:
    """Return the head of a run from the rows of its file. Raise SemvizError as ``load_run``."""
    _check_head(path, rows, damaged, is_checked)
    try:
        return FileHead(
            info=decode_row(RunInfo, rows[run.INFO][0][1]),
            semantic_map=decode_row(SemanticMap, rows[run.MAP][0][1]),
            written=_frames_written(rows, is_checked),
            is_checked=is_checked,
        )
    except (*BROKEN, SemvizError) as error:
        raise broken_run(path, error) from None


def broken_run(path: Path, error: Exception) -> SemvizError:
    """Return the error of a run whose values do not fit together."""
    return SemvizError(f"{path}: broken run ({shown(repr(error))}); localize again")


BLOB = "EncodedImage:blob"
"""Component of images; their entities have rows without it, too."""
FrameRows = dict[str, Pools]
"""The rows of one frame, by entity."""


class ReadFrame(NamedTuple):
    """A frame, and how many were written before it."""

    record: FrameRecord
    ordinal: int


def read_frame(rows: FrameRows, number: int, head: FileHead) -> ReadFrame:
    """Return a frame, and note its diagnosis if the file holds that of this version of semviz.

    Raise DamagedRowError if it is not as it was written.
    """
    row = rows[run.FRAME]
    left, right = (_image(rows.get(entity, {})) for entity in (run.IMAGE, run.IMAGE_RIGHT))
    if head.is_checked:
        verify_row(run.FRAME, number, row, (left, right))
    record = replace(decode_row(FrameRecord, row), image=left, image_right=right)
    if head.recalls and run.DIAGNOSIS in rows:
        _recall_diagnosis(record, rows[run.DIAGNOSIS])
    return ReadFrame(record, int(row[run.ORDINAL][0]) if head.is_checked else -1)


def _check_head(path: Path, rows: Mapping[str, list[Row]], damaged: bool, is_checked: bool) -> None:
    """Raise SemvizError if the file is no run, of a newer version, or has a damaged head or map."""
    broken = SemvizError(
        f"{path}: the head of this run, with its map, is damaged; restore the file from a copy, "
        "or localize again"
    )
    foreign = SemvizError(
        f"{path}: not a run of semviz, or its head is damaged; restore the file from a copy, or "
        "localize again"
        if damaged
        else f"{path}: a recording of rerun, but not a run of semviz"
    )
    if run.INFO not in rows:
        raise foreign
    try:
        if is_checked:
            for entity in (run.INFO, run.MAP):
                verify_row(entity, *rows[entity][0])
        version = int(rows[run.INFO][0][1]["version"][0])
    except (*BROKEN, DamagedRowError):
        raise broken if is_checked else foreign from None
    if version > run.FORMAT_VERSION:
        raise SemvizError(
            f"{path}: run version {version}; this semviz reads up to {run.FORMAT_VERSION}: "
            "update semviz"
        )


def _frames_written(rows: Mapping[str, list[Row]], is_checked: bool) -> int | None:
    """Return the number of frames of a complete run, None for an interrupted one."""
    for frame, row in rows.get(run.END, []):
        try:
            if is_checked:
                verify_row(run.END, frame, row)
            return int(row["frames"][0])
        except DamagedRowError:
            continue
    return None


def _recall_diagnosis(record: FrameRecord, row: Pools) -> None:
    """Note the diagnosis that the file holds; a damaged one is made again when it is needed."""
    with suppress(*BROKEN, SemvizError):
        verify_row(run.DIAGNOSIS, record.frame.index, row)
        run.KNOWN_DIAGNOSES[record] = decode_row(FrameDiagnosis, row)


def decode_row(kind: type[Value], row: Pools) -> Value:
    """Return the value of class ``kind`` that a row holds."""
    return decode(kind, parsed_json(row[run.STRUCTURE][0]), row)


def _image(row: Pools) -> bytes | None:
    """Return an image. A blob is one list of bytes, or none."""
    images = [np.asarray(image).tobytes() for image in row.get(BLOB, ())]
    return images[-1] if images else None
