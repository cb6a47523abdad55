"""Make the backdrop of a workspace, and find it for the web tools.

A workspace has at most one, the file ``backdrop.safetensors``. What it was made from is compared
with the drive that it is shown with: a stale one is reported, not shown.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping import depth_fusion
from semviz_annotation.mapping.backdrop import (
    Backdrop,
    BackdropSource,
    load_backdrop,
    save_backdrop,
)
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.errors import SemvizError, require_extra
from semviz_core.common.progress import OnProgress

FILE = "backdrop.safetensors"


def backdrop_path(workspace: Workspace) -> Path:
    """Return where the backdrop is or would be."""
    return workspace.path / FILE


def ensure_backdrop(
    workspace: Workspace,
    frames: Sequence[Frame],
    options: depth_fusion.FusionOptions,
    force: bool,
    on_progress: OnProgress,
) -> tuple[Backdrop, bool]:
    """Return the backdrop from ``frames``, and whether it was made now, or was up to date.

    Raises SemvizError for a drive with one camera, without open3d, and for a file that is no
    backdrop, unless ``force`` says to replace it. ``on_progress`` may raise to stop it; then the
    file is as it was.
    """
    path, source = backdrop_path(workspace), workspace.source
    if source.rig.right is None:
        raise SemvizError(
            f"{workspace.path}: one camera; a backdrop needs stereo images, left and right"
        )
    chosen = depth_fusion.chosen_frames(frames)
    wanted = BackdropSource.of(source.map_frame, source.rig, chosen, options)
    if path.exists():
        try:
            existing = load_backdrop(path)
        except SemvizError:
            if not force:
                raise SemvizError(
                    f"{path}: there already, and no backdrop that this semviz can read; "
                    "--force replaces it"
                ) from None
        else:
            if existing.source.is_same(wanted):
                return existing, False
    require_extra("semviz map backdrop", "open3d", "view3d")
    made = Backdrop.of(depth_fusion.fuse(source, chosen, options, on_progress), wanted)
    save_backdrop(made, path)
    return made, True


@dataclass(frozen=True, eq=False)
class FoundBackdrop:
    """What the web tools show behind a drive."""

    backdrop: Backdrop | None
    note: str = ""
    """Why there is none, and what to do."""


def find_backdrop(
    workspace: Workspace | None, map_frame: MapFrame, rig: Rig, frames: Iterable[Frame]
) -> FoundBackdrop:
    """Return the backdrop of ``workspace`` if it fits the drive. None: no workspace was found."""
    if workspace is None:
        return FoundBackdrop(None, "No backdrop: the workspace of this run was not found.")
    path, command = backdrop_path(workspace), f"semviz map backdrop {workspace.path}"
    if not path.is_file():
        return FoundBackdrop(None, f"No backdrop yet. Make one: {command}")
    try:
        backdrop = _loaded(path, path.stat().st_mtime_ns)
    except SemvizError:
        note = f"The backdrop cannot be read. Make it again: {command} --force"
        return FoundBackdrop(None, note)
    change = backdrop.source.change(map_frame, rig, frames)
    if change:
        return FoundBackdrop(None, f"The backdrop is stale: {change}. Make it again: {command}")
    return FoundBackdrop(backdrop)


@lru_cache(maxsize=2)
def _loaded(path: Path, changed_ns: int) -> Backdrop:
    """Return the same object to all pages, until the file changes."""
    return load_backdrop(path)
