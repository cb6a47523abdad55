"""Training images for the detector from the labelled frames of workspaces.

A frame that a person reviewed is complete: unlabelled area contains nothing. In an unreviewed
frame only the surroundings of labels count. Expected positions of elements from other frames
are ignored too, unless a person confirmed that the element is absent or the frame empty.
"""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from semviz.annotator import element_positions
from semviz.annotator.panes import Cameras
from semviz.research.matcher_data import HELD_OUT_SHARE, LEAST_FRAMES
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import Labels, proposal_id
from semviz_annotation.mapping.quality.label_links import observe
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Dataset, Side
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.research.training.detector_images import LabelledImage

AROUND_PX = 16.0
"""Margin around labels in which an unreviewed frame counts as completely labelled."""
DOUBT_PX = 10.0
"""Margin around expected but unlabelled elements that is ignored."""
OWN_PX = 3.0
"""Margin around labels that is never ignored."""
_NOWHERE: FloatArray = np.zeros((0, 4))


@dataclass(frozen=True, eq=False)
class LabelledSide:
    """The labels of an image."""

    folder: Path
    """Of the workspace."""
    frame_index: int
    side: Side
    elements: Elements2D
    is_complete: bool
    """Whether all elements are labelled, except for doubtful ones."""
    doubtful_px: FloatArray
    """(k, 4) boxes (left, top, right, bottom) of elements that may be visible."""

    def read(self) -> LabelledImage:
        """Return the image with its labels. Raise SemvizError if it cannot be read."""
        image = _source(self.folder).image(self.frame_index, self.side)
        height, width = image.shape[:2]
        return LabelledImage(image, self.elements, ignored=self._ignored(height, width))

    def _ignored(self, height: int, width: int) -> BoolArray | None:
        labelled = boxes_of(self.elements)
        if self.is_complete and not len(self.doubtful_px):
            return None
        ignored = np.full((height, width), not self.is_complete)
        if not self.is_complete:
            _fill(ignored, labelled, AROUND_PX, False)
        _fill(ignored, self.doubtful_px, DOUBT_PX, True)
        _fill(ignored, labelled, OWN_PX, False)
        return ignored


@dataclass(frozen=True, eq=False)
class WorkspaceImages:
    """Labelled images of workspaces, by number; see ``LabelledImages``."""

    workspaces: tuple[str, ...]
    training: tuple[LabelledSide, ...]
    """Frame by frame, the left image before the right one."""
    kept_back: tuple[LabelledSide, ...]
    """The last frames of each workspace: few have neighbours in the training set."""

    @property
    def count(self) -> int:
        return len(self.training)

    @property
    def held_out_count(self) -> int:
        return len(self.kept_back)

    def image(self, number: int) -> LabelledImage:
        """Return training image ``number``."""
        return self.training[number].read()

    def held_out(self, number: int) -> LabelledImage:
        """Return validation image ``number``."""
        return self.kept_back[number].read()

    def describe(self) -> dict[str, Any]:
        """Return the origin of the images as JSON."""
        sides = (*self.training, *self.kept_back)
        return {
            "workspaces": list(self.workspaces),
            "images": self.count,
            "held_out_images": self.held_out_count,
            "reviewed_images": sum(side.is_complete for side in sides),
            "labels": sum(len(side.elements) for side in sides),
            "content": _digest(sides),
        }


SidesOf = Callable[[Workspace, range | None], list[LabelledSide]]
"""Returns the images of a workspace that can be learned from."""


def workspace_images(
    workspaces: Sequence[Workspace],
    frames: range | None = None,
    sides_of: "SidesOf | None" = None,
) -> WorkspaceImages:
    """Return the labelled or reviewed images of ``workspaces``, of all frames or of ``frames``.

    ``sides_of`` gives the images of a workspace; default: ``labelled_sides``. Raise SemvizError if
    a workspace has fewer than two such frames: one for training, one for validation.
    """
    training: list[LabelledSide] = []
    kept_back: list[LabelledSide] = []
    for workspace in workspaces:
        sides = (sides_of or labelled_sides)(workspace, frames)
        indices = sorted({side.frame_index for side in sides})
        if len(indices) < LEAST_FRAMES:
            selection = "" if frames is None else f" of frames {frames.start}:{frames.stop}"
            raise SemvizError(
                f"{workspace.path}: {len(indices)} frames{selection} are labelled or reviewed, "
                f"training needs {LEAST_FRAMES}; label more with 'semviz annotate'"
            )
        kept = set(indices[-max(1, round(HELD_OUT_SHARE * len(indices))) :])
        training += [side for side in sides if side.frame_index not in kept]
        kept_back += [side for side in sides if side.frame_index in kept]
    names = tuple(workspace.name for workspace in workspaces)
    return WorkspaceImages(names, tuple(training), tuple(kept_back))


