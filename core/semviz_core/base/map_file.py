"""Save and load a map as one Parquet file with one row per element.

A file is written completely or not at all. A checksum of all values is stored with them.
"""

import base64
import io
import json
import math
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semviz_core.base.classes import OLDER_CENTER, ClassSet, ElementClass, parse_triangle_center
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import Decision, MapFrame, Provenance, SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import first_line, open_parquet, parsed_json, shown, unpacked

if TYPE_CHECKING:
    import pyarrow as pa

FORMAT = "semviz-map"
VERSION, OLDER_VERSION = 3, 2
"""Maps whose triangles follow the box are written as version 2. Earlier versions of semviz, which
would take any triangle's middle for that of its box, refuse those of version 3."""
CHECKSUM = "crc32"
"""Key of the metadata; missing in maps of earlier versions of semviz, which are not checked."""
_VECTORS = {"anchor_m": 3, "end_m": 3, "covariance_m2": 36}
_PLACES = ["id", "class_id", "anchor_known", "end_known", *_VECTORS]
"""Columns that localization needs."""
_ORIGINS = {
    "label_ids": "label_ids.list.element",
    "observation_ids": "observation_ids.list.element",
    "attributes": "attributes.list.element",
}
"""Columns of texts, and their paths in the file."""
_WRITING: dict[str, Any] = {
    "compression": "zstd",
    "use_dictionary": list(_ORIGINS.values()),
    "write_statistics": False,
}
"""Numbers are hardly ever repeated, and nobody asks a map for its smallest ones."""
_ATTRIBUTES = "attributes"
"""Optional column: texts such as ``material=steel``; a name has no ``=``."""
_LOG_ODDS = "existence_log_odds"
"""Optional column: of elements from detections, null for others."""
MOST_BYTES = 2 * 2**30
MOST_VALUES = 36_000_000
"""Limits of one map: 1,000,000 elements, each with 36 numbers of covariance."""
MOST_DECISION_BYTES = 256 * 2**20
MOST_TEXT_CHARACTERS = 300
"""Of an id, and of an attribute with its value."""


def save_map(semantic_map: SemanticMap, path: Path | str) -> None:
    """Write ``path`` completely or not at all. Raise SemvizError if it cannot be written."""
    import pyarrow.parquet as pq

    table = _table(semantic_map)
    with replacing(Path(path)) as temporary:
        pq.write_table(table, temporary, **_WRITING)


def map_content(semantic_map: SemanticMap) -> bytes:
    """Return the content of the file of a map; the same for equal maps, and one pyarrow."""
    import pyarrow.parquet as pq

    content = io.BytesIO()
    pq.write_table(_table(semantic_map), content, **_WRITING)
    return content.getvalue()


def _table(semantic_map: SemanticMap) -> "pa.Table":
    """Return a map's rows, with all else as metadata."""
    import pyarrow as pa

    elements = semantic_map.elements
    columns: dict[str, Any] = {
        name: pa.array(getattr(elements, name)) for name in _PLACES if name not in _VECTORS
    }
    for name, width in _VECTORS.items():
        flat = np.ascontiguousarray(getattr(elements, name)).reshape(-1)
        columns[name] = pa.FixedSizeListArray.from_arrays(pa.array(flat), width)
    provenance = semantic_map.provenance or (Provenance(),) * len(elements)
    log_odds = [entry.log_odds for entry in provenance]
    if any(value is not None for value in log_odds):
        columns[_LOG_ODDS] = pa.array(log_odds, pa.float64())
    for name in ("label_ids", "observation_ids"):
        columns[name] = pa.array(
            [list(getattr(entry, name)) for entry in provenance], pa.list_(pa.string())
        )
    if semantic_map.attributes:
        texts = [
            [f"{name}={value}" for name, value in semantic_map.attributes.get(id_, {}).items()]
            for id_ in elements.id.tolist()
        ]
        columns[_ATTRIBUTES] = pa.array(texts, pa.list_(pa.string()))
    table, metadata = pa.table(columns), _metadata(semantic_map)
    text = json.dumps(metadata | {CHECKSUM: _checksum(table, metadata)})
    return table.replace_schema_metadata({FORMAT: text})


