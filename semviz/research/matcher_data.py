"""Training samples for matchers from workspaces: labelled frames with true poses and maps.

Each sample draws its own prior. A workspace needs two frames with a pose and four labels, one of
them of a map element nearby.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from semviz.workspace.localize import CROP_RADIUS_M, ROAD_RADIUS_M, check_map_frame
from semviz.workspace.observations import observe_labels
from semviz.workspace.workspace import MAIN, Workspace
from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.elements import Elements2D
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localization.correspondences.sample import Sample
from semviz_core.research.evaluation.problems import NEEDED_DETECTIONS, LocalizationProblem
from semviz_core.research.training.simulated_samples import HELD_OUT, make_sample

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
