"""Training data from labelled workspaces: samples for matchers, images for the detector.

Each sample draws its own prior. A workspace needs two frames with a pose and four labels, one of
them of a map element nearby.

A frame that a person reviewed is complete: unlabelled area contains nothing. In an unreviewed
frame only the surroundings of labels count. Expected positions of elements from other frames
are ignored too, unless a person confirmed that the element is absent or the frame empty.
"""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from semviz.annotator import element_positions
from semviz.annotator.panes import Cameras
from semviz.workspace.chosen_frames import check_map_frame
from semviz.workspace.localization.localize import CROP_RADIUS_M, ROAD_RADIUS_M
from semviz.workspace.observations import observe_labels
from semviz.workspace.workspace import MAIN, Workspace
from semviz_annotation.labels.labels import Labels, proposal_id
from semviz_annotation.mapping.quality.label_links import observe
from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Dataset, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.research.evaluation.problems import NEEDED_DETECTIONS, LocalizationProblem
from semviz_core.research.training.detector_images import LabelledImage
from semviz_core.research.training.simulated_samples import HELD_OUT, make_sample

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
    sides = source.rig.sides
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


CROP_M = CROP_RADIUS_M["labels"]
LEAST_FRAMES = 2
"""One for training, one for validation."""
HELD_OUT_SHARE = 0.2
"""Validation share of each workspace's frames: the last ones, so that few have neighbours in the
training set."""


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """The labels of an image with its true pose and map."""

    observed: Elements2D
    element_id: IntArray
    """(m,) of the map, -1 for unmapped elements."""
    T_map_camera: Pose
    camera: Camera
    semantic_map: SemanticMap


@dataclass(frozen=True, eq=False)
class WorkspaceSamples:
    """Problems and samples by number, as ``SimulatedSamples``: any frame, with its own fix.

    A number gives the same one in every process.
    """

    workspaces: tuple[str, ...]
    training: tuple[LabelledFrame, ...]
    kept_back: tuple[LabelledFrame, ...]
    known: PriorOptions
    """Accuracy of the simulated fixes."""
    shift_m: float
    """As in ``SimulatedSamples``."""

    def problem(self, number: int) -> LocalizationProblem:
        """Return a frame with at least four labels, one of which is in the map.

        ``number`` is below HELD_OUT for training.
        """
        frames = self.training if number < HELD_OUT else self.kept_back
        rng = np.random.default_rng([number, 0])
        frame = frames[rng.integers(len(frames))]
        semantic_map, observed = frame.semantic_map, frame.observed
        prior = simulate_prior(frame.T_map_camera, self.known, int(rng.integers(2**63)))
        prior = replace(prior, road_m=semantic_map.road_near(prior.position_m, ROAD_RADIUS_M))
        submap = semantic_map.crop(prior.position_m, CROP_M)
        pairs = np.argwhere(frame.element_id[:, None] == submap.id)
        truth = frame.T_map_camera.inverse()
        return LocalizationProblem(
            observed, submap, frame.camera, prior, truth, pairs, observed.end_known
        )

    def sample(self, number: int) -> Sample:
        """Return ``problem(number)`` as a sample, turned and shifted at random."""
        return make_sample(self.problem(number), self.shift_m, np.random.default_rng([number, 1]))

    def held_out(self, number: int) -> Sample:
        """Return validation sample ``number``, of frames that are never trained on."""
        return self.sample(HELD_OUT + number)

    def describe(self) -> dict[str, Any]:
        """Return the settings of the samples as JSON."""
        return {
            "workspaces": list(self.workspaces),
            "frames": len(self.training),
            "held_out_frames": len(self.kept_back),
            "shift_m": self.shift_m,
            "known": asdict(self.known),
            "content": self._digest(),
        }

    def _digest(self) -> str:
        """Return a digest of labels, poses and maps: a training resumes only with the same."""
        content = hashlib.sha256()
        for frame in (*self.training, *self.kept_back):
            observed = frame.observed
            for part in (observed.anchor_px, observed.end_px, observed.class_id, frame.element_id):
                content.update(part.tobytes())
            content.update(frame.T_map_camera.as_matrix().tobytes())
            content.update(frame.semantic_map.digest.encode())
        return content.hexdigest()[:12]


def workspace_samples(
    workspaces: Sequence[Workspace],
    map_name: str = MAIN,
    known: PriorOptions | None = None,
    shift_m: float = 0.0,
) -> WorkspaceSamples:
    """Return samples from the labels of ``workspaces`` and their maps ``map_name``.

    Raise SemvizError if a workspace has no map, no poses, other classes, or too few frames.
    """
    known = known or PriorOptions()
    training: list[LabelledFrame] = []
    kept_back: list[LabelledFrame] = []
    for workspace in workspaces:
        frames = labelled_frames(workspace, map_name, CROP_M - known.distance_m[1])
        last = max(1, round(HELD_OUT_SHARE * len(frames)))
        training += frames[:-last]
        kept_back += frames[-last:]
    names = tuple(workspace.name for workspace in workspaces)
    return WorkspaceSamples(names, tuple(training), tuple(kept_back), known, shift_m)


def labelled_frames(
    workspace: Workspace, map_name: str, within_m: float
) -> tuple[LabelledFrame, ...]:
    """Return the frames with a pose and four labels, one of them of a map element ``within_m``.

    Raise SemvizError if these are fewer than two.
    """
    where, source = workspace.path, workspace.source
    semantic_map = workspace.read_map(map_name)
    check_map_frame(semantic_map, source)
    _check_classes(workspace, semantic_map.classes)
    observe = observe_labels(workspace, semantic_map)
    labelled = ((frame, *observe(frame)) for frame in source.frames)
    seen = [frame for frame in labelled if len(frame[1]) >= NEEDED_DETECTIONS]
    if len(seen) < LEAST_FRAMES:
        raise SemvizError(
            f"{where}: {len(seen)} frames have {NEEDED_DETECTIONS} labels or more, training needs "
            f"{LEAST_FRAMES}; label more"
        )
    posed = [
        LabelledFrame(observed, ids, frame.T_map_camera, source.rig.left, semantic_map)
        for frame, observed, ids in seen
        if frame.T_map_camera is not None
    ]
    if not posed:
        raise SemvizError(
            f"{where}: the labelled frames have no poses to learn from; "
            "'semviz new' takes a file of them with --poses"
        )
    frames = tuple(frame for frame in posed if _shows_mapped(frame, within_m))
    if len(frames) < LEAST_FRAMES:
        raise SemvizError(
            f"{where}: map '{map_name}' holds what is labelled in {len(frames)} frames, training "
            f"needs {LEAST_FRAMES}; build it from these labels"
        )
    return frames


def _check_classes(workspace: Workspace, classes: ClassSet) -> None:
    """Raise SemvizError if the map has other classes than the networks."""
    if set(classes) != set(DEFAULT_CLASSES):
        names, known = (
            ", ".join(class_.name for class_ in some) for some in (classes, DEFAULT_CLASSES)
        )
        raise SemvizError(
            f"{workspace.path}: its map has the classes {names}; matchers are trained for {known}"
        )


def _shows_mapped(frame: LabelledFrame, within_m: float) -> bool:
    near = frame.semantic_map.crop(frame.T_map_camera.translation, within_m)
    return bool(np.isin(frame.element_id, near.id).any())
