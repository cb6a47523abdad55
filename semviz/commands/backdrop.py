"""The command map backdrop."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from tyro.conf import Positional, arg

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz_annotation.mapping.backdrop import Backdrop

CloudFormat: TypeAlias = Annotated[
    Literal["ply", "pcd"] | None, arg(metavar="{ply,pcd}", help_behavior_hint="")
]


@dataclass(frozen=True)
class MapBackdropCommand:
    """Make a dense coloured backdrop of a drive from its stereo images, shown behind the map in
    both 3D panes; export it as a point cloud.

    Example: 'semviz map backdrop town'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    export: parsing.OptionalPath = None
    """Also write the points to this file: .ply or .pcd."""
    format: CloudFormat = None
    """Format of the export; default: by ending."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP]: use only these frames."""
    max_points: int = 400_000
    """At most so many points; voxels grow until that holds."""
    max_depth_m: float = 25.0
    """Leave out surfaces further from the camera."""
    voxel_m: float = 0.05
    """Average points over voxels of this size, or larger ones."""
    force: bool = False
    """Replace an exported file, or a file in the backdrop's place that is none."""
    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        from semviz.presentation.terminal import Steps
        from semviz.workspace.chosen_frames import select_frames
        from semviz.workspace.maps.backdrop import backdrop_path, ensure_backdrop
        from semviz_annotation.mapping.depth_fusion import FusionOptions

        options = FusionOptions(self.max_depth_m, self.voxel_m, self.max_points)
        self._check_export()
        workspace = parsing.open_workspace(self.workspace)
        frames = select_frames(workspace.source, parsing.parse_frames(self.frames))
        with Steps() as steps:
            backdrop, is_new = ensure_backdrop(workspace, frames, options, self.force, steps.show)
        result = self._result(backdrop, backdrop_path(workspace), is_new)
        if self.export is not None:
            self._export(backdrop, self.export)
        print(json.dumps(result) if self.json else _as_text(result))
        return 0

    def _check_export(self) -> None:
        """Before minutes of work: SemvizError for an export that would be refused."""
        from semviz.workspace.outputs import check_outputs, never
        from semviz_annotation.map_formats.mesh import cloud_format

        if self.export is None:
            if self.format is not None:
                raise SemvizError("--format is for --export; name the file to write")
            return
        cloud_format(self.export, self.format)
        check_outputs(self.export, never, force=True, reads=[self.workspace])
        if self.export.exists() and not self.force:
            raise SemvizError(f"{self.export}: is there already; --force replaces it")

    def _export(self, backdrop: "Backdrop", path: Path) -> None:
        from semviz_annotation.map_formats.mesh import cloud_format, export_backdrop

        export_backdrop(backdrop, path, cloud_format(path, self.format))

    def _result(self, backdrop: "Backdrop", path: Path, is_new: bool) -> dict[str, Any]:
        return {
            "backdrop": str(path),
            "made": is_new,
            "points": len(backdrop),
            "frames": len(backdrop.source.frames),
            "spacing_m": round(backdrop.spacing_m, 4),
            "bytes": path.stat().st_size,
            "export": None if self.export is None else str(self.export),
        }


def _as_text(result: dict[str, Any]) -> str:
    what = "" if result["made"] else "up to date, "
    lines = [
        f"{result['backdrop']}: {what}{result['points']} points of {result['frames']} frames, "
        f"{100 * result['spacing_m']:.0f} cm apart, {result['bytes'] / 1e6:.1f} MB"
    ]
    if result["export"] is not None:
        lines.append(f"{result['export']}: {result['points']} points")
    return "\n".join(lines)
