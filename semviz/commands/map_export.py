"""semviz map export"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from tyro.conf import Positional, arg

from semviz.commands.parsing import OptionalFloat, OptionalText, parse_anchor
from semviz_core.errors import SemvizError

ExportFormat: TypeAlias = Annotated[
    Literal["geojson", "lanelet2", "colmap", "ply", "glb", "csv"] | None,
    arg(metavar="{geojson,lanelet2,colmap,ply,glb,csv}", help_behavior_hint=""),
]


@dataclass(frozen=True)
class MapExport:
    """Write a map for other tools, and say what their format cannot hold."""

    workspace: Positional[Path]
    """The workspace."""
    file: Positional[Path]
    """The file to write; for colmap a new folder."""
    map: str = "main"
    """Name of the map."""
    format: ExportFormat = None
    """Unless given, the file's ending tells: .geojson, .osm (lanelet2), .ply, .glb, .csv."""
    anchor: OptionalText = None
    """LATITUDE,LONGITUDE[,HEIGHT] of the map's origin (WGS84): for geojson and lanelet2."""
    anchor_heading: OptionalFloat = None
    """Compass direction of the map's x axis at the anchor; 90 (east) unless given."""
    json: bool = False
    """Print one JSON object instead of lines: counts, what was dropped, what was assumed."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.map_formats.exporting import export_colmap, export_map

        anchor = parse_anchor(self.anchor, self.anchor_heading)
        workspace = Workspace.open(self.workspace)
        semantic_map = workspace.read_map(self.map)
        if self.format == "colmap":
            if anchor is not None:
                raise SemvizError("--anchor: a model of COLMAP is in the map's own metres")
            labels = workspace.read_labels()
            report = export_colmap(semantic_map, labels, workspace.source, self.file)
        else:
            report = export_map(semantic_map, self.file, self.format, anchor)
        print(json.dumps(report.as_dict()) if self.json else report.as_text())
        return 0