def load_map(path: Path | str) -> SemanticMap:
    """Read a map. Raise SemvizError if ``path`` is missing, damaged, not a map, or newer."""
    path = Path(path)
    if not path.is_file():
        raise SemvizError(f"{path}: no such map; make one with 'semviz map build'")
    return _parsed(path, path)


def parsed_map(content: bytes, name: str, *, origins: bool = True) -> SemanticMap:
    """Return the map in the content of a file called ``name``.

    Without ``origins``, it has no provenance and attributes, and its checksum is not compared: for
    content that is known to be right. Raise SemvizError as ``load_map`` does.
    """
    return _parsed(content, name, origins=origins)


def _parsed(content: Path | bytes, path: Path | str, *, origins: bool = True) -> SemanticMap:
    import pyarrow as pa

    try:
        texts = tuple(_ORIGINS.values()) if origins else ()
        file = open_parquet(content, MOST_BYTES, MOST_VALUES, texts, path)
        table = file.read() if origins else file.read(_PLACES, use_threads=False)
    except pa.ArrowInvalid as error:  # whole, but its columns are not those of a map
        raise SemvizError(f"{path}: broken map ({first_line(error)}); rebuild it") from None
    except (pa.ArrowException, OSError, ValueError) as error:
        cause = first_line(error)
        raise SemvizError(f"{path}: not a readable Parquet file ({cause}); rebuild it") from None
    raw = (table.schema.metadata or {}).get(FORMAT.encode())
    if raw is None:
        raise SemvizError(f"{path}: a Parquet file, but not a map of semviz")
    try:
        metadata = parsed_json(raw)
        version = int(metadata["version"])
        if version <= VERSION:
            semantic_map = _assemble(table, metadata, _provenance(table) if origins else ())
            if origins and metadata.pop(CHECKSUM, None) not in (None, _checksum(table, metadata)):
                raise SemvizError("it is not as it was written: its checksum differs")
            return semantic_map
    except SemvizError as error:
        raise SemvizError(f"{path}: broken map ({error}); rebuild it") from None
    except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
        raise SemvizError(f"{path}: broken map ({shown(repr(error))}); rebuild it") from None
    except pa.ArrowException as error:
        raise SemvizError(f"{path}: broken map ({first_line(error)}); rebuild it") from None
    newer = f"map version {version}, this semviz reads up to {VERSION}"
    raise SemvizError(f"{path}: {newer}; update semviz")


def _assemble(
    table: Any, metadata: dict[str, Any], provenance: tuple[Provenance, ...]
) -> SemanticMap:
    import pyarrow as pa

    def vectors(name: str) -> FloatArray:
        column = table[name].combine_chunks()
        if not pa.types.is_fixed_size_list(column.type):
            raise ValueError(f"{name} is a column of {column.type}")
        flat = column.flatten().to_numpy()
        array: FloatArray = np.asarray(flat).reshape(-1, _VECTORS[name])
        return array

    elements = Elements3D(
        id=table["id"].to_numpy(),
        anchor_m=vectors("anchor_m"),
        end_m=vectors("end_m"),
        class_id=table["class_id"].to_numpy(),
        covariance_m2=vectors("covariance_m2").reshape(-1, 6, 6),
        anchor_known=table["anchor_known"].to_numpy(),
        end_known=table["end_known"].to_numpy(),
    )
    frame = metadata["frame"]
    origin = tuple(frame["origin"]) if frame["origin"] else None
    return SemanticMap(
        elements=elements,
        frame=MapFrame(frame["name"], origin, frame.get("x_heading_deg", 90.0)),
        classes=ClassSet(tuple(ElementClass(**row) for row in metadata["classes"])),
        trajectory_m=_decode_points(metadata["trajectory_m"]),
        provenance=provenance,
        decisions=tuple(_decision(row) for row in _unpacked(metadata.get("decisions"))),
        made_by=str(metadata["made_by"]),
        settings=dict(metadata.get("settings", {})),
        operation=int(metadata["operation"]),
        triangle_center=parse_triangle_center(metadata.get("triangle_center")),
        attributes=_attributes(table),
    )


