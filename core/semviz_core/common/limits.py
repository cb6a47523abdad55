"""Read files of others within limits: their size, and what they unpack to, before they are decoded.

A file may be a pipe, a device or endless, and a few kB of it may unpack to gigabytes. What is
refused here raises SemvizError with the path, in one line.

A page of a few bytes in a Parquet file can repeat one value two thousand million times. pyarrow has
no limit for that, and ends the process where it asks for a damaged chunk's numbers, so the few
fields needed are read here, from Thrift's compact protocol (apache/parquet-format, parquet.thrift).
"""

import csv
import io
import json
import os
import re
import stat
import struct
import tomllib
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from pyarrow.parquet import ParquetFile


_MAGIC = b"PAR1"
_MOST_FOOTER_BYTES = 256 * 2**20
_MOST_DEPTH = 20
_HEADER_BYTES = 2**16
"""A page's header is shorter, unless its statistics are long."""
_MOST_HEADER_BYTES = 2**24
_BINARY, _LIST, _SET, _STRUCT = 8, 9, 10, 12
Struct = dict[int, Any]
"""Values by field id."""
Names = tuple[str, ...]


class Unpacked(NamedTuple):
    """What the pages of one column unpack to."""

    values: int
    bytes: int


def unpacked_columns(content: Path | bytes) -> list[Unpacked]:
    """Return what each column unpacks to. Raise ValueError if the file is damaged."""
    with io.BytesIO(content) if isinstance(content, bytes) else content.open("rb") as file:
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
        data, place, value = self._data, self.place, 0
        for shift, byte in zip(range(0, 70, 7), data[place : place + 10], strict=False):
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                self.place = place + shift // 7 + 1
                return value
        raise ValueError("a number of more than 64 bits, or cut off")

    def _zigzag(self) -> int:
        value = self._varint()
        return (value >> 1) ^ -(value & 1)


MOST_TEXT_BYTES = 64 * 2**20
MOST_SETTINGS_BYTES = 2**20
MOST_IMAGE_BYTES = 256 * 2**20
MOST_IMAGE_PIXELS = 2**26
"""About 8192 by 8192; decoded, that takes 200 MB."""
MOST_TENSOR_BYTES = 4 * 2**30
"""Of a file of weights, or of a backdrop."""
_MOST_KEY_PARTS, _TOML_KEY_END = 20, re.compile(r"[,={}\[\]\n]")
_JPEG_START, _PNG_START = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_PNG_DEPTH = 24
"""Where a PNG says its bits a channel."""
_JPEG_SIZES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Markers of segments that hold a JPEG's size (ITU-T T.81, table B.1)."""
_JPEG_BARE = {0x01, *range(0xD0, 0xD9)}
"""Markers without a segment."""


def check_file(path: Path, most_bytes: int) -> None:
    """Raise SemvizError if ``path`` is no ordinary file, or larger than ``most_bytes``."""
    os.close(_opened(path, most_bytes))


def read_limited(path: Path, most_bytes: int, count: int | None = None) -> bytes:
    """Return a file's content, or its first ``count`` bytes.

    Raise SemvizError if ``check_file`` does, or it cannot be read.
    """
    with os.fdopen(_opened(path, most_bytes), "rb") as file:
        try:
            content = file.read(most_bytes + 1 if count is None else count)
        except OSError as error:
            raise SemvizError(f"{path}: cannot be read ({error.strerror})") from None
    if len(content) > most_bytes:  # it has grown meanwhile
        raise _too_large(path, most_bytes)
    return content


def _opened(path: Path, most_bytes: int) -> int:
    """Return a descriptor; opening a pipe does not wait for its writer, and is refused."""
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except (OSError, ValueError) as error:  # ValueError: a NUL or a lone surrogate in the name
        why = getattr(error, "strerror", None) or "no name of a file"
        raise SemvizError(f"{shown(path)}: cannot be read ({why})") from None
    found = os.fstat(descriptor)
    if stat.S_ISREG(found.st_mode) and found.st_size <= most_bytes:
        return descriptor
    os.close(descriptor)
    if stat.S_ISREG(found.st_mode):
        raise _too_large(path, most_bytes)
    raise SemvizError(f"{path}: cannot be read (a folder or a device, not a file)")


def _too_large(path: Path, most_bytes: int) -> SemvizError:
    return SemvizError(
        f"{path}: more than {most_bytes / 2**20:g} MB; split the file, or make it smaller"
    )


def shown(path: object, most: int = 200) -> str:
    """Return a name from a file as one printable line, shortened if it is long."""
    text = str(path)
    printable = text if text.isprintable() else ascii(text)[1:-1]
    return printable if len(printable) <= most else f"{printable[:most]} ..."


def first_line(error: object, most: int = 200) -> str:
    """Return the first line of an error's text, printable and shortened."""
    return shown((str(error).splitlines() or [type(error).__name__])[0], most)


def unpacked(data: bytes, most_bytes: int) -> bytes:
    """Return what ``zlib.compress`` packed. Raise ValueError if it is damaged or larger."""
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(data, most_bytes)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if not unpacker.eof:
        raise ValueError(f"compressed data is cut off, or unpacks to more than {most_bytes} bytes")
    return content


def parsed_json(text: str | bytes) -> Any:
    """Return parsed JSON. Raise ValueError if it is invalid, or nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("JSON nested too deeply") from None


def table_rows(lines: Iterable[str], where: object, delimiter: str = ",") -> list[list[str]]:
    """Return the cells of the lines of a CSV table.

    Raise SemvizError, starting with ``where``, if a cell is too long: a quote is open, say.
    """
    try:
        return list(csv.reader(lines, delimiter=delimiter))
    except csv.Error as error:
        raise SemvizError(f"{where}: not a CSV table ({first_line(error)}); repair it") from None


@contextmanager
def parsing_xml() -> Iterator[None]:
    """Raise SemvizError, without the file's name, for what defusedxml or its parser refuses."""
    from xml.etree.ElementTree import ParseError

    from defusedxml.common import DefusedXmlException

    try:
        yield
    except DefusedXmlException:
        raise SemvizError("declares a document type or entities; such files are refused") from None
    except (ParseError, LookupError, ValueError) as error:
        raise SemvizError(f"not XML ({first_line(error)})") from None


