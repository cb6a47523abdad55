"""What a Parquet file says it unpacks to: its pages' values and bytes, read before any is decoded.

A page of a few bytes can repeat one value two thousand million times. pyarrow has no limit for
that, and ends the process where it asks for a damaged chunk's numbers, so the few fields needed
are read here, from Thrift's compact protocol (apache/parquet-format, parquet.thrift).
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

_MAGIC = b"PAR1"
_MOST_FOOTER_BYTES = 256 * 2**20
_MOST_DEPTH = 20
_HEADER_BYTES = 2**16
"""A page's header is shorter, unless its statistics are long."""
_MOST_HEADER_BYTES = 2**24
_BINARY, _LIST, _SET, _STRUCT = 8, 9, 10, 12
Struct = dict[int, Any]
"""Values by field id."""


class Unpacked(NamedTuple):
    """What the pages of one column unpack to."""

    values: int
    bytes: int


def unpacked_columns(path: Path) -> list[Unpacked]:
    """Return what each column unpacks to. Raise ValueError if the file is damaged."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(size - 8, 0))
        tail = file.read(8)
        length = struct.unpack("<I", tail[:4])[0] if len(tail) == 8 else 0
        if tail[4:] != _MAGIC or not 0 < length <= min(size - 8, _MOST_FOOTER_BYTES):
            raise ValueError("no Parquet magic bytes, or a footer of the wrong size")
        file.seek(size - 8 - length)
        footer = _Thrift(file.read(length)).struct()
        found: dict[int, Unpacked] = {}
        for group in _list(footer, 4):
            for number, chunk in enumerate(_list(group, 1)):
                values, bytes_ = found.get(number, Unpacked(0, 0))
                for page in _pages(file, _struct(chunk, 3), size):
                    values, bytes_ = values + page.values, bytes_ + page.bytes
                found[number] = Unpacked(values, bytes_)
    return [found[number] for number in sorted(found)]


def _pages(file: Any, chunk: Struct, size: int) -> Iterator[Unpacked]:
    """Yield what each page of a column chunk unpacks to, from its header."""
    start = _int(chunk, 9)
    if 0 < _int(chunk, 11) < start:
        start = _int(chunk, 11)  # of the dictionary
    end = start + _int(chunk, 7) if _int(chunk, 5) else start  # no values: nothing is read
    while start < end:
        if end > size:
            raise ValueError("a column ends after the file")
        header, length = _page_header(file, start)
        values = max(_int(_struct(header, field), 1) for field in (5, 7, 8))
        yield Unpacked(values, _int(header, 2))
        start += length + _int(header, 3)


def _page_header(file: Any, start: int) -> tuple[Struct, int]:
    """Return a page's header, and its length."""
    wanted = _HEADER_BYTES
    while True:
        file.seek(start)
        thrift = _Thrift(file.read(wanted))
        try:
            return thrift.struct(), thrift.place
        except ValueError:
            wanted *= 16
            if wanted > _MOST_HEADER_BYTES:
                raise


def _int(fields: Struct, field: int) -> int:
    value = fields.get(field, 0)
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"a negative size in field {field}")
    return value


def _struct(fields: Struct, field: int) -> Struct:
    value = fields.get(field, {})
    return value if isinstance(value, dict) else {}


def _list(fields: Struct, field: int) -> list[Struct]:
    value = fields.get(field, [])
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


class _Thrift:
    """Reads Thrift's compact protocol; texts are skipped. Every item takes at least a byte."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.place = 0

    def struct(self, depth: int = 0) -> Struct:
        """Return the fields of a struct. Raise ValueError if it is damaged."""
        if depth > _MOST_DEPTH:
            raise ValueError("nested too deeply")
        fields: Struct = {}
        field = 0
        while header := self._byte():
            kind = header & 0x0F
            field = field + (header >> 4) if header >> 4 else self._zigzag()
            fields[field] = kind == 1 if kind in (1, 2) else self._value(kind, depth)
        return fields

    def _value(self, kind: int, depth: int) -> Any:
        if kind in (1, 2, 3):
            return self._byte()
        if kind in (4, 5, 6):
            return self._zigzag()
        if kind == 7:
            return self._skip(8)
        if kind == _BINARY:
            return self._skip(self._varint())
        if kind in (_LIST, _SET):
            return self._items(depth)
        if kind == _STRUCT:
            return self.struct(depth + 1)
        raise ValueError(f"an unknown type {kind}")  # a map, too: Parquet has none

    def _items(self, depth: int) -> list[Any]:
        header = self._byte()
        count = header >> 4 if header >> 4 < 15 else self._varint()
        if count > len(self._data) - self.place:
            raise ValueError("a list that is longer than the file")
        return [self._value(header & 0x0F, depth + 1) for _ in range(count)]

    def _byte(self) -> int:
        if self.place >= len(self._data):
            raise ValueError("cut off")
        self.place += 1
        return self._data[self.place - 1]

    def _skip(self, count: int) -> None:
        if count > len(self._data) - self.place:
            raise ValueError("cut off")
        self.place += count

    def _varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise ValueError("a number of more than 64 bits")

    def _zigzag(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)
