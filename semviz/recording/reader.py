"""Reading runs back from .rrd files."""

import json
import subprocess
import sys
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from semviz.recording import layout
from semviz.recording.codec import Pools, decode
from semviz.recording.columns import FRAME
from semviz.recording.run import FrameRecord, Run, RunInfo
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap

_MAGIC = b"RRF"
_REPAIR_LIMIT_S = 600


def load_run(path: Path | str) -> Run:
    """Read a run; of an interrupted or cut one, every frame that is whole.

    Raises SemvizError where ``path`` is missing, no .rrd file, no run of semviz, newer, or broken.
    """
    path = Path(path)
    check_run_file(path)
    try:
        rows = _read_rows(path)
    except RuntimeError:  # rerun refuses a file that ends within a message
        rows = _read_repaired(path)
    return _assemble(path, rows)


def check_run_file(path: Path) -> None:
    """A first look, nothing decoded: SemvizError where ``path`` is missing or no .rrd file."""
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
"""A frame number (0 for static data) and the components logged there."""


def _read_rows(path: Path) -> dict[str, list[Row]]:
    """All rows of the entities that we read, by entity."""
    from rerun.chunk import RrdReader

    rows: dict[str, list[Row]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of runs without a footer: the interrupted ones
        reader = RrdReader(path)
        if not reader.recordings():
            return rows
        wanted = [f"+ {layout.EXACT}/**", f"+ {layout.IMAGE}", f"+ {layout.IMAGE_RIGHT}"]
        for chunk in reader.stream().filter(content=wanted):
            rows.setdefault(chunk.entity_path, []).extend(_rows(chunk.to_record_batch()))
    return rows


def _read_repaired(path: Path) -> dict[str, list[Row]]:
    """The rows before the place where the file is cut, by rerun's own repair."""
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder, "whole.rrd")
        repair = ["rrd", "merge", "--continue-on-error", str(path), "-o", str(whole)]
        done = subprocess.run(
            [sys.executable, "-m", "rerun_cli", *repair],
            capture_output=True,
            timeout=_REPAIR_LIMIT_S,
        )
        if done.returncode or not whole.is_file():
            raise SemvizError(f"{path}: broken, and rerun cannot repair it; localize again")
        return _read_rows(whole)


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


def _assemble(path: Path, rows: dict[str, list[Row]]) -> Run:
    if layout.INFO not in rows:
        raise SemvizError(f"{path}: a recording of rerun, but not a run of semviz")
    (_, info), *_ = rows[layout.INFO]
    try:
        version = int(info["version"][0])
    except (KeyError, IndexError, ValueError):
        raise SemvizError(f"{path}: a recording of rerun, but not a run of semviz") from None
    if version > layout.FORMAT_VERSION:
        raise SemvizError(
            f"{path}: run version {version}, this semviz reads up to {layout.FORMAT_VERSION}; "
            "update semviz"
        )
    try:
        left, right = (_images(rows.get(one, [])) for one in (layout.IMAGE, layout.IMAGE_RIGHT))
        ordered = sorted(rows.get(layout.FRAME, []), key=lambda one: one[0])
        return Run(
            info=_decode(RunInfo, info),
            semantic_map=_decode(SemanticMap, rows[layout.MAP][0][1]),
            frames=tuple(
                replace(
                    _decode(FrameRecord, row), image=left.get(frame), image_right=right.get(frame)
                )
                for frame, row in ordered
            ),
            complete=layout.END in rows,
        )
    except (KeyError, IndexError, ValueError, TypeError, SemvizError) as error:
        raise SemvizError(f"{path}: broken run ({error!r}); localize again") from None


def _decode(kind: Any, row: Pools) -> Any:
    return decode(kind, json.loads(row[layout.STRUCTURE][0]), row)


def _images(rows: list[Row]) -> dict[int, bytes]:
    """By frame number. A blob is one list of bytes; none where the frame has no image."""
    blobs = ((frame, row.get("EncodedImage:blob", ())) for frame, row in rows)
    return {frame: np.asarray(one).tobytes() for frame, blob in blobs for one in blob}
