"""semviz map check"""

import json
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from semviz.commands.parsing import OptionalText, parse_frames


@dataclass(frozen=True)
class MapCheck:
    """Say how good a map is: its errors against the labels, class by class, the labels that agree
    least with the others, and what cannot be right in it."""

    workspace: Positional[Path]
    """The workspace."""
    map: str = "main"
    """Name of the map."""
    frames: OptionalText = None
    """FIRST:END[:STEP]: measure in these frames only."""
    gate: bool = False
    """Exit with status 1, and a line for each class, where the map is not good enough."""
    max_rmse_px: float = 1.0
    """With --gate: signs' RMSE and poles' lateral RMSE must be below this."""
    max_angle_deg: float = 1.0
    """With --gate: poles' angular RMSE must be below this."""
    json: bool = False
    """Print one JSON object instead of tables."""

    def run(self) -> int:
        import sys

        from semviz.workspace import Workspace
        from semviz_annotation.mapping.quality.accuracy import Gate
        from semviz_annotation.mapping.quality.check import check_map

        workspace = Workspace.open(self.workspace)
        check = check_map(
            workspace.read_map(self.map),
            workspace.read_labels(),
            workspace.source,
            parse_frames(self.frames),
        )
        print(json.dumps(check.as_dict()) if self.json else check.as_text())
        if check.is_old:
            print(
                f"labels are at operation {check.labels_operation}, the map knows "
                f"{check.semantic_map.operation}: rebuild it",
                file=sys.stderr,
            )
        if not self.gate:
            return 0
        failures = Gate(self.max_rmse_px, self.max_angle_deg).failures(check.accuracy)
        for line in failures:
            print(f"not good enough: {line}", file=sys.stderr)
        return 1 if failures else 0
