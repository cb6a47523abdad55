"""Read every sound frame of a run from its .rrd file, even an interrupted or damaged one.

Head, map and frames are compared with their checksums. A frame that differs is left out and
counted; without a sound head and map, the file is refused.

An .rrd file is a head of 12 bytes and messages: kind, length, and a protobuf message with an Arrow
stream, usually compressed. rerun's own reader is not used because one flipped bit can end the
process: it allocates whatever size a message names. Here a message that cannot be read is skipped,
and reading goes on at the next message that can.
"""

import mmap
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from semviz.runs import run
from semviz.runs.codec import DamagedRowError, Pools, decode, verify_row
from semviz.runs.columns import FRAME
from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import parsed_json, shown
from semviz_core.diagnosis.fault import FrameDiagnosis

_HEAD_BYTES = 12
_MESSAGE = struct.Struct("<QQ")
_KINDS = 4
"""0: end; 1: names a recording; 2: a record batch; 3: activates a layout of views."""
_END, _BATCH = 0, 2
_TRAILER_BYTES = 32
"""After the end of a complete recording."""
_BATCH_KIND = struct.pack("<Q", _BATCH)
_COMPRESSION, _SIZE, _CONTENT = 2, 3, 5
"""Fields of the protobuf message of a record batch."""
_LZ4 = 2
_MOST_LZ4 = 255
"""LZ4 compresses at most so many times."""


@dataclass
class RrdFile:
    """An .rrd file; after ``batches`` was consumed, ``damaged`` tells whether parts were skipped.

    A file that ends within a message counts as damaged, one that ends between two does not.
    """

    path: Path
    damaged: bool = False

    def batches(self, is_wanted: Callable[[str], bool]) -> Iterator[tuple[str, Any]]:
        """Yield the entity path and record batch of each message of a wanted entity.

        Raise OSError if the file cannot be read.
        """
        with (
            self.path.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
        ):
            at = _HEAD_BYTES
            while 0 <= at < len(content):
                try:
                    kind, end = _message(content, at)
                    found = _batch(content[at + _MESSAGE.size : end], is_wanted, kind)
                except Exception:  # damaged bytes make pyarrow raise anything
                    self.damaged = True
                    at = content.find(_BATCH_KIND, at + 1)  # a damaged length is not to be trusted
                    continue
                if found is not None:
                    yield found
                if kind == _END and end + _TRAILER_BYTES >= len(content):
                    return
                at = end


def _message(content: mmap.mmap, at: int) -> tuple[int, int]:
    """Return kind and end of the message at a position. Raise ValueError if it is damaged."""
    kind, length = _MESSAGE.unpack_from(content, at)
    end = at + _MESSAGE.size + length
    if kind >= _KINDS or end > len(content):
        raise ValueError("damaged head of a message")
    return kind, end


def _batch(message: bytes, is_wanted: Callable[[str], bool], kind: int) -> tuple[str, Any] | None:
    """Return entity and batch of a message; None if it is of another kind, or not wanted."""
    if kind != _BATCH:
        return None
    fields = dict(_fields(message))
    content = fields[_CONTENT]
    if fields.get(_COMPRESSION) == _LZ4:
        size = fields[_SIZE]
        if size > _MOST_LZ4 * len(content):
            raise ValueError("LZ4 does not compress so much")
        content = pa.Codec("lz4_raw").decompress(content, decompressed_size=size)
    with pa.ipc.open_stream(content) as stream:
        entity = (stream.schema.metadata or {})[b"rerun:entity_path"].decode()
        if not is_wanted(entity):
            return None
        batch = stream.read_next_batch()
    batch.validate(full=True)
    return entity, batch


