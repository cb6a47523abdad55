"""What is checked of a bag before rosbags opens it, and how much rosbags may unpack at once.

rosbags unpacks each chunk whole, whatever size it states, and a file of zeros packs a thousandfold.
"""

import shutil
import sqlite3
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pyarrow as pa

from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import MOST_IMAGE_BYTES, MOST_SETTINGS_BYTES, check_file

MOST_CHUNK_BYTES = MOST_IMAGE_BYTES + 64 * 2**20
"""An image, and what else its chunk holds."""
_PIECE_BYTES = 2**22


class UnpackingError(SemvizError):
    """A part of a bag unpacks to too much."""


def check_bag_files(path: Path) -> None:
    """Raise SemvizError if a file of a bag is none, is a database of programs, or unpacks to more
    than the disk for temporary files holds."""
    check_file(path / "metadata.yaml" if path.is_dir() else path, sys.maxsize)
    folder = path.parent if path.suffix == ".db3" else path
    if folder.is_dir():
        metadata = folder / "metadata.yaml"
        if metadata.exists():
            check_file(metadata, 4 * MOST_SETTINGS_BYTES)
        for file in sorted(folder.iterdir()):
            if file.suffix in (".db3", ".mcap", ".zstd"):
                check_file(file, sys.maxsize)
            if file.suffix == ".db3":
                _check_tables(file)
            elif file.suffix == ".zstd":
                _check_unpacked(file)


def limit_unpacking() -> None:
    """Give rosbags functions that stop: its own ones have no limit."""
    from rosbags.rosbag1 import reader as bags1
    from rosbags.rosbag2 import reader as bags2
    from rosbags.rosbag2 import storage_mcap

    bags1.decompressors.update({name: _unpack(name) for name in ("bz2", "lz4")})
    storage_mcap.DECOMPRESSORS.update({name: _unpack(name) for name in ("lz4", "zstd")})
    theirs = vars(bags2)["zstd"]
    vars(bags2)["zstd"] = SimpleNamespace(decompress=_unpack("zstd"), open=theirs.open)


def _unpack(codec: str) -> Callable[..., bytes]:
    def unpack(data: bytes, size: int = MOST_CHUNK_BYTES) -> bytes:
        most, total, pieces = min(size, MOST_CHUNK_BYTES), 0, []
        try:
            with pa.CompressedInputStream(pa.py_buffer(data), codec) as stream:
                while piece := stream.read(_PIECE_BYTES):
                    pieces.append(piece)
                    total += len(piece)
                    if total > most:
                        raise UnpackingError(f"a chunk unpacks to more than {most} bytes")
        except OSError as error:  # of Arrow; no file is read here
            raise ValueError(str(error)) from None
        return b"".join(pieces)

    return unpack


def _check_unpacked(file: Path) -> None:
    """Raise SemvizError if a file needs more room than there is: rosbags unpacks it to the disk."""
    room = shutil.disk_usage(tempfile.gettempdir()).free - MOST_CHUNK_BYTES
    try:
        with pa.CompressedInputStream(pa.OSFile(str(file)), "zstd") as stream:
            while piece := stream.read(_PIECE_BYTES):
                room -= len(piece)
                if room < 0:
                    raise SemvizError(
                        f"{file}: unpacks to more than {tempfile.gettempdir()} has room for; set "
                        "TMPDIR to a larger disk"
                    )
    except (OSError, ValueError) as error:
        raise SemvizError(f"{file}: cannot be unpacked ({error})") from None


def _check_tables(file: Path) -> None:
    """Raise SemvizError if a database has a view or trigger: a query of them may never end."""
    try:
        with sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro&immutable=1", uri=True) as opened:
            rows = opened.execute(
                "SELECT name FROM sqlite_master WHERE type IN ('view', 'trigger')"
                " OR sql LIKE 'create virtual%'"
            ).fetchall()
        opened.close()
    except sqlite3.Error:
        return  # rosbags says what is wrong with it
    if rows:
        raise SemvizError(f"{file}: a database with a view or trigger, which no bag has; not read")
