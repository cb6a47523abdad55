"""Import and export of maps in foreign formats, completely or not at all.

An imported map is in the map frame of the workspace.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, TypeAlias

from semviz_annotation.label_formats.reading import at
from semviz_annotation.labels.labels import Labels
from semviz_annotation.map_formats import geojson, lanelet2_osm
from semviz_annotation.map_formats.colmap import write_colmap
from semviz_annotation.map_formats.conversion import (
    ExchangeReport,
    MapImportContext,
    ParsedMap,
    counts,
    map_of,
)
from semviz_annotation.map_formats.csv_table import read_csv, write_csv
from semviz_annotation.map_formats.geojson import read_geojson, write_geojson
from semviz_annotation.map_formats.georeference import Georeference, require_georeference
from semviz_annotation.map_formats.lanelet2_osm import read_lanelet2, write_lanelet2
from semviz_annotation.map_formats.mesh import write_mesh
from semviz_annotation.map_formats.opendrive import read_opendrive
from semviz_core.base.frame import Dataset
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError

ImportFormat: TypeAlias = Literal["geojson", "lanelet2", "opendrive", "csv"]
_READERS: Mapping[ImportFormat, Callable[[Path, MapImportContext], ParsedMap]] = {
    "geojson": read_geojson,
    "lanelet2": read_lanelet2,
    "opendrive": read_opendrive,
    "csv": read_csv,
}
_IMPORT_FORMATS: Mapping[str, ImportFormat] = {
    ".geojson": "geojson",
    ".json": "geojson",
    ".osm": "lanelet2",
    ".xodr": "opendrive",
    ".csv": "csv",
}


def import_map(
    path: Path, context: MapImportContext, format_: ImportFormat | None = None
) -> tuple[SemanticMap, ExchangeReport]:
    """Return the map in ``path``, in the frame of ``context``, with a report of dropped content.

    ``format_`` None: by the file's extension. Raise SemvizError, naming file and item, if the file
    cannot be read, is of another frame, or holds no element.
    """
    with at(path):
        format_ = format_ or _import_format(path)
        parsed = _READERS[format_](path, context)
        semantic_map = map_of(parsed, context, f"imported from {path.name} ({format_})")
    return semantic_map, ExchangeReport.of(path, format_, counts(semantic_map), parsed.tally)


def _import_format(path: Path) -> ImportFormat:
    format_ = _IMPORT_FORMATS.get(path.suffix.lower())
    if format_ is None:
        raise SemvizError("no format has this ending; say which with --format")
    return format_


FileFormat: TypeAlias = Literal["geojson", "lanelet2", "ply", "glb", "csv"]
_EXPORT_FORMATS: Mapping[str, FileFormat] = {
    ".geojson": "geojson",
    ".json": "geojson",
    ".osm": "lanelet2",
    ".ply": "ply",
    ".glb": "glb",
    ".csv": "csv",
}


_NEEDS_PLACE = {"geojson": geojson.NEEDS_PLACE, "lanelet2": lanelet2_osm.NEEDS_PLACE}


def check_export(
    semantic_map: SemanticMap, path: Path, format_: FileFormat | None, anchor: Georeference | None
) -> FileFormat:
    """Return the format of an export. Raise SemvizError if the map cannot be written in it."""
    _check(semantic_map)
    format_ = format_ or _export_format(path)
    why = _NEEDS_PLACE.get(format_)
    if why is not None:
        require_georeference(anchor or Georeference.of(semantic_map.frame), why)
    elif anchor is not None:
        raise SemvizError(f"--anchor: {format_} is in the map's own metres")
    return format_


def export_map(
    semantic_map: SemanticMap,
    path: Path,
    format_: FileFormat | None = None,
    anchor: Georeference | None = None,
) -> ExchangeReport:
    """Write a map to ``path``; ``format_`` None: by the file's extension.

    ``anchor`` replaces the position of the map's origin on Earth. Raise SemvizError if the map
    cannot be written. Nothing is written then.
    """
    format_ = check_export(semantic_map, path, format_, anchor)
    place = anchor or Georeference.of(semantic_map.frame)
    match format_:
        case "geojson":
            tally = write_geojson(semantic_map, path, place)
        case "lanelet2":
            tally = write_lanelet2(semantic_map, path, place)
        case "csv":
            tally = write_csv(semantic_map, path)
        case "ply" | "glb":
            tally = write_mesh(semantic_map, path, format_)
    return ExchangeReport.of(path, format_, counts(semantic_map), tally)


def export_colmap(
    semantic_map: SemanticMap, labels: Labels, source: Dataset, path: Path
) -> ExchangeReport:
    """Write a map with its frames and labels as the new folder ``path``."""
    _check(semantic_map)
    tally = write_colmap(semantic_map, labels, source, path)
    return ExchangeReport.of(path, "colmap", counts(semantic_map), tally)


def _check(semantic_map: SemanticMap) -> None:
    if not len(semantic_map):
        raise SemvizError("the map is empty; there is nothing to export")


def _export_format(path: Path) -> FileFormat:
    format_ = _EXPORT_FORMATS.get(path.suffix.lower())
    if format_ is None:
        raise SemvizError(f"{path}: no format has this ending; say which with --format")
    return format_
