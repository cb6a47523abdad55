"""semviz map diff"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from semviz.workspace import Workspace
    from semviz_core.semantic_map import SemanticMap


@dataclass(frozen=True)
class MapDiff:
    """List what one map has differently from another: moved, new, gone, merged, split, renamed."""

    workspace: Positional[Path]
    """The workspace."""
    base: Annotated[Positional[str], arg(metavar="BASE")]
    """Name of a map in the workspace, or a file (.parquet)."""
    other: Annotated[Positional[str], arg(metavar="OTHER")]
    """The map that is compared with it: a name or a file."""
    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.mapping.quality.diff import diff_maps

        workspace = Workspace.open(self.workspace)
        diff = diff_maps(_read(workspace, self.base), _read(workspace, self.other))
        print(json.dumps(diff.as_dict()) if self.json else diff.as_text())
        return 0


def _read(workspace: "Workspace", name: str) -> "SemanticMap":
    from semviz_core.map_file import load_map

    return load_map(name) if name.endswith(".parquet") else workspace.read_map(name)
