"""The commands map export and map import: other tools' files, and where a map is on Earth."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from tyro.conf import Positional, UseAppendAction, arg

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

ExportFormat: TypeAlias = Annotated[
    Literal["geojson", "lanelet2", "colmap", "ply", "glb", "csv"] | None,
    arg(metavar="{geojson,lanelet2,colmap,ply,glb,csv}", help_behavior_hint=""),
]


_MARKS = {
    "geojson": (b'{"type": "FeatureCollection", "semviz": {',),
    "lanelet2": (b'<osm version="0.6" generator="semviz"',),
    "ply": (b"ply\n", b"comment semviz\n"),
    "glb": (b"glTF", b'"generator":"semviz"'),
    "csv": (b"id,class,frame,anchor_x_m,anchor_y_m,anchor_z_m,end_x_m,",),
}
"""What the start of an exported map contains, in this order, by format."""


@dataclass(frozen=True)
class MapExportCommand:
    """Export a map for other tools, and list the losses of the format.

    Example: 'semviz map export town town.geojson --anchor 49.01,8.42,115'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    file: Positional[Path]
    """File to write; for colmap a new folder."""
    map: str = "main"
    """Name of the map."""
    format: ExportFormat = None
    """Default by ending: .geojson, .osm (lanelet2), .ply, .glb, .csv."""
    anchor: parsing.OptionalText = None
    """LATITUDE,LONGITUDE[,HEIGHT] of the map's origin (WGS84), for geojson and lanelet2; default:
    that of the map or the workspace."""
    anchor_heading: parsing.OptionalFloat = None
    """Compass direction of the map's x axis at the anchor, in degrees; default: 90 (east)."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object instead of lines: counts, dropped items, assumed values."""

    def run(self) -> int:
        from semviz.workspace import outputs
        from semviz_annotation.map_formats.exchange import check_export, export_colmap, export_map

        anchor = parsing.parse_anchor(self.anchor, self.anchor_heading)
        workspace = parsing.open_workspace(self.workspace)
        semantic_map = workspace.read_map(self.map)
        if self.format == "colmap":
            outputs.check_new_folder(self.file, [self.workspace])
            if anchor is not None:
                raise SemvizError("--anchor: colmap models keep the map frame; leave it out")
            labels = workspace.read_labels()
            report = export_colmap(semantic_map, labels, workspace.source, self.file)
        else:
            form = check_export(semantic_map, self.file, self.format, anchor)
            ours = outputs.contains(*_MARKS[form])
            outputs.check_outputs(self.file, ours, force=self.force, reads=[self.workspace])
            report = export_map(semantic_map, self.file, form, anchor)
        print(json.dumps(report.as_dict()) if self.json else report.as_text())
        return 0


ImportFormat: TypeAlias = Annotated[
    Literal["geojson", "lanelet2", "opendrive", "csv"] | None,
    arg(metavar="{geojson,lanelet2,opendrive,csv}", help_behavior_hint=""),
]


@dataclass(frozen=True)
class MapImportCommand:
    """Import a map from a file of another tool.

    Examples: 'semviz map import town town.xodr --anchor 49.01,8.42'; 'semviz map import town
    lamps.geojson --all-of-class pole --pole-height 6'."""

    workspace: Positional[Path]
    """Workspace; the map will be in the map frame of its poses."""
    file: Positional[Path]
    """File to read."""
    name: parsing.OptionalText = None
    """Name of the map in the workspace; default: the file's name without its ending."""
    format: ImportFormat = None
    """Default by ending: .geojson, .osm (lanelet2), .xodr (opendrive), .csv."""
    class_map: UseAppendAction[tuple[str, ...]] = ()
    """NAME=CLASS: class for a name in the file, or 'ignore'; one option per name."""
    class_property: parsing.OptionalText = None
    """Property of GeoJSON that says what a feature is; default: 'class', or the tags of
    OpenStreetMap."""
    all_of_class: parsing.OptionalText = None
    """The class of everything in a file of GeoJSON, for example of a city's street lamps."""
    height_property: parsing.OptionalText = None
    """Property of GeoJSON with the height of poles; default: 'height'."""
    pole_height: parsing.OptionalFloat = None
    """Height (m) of poles that are points without one; default: they are left out."""
    sign_height: parsing.OptionalFloat = None
    """Height (m) of signs' middles above points of GeoJSON or OpenStreetMap; default: 0."""
    anchor: parsing.OptionalText = None
    """LATITUDE,LONGITUDE[,HEIGHT] of the map's origin (WGS84), if neither the file nor the
    workspace has it. The workspace keeps it."""
    anchor_heading: parsing.OptionalFloat = None
    """Compass direction of the map's x axis at the anchor, in degrees; default: 90 (east)."""
    replace: bool = False
    """Replace an existing map of this name."""
    json: bool = False
    """Print one JSON object instead of lines: counts, dropped items, assumed values."""

    def run(self) -> int:
        from semviz.workspace.outputs import PARQUET, check_outputs
        from semviz_annotation.label_formats.reading import parse_class_map
        from semviz_annotation.map_formats.conversion import MapImportContext
        from semviz_annotation.map_formats.exchange import import_map
        from semviz_core.base.map_file import save_map

        anchor = parsing.parse_anchor(self.anchor, self.anchor_heading)
        class_map = parse_class_map(self.class_map)
        workspace = parsing.open_workspace(self.workspace)
        path = workspace.map_path(self.file.stem if self.name is None else self.name)
        if path.exists() and not self.replace:
            raise SemvizError(f"{path}: exists already; choose another --name or use --replace")
        check_outputs(path, PARQUET, can_force=False, reads=[self.file], purpose="map")
        frame = workspace.map_frame
        heights = {"--pole-height": self.pole_height, "--sign-height": self.sign_height}
        for option, height in heights.items():
            if height is not None and not 0.0 < height < 1000.0:
                raise SemvizError(f"{option} {height:g}: give metres above 0")
        context = MapImportContext(
            frame,
            workspace.classes,
            class_map,
            anchor,
            self.class_property,
            self.all_of_class,
            self.height_property,
            self.pole_height,
            self.sign_height,
        )
        semantic_map, report = import_map(self.file, context, self.format)
        save_map(semantic_map, path)
        is_new_place = workspace.keep_georeference(semantic_map.frame)
        if self.json:
            print(json.dumps(report.as_dict() | {"map": str(path)}))
        else:
            print(report.as_text())
            print(f"{path}: {len(semantic_map)} elements in the frame {frame.name}")
            if is_new_place:
                print(f"{workspace.path}: keeps where its origin is on Earth, for exports")
        return 0
