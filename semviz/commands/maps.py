"""semviz map build, semviz map check"""

import json
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from semviz.commands.parsing import OptionalText, parse_frames


@dataclass(frozen=True)
class MapBuild:
    """Triangulate the labels of a workspace and merge them into a map."""

    workspace: Positional[Path]
    """The workspace."""
    name: str = "main"
    """Name of the map in the workspace."""
    frames: OptionalText = None
    """FIRST:END[:STEP]: build from these frames only."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.build_map import BuildOptions, build_map
        from semviz_core.map_file import save_map

        workspace = Workspace.open(self.workspace)
        labels = workspace.read_labels()
        built, report = build_map(
            labels, workspace.source, BuildOptions(), parse_frames(self.frames)
        )
        path = workspace.map_path(self.name)
        save_map(built, path)
        print(report)
        print(f"{path}: {len(built)} elements, {path.stat().st_size / 1000:.0f} kB")
        return 0


@dataclass(frozen=True)
class MapCheck:
    """Measure how far a map's projections are from the labels, class by class."""

    workspace: Positional[Path]
    """The workspace."""
    map: str = "main"
    """Name of the map."""
    frames: OptionalText = None
    """FIRST:END[:STEP]: measure in these frames only."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.accuracy import mapping_accuracy

        workspace = Workspace.open(self.workspace)
        accuracy = mapping_accuracy(
            workspace.read_map(self.map),
            workspace.read_labels(),
            workspace.source,
            parse_frames(self.frames),
        )
        print(json.dumps(accuracy.as_dict()) if self.json else accuracy.as_text())
        return 0
