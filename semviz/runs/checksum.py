"""Checksums of a run's rows: of its head, of each frame with its images, of its end."""

import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semviz.runs import run
from semviz_core.common.errors import SemvizError


class DamagedRowError(SemvizError):
    """A row is not as it was written."""


def row_checksum(
    entity: str,
    frame: int,
    row: Mapping[str, NDArray[Any] | str],
    images: Sequence[bytes | None] = (),
) -> int:
    """Return the CRC-32 of a row: its entity, frame number (0 without), components and images.

    Each part is preceded by its name, type and length, so that none can pass for another.
    """
    checksum = zlib.crc32(f"{entity} {frame}\n".encode())
    for name in sorted(row.keys() - {run.CHECKSUM}):
        value = row[name]
        content = value.encode() if isinstance(value, str) else np.ascontiguousarray(value).data
        kind = "text" if isinstance(value, str) else value.dtype.str
        checksum = zlib.crc32(f"{name} {kind} {len(content)}\n".encode(), checksum)
        checksum = zlib.crc32(content, checksum)
    for image in images:
        checksum = zlib.crc32(f"image {-1 if image is None else len(image)}\n".encode(), checksum)
        checksum = zlib.crc32(image or b"", checksum)
    return checksum


def verify_row(
    entity: str, frame: int, row: Mapping[str, Any], images: Sequence[bytes | None] = ()
) -> None:
    """Raise DamagedRowError if the row does not have the checksum that it was written with."""
    try:
        values = {name: value[0] if value.dtype == object else value for name, value in row.items()}
        (recorded,) = values[run.CHECKSUM].tolist()
        is_sound = recorded == row_checksum(entity, frame, values, images)
    except (KeyError, IndexError, ValueError, AttributeError):
        is_sound = False
    if not is_sound:
        raise DamagedRowError(f"{entity} of frame {frame} is not as it was written")
