"""Check the poses of a workspace against its images, and against its labels.

The motions of images take seconds per hundred frames, so a workspace keeps them in one file. They
depend on images and calibration, not on poses; a file of other images is measured again.

Labels tell whether the elements of a fault's frames jump together. The elements are placed by the
labels of all other frames. If their labels in the frames of the fault fit refined poses much better
than given ones, the poses are wrong and not the labels.
"""

import hashlib
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.views import rig_view
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.quality.label_links import map_rows
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Dataset, FileDataset, Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.validation import Calibration
from semviz_core.metrics.image_errors import ImageErrors
from semviz_core.pose_checks.faults import PoseCheck, PoseFault, check_drive, refined_frames
from semviz_core.pose_checks.image_motions import (
    OnProgress,
    load_motions,
    measure_motions,
    save_motions,
)

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
    """Return the check of all poses if the motions of the images are known; measure nothing."""
    frames = workspace.source.frames
    if not motions_path(workspace).is_file() or len(frames) < MIN_FRAMES:
        return None
    motions = load_motions(motions_path(workspace), source_key(workspace, frames))
    if motions is None:
        return None
    check = check_drive(frames, motions, workspace.source.rig)
    return check if check.is_checked else None


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


AGREES = 0.5
"""An element agrees if its error falls below this share."""


@dataclass(frozen=True)
class LabelEvidence:
    """Errors of the elements in the frames of a fault, placed by other frames."""

    elements: int
    agreeing: int
    """Elements that fit the refined poses much better than the given ones."""
    before_px: float
    """Median over elements, with the given poses."""
    after_px: float
    """Median over elements, with the refined poses."""

    def __str__(self) -> str:
        return (
            f"{self.agreeing} of {self.elements} labelled elements agree: median "
            f"{self.before_px:.1f} px, {self.after_px:.1f} px after refining"
        )


@dataclass(frozen=True, eq=False)
class RefinedDrive:
    """A drive with refined poses."""

    source: Dataset
    frames: tuple[Frame, ...]

    @property
    def map_frame(self) -> MapFrame:
        return self.source.map_frame

    @property
    def rig(self) -> Rig:
        return self.source.rig

    def image(self, index: int, side: Side) -> ByteImage:
        return self.source.image(index, side)


def label_evidence(
    labels: Labels, source: Dataset, check: PoseCheck, fault: PoseFault
) -> LabelEvidence | None:
    """Return what labels say about a fault of some frames.

    None for faults of the whole drive, without labels inside and outside its frames, or if those
    outside place no element.
    """
    known = {frame.index for frame in check.frames}
    inside = {index for index in known if fault.first <= index <= fault.last}
    others = [index for index in labels.frames if index in known - inside]
    if not others or not inside & set(labels.frames):
        return None
    drive = RefinedDrive(source, refined_frames(check))
    try:
        placed, _ = build_map(labels, drive, frames=others)
    except SemvizError:  # too few labels
        return None
    given = _errors_px(labels, placed, drive.rig, check.frames, inside)
    refined = _errors_px(labels, placed, drive.rig, drive.frames, inside)
    rows = sorted(given.keys() & refined.keys())
    if not rows:
        return None
    before, after = (np.array([errors[row] for row in rows]) for errors in (given, refined))
    agreeing = int((after < AGREES * before).sum())
    return LabelEvidence(len(rows), agreeing, float(np.median(before)), float(np.median(after)))


def _errors_px(
    labels: Labels,
    placed: SemanticMap,
    rig: Rig,
    frames: tuple[Frame, ...],
    inside: set[int],
) -> dict[int, float]:
    """Return the median error of each element of ``placed``, by row, in the frames ``inside``."""
    rows, elements = map_rows(placed), placed.elements
    errors: dict[int, list[float]] = defaultdict(list)
    poses: dict[int, Pose] = {
        frame.index: frame.T_map_camera
        for frame in frames
        if frame.index in inside and frame.T_map_camera is not None
    }
    for index, pose in poses.items():
        for observation in labels.in_frame(index):
            row = rows.row(observation)
            if row < 0:
                continue
            view = rig_view(rig, observation.side, pose.inverse())
            ends = np.stack([elements.anchor_m[row], elements.end_m[row]])
            label = np.array([observation.anchor_px, observation.end_px or (np.nan, np.nan)])
            error = ImageErrors.between(view.project(ends), label)
            size = np.concatenate([error.lateral_px, error.longitudinal_px])
            if np.isfinite(size).all():
                errors[row].append(float(np.sqrt(np.mean(size**2))))
    return {row: float(np.median(sizes)) for row, sizes in errors.items()}
