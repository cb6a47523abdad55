"""Open a run whose frames stay in its file: each is read when it is needed, a few are kept.

A complete run of this version of semviz ends with its table, which has the places of all frames.
Any other run is read through once, to find and check its frames, and to make its table.
"""

import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, overload

import pyarrow as pa

from semviz.runs import run
from semviz.runs.codec import DamagedRowError, verify_row
from semviz.runs.frame_table import KNOWN_TABLES, FrameTable, TableBuilder
from semviz.runs.reader import (
    BLOB,
    BROKEN,
    FileHead,
    FrameRows,
    ReadFrame,
    Row,
    broken_run,
    check_run_file,
    decode_row,
    is_exact,
    numbers_of,
    read_frame,
    read_head,
    rows_of,
)
from semviz.runs.rrd_file import RrdFile, last_message, messages_in
from semviz.runs.run import FrameRecord, Run
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError

HELD = 128
"""Frames kept in memory, of those that were used last."""
Value = TypeVar("Value")
Place = tuple[int, int]
"""First byte of messages in a file, and the byte after them."""
Report = Callable[[str, float], None]
"""Gets what is done, and the share of it that is done."""


@dataclass(frozen=True, eq=False)
class StoredTable:
    """The table of a run as its file holds it."""

    frames: FrameTable
    start: IntArray
    """(n,) first byte of each frame's messages."""
    stop: IntArray
    """(n,) the byte after them."""
    at: int
    """First byte of the table itself: the file was not rearranged if it is there."""


def open_run(
    path: Path | str, report: Report = lambda _, share: None, *, checks_frames: bool = False
) -> Run:
    """Return a run whose frames are read when they are needed, with its table.

    Raise SemvizError as ``load_run`` does. A frame that turns out to be damaged when it is read
    raises DamagedRowError; if ``checks_frames``, or without a usable table, it is left out instead.
    """
    path = Path(path)
    check_run_file(path)
    try:
        by_table = None if checks_frames else _opened_by_table(path)
        return by_table or _opened_by_reading(path, report)
    except OSError as error:
        raise SemvizError(f"{path}: cannot be read ({error.strerror})") from None
    finally:
        pa.default_memory_pool().release_unused()


def from_sound_frames(path: Path, work: Callable[[Run], Value]) -> Value:
    """Return what ``work`` makes of a run, whose frames stay in its file.

    If it meets a damaged frame, it is done again without those. Raise SemvizError as ``open_run``.
    """
    try:
        return work(open_run(path))
    except DamagedRowError:
        return work(open_run(path, checks_frames=True))


def check_run_head(path: Path) -> None:
    """Raise SemvizError if ``path`` is no run, or its head or map are damaged."""
    check_run_file(path)
    _head(path)


class StoredFrames(Sequence[FrameRecord]):
    """The frames of a run, read from its file when they are needed. Thread-safe.

    The file stays open, so that a run which replaces it does not mix with this one.
    """

    def __init__(
        self, path: Path, head: FileHead, numbers: Sequence[int], places: Sequence[Sequence[Place]]
    ) -> None:
        self._path = path
        self._head = head
        self._numbers = numbers
        self.places = places
        """Of the messages of each frame."""
        self._file = os.open(path, os.O_RDONLY)
        self._held: OrderedDict[int, FrameRecord] = OrderedDict()
        self._lock = threading.Lock()
        weakref.finalize(self, os.close, self._file)

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, position: int) -> FrameRecord: ...
    @overload
    def __getitem__(self, position: slice) -> Sequence[FrameRecord]: ...
    def __getitem__(self, position: int | slice) -> FrameRecord | Sequence[FrameRecord]:
        if isinstance(position, slice):
            return tuple(self[one] for one in range(*position.indices(len(self))))
        position = range(len(self))[position]
        with self._lock:
            if position in self._held:
                self._held.move_to_end(position)
                return self._held[position]
        record = self.read(position).record
        with self._lock:
            record = self._held.setdefault(position, record)  # another thread may have read it
            if len(self._held) > HELD:
                self._held.popitem(last=False)
        return record

    def read(self, position: int) -> ReadFrame:
        """Read a frame from the file. Raise SemvizError if it is damaged."""
        number = int(self._numbers[position])
        try:
            return read_frame(self._rows(position, number), number, self._head)
        except DamagedRowError:
            raise DamagedRowError(
                f"{self._path}: frame {number} is damaged: restore the file from a copy, localize "
                "again, or keep the other frames with 'semviz repair'"
            ) from None
        except (*BROKEN, OSError) as error:
            raise broken_run(self._path, error) from None

    def _rows(self, position: int, number: int) -> FrameRows:
        """Return the rows of a frame. Raise DamagedRowError if they cannot be read."""
        rows: FrameRows = {}
        for start, stop in self.places[position]:
            part = os.pread(self._file, stop - start, start)
            try:
                for message in messages_in(part, is_exact):
                    for _, row in rows_of(message.batch, number):
                        rows.setdefault(message.entity, {}).update(row)
            except Exception:  # damaged bytes make pyarrow raise anything
                break
        if run.FRAME not in rows:
            raise DamagedRowError(f"frame {number} cannot be read")
        return rows


