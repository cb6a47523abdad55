"""semviz map check"""

import json
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from semviz.commands.parsing import OptionalText, parse_frames


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
        from semviz_annotation.mapping.accuracy import mapping_accuracy

        workspace = Workspace.open(self.workspace)
        accuracy = mapping_accuracy(
            workspace.read_map(self.map),
            workspace.read_labels(),
            workspace.source,
            parse_frames(self.frames),
        )
        print(json.dumps(accuracy.as_dict()) if self.json else accuracy.as_text())
        return 0