def read_toml(path: Path) -> dict[str, Any]:
    """Return a file's TOML. Raise SemvizError if it is unreadable, or too large."""
    try:
        text = read_limited(path, MOST_SETTINGS_BYTES).decode("utf-8-sig")
        if any(part.count(".") > _MOST_KEY_PARTS for part in _TOML_KEY_END.split(text)):
            raise ValueError(f"a key of more than {_MOST_KEY_PARTS} parts")  # quadratic in tomllib
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise SemvizError(
            f"{path}: not readable as TOML ({first_line(error)}); repair it"
        ) from None


def image_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the header of a PNG or JPEG; None if it has no such header."""
    if data.startswith(_PNG_START):
        whole = len(data) >= 24 and data[12:16] == b"IHDR"
        return struct.unpack(">II", data[16:24]) if whole else None
    return _jpeg_size(data) if data.startswith(_JPEG_START) else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF or marker in _JPEG_BARE:  # filling, or a marker alone
            place += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack(">H", data[place + 2 : place + 4])
        if marker in _JPEG_SIZES:
            height, width = struct.unpack(">HH", data[place + 5 : place + 9])
            return width, height
        place += 2 + max(length, 2)
    return None


def check_image_size(data: bytes, where: object) -> tuple[int, int]:
    """Return width and height of a PNG or JPEG, from its header.

    Raise SemvizError, starting with ``where``, if it is neither, or too large to be decoded.
    """
    width, height = image_size(data) or (0, 0)
    if not width or not height or not _chunks_fit(data):
        raise SemvizError(f"{where}: not a readable PNG or JPEG image; copy it again")
    check_pixels(width, height, where)
    return width, height


def check_pixels(width: int, height: int, where: object) -> None:
    """Raise SemvizError, starting with ``where``, if an image of this size is too large."""
    if width * height > MOST_IMAGE_PIXELS:
        raise SemvizError(
            f"{where}: the image is {width}x{height}; up to {MOST_IMAGE_PIXELS} pixels are read"
        )


def _chunks_fit(data: bytes) -> bool:
    """Whether no chunk of a PNG states more bytes than there are: OpenCV would reserve them."""
    if not data.startswith(_PNG_START):
        return True
    place = len(_PNG_START)
    while place + 8 <= len(data):
        place += 12 + int(struct.unpack(">I", data[place : place + 4])[0])
    return place == len(data)


def decode_image(data: bytes, where: object, reduced: bool = False) -> ByteImage:
    """Return (height, width, 3) blue first, of a PNG or JPEG; at half the size if ``reduced``.

    Raise SemvizError if ``check_image_size`` does (nothing is decoded then), or it is damaged.
    """
    import cv2

    flags = cv2.IMREAD_REDUCED_COLOR_2 if reduced else cv2.IMREAD_COLOR
    return np.asarray(_decoded(data, where, flags), np.uint8)


def brightest_of_16_bits(data: bytes, where: object) -> int | None:
    """Return the largest value of an image with 16 bits a channel; None if it has 8."""
    import cv2

    if not data.startswith(_PNG_START) or data[_PNG_DEPTH] != 16:
        return None
    return int(_decoded(data, where, cv2.IMREAD_UNCHANGED).max())


def read_image(path: Path) -> ByteImage:
    """Return (height, width, 3), red first, of a PNG or JPEG file; see above."""
    return decode_image(read_limited(path, MOST_IMAGE_BYTES), path)[..., ::-1]


def read_mask(path: Path) -> NDArray[np.uint8 | np.uint16]:
    """Return (height, width) or (height, width, c) as stored, for example ids; see above."""
    import cv2

    data = read_limited(path, MOST_IMAGE_BYTES)
    return np.asarray(_decoded(data, path, cv2.IMREAD_UNCHANGED))


def _decoded(data: bytes, where: object, flags: int) -> Any:
    import cv2

    check_image_size(data, where)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise SemvizError(f"{where}: not a readable PNG or JPEG image; copy it again")
    return image


def open_parquet(
    content: Path | bytes, most_bytes: int, most_values: int, texts: Names = (), name: object = ""
) -> "ParquetFile":
    """Open a Parquet file, or its content, that takes at most ``most_bytes``, packed and unpacked.

    No column may have more than ``most_values`` values, which a few bytes can repeat. Texts at the
    paths ``texts`` are read without copies of repeated ones. Pages with a checksum are compared
    with it. Raise SemvizError for others, with ``name``, and pyarrow's errors for damaged ones.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if isinstance(content, Path):
        check_file(content, most_bytes)
    columns, name = unpacked_columns(content), name or content
    if sum(column.bytes for column in columns) > most_bytes:
        raise SemvizError(f"{name}: unpacks to more than {most_bytes // 2**20} MB; not read")
    if max((column.values for column in columns), default=0) > most_values:
        raise SemvizError(f"{name}: more than {most_values} values in a column; not read")
    source = pa.BufferReader(content) if isinstance(content, bytes) else content
    if texts:
        schema = pq.read_metadata(source).schema
        texts = tuple({schema.column(k).path for k in range(len(schema))}.intersection(texts))
    return pq.ParquetFile(source, read_dictionary=texts, page_checksum_verification=True)
