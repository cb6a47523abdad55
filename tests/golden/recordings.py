"""G2: runs of every version of the file format read back, and one written again."""

from pathlib import Path
from typing import Any

from golden.canonical import digest
from golden.files import FIXTURES, run_content, unpacked
from semviz import load_run
from semviz.runs.run import TABLE
from semviz.runs.writer import RunWriter

VERSION_2 = Path(__file__).parents[1] / "app" / "data" / "run-version-2.rrd.gz"


def golden_values(folder: Path) -> dict[str, Any]:
    """Return the content of each file, and of a copy of the newest by the present writer."""
    paths = {
        1: unpacked(FIXTURES / "run-version-1.rrd.gz", folder),
        2: unpacked(VERSION_2, folder),
        3: unpacked(FIXTURES / "run-version-3.rrd.gz", folder),
    }
    read = {f"version {number}": run_content(path) for number, path in paths.items()}
    again = _written_again(paths[3], folder / "again.rrd")
    return read | {
        "version 3, written again": run_content(again),
        "version 3, stored": stored(paths[3]),
        "version 3, written again, stored": stored(again),
    }


def _written_again(path: Path, again: Path) -> Path:
    run = load_run(path)
    with RunWriter(again, run.info, run.semantic_map) as writer:
        for record in run.frames:
            writer.write(record)
    return again


def stored(path: Path) -> dict[str, list[str]]:
    """Return hashes of column names and types, and of values, by rerun's entity.

    The layout of views, and ids and times that rerun writes itself, are left out; so are the places
    of frames in the file, which depend on how well these ids compress.
    """
    from rerun.chunk import RrdReader

    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for column, field in zip(batch.columns, batch.schema, strict=True):
            if field.name in ("log_time", "log_tick") or "RowId" in field.name:
                continue
            if chunk.entity_path == TABLE and field.name not in ("float64", "bool"):
                continue
            values = column.to_pylist()
            column_of = (field.name, str(field.type)), repr(values)
            found.setdefault(chunk.entity_path, []).append(column_of)
    return {
        entity: [digest(sorted({name for name, _ in rows})), digest(sorted(rows))]
        for entity, rows in sorted(found.items())
    }