def labelled_sides(workspace: Workspace, frames: range | None = None) -> list[LabelledSide]:
    """Return the labelled or reviewed images of a workspace, frame by frame, left first.

    An image without labels is complete if its frame was reviewed as empty. If only the other image
    of the frame has labels, it is left out. Elements that a person left out of maps, such as
    rejected tracks, are neither landmarks nor background.
    """
    source, all_labels = workspace.source, workspace.read_labels()
    labels = all_labels.without_left_out()
    cameras = Cameras(source.rig, source.frames)
    places = element_positions.ElementPositions(cameras)
    sides: tuple[Side, ...] = ("left",) if source.rig.right is None else ("left", "right")
    labelled = []
    for index in sorted(frame.index for frame in source.frames):
        state = labels.review(index)
        if (frames is not None and index not in frames) or state == "unseen":
            continue
        for side in sides:
            elements, _ = observe(labels, index, side)
            if not len(elements) and state != "reviewed, empty":
                continue
            doubtful = (
                _NOWHERE
                if state == "reviewed, empty"
                else _doubtful(index, side, labels, cameras, places)
            )
            doubtful = np.concatenate([doubtful, _left_out(index, side, all_labels)])
            is_complete = state != "in work"
            labelled.append(
                LabelledSide(workspace.path, index, side, elements, is_complete, doubtful)
            )
    return labelled


@lru_cache(maxsize=16)
def _source(folder: Path) -> Dataset:
    """Open the workspace's images, once in each process."""
    return Workspace.open(folder).source


def _doubtful(
    frame_index: int,
    side: Side,
    labels: Labels,
    cameras: Cameras,
    places: element_positions.ElementPositions,
) -> FloatArray:
    """Return boxes (k, 4) of mapped elements that should be visible and were not dismissed."""
    T_camera_map = cameras.T_camera_map(frame_index)
    if T_camera_map is None:
        return _NOWHERE
    near = places.near(labels, frame_index)
    projected = element_positions.projected_elements(
        frame_index, side, T_camera_map, cameras.rig, labels, near
    )
    unlabelled = [
        element for element in projected if not _is_dismissed(element, frame_index, labels)
    ]
    ends = [(element.anchor_px, element.end_px or element.anchor_px) for element in unlabelled]
    return _around(np.array(ends, dtype=np.float64).reshape(-1, 2, 2))


def _left_out(frame_index: int, side: Side, labels: Labels) -> FloatArray:
    """Return boxes (k, 4) of the labels of elements that are left out of maps."""
    rows = labels.in_frame(frame_index, side)
    left_out = [row for row in rows if labels.is_left_out(row.element_id)]
    ends = [(row.anchor_px, row.end_px or row.anchor_px) for row in left_out]
    return _around(np.array(ends, dtype=np.float64).reshape(-1, 2, 2))


def _is_dismissed(
    element: element_positions.ProjectedElement, frame_index: int, labels: Labels
) -> bool:
    """Return whether a person stated that the element is not visible. Occluded ones may be, in
    part."""
    dismissal = labels.dismissals.get(proposal_id(element.element_id, frame_index, element.side))
    return dismissal is not None and dismissal.why != "occluded"


def boxes_of(elements: Elements2D) -> FloatArray:
    """Return the boxes (m, 4) around the ends of elements."""
    anchor = elements.anchor_px
    end = np.where(elements.is_line[:, None], elements.end_px, anchor)
    return _around(np.stack([anchor, end], axis=1))


def _around(ends_px: FloatArray) -> FloatArray:
    """Return boxes (n, 4) around two ends (n, 2, 2) each."""
    return np.concatenate([ends_px.min(axis=1), ends_px.max(axis=1)], axis=1)


def _fill(mask: BoolArray, boxes_px: FloatArray, grown_px: float, value: bool) -> None:
    """Set ``mask`` to ``value`` within boxes, grown on all sides."""
    for left, top, right, bottom in boxes_px:
        rows = slice(max(0, round(top - grown_px)), max(0, round(bottom + grown_px) + 1))
        columns = slice(max(0, round(left - grown_px)), max(0, round(right + grown_px) + 1))
        mask[rows, columns] = value


def _digest(sides: Iterable[LabelledSide]) -> str:
    """Return a digest of the labels: a training resumes only with the same."""
    content = hashlib.sha256()
    for side in sides:
        content.update(f"{side.frame_index} {side.side} {side.is_complete}".encode())
        for part in (
            side.elements.anchor_px,
            side.elements.end_px,
            side.elements.class_id,
            side.elements.anchor_known,
            side.elements.end_known,
            side.doubtful_px,
        ):
            content.update(part.tobytes())
    return content.hexdigest()[:12]
