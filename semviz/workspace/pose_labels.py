"""What labels say about a fault of poses: do the elements of its frames jump together?

The elements are placed by the labels of all other frames. If their labels in the frames of the
fault fit refined poses much better than given ones, the poses are wrong and not the labels.
"""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.views import rig_view
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.quality.label_links import map_rows
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Dataset, Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.image_errors import ImageErrors
from semviz_core.pose_checks.faults import PoseCheck, PoseFault, refined_frames

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
