"""semviz map build"""

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
        from semviz_annotation.mapping.build import BuildOptions, build_map
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
