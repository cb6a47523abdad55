"""The command map merge."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.workspace.workspace import Workspace
    from semviz_core.base.semantic_map import SemanticMap


@dataclass(frozen=True)
class MapMergeCommand:
    """Merge the maps of several drives of one place: find the landmarks that they share, and
    correct the errors of each drive's poses by them. The given maps stay as they are.

    Example: 'semviz map merge may june july --write town'."""

    workspace: Positional[Path]
    """Folder of the workspace that gets the merged map; its own map is the first, whose frame and
    ids are kept."""
    others: Positional[tuple[Path, ...]]
    """The other maps: folders of workspaces, or files (.parquet)."""
    write: str
    """Name of the merged map in the workspace."""
    map: str = "main"
    """Name of the map in each workspace."""
    keep_first: bool = False
    """The first map stays where it is, and the other drives are moved to it: for a map in use."""
    pose_sigma_m: float = 0.5
    """Error of each drive's poses, in each direction."""
    pose_sigma_deg: float = 0.5
    """Error of each drive's heading."""
    plot: parsing.OptionalPath = None
    """Also write a picture of how each drive was moved to this PNG file."""
    force: parsing.Force = False
    replace: bool = False
    """Replace an existing map of this name."""
    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        from semviz.presentation.terminal import Steps
        from semviz.reports.merged_drives import draw_merging
        from semviz.workspace.outputs import PNG, check_outputs
        from semviz_annotation.mapping.drives.corrections import PoseErrors
        from semviz_annotation.mapping.drives.merge import MergeOptions
        from semviz_annotation.mapping.drives.merged_map import merge_maps
        from semviz_core.base.map_file import save_map

        errors = PoseErrors(self.pose_sigma_m, math.radians(self.pose_sigma_deg))
        if self.write == self.map:
            raise SemvizError(f"--write {self.write} is a map to merge; choose another name")
        workspace = parsing.open_workspace(self.workspace)
        path = parsing.path_of_new_map(workspace, self.write, replace=self.replace)
        if self.plot is not None:
            reads = [self.workspace, *self.others]
            check_outputs(self.plot, PNG, force=self.force, reads=reads)
        maps = self._maps(workspace)
        with Steps() as steps:
            fixed = (0,) if self.keep_first else ()
            merged = merge_maps(maps, MergeOptions(errors, fixed), steps.show)
        save_map(merged.semantic_map, path)
        if self.plot is not None:
            draw_merging(merged.merging, list(maps), self.plot)
        if self.json:
            print(json.dumps({"map": str(path), **merged.report.as_dict()}))
            return 0
        for line in merged.report.lines():
            print(line)
        print(f"{path}: {len(merged.semantic_map)} elements")
        return 0

    def _maps(self, workspace: "Workspace") -> "dict[str, SemanticMap]":
        """Return the maps by what people call them. Raise SemvizError if one is named twice."""
        from semviz_core.base.map_file import load_map

        maps = {str(self.workspace): workspace.read_map(self.map)}
        for other in self.others:
            if str(other) in maps:
                raise SemvizError(f"{other}: is given twice; each drive counts once")
            if other.suffix == ".parquet":
                maps[str(other)] = load_map(other)
            else:
                maps[str(other)] = parsing.open_workspace(other).read_map(self.map)
        if len(maps) < 2:
            raise SemvizError("give two workspaces or more, whose maps are to be merged")
        return maps
