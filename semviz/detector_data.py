"""What detectors train on, from workspaces: images of the frames that people labelled.

A frame that somebody reviewed is complete: where nothing is labelled there is nothing to be found.
Of a frame that is not reviewed only the surroundings of its labels count, the rest says nothing.
Nor do places where an element of other frames should be, while nobody said that it is not there or
that the frame is empty.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from semviz.annotator.cameras import Cameras
from semviz.annotator.ghosts import Ghost, ghosts_in
from semviz.annotator.places import Places
from semviz.training_data import HELD_OUT_SHARE, LEAST_FRAMES
from semviz.workspace import Workspace
from semviz_annotation.labels import Labels, proposal_id
from semviz_annotation.observe import observe
from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.detection.labelled import LabelledImage
from semviz_core.elements import Elements2D
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side, Source

AROUND_PX = 16.0
"""So far around its labels a frame that is not reviewed says what is there, and what is not."""
DOUBT_PX = 10.0
"""So far around a place nobody knows whether the element that should be there is."""
OWN_PX = 3.0
"""So far around it a label says what is there, whatever else may be."""
_NOWHERE: FloatArray = np.zeros((0, 4))


@dataclass(frozen=True, eq=False)
class LabelledSide:
    """What people labelled in one image."""

    folder: Path
    """Of the workspace."""
    frame_index: int
    side: Side
    elements: Elements2D
    is_complete: bool
    """Whether there is nothing but what is labelled, and perhaps what is doubtful."""
    doubtful_px: FloatArray
    """(k, 4) boxes: left, top, right, bottom of elements that may be there."""

    def read(self) -> LabelledImage:
        """The image with its labels; SemvizError where it cannot be read."""
        image = _source(self.folder).image(self.frame_index, self.side)
        height, width = image.shape[:2]
        return LabelledImage(image, self.elements, ignored=self._ignored(height, width))

    def _ignored(self, height: int, width: int) -> BoolArray | None:
        labelled = _boxes(self.elements)
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
    """The last frames of each workspace: few are neighbours of those trained on."""

    @property
    def count(self) -> int:
        return len(self.training)

    @property
    def held_out_count(self) -> int:
        return len(self.kept_back)

    def image(self, number: int) -> LabelledImage:
        """Number ``number`` of those to train on."""
        return self.training[number].read()

    def held_out(self, number: int) -> LabelledImage:
        """Number ``number`` of those that are never trained on."""
        return self.kept_back[number].read()

    def describe(self) -> dict[str, Any]:
        """Where the images come from, as JSON."""
        sides = (*self.training, *self.kept_back)
        return {
            "workspaces": list(self.workspaces),
            "images": self.count,
            "held_out_images": self.held_out_count,
            "reviewed_images": sum(one.is_complete for one in sides),
            "labels": sum(len(one.elements) for one in sides),
            "content": _digest(sides),
        }


def workspace_images(
    workspaces: Sequence[Workspace], frames: range | None = None
) -> WorkspaceImages:
    """The images that people labelled or reviewed in ``workspaces``, of all frames or of some.

    SemvizError where one has fewer than two such frames: one to train on, one to keep back.
    """
    training: list[LabelledSide] = []
    kept_back: list[LabelledSide] = []
    for workspace in workspaces:
        sides = labelled_sides(workspace, frames)
        indices = sorted({one.frame_index for one in sides})
        if len(indices) < LEAST_FRAMES:
            among = "" if frames is None else f" of frames {frames.start}:{frames.stop}"
            raise SemvizError(
                f"{workspace.path}: {len(indices)} frames{among} are labelled or reviewed, "
                f"training needs {LEAST_FRAMES}; label more with 'semviz annotate'"
            )
        kept = set(indices[-max(1, round(HELD_OUT_SHARE * len(indices))) :])
        training += [one for one in sides if one.frame_index not in kept]
        kept_back += [one for one in sides if one.frame_index in kept]
    names = tuple(one.name for one in workspaces)
    return WorkspaceImages(names, tuple(training), tuple(kept_back))


def labelled_sides(workspace: Workspace, frames: range | None = None) -> list[LabelledSide]:
    """The images of a workspace of which people said something, frame by frame, left first.

    A reviewed frame's image without labels is complete where the frame is said to be empty;
    where only the other image has labels, nobody labelled this one, and it is left out.
    """
    source, labels = workspace.source, workspace.read_labels()
    cameras = Cameras(source.rig, source.frames)
    places = Places(cameras)
    sides: tuple[Side, ...] = ("left",) if source.rig.right is None else ("left", "right")
    found = []
    for index in sorted(one.index for one in source.frames):
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
            is_complete = state != "in work"
            found.append(LabelledSide(workspace.path, index, side, elements, is_complete, doubtful))
    return found


@lru_cache(maxsize=16)
def _source(folder: Path) -> Source:
    """Opened once in each process."""
    return Workspace.open(folder).source


def _doubtful(
    frame_index: int, side: Side, labels: Labels, cameras: Cameras, places: Places
) -> FloatArray:
    """(k, 4) boxes of mapped elements that should be seen, unless somebody said they are not."""
    T_camera_map = cameras.T_camera_map(frame_index)
    if T_camera_map is None:
        return _NOWHERE
    near = places.near(labels, frame_index)
    ghosts = ghosts_in(frame_index, side, T_camera_map, cameras.rig, labels, near)
    open_ones = [one for one in ghosts if not _is_told(one, frame_index, labels)]
    ends = [(one.anchor_px, one.end_px or one.anchor_px) for one in open_ones]
    return _around(np.array(ends, dtype=np.float64).reshape(-1, 2, 2))


def _is_told(ghost: Ghost, frame_index: int, labels: Labels) -> bool:
    """Whether somebody said that an element is not to be seen; of what something hides, a part
    may be."""
    said = labels.dismissals.get(proposal_id(ghost.element_id, frame_index, ghost.side))
    return said is not None and said.why != "occluded"


def _boxes(elements: Elements2D) -> FloatArray:
    """(m, 4) around the ends."""
    anchor = elements.anchor_px
    end = np.where(elements.is_line[:, None], elements.end_px, anchor)
    return _around(np.stack([anchor, end], axis=1))


def _around(ends_px: FloatArray) -> FloatArray:
    """(n, 4) boxes around the two ends (n, 2, 2) of each."""
    return np.concatenate([ends_px.min(axis=1), ends_px.max(axis=1)], axis=1)


def _fill(mask: BoolArray, boxes_px: FloatArray, grown_px: float, value: bool) -> None:
    """Set what is in boxes, grown on all sides."""
    for left, top, right, bottom in boxes_px:
        rows = slice(max(0, round(top - grown_px)), max(0, round(bottom + grown_px) + 1))
        columns = slice(max(0, round(left - grown_px)), max(0, round(right + grown_px) + 1))
        mask[rows, columns] = value


def _digest(sides: Iterable[LabelledSide]) -> str:
    """Of all that is labelled: a training doesn't go on with other labels."""
    content = hashlib.sha256()
    for one in sides:
        content.update(f"{one.frame_index} {one.side} {one.is_complete}".encode())
        for part in (
            one.elements.anchor_px,
            one.elements.end_px,
            one.elements.class_id,
            one.elements.anchor_known,
            one.elements.end_known,
            one.doubtful_px,
        ):
            content.update(part.tobytes())
    return content.hexdigest()[:12]