def stored_table(path: Path) -> StoredTable | None:
    """Return the table at the end of a run, which was not rearranged since; None if it has none
    that can be used. Nothing else of the file is read."""
    message = last_message(path, run.TABLE)
    if message is None:
        return None
    try:
        ((_, row),) = rows_of(message.batch)
        verify_row(run.TABLE, 0, row)
        stored = decode_row(StoredTable, row)
    except (*BROKEN, SemvizError):
        return None
    return stored if stored.at == message.start else None


def _opened_by_table(path: Path) -> Run | None:
    """Return the run by the table at its end; None if it has none that can be used."""
    stored = stored_table(path)
    if stored is None:
        return None
    head = _head(path)
    if head.written is None or not head.recalls:
        return None
    places = [(place,) for place in zip(stored.start.tolist(), stored.stop.tolist(), strict=True)]
    opened = head.run(StoredFrames(path, head, stored.frames.index.tolist(), places), ())
    KNOWN_TABLES[opened] = stored.frames
    return opened


def _head(path: Path) -> FileHead:
    """Return the head of a run; its end is looked for among the last messages alone."""
    rows: dict[str, list[Row]] = {}
    file, wanted = RrdFile(path), {run.INFO, run.MAP}
    for message in file.messages(wanted.__contains__):
        with suppress(*BROKEN):  # columns of other types
            rows[message.entity] = rows_of(message.batch)
        if rows.keys() == wanted:
            break
    if (end := last_message(path, run.END)) is not None:
        rows[run.END] = rows_of(end.batch)
    is_checked = any(run.CHECKSUM in row for entity in rows.values() for _, row in entity)
    return read_head(path, rows, file.damaged, is_checked)


def _opened_by_reading(path: Path, report: Report) -> Run:
    """Return the run after its frames were found, checked and summed up."""
    found = _find_frames(path, report)
    head = read_head(path, found.rows, found.damaged, found.is_checked)
    numbers = sorted(found.frames)
    stored = StoredFrames(path, head, numbers, [found.places[number] for number in numbers])
    builder = TableBuilder(Run(head.info, head.semantic_map, ()))
    sound, damaged, written = list[int](), list[int](), 0
    for position in _reported(range(len(numbers)), report):
        try:
            frame = stored.read(position)
        except DamagedRowError:
            damaged.append(numbers[position])
        else:
            builder.add(frame.record)
            sound.append(numbers[position])
            written = max(written, frame.ordinal + 1)
    frames = StoredFrames(path, head, sound, [found.places[number] for number in sound])
    opened = head.run(frames, tuple(damaged), written)
    KNOWN_TABLES[opened] = builder.table()
    return opened


def _reported(positions: range, report: Report) -> Iterator[int]:
    every = max(len(positions) // 100, 1)
    for position in positions:
        if position % every == 0:
            report("reading its frames", position / len(positions))
        yield position


@dataclass(eq=False)
class _FoundFrames:
    """Where the frames of a file are."""

    rows: dict[str, list[Row]] = field(default_factory=dict)
    """Of head, map and end."""
    frames: set[int] = field(default_factory=set)
    """Numbers of the frames with values."""
    places: dict[int, list[Place]] = field(default_factory=dict)
    """Of all messages of each frame number."""
    damaged: bool = False
    is_checked: bool = False

    def add(self, entity: str, batch: Any, place: Place) -> None:
        self.is_checked |= run.CHECKSUM in batch.schema.names
        if entity in (run.INFO, run.MAP, run.END):
            self.rows.setdefault(entity, []).extend(rows_of(batch))
            return
        if entity in (run.IMAGE, run.IMAGE_RIGHT) and BLOB not in batch.schema.names:
            return
        numbers = numbers_of(batch)
        for number in numbers:
            self.places.setdefault(number, []).append(place)
        if entity == run.FRAME:
            self.frames.update(numbers)


def _find_frames(path: Path, report: Report) -> _FoundFrames:
    """Look through a file for the places of its frames."""
    found, file, size, shown = _FoundFrames(), RrdFile(path), path.stat().st_size, 0
    for message in file.messages(is_exact):
        try:
            found.add(message.entity, message.batch, (message.start, message.stop))
        except BROKEN:  # columns of other types
            file.damaged = True
        if (percent := 100 * message.stop // size) > shown:
            report("looking for its frames", (shown := percent) / 100)
    found.damaged = file.damaged
    return found
