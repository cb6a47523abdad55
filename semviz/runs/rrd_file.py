"""The messages of an .rrd file: those of wanted entities, the last ones, or those of a part.

An .rrd file is a head of 12 bytes and messages: kind, length, and a protobuf message with an Arrow
stream, usually compressed. rerun's own reader is not used because one flipped bit can end the
process: it allocates whatever size a message names. Here a message that cannot be read is skipped,
and reading goes on at the next message that can.
"""

import mmap
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

_HEAD_BYTES = 12
_MESSAGE = struct.Struct("<QQ")
_KINDS = 4
"""0: end; 1: names a recording; 2: a record batch; 3: activates a layout of views."""
_END, _BATCH = 0, 2
_TRAILER_BYTES = 32
"""After the end of a complete recording."""
_TRAILER = struct.Struct("<QQ")
"""Start of the trailer: place and length of the content of the message before it."""
_LAST = 4
"""Messages before the end that are looked at."""
_RELEASED_BYTES = 1 << 26
"""Pages of a mapped file count as memory of the process until they are given back."""
_BATCH_KIND = struct.pack("<Q", _BATCH)
_LENGTH_BYTES = 8
_COMPRESSION, _SIZE, _CONTENT = 2, 3, 5
"""Fields of the protobuf message of a record batch."""
_LZ4 = 2
_MOST_LZ4 = 255
"""LZ4 compresses at most so many times."""


class Message(NamedTuple):
    """A record batch of an entity, and its place in the file."""

    entity: str
    batch: Any
    start: int
    stop: int


@dataclass
class RrdFile:
    """An .rrd file; after ``messages`` was consumed, ``damaged`` tells whether parts were skipped.

    A file that ends within a message counts as damaged, one that ends between two does not.
    """

    path: Path
    damaged: bool = False

    def messages(self, is_wanted: Callable[[str], bool]) -> Iterator[Message]:
        """Yield the record batches of wanted entities. Raise OSError if the file cannot be read."""
        with (
            self.path.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
        ):
            at, released = _HEAD_BYTES, 0
            while 0 <= at < len(content):
                try:
                    kind, end = _message(content, at)
                    found = _batch(content[at + _MESSAGE.size : end], is_wanted, kind)
                except Exception:  # damaged bytes make pyarrow raise anything
                    self.damaged = True
                    at = content.find(_BATCH_KIND, at + 1)  # a damaged length is not to be trusted
                    continue
                if found is not None:
                    yield Message(*found, at, end)
                if kind == _END and end + _TRAILER_BYTES >= len(content):
                    return
                at = end
                if at - released > _RELEASED_BYTES:
                    released = _release(content, released, at)


def messages_in(part: bytes, is_wanted: Callable[[str], bool]) -> list[Message]:
    """Return the record batches of wanted entities in a part of a file that holds whole messages.

    Places are relative to the part. Raise an exception of any class if it is damaged.
    """
    found, at = list[Message](), 0
    while at < len(part):
        kind, end = _message(part, at)
        batch = _batch(part[at + _MESSAGE.size : end], is_wanted, kind)
        if batch is not None:
            found.append(Message(*batch, at, end))
        at = end
    return found


def last_message(path: Path, entity: str) -> Message | None:
    """Return the last record batch of an entity if it is among the last few of a complete file.

    None if there is none, or what precedes the end is damaged. Raise OSError if the file cannot be
    read.
    """
    with (
        path.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
    ):
        if len(content) < _HEAD_BYTES + _TRAILER_BYTES:
            return None
        stop, _ = _TRAILER.unpack_from(content, len(content) - _TRAILER_BYTES)
        stop -= _MESSAGE.size  # of the message whose content the trailer names
        for _ in range(_LAST):
            start = _start_of_message(content, stop)
            if start is None:
                return None
            with suppress(Exception):  # damaged bytes make pyarrow raise anything
                found = _batch(content[start + _MESSAGE.size : stop], entity.__eq__, _BATCH)
                if found is not None:
                    return Message(*found, start, stop)
            stop = start
    return None


def _start_of_message(content: mmap.mmap, stop: int) -> int | None:
    """Return the start of the record batch that ends at ``stop``: its length says so."""
    at = max(min(stop, len(content)) - _LENGTH_BYTES, 0)  # a length follows the kind
    while (at := content.rfind(_BATCH_KIND, 0, at)) > 0:
        if _MESSAGE.unpack_from(content, at)[1] == stop - at - _MESSAGE.size:
            return at
    return None


def _release(content: mmap.mmap, start: int, stop: int) -> int:
    """Give back the memory of pages that were read. Return where the rest starts."""
    start, stop = (place // mmap.PAGESIZE * mmap.PAGESIZE for place in (start, stop))
    if hasattr(mmap, "MADV_DONTNEED"):
        content.madvise(mmap.MADV_DONTNEED, start, stop - start)
    return stop


def _message(content: mmap.mmap | bytes, at: int) -> tuple[int, int]:
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
