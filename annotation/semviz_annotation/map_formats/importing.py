"""A map from another tool's file, into the map frame of a workspace: whole or not at all."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, TypeAlias

from semviz_annotation.formats.reading import at
from semviz_annotation.map_formats.csv_table import read_csv
from semviz_annotation.map_formats.geojson import read_geojson
from semviz_annotation.map_formats.lanelet2_osm import read_lanelet2
from semviz_annotation.map_formats.opendrive import read_opendrive
from semviz_annotation.map_formats.reading import Found, Reading, map_of
from semviz_annotation.map_formats.tally import ExchangeReport
from semviz_annotation.map_formats.writing import counts
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap

ImportFormat: TypeAlias = Literal["geojson", "lanelet2", "opendrive", "csv"]
_READERS: Mapping[ImportFormat, Callable[[Path, Reading], Found]] = {
    "geojson": read_geojson,
    "lanelet2": read_lanelet2,
    "opendrive": read_opendrive,
    "csv": read_csv,
}
_BY_ENDING: Mapping[str, ImportFormat] = {
    ".geojson": "geojson",
    ".json": "geojson",
    ".osm": "lanelet2",
    ".xodr": "opendrive",
    ".csv": "csv",
}


def import_map(
    path: Path, reading: Reading, format_: ImportFormat | None = None
) -> tuple[SemanticMap, ExchangeReport]:
    """The map that ``path`` holds, in the frame of ``reading``, and what became of the rest.

    ``format_`` None tells by the file's ending. Raises SemvizError, one line that names file and
    item, where it cannot be read, is of another frame, or holds nothing.
    """
    with at(path):
        format_ = format_ or _format_of(path)
        found = _READERS[format_](path, reading)
        semantic_map = map_of(found, reading, f"imported from {path.name} ({format_})")
    return semantic_map, ExchangeReport.of(path, format_, counts(semantic_map), found.tally)


def _format_of(path: Path) -> ImportFormat:
    format_ = _BY_ENDING.get(path.suffix.lower())
    if format_ is None:
        raise SemvizError("no format has this ending; say which with --format")
    return format_
