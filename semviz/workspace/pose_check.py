"""Check the poses of a workspace against its images, with the motions of the images kept.

Motions take seconds per hundred frames, so a workspace keeps them in one file. They depend on
images and calibration, not on poses; a file of other images is measured again.
"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from semviz.workspace.workspace import Workspace
from semviz_core.base.frame import FileDataset, Frame, Side
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.rig_cameras import frames_of_camera
from semviz_core.datasets.validation import Calibration
from semviz_core.pose_checks.faults import PoseCheck, check_drive, pose_information
from semviz_core.pose_checks.image_motions import (
    OnProgress,
    load_motions,
    measure_motions,
    save_motions,
)
from semviz_core.pose_checks.refinement import PoseInformation

FILE = "image_motions.safetensors"
MIN_FRAMES = 3


def motions_path(workspace: Workspace) -> Path:
    """Return where the motions of the images are or would be."""
    return workspace.path / FILE


def check_poses(
    workspace: Workspace, frames: Sequence[Frame], on_progress: OnProgress
) -> PoseCheck:
    """Return what images say about the poses of ``frames``.

    ``on_progress`` may raise to stop. Raise SemvizError if there are too few frames or poses, or
    if the images show too little motion to check anything.
    """
    _require_poses(workspace, frames)
    source = source_key(workspace, frames)
    motions = load_motions(motions_path(workspace), source)
    if motions is None:
        motions = measure_motions(workspace.source, frames, on_progress)
        save_motions(motions, source, motions_path(workspace))
    check = check_drive(frames, motions, workspace.source.rig)
    if not check.is_checked:
        raise SemvizError(
            f"{workspace.path}: only {check.measured:.0%} of the pairs of frames share enough "
            "points to check poses; choose --frames where neighbours look alike"
        )
    return check


def known_check(workspace: Workspace) -> PoseCheck | None:
    """Return the check of all given poses if the motions of the images are known; measure
    nothing."""
    frames = frames_of_camera(workspace.given_source, None)
    if not motions_path(workspace).is_file() or len(frames) < MIN_FRAMES:
        return None
    motions = load_motions(motions_path(workspace), source_key(workspace, frames))
    if motions is None:
        return None
    check = check_drive(frames, motions, workspace.given_source.rig)
    return check if check.is_checked else None


def pose_errors(workspace: Workspace) -> PoseInformation | None:
    """Return the errors of the poses used now, as images show them; None if the motions of the
    images are not known."""
    check = known_check(workspace)
    if check is None:
        return None
    pairs = zip(workspace.given_source.frames, workspace.source.frames, strict=True)
    refined = [now.index for given, now in pairs if now is not given and not now.left_out]
    return pose_information(check, refined)


def _require_poses(workspace: Workspace, frames: Sequence[Frame]) -> None:
    posed = sum(frame.T_map_camera is not None for frame in frames)
    if len(frames) < MIN_FRAMES or posed < MIN_FRAMES:
        raise SemvizError(
            f"{workspace.path}: {posed} of {len(frames)} frames have a pose; "
            f"a check needs {MIN_FRAMES} or more"
        )


def source_key(workspace: Workspace, frames: Sequence[Frame]) -> str:
    """Return a digest of what the motions depend on: images, by size and time, and calibration."""
    source = workspace.source
    settings = workspace.settings.source.model_dump(exclude={"poses", "frames", "root"})
    parts: list[object] = [Calibration.of(source.rig).hash, settings]
    parts += [frame.index for frame in frames]
    if isinstance(source, FileDataset):
        sides: tuple[Side, ...] = ("left", "right") if source.rig.right is not None else ("left",)
        parts += [_file_state(source, frame.index, side) for frame in frames for side in sides]
    return hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()


def _file_state(source: FileDataset, index: int, side: Side) -> tuple[int, int] | None:
    """Return size and time of a recorded image; None if there is none."""
    try:
        state = source.original_path(index, side).stat()
    except (SemvizError, OSError):
        return None
    return state.st_size, state.st_mtime_ns
