"""A map into another tool's format: a file or folder, whole or not at all."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, TypeAlias

from semviz_annotation.labels import Labels
from semviz_annotation.map_formats.colmap import write_colmap
from semviz_annotation.map_formats.csv_table import write_csv
from semviz_annotation.map_formats.geojson import write_geojson
from semviz_annotation.map_formats.georeference import Georeference
from semviz_annotation.map_formats.lanelet2_osm import write_lanelet2
from semviz_annotation.map_formats.mesh import write_mesh
from semviz_annotation.map_formats.tally import ExchangeReport
from semviz_annotation.map_formats.writing import counts
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.source import Source

FileFormat: TypeAlias = Literal["geojson", "lanelet2", "ply", "glb", "csv"]
_BY_ENDING: Mapping[str, FileFormat] = {
    ".geojson": "geojson",
    ".json": "geojson",
    ".osm": "lanelet2",
    ".ply": "ply",
    ".glb": "glb",
    ".csv": "csv",
}


def export_map(
    semantic_map: SemanticMap,
    path: Path,
    format_: FileFormat | None = None,
    anchor: Georeference | None = None,
) -> ExchangeReport:
    """Write a map to ``path``; ``format_`` None tells by its ending.

    ``anchor`` is where its origin is on Earth, where the map does not know, or is wrong. Raises
    SemvizError where it cannot be written; then nothing is.
    """
    _check(semantic_map)
    format_ = format_ or _format_of(path)
    if anchor is not None and format_ not in ("geojson", "lanelet2"):
        raise SemvizError(f"--anchor: {format_} is in the map's own metres")
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
    semantic_map: SemanticMap, labels: Labels, source: Source, path: Path
) -> ExchangeReport:
    """Write a map with the frames and labels it was built from, as the new folder ``path``."""
    _check(semantic_map)
    tally = write_colmap(semantic_map, labels, source, path)
    return ExchangeReport.of(path, "colmap", counts(semantic_map), tally)


def _check(semantic_map: SemanticMap) -> None:
    if not len(semantic_map):
        raise SemvizError("the map is empty; there is nothing to export")


def _format_of(path: Path) -> FileFormat:
    format_ = _BY_ENDING.get(path.suffix.lower())
    if format_ is None:
        raise SemvizError(f"{path}: no format has this ending; say which with --format")
    return format_
