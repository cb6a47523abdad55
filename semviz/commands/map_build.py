"""semviz map build"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from semviz.commands.parsing import OptionalFloat, OptionalInt, OptionalText, parse_frames
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz_annotation.mapping.options import BuildOptions
    from semviz_annotation.mapping.paper import PaperOptions

_ONLY = {
    "joint": ("min_frames", "pose_sigma_m", "refine_poses"),
    "paper": ("eps_m", "min_points"),
}
"""Options that mean something for one method."""


@dataclass(frozen=True)
class MapBuild:
    """Place the labels of a workspace in space, link what is one thing, and make a map of it."""

    workspace: Positional[Path]
    """The workspace."""
    name: str = "main"
    """Name of the map in the workspace."""
    frames: OptionalText = None
    """FIRST:END[:STEP]: build from these frames only."""
    method: Literal["joint", "paper"] = "joint"
    """paper: each stereo pair by itself, then DBSCAN, to compare with."""
    sigma_px: float = 1.0
    """How well labels are placed: 1 for people, 2 to 4 for detectors."""
    min_frames: OptionalInt = None
    """Leave out what fewer frames show (1); with a detector, 2 or 3."""
    pose_sigma_m: OptionalFloat = None
    """How far poses may be off from one pass to the next (0.05)."""
    refine_poses: bool = False
    """Move the poses, too, by about --pose-sigma-m (0.01)."""
    eps_m: OptionalFloat = None
    """Method paper: DBSCAN's radius (1.0)."""
    min_points: OptionalInt = None
    """Method paper: DBSCAN's core size, in stereo pairs (1)."""
    json: bool = False
    """Print one JSON object instead of words."""

    def run(self) -> int:
        from semviz.progress import Steps
        from semviz.workspace import Workspace
        from semviz_annotation.mapping.build import build_map
        from semviz_core.map_file import save_map

        options = self._options()
        workspace = Workspace.open(self.workspace)
        labels, path = workspace.read_labels(), workspace.map_path(self.name)
        with Steps() as steps:
            built, report = build_map(
                labels,
                workspace.source,
                options,
                parse_frames(self.frames),
                on_progress=steps.show,
            )
        save_map(built, path)
        if self.json:
            print(json.dumps({"map": str(path), **report.as_dict()}))
        else:
            print(report)
            print(f"{path}: {len(built)} elements, {path.stat().st_size / 1000:.0f} kB")
        return 0

    def _options(self) -> "BuildOptions | PaperOptions":
        from semviz_annotation.mapping.options import BuildOptions
        from semviz_annotation.mapping.paper import PaperOptions
        from semviz_annotation.mapping.placing.refine import RefineOptions

        for method, names in _ONLY.items():
            for name in names:
                if method != self.method and getattr(self, name) not in (None, False):
                    option = name.replace("_", "-")
                    raise SemvizError(f"--{option} is for --method {method}; leave it out")
        mine = {name: getattr(self, name) for name in _ONLY[self.method]}
        given = {name: value for name, value in mine.items() if value is not None}
        if self.method == "paper":
            return PaperOptions(sigma_px=self.sigma_px, **given)
        if given.pop("refine_poses"):
            prior = RefineOptions()
            sigma_m = given.get("pose_sigma_m", prior.pose_sigma_m)
            given["refine"] = replace(prior, pose_sigma_m=sigma_m)
        return BuildOptions(sigma_px=self.sigma_px, **given)