def _fields(message: bytes) -> Iterator[tuple[int, Any]]:
    """Yield number and value of each field: an integer, or bytes. Raise an error if damaged."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        value, at = _varint(message, at)  # of bytes: their number
        number, wire = key >> 3, key & 7
        end = at + value if wire == 2 else at
        if not number or wire not in (0, 2) or end > len(message):
            raise ValueError("damaged field")
        yield number, message[at:end] if wire == 2 else value
        at = end


def _varint(message: bytes, at: int) -> tuple[int, int]:
    """Return an integer of seven bits a byte, and the position after it."""
    value = shift = 0
    while message[at] & 0x80:
        value |= (message[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
    return value | message[at] << shift, at + 1


_MAGIC = b"RRF"
_BROKEN = (LookupError, ValueError, TypeError, AttributeError, ArithmeticError)
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
    for entity, batch in file.batches(_is_wanted):
        try:
            rows.setdefault(entity, []).extend(_rows(batch))
        except _BROKEN:  # columns of other types
            file.damaged = True
    return rows, file.damaged


def _is_wanted(entity: str) -> bool:
    return entity.startswith(f"{run.EXACT}/") or entity in (run.IMAGE, run.IMAGE_RIGHT)


def _rows(batch: Any) -> list[Row]:
    kinds = [(field.metadata or {}).get(b"rerun:kind") for field in batch.schema]
    data = [number for number, kind in enumerate(kinds) if kind == b"data"]
    names = batch.schema.names
    frames = batch[FRAME].to_pylist() if FRAME in names else [0] * batch.num_rows
    return [
        (
            frame,
            {
                names[number]: batch.column(number)[row].values.to_numpy(zero_copy_only=False)
                for number in data
                if batch.column(number)[row].is_valid
            },
        )
        for row, frame in enumerate(frames)
    ]


def assemble(path: Path, rows: dict[str, list[Row]], damaged: bool) -> Run:
    is_checked = any(run.CHECKSUM in row for entity in rows.values() for _, row in entity)
    _check_head(path, rows, damaged, is_checked)
    (_, info), *_ = rows[run.INFO]
    try:
        sound, damaged_frames = _sound_frames(rows, is_checked)
        frames = tuple(
            replace(_decode(FrameRecord, row), image=left, image_right=right)
            for row, left, right in sound
        )
        if (decoded_info := _decode(RunInfo, info)).version == installed_version("semviz"):
            _recall_diagnoses(rows, frames)
        written = _frames_written(rows, is_checked)
        last = max((int(row[run.ORDINAL][0]) + 1 for row, *_ in sound if is_checked), default=0)
        expected = last if written is None else written
        return Run(
            info=decoded_info,
            semantic_map=_decode(SemanticMap, rows[run.MAP][0][1]),
            frames=frames,
            complete=written is not None,
            damaged=damaged_frames,
            lost=max(expected - len(frames), len(damaged_frames)),
            checked=is_checked,
        )
    except (*_BROKEN, SemvizError) as error:
        raise SemvizError(f"{path}: broken run ({shown(repr(error))}); localize again") from None


def _check_head(path: Path, rows: dict[str, list[Row]], damaged: bool, is_checked: bool) -> None:
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
    except (*_BROKEN, DamagedRowError):
        raise broken if is_checked else foreign from None
    if version > run.FORMAT_VERSION:
        raise SemvizError(
            f"{path}: run version {version}; this semviz reads up to {run.FORMAT_VERSION}: "
            "update semviz"
        )


SoundFrame = tuple[Pools, bytes | None, bytes | None]
"""The row of a frame, and its left and right image."""


def _sound_frames(
    rows: dict[str, list[Row]], is_checked: bool
) -> tuple[list[SoundFrame], tuple[int, ...]]:
    """Return the frames in order, and the numbers of those whose checksum differs."""
    left, right = (_images(rows.get(entity, [])) for entity in (run.IMAGE, run.IMAGE_RIGHT))
    sound, damaged = [], []
    for frame, row in sorted(rows.get(run.FRAME, []), key=lambda row: row[0]):
        images = left.get(frame), right.get(frame)
        try:
            if is_checked:
                verify_row(run.FRAME, frame, row, images)
            sound.append((row, *images))
        except DamagedRowError:
            damaged.append(frame)
    return sound, tuple(damaged)


def _frames_written(rows: dict[str, list[Row]], is_checked: bool) -> int | None:
    """Return the number of frames of a complete run, None for an interrupted one."""
    for frame, row in rows.get(run.END, []):
        try:
            if is_checked:
                verify_row(run.END, frame, row)
            return int(row["frames"][0])
        except DamagedRowError:
            continue
    return None


def _recall_diagnoses(rows: dict[str, list[Row]], frames: Sequence[FrameRecord]) -> None:
    """Note the diagnoses that the file holds; a damaged one is made again when it is needed."""
    records = {record.frame.index: record for record in frames}
    for frame, row in rows.get(run.DIAGNOSIS, []):
        if frame not in records:
            continue
        with suppress(*_BROKEN, SemvizError):
            verify_row(run.DIAGNOSIS, frame, row)
            run.KNOWN_DIAGNOSES[records[frame]] = _decode(FrameDiagnosis, row)


def _decode(kind: Any, row: Pools) -> Any:
    return decode(kind, parsed_json(row[run.STRUCTURE][0]), row)


def _images(rows: list[Row]) -> dict[int, bytes]:
    """Return images by frame number. A blob is one list of bytes, or none."""
    blobs = ((frame, row.get("EncodedImage:blob", ())) for frame, row in rows)
    return {frame: np.asarray(image).tobytes() for frame, blob in blobs for image in blob}
