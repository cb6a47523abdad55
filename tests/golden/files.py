"""Fixtures, and what files of each kind hold, as text that does not change with time or version."""

import gzip
import json
import re
from pathlib import Path
from typing import Any

from golden.canonical import digest, numbered_ids, plain, sha
from semviz import load_run

FIXTURES = Path(__file__).parent / "fixtures"
EXPECTED = Path(__file__).parent / "expected"

_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d(:\d\d(\.\d+)?)?(Z|\+00:00)?")
_VERSION = re.compile(r"(semviz[ -])\d+\.\d+\.\d+\S*")


def unpacked(fixture: Path, folder: Path) -> Path:
    """A fixture, unzipped into ``folder`` under its name without .gz."""
    path = folder / fixture.name.removesuffix(".gz")
    path.write_bytes(gzip.decompress(fixture.read_bytes()))
    return path


def masked(text: str, *, ids: bool = True) -> str:
    """Without times and versions and, with ``ids``, without what ids are called."""
    timeless = _VERSION.sub(r"\1<version>", _TIME.sub("<time>", text))
    return numbered_ids(timeless) if ids else timeless


def run_content(path: Path) -> dict[str, str]:
    """Hashes of a run file: what it says of itself, its map, each frame."""
    run = load_run(path)
    info = plain(run.info)
    if weights := info["options"].get("weights"):
        info["options"]["weights"] = Path(weights).name  # in a folder that is gone afterwards
    return {
        "info": digest(info | {"name": "", "workspace": ""}),
        "map": digest(run.semantic_map),
        "complete": str(run.complete),
        **{f"frame {frame.frame.index}": _frame(frame) for frame in run.frames},
    }


def _frame(record: Any) -> str:
    """Without the sentence of the reason, which is for people."""
    content = plain(record)
    content["localization"].pop("reason")
    return sha(json.dumps(content, sort_keys=True))


VARYING = ("made_by", "crc32")
"""Keys of a map's metadata that differ with the version: the checksum is of ``made_by`` too."""


def table_content(path: Path) -> dict[str, Any]:
    """A Parquet file: its columns with their types, compression and values; its metadata.

    Bytes hold the version of the library that wrote them. Of a map's metadata, VARYING is left
    out.
    """
    import pyarrow.parquet as pq

    file = pq.ParquetFile(path)
    table = file.read()
    compression = {file.metadata.row_group(0).column(0).compression} if table.num_rows else set()
    metadata = {}
    for key, text in (table.schema.metadata or {}).items():
        value = json.loads(text) if text.startswith(b"{") else text.decode()
        if isinstance(value, dict):
            value = {name: entry for name, entry in value.items() if name not in VARYING}
        metadata[key.decode()] = digest(value)
    return {
        "rows": table.num_rows,
        "compression": sorted(compression),
        **{
            f"{field.name}: {field.type}": digest(table[field.name].to_pylist())
            for field in table.schema
        },
        **{f"metadata {name}": value for name, value in metadata.items()},
    }
