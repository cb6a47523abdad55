"""Maps on disk: one Parquet file, one row an element."""

import base64
import json
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.classes import ClassSet, ElementClass
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError
from semviz_core.files import replacing
from semviz_core.semantic_map import Decision, MapFrame, Provenance, SemanticMap

FORMAT = "semviz-map"
VERSION = 2
_VECTORS = {"anchor_m": 3, "end_m": 3, "covariance_m2": 36}


def save_map(semantic_map: SemanticMap, path: Path | str) -> None:
    """Write ``path`` whole or not at all."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    elements = semantic_map.elements
    columns: dict[str, Any] = {
        name: pa.array(getattr(elements, name))
        for name in ("id", "class_id", "anchor_known", "end_known")
    }
    for name, width in _VECTORS.items():
        flat = np.ascontiguousarray(getattr(elements, name)).reshape(-1)
        columns[name] = pa.FixedSizeListArray.from_arrays(pa.array(flat), width)
    provenance = semantic_map.provenance or (Provenance(),) * len(elements)
    for name in ("label_ids", "observation_ids"):
        columns[name] = pa.array(
            [list(getattr(one, name)) for one in provenance], pa.list_(pa.string())
        )
    table = pa.table(columns).replace_schema_metadata({FORMAT: _metadata(semantic_map)})
    with replacing(Path(path)) as temporary:
        pq.write_table(table, temporary, compression="zstd")


def load_map(path: Path | str) -> SemanticMap:
    """Read a map; SemvizError where ``path`` is missing, broken, foreign or newer."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = Path(path)
    if not path.is_file():
        raise SemvizError(f"{path}: no such map; make one with 'semviz map build'")
    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        why = str(error).splitlines()[0]
        raise SemvizError(f"{path}: not a readable Parquet file ({why}); rebuild it") from None
    raw = (table.schema.metadata or {}).get(FORMAT.encode())
    if raw is None:
        raise SemvizError(f"{path}: a Parquet file, but not a map of semviz")
    try:
        metadata = json.loads(raw)
        version = int(metadata["version"])
        if version <= VERSION:
            return _assemble(table, metadata)
    except SemvizError as error:
        raise SemvizError(f"{path}: broken map ({error}); rebuild it") from None
    except (KeyError, ValueError, TypeError, OverflowError, RecursionError, zlib.error) as error:
        raise SemvizError(f"{path}: broken map ({error!r}); rebuild it") from None
    newer = f"map version {version}, this semviz reads up to {VERSION}"
    raise SemvizError(f"{path}: {newer}; update semviz")


def _assemble(table: Any, metadata: dict[str, Any]) -> SemanticMap:
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
    provenance = tuple(
        Provenance(tuple(labels), tuple(observations))
        for labels, observations in zip(
            table["label_ids"].to_pylist(), table["observation_ids"].to_pylist(), strict=True
        )
    )
    frame = metadata["frame"]
    origin = tuple(frame["origin"]) if frame["origin"] else None
    return SemanticMap(
        elements=elements,
        frame=MapFrame(frame["name"], origin, frame.get("x_heading_deg", 90.0)),
        classes=ClassSet(tuple(ElementClass(**one) for one in metadata["classes"])),
        trajectory_m=_decode_points(metadata["trajectory_m"]),
        provenance=provenance if any(one.label_ids for one in provenance) else (),
        decisions=tuple(_decision(one) for one in _unpacked(metadata.get("decisions"))),
        made_by=str(metadata["made_by"]),
        settings=dict(metadata.get("settings", {})),
        operation=int(metadata["operation"]),
    )


def _metadata(semantic_map: SemanticMap) -> str:
    return json.dumps(
        {
            "format": FORMAT,
            "version": VERSION,
            "units": "m, z up, right-handed",
            "frame": asdict(semantic_map.frame),
            "classes": [asdict(one) for one in semantic_map.classes],
            "trajectory_m": _encode_points(semantic_map.trajectory_m),
            "decisions": _packed([asdict(one) for one in semantic_map.decisions]),
            "made_by": semantic_map.made_by,
            "settings": dict(semantic_map.settings),
            "operation": semantic_map.operation,
        }
    )


def _decision(data: dict[str, Any]) -> Decision:
    lists = {name: tuple(value) for name, value in data.items() if isinstance(value, list)}
    return Decision(**(data | lists))


def _packed(rows: list[dict[str, Any]]) -> str:
    """As JSON, made small: Parquet does not compress its metadata."""
    return base64.b64encode(zlib.compress(json.dumps(rows).encode())).decode()


def _unpacked(text: str | None) -> list[dict[str, Any]]:
    """What was packed; nothing where the map is of version 1."""
    if text is None:
        return []
    rows: list[dict[str, Any]] = json.loads(zlib.decompress(base64.b64decode(text, validate=True)))
    return rows


def _encode_points(points: FloatArray) -> str:
    return base64.b64encode(np.ascontiguousarray(points, dtype="<f8").tobytes()).decode()


def _decode_points(text: str) -> FloatArray:
    return np.frombuffer(base64.b64decode(text, validate=True), dtype="<f8").reshape(-1, 3)
