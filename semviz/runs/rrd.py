"""Read record batches from an .rrd file, and step over its damaged parts.

An .rrd file is a head of 12 bytes and messages: kind, length, and a protobuf message with an Arrow
stream, usually compressed. rerun's own reader is not used because one flipped bit can end the
process: it allocates whatever size a message names. Here a message that cannot be read is skipped,
and reading goes on at the next message that can.
"""

import mmap
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

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