def _provenance(table: Any) -> tuple[Provenance, ...]:
    """Return what each element was made from; nothing if that is known of none."""
    lists = (_texts(table[name]) for name in ("label_ids", "observation_ids"))
    found = tuple(
        Provenance(tuple(labels), tuple(observations), odds)
        for labels, observations, odds in zip(*lists, _log_odds(table), strict=True)
    )
    return found if any(entry != Provenance() for entry in found) else ()


def _attributes(table: Any) -> dict[int, dict[str, str]]:
    """Return the attributes of each element that has any, by its id."""
    if _ATTRIBUTES not in table.column_names:
        return {}
    rows = zip(table["id"].to_pylist(), _texts(table[_ATTRIBUTES]), strict=True)
    return {id_: dict(text.split("=", 1) for text in texts) for id_, texts in rows if texts}


def _log_odds(table: Any) -> list[float | None]:
    """Return the log-odds of each element that has any."""
    if _LOG_ODDS not in table.column_names:
        return [None] * len(table)
    values: list[float | None] = table[_LOG_ODDS].to_pylist()
    if not all(value is None or math.isfinite(value) for value in values):
        raise ValueError(f"{_LOG_ODDS} that are not finite")
    return values


def _texts(column: Any) -> list[list[str]]:
    """Return the ids in a column of lists, which holds each of them once."""
    for chunk in column.chunks:
        ids = chunk.values.dictionary if hasattr(chunk.values, "dictionary") else chunk.values
        if any(len(text) > MOST_TEXT_CHARACTERS for text in ids.to_pylist() if text):
            raise ValueError(f"a text of more than {MOST_TEXT_CHARACTERS} characters")
    lists: list[list[str]] = column.to_pylist()
    return lists


def _metadata(semantic_map: SemanticMap) -> dict[str, Any]:
    center = semantic_map.triangle_center
    return {
        "format": FORMAT,
        "version": OLDER_VERSION if center == OLDER_CENTER else VERSION,
        "units": "m, z up, right-handed",
        "frame": asdict(semantic_map.frame),
        "classes": [asdict(class_) for class_ in semantic_map.classes],
        "trajectory_m": _encode_points(semantic_map.trajectory_m),
        "decisions": _packed([asdict(decision) for decision in semantic_map.decisions]),
        "made_by": semantic_map.made_by,
        "settings": dict(semantic_map.settings),
        "operation": semantic_map.operation,
        "triangle_center": center,
    }


def _checksum(table: Any, metadata: dict[str, Any]) -> int:
    """Return the CRC-32 of the metadata as sorted JSON, then of each column by its name."""
    import pyarrow as pa

    # What the file holds is JSON, so equal values may differ before: tuples, numbers as keys.
    plain = json.loads(json.dumps(metadata))
    checksum = zlib.crc32(json.dumps(plain, sort_keys=True).encode())
    for name in sorted(table.column_names):
        column = table[name].combine_chunks()
        if pa.types.is_fixed_size_list(column.type):
            column = column.flatten()
        if pa.types.is_list(column.type):
            content = json.dumps(column.to_pylist()).encode()
        else:
            content = np.ascontiguousarray(column.to_numpy(zero_copy_only=False)).tobytes()
        checksum = zlib.crc32(f"{name} {len(content)}\n".encode(), checksum)
        checksum = zlib.crc32(content, checksum)
    return checksum


def _decision(data: dict[str, Any]) -> Decision:
    lists = {name: tuple(value) for name, value in data.items() if isinstance(value, list)}
    return Decision(**(data | lists))


def _packed(rows: list[dict[str, Any]]) -> str:
    """Return compressed JSON, since Parquet does not compress its metadata."""
    return base64.b64encode(zlib.compress(json.dumps(rows).encode())).decode()


def _unpacked(text: str | None) -> list[dict[str, Any]]:
    """Return the rows of ``_packed``; none for a map of version 1."""
    if text is None:
        return []
    packed = base64.b64decode(text, validate=True)
    rows: list[dict[str, Any]] = parsed_json(unpacked(packed, MOST_DECISION_BYTES))
    return rows


def _encode_points(points: FloatArray) -> str:
    return base64.b64encode(np.ascontiguousarray(points, dtype="<f8").tobytes()).decode()


def _decode_points(text: str) -> FloatArray:
    return np.frombuffer(base64.b64decode(text, validate=True), dtype="<f8").reshape(-1, 3)
