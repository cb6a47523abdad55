"""semviz map import"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from tyro.conf import Positional, UseAppendAction, arg

from semviz.commands.parsing import OptionalFloat, OptionalText, parse_anchor
from semviz_core.errors import SemvizError

ImportFormat: TypeAlias = Annotated[
    Literal["geojson", "lanelet2", "opendrive", "csv"] | None,
    arg(metavar="{geojson,lanelet2,opendrive,csv}", help_behavior_hint=""),
]


@dataclass(frozen=True)
class MapImport:
    """Make a map of a workspace from a file of another tool."""

    workspace: Positional[Path]
    """The workspace; the map will be in the frame of its poses."""
    file: Positional[Path]
    """The file to read."""
    name: OptionalText = None
    """Name of the map in the workspace; the file's name without its ending unless given."""
    format: ImportFormat = None
    """Unless given, the file's ending tells: .geojson, .osm (lanelet2), .xodr (opendrive), .csv."""
    class_map: UseAppendAction[tuple[str, ...]] = ()
    """NAME=CLASS: what the file calls NAME is CLASS here, or 'ignore'; give it once a name."""
    anchor: OptionalText = None
    """LATITUDE,LONGITUDE[,HEIGHT] of the map's origin (WGS84), where the file does not say it."""
    anchor_heading: OptionalFloat = None
    """Compass direction of the map's x axis at the anchor; 90 (east) unless given."""
    replace: bool = False
    """Take the place of a map of this name."""
    json: bool = False
    """Print one JSON object instead of lines: counts, what was dropped, what was assumed."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.formats.reading import parse_class_map
        from semviz_annotation.map_formats.importing import import_map
        from semviz_annotation.map_formats.reading import Reading
        from semviz_core.map_file import save_map

        anchor = parse_anchor(self.anchor, self.anchor_heading)
        class_map = parse_class_map(self.class_map)
        workspace = Workspace.open(self.workspace)
        path = workspace.map_path(self.file.stem if self.name is None else self.name)
        if path.exists() and not self.replace:
            raise SemvizError(f"{path}: is there already; choose another --name, or say --replace")
        frame = workspace.source.map_frame
        reading = Reading(frame, workspace.classes, class_map, anchor)
        semantic_map, report = import_map(self.file, reading, self.format)
        save_map(semantic_map, path)
        if self.json:
            print(json.dumps(report.as_dict() | {"map": str(path)}))
        else:
            print(report.as_text())
            print(f"{path}: {len(semantic_map)} elements in the frame {frame.name}")
        return 0
