"""Wrong poses of a workspace, what labels say about them, and the choice that a person makes.

A check compares the given poses with the motions of the images. Motions take seconds per hundred
frames, and depend on images and calibration alone, so the workspace keeps them in one file; a file
of other images is measured again. The choices made so far answer the check's faults.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from semviz.workspace.checked_file import changing, write_checked
from semviz.workspace.poses import pose_labels
from semviz.workspace.poses.pose_choices import (
    Choice,
    PoseChoices,
    PoseOperation,
    RefinedPose,
    Subject,
    digest_of,
    now,
    subject_of,
)
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.build import POSES
from semviz_core.base.frame import FileDataset, Frame, Side
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnProgress
from semviz_core.datasets.rig_cameras import DatasetWithFrames, cameras_by_frame, frames_of_camera
from semviz_core.datasets.validation import Calibration
from semviz_core.pose_checks import faults, image_motions
from semviz_core.pose_checks.comparison import rows_of_runs
from semviz_core.pose_checks.pose_covariance import PoseCovariance

FILE = "image_motions.safetensors"
MIN_FRAMES = 3


def motions_path(workspace: Workspace) -> Path:
    """Return where the motions of the images are or would be."""
    return workspace.path / FILE


def check_poses(
    workspace: Workspace, frames: Sequence[Frame], on_progress: OnProgress
) -> faults.PoseCheck:
    """Return what images say about the poses of ``frames``.

    ``on_progress`` may raise to stop. Raise SemvizError if there are too few frames or poses, or
    if the images show too little motion to check anything.
    """
    _require_poses(workspace, frames)
    source = source_key(workspace, frames)
    motions = image_motions.load_motions(motions_path(workspace), source)
    if motions is None:
        motions = image_motions.measure_motions(workspace.source, frames, on_progress)
        image_motions.save_motions(motions, source, motions_path(workspace))
    check = faults.check_drive(frames, motions, workspace.source.rig)
    if not check.is_checked:
        raise SemvizError(
            f"{workspace.path}: only {check.measured:.0%} of the pairs of frames share enough "
            "points to check poses; choose --frames where neighbours look alike"
        )
    return check


def known_check(workspace: Workspace) -> faults.PoseCheck | None:
    """Return the check of all given poses if the motions of the images are known; measure
    nothing."""
    frames = frames_of_camera(workspace.given_source, None)
    if not motions_path(workspace).is_file() or len(frames) < MIN_FRAMES:
        return None
    motions = image_motions.load_motions(motions_path(workspace), source_key(workspace, frames))
    if motions is None:
        return None
    check = faults.check_drive(frames, motions, workspace.given_source.rig)
    return check if check.is_checked else None


def pose_errors(workspace: Workspace) -> PoseCovariance | None:
    """Return the errors of the poses used now, as images show them; None if the motions of the
    images are not known."""
    check = known_check(workspace)
    if check is None:
        return None
    pairs = zip(workspace.given_source.frames, workspace.source.frames, strict=True)
    refined = [now.index for given, now in pairs if now is not given and not now.left_out]
    return faults.pose_covariance(check, refined)


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


@dataclass(frozen=True, eq=False)
class PoseStretch:
    """A fault of poses, with the labels of its frames."""

    fault: faults.PoseFault
    check: faults.PoseCheck
    labels: Labels
    workspace: Workspace

    @property
    def subject(self) -> Subject:
        return subject_of(self.fault)

    @property
    def can_refine(self) -> bool:
        """Whether other poses repair it: not a fault of the calibration."""
        return self.fault.kind not in faults.RIG_KINDS

    @property
    def labels_agree(self) -> bool:
        """Whether most of the elements fit refined poses better, or none says anything."""
        evidence = None if self.seen is None else self.seen.evidence
        return evidence is None or 2 * evidence.agreeing >= evidence.elements

    @property
    def label_count(self) -> int:
        inside = range(self.fault.first, self.fault.last + 1)
        return sum(
            len(self.labels.in_frame(frame)) for frame in self.labels.frames if frame in inside
        )

    @cached_property
    def seen(self) -> pose_labels.FaultLabels | None:
        """The labels against elements placed by other frames; None if they say nothing."""
        if not self.can_refine:
            return None
        source, (first, last) = self.workspace.given_source, (self.fault.first, self.fault.last)
        return pose_labels.FaultLabels.of(self.labels, source, self.check, first, last)

    @cached_property
    def moves(self) -> tuple[pose_labels.ElementMove, ...]:
        """How far refining these poses moves the elements of the map."""
        if not self.can_refine:
            return ()
        source, (first, last) = self.workspace.given_source, (self.fault.first, self.fault.last)
        return pose_labels.element_moves(self.labels, source, self.check, first, last)

    @cached_property
    def lost(self) -> tuple[str, ...]:
        """Names of elements that no map has if the frames are left out: fewer than two labels."""
        inside = range(self.fault.first, self.fault.last + 1)
        rows = [
            row
            for frame in self.labels.frames
            if frame in inside
            for row in self.labels.in_frame(frame)
        ]
        elements = [self.labels.element(id_) for id_ in {row.element_id for row in rows}]
        return tuple(
            self.labels.classes.element_name(element.class_id, element.number)
            for element in sorted(elements, key=lambda element: element.number)
            if sum(row.frame_index not in inside for row in self.labels.of_element(element.id)) < 2
        )


@dataclass(frozen=True, eq=False)
class PoseFindings:
    """What images and labels say about the given poses, whatever is chosen for them."""

    workspace: Workspace
    check: faults.PoseCheck
    """Of the given poses."""
    labels: Labels

    @cached_property
    def stretches(self) -> tuple[PoseStretch, ...]:
        """The faults, by how far poses are off."""
        found = (
            PoseStretch(fault, self.check, self.labels, self.workspace)
            for fault in self.check.faults
        )
        return tuple(sorted(found, key=lambda one: -_size(one.fault)))

    @cached_property
    def agreements(self) -> dict[int, pose_labels.FrameAgreement]:
        """How the labels of each frame fit the given poses."""
        given = DatasetWithFrames(self.workspace.given_source, self.check.frames)
        found = pose_labels.frame_agreements(self.labels, given, faults.refined_frames(self.check))
        return {agreement.frame: agreement for agreement in found}


@dataclass(frozen=True, eq=False)
class PoseReview:
    """The faults of the given poses, with the choices made for them."""

    findings: PoseFindings
    choices: PoseChoices

    @classmethod
    def of(cls, workspace: Workspace, check: faults.PoseCheck, labels: Labels) -> "PoseReview":
        """Return the faults of ``check``, of the given poses, with the choices made so far."""
        return cls(PoseFindings(workspace, check, labels), workspace.pose_choices())

    @property
    def workspace(self) -> Workspace:
        return self.findings.workspace

    @property
    def check(self) -> faults.PoseCheck:
        return self.findings.check

    @property
    def labels(self) -> Labels:
        return self.findings.labels

    @cached_property
    def stretches(self) -> tuple[PoseStretch, ...]:
        """Those without a choice first, then by how far poses are off."""
        return tuple(
            sorted(self.findings.stretches, key=lambda one: self.choice_for(one) is not None)
        )

    def choice_for(self, stretch: PoseStretch) -> PoseOperation | None:
        """Return the choice that answers a fault; None if it is open."""
        return self.choices.choice_for(stretch.fault)

    @property
    def open(self) -> tuple[PoseStretch, ...]:
        return tuple(stretch for stretch in self.stretches if self.choice_for(stretch) is None)

    @property
    def wrong_frames(self) -> frozenset[int]:
        """Frames whose poses are wrong and used all the same: their labels are not to blame."""
        return frozenset(
            frame.index
            for stretch in self.stretches
            if self._is_used(stretch) and stretch.subject == "frames" and stretch.labels_agree
            for frame in self.check.frames
            if stretch.fault.first <= frame.index <= stretch.fault.last
        )

    def _is_used(self, stretch: PoseStretch) -> bool:
        operation = self.choice_for(stretch)
        return operation is None or operation.choice == "keep"

    @property
    def wrong_observations(self) -> frozenset[str]:
        """Ids of the labels in those frames."""
        frames = sorted(self.wrong_frames & set(self.labels.frames))
        return frozenset(row.id for frame in frames for row in self.labels.in_frame(frame))

    @cached_property
    def used(self) -> tuple[Frame, ...]:
        """The frames with the chosen poses."""
        return self.choices.applied(self.check.frames)


def _size(fault: faults.PoseFault) -> float:
    """Return how bad a fault is: all poses, then by turn and shift, then the calibration."""
    if fault.kind in faults.RIG_KINDS:
        return 0.0
    if subject_of(fault) != "frames":
        return 1000.0
    return fault.turn_deg + fault.shift_m


def choose_poses(
    review: PoseReview,
    choice: Choice,
    stretch: tuple[int, int, Subject],
    author: str,
    request_id: str = "",
) -> PoseOperation:
    """Store a choice for a stretch (first and last frame, and what it is about); it is on disk when
    this returns. A request id that was used before returns its operation.

    Raise SemvizError, and change nothing, if the drive is simulated, the frames are not in it, or
    the labels that were kept back fit refined poses worse.
    """
    operation = _operation(review, choice, stretch, author, request_id)
    workspace = review.workspace
    path = workspace.pose_choices_path
    with changing(path):
        choices = workspace.pose_choices()
        for earlier in choices.operations:
            if request_id and earlier.request_id == request_id:
                return earlier
        write_checked(path, choices.with_operation(operation))
    return operation


def step_choices(workspace: Workspace, by: Literal[-1, 1]) -> PoseOperation:
    """Undo the last choice (-1) or redo the last undone one (1); return its operation.

    Raise SemvizError if there is none.
    """
    path = workspace.pose_choices_path
    with changing(path):
        choices = workspace.pose_choices()
        moved = choices.moved(by)
        write_checked(path, moved)
    return choices.operations[min(choices.standing, moved.standing)]


def _operation(
    review: PoseReview,
    choice: Choice,
    stretch: tuple[int, int, Subject],
    author: str,
    request_id: str,
) -> PoseOperation:
    first, last, subject = stretch
    frames = [frame for frame in review.check.frames if first <= frame.index <= last]
    if not isinstance(review.workspace.given_source, FileDataset):
        raise SemvizError("the poses of a simulated street are true: there is nothing to choose")
    if not frames:
        raise SemvizError(f"the drive has no frames from {first} to {last}")
    operation = PoseOperation(
        choice="ask",
        first=frames[0].index,
        last=frames[-1].index,
        subject=subject,
        author=author,
        time=now(),
        request_id=request_id,
    )
    if choice != "refine":
        return operation.model_copy(update={"choice": choice})
    refined = _refined(review, operation)
    numbers = {pose.frame for pose in refined}
    given = digest_of([frame for frame in review.check.frames if frame.index in numbers])
    return PoseOperation.model_validate(
        operation.model_dump() | {"choice": "refine", "given": given, "poses": refined}
    )


def _refined(review: PoseReview, wanted: PoseOperation) -> tuple[RefinedPose, ...]:
    """Return the refined poses of the frames. Raise SemvizError if they may not be used."""
    if wanted.subject in faults.RIG_KINDS:
        raise SemvizError("other poses do not repair the calibration; correct that, or keep it")
    source = review.workspace.given_source
    if cameras_by_frame(source):
        raise SemvizError(
            "a rig of several cameras: its poses are refined by 'semviz poses refine'"
        )
    for other in review.stretches if wanted.subject == "frames" else ():
        is_whole = other.subject != "frames" and other.can_refine
        operation = review.choice_for(other)
        if is_whole and (operation is None or operation.choice != "refine"):
            raise SemvizError(f"first refine the whole drive: {other.fault.text}")
    seen = pose_labels.FaultLabels.of(
        review.labels, source, review.check, wanted.first, wanted.last
    )
    evidence = None if seen is None else seen.evidence
    if evidence is not None and evidence.grows_worse:
        raise SemvizError(
            f"Refining makes the labels kept back worse ({evidence.before_px:.1f} px, then "
            f"{evidence.after_px:.1f} px). Nothing was changed."
        )
    chosen = [
        RefinedPose.of(frame)
        for frame in faults.refined_frames(review.check)
        if wanted.first <= frame.index <= wanted.last and frame.T_map_camera is not None
    ]
    if not chosen:
        raise SemvizError(f"{wanted.where}: no pose to refine")
    return tuple(chosen)


def used_poses(workspace: Workspace) -> dict[str, Any]:
    """Return, as JSON values, which poses are used now: the frames refined and left out, and a
    digest of all poses. Empty if nobody has chosen anything."""
    given, used = workspace.given_source.frames, workspace.source.frames
    pairs = list(zip(given, used, strict=True))
    refined = [one.index for one, now in pairs if now is not one and not now.left_out]
    left_out = [now.index for now in used if now.left_out]
    if not refined and not left_out:
        return {}
    order = [frame.index for frame in given]
    return {
        "refined": _runs(refined, order),
        "left_out": _runs(left_out, order),
        "digest": digest_of(used),
    }


def with_used_poses(semantic_map: SemanticMap, workspace: Workspace) -> SemanticMap:
    """Return a map that was built now, with a record of the poses it was built with."""
    used = used_poses(workspace)
    if not used:
        return semantic_map
    return replace(semantic_map, settings={**semantic_map.settings, POSES: used})


def pose_change(semantic_map: SemanticMap, workspace: Workspace) -> str:
    """Return in which way a map was built with other poses than those used now; empty if not."""
    before, after = semantic_map.settings.get(POSES, {}), used_poses(workspace)
    if before.get("digest") == after.get("digest"):
        return ""
    parts = []
    for name, word in (("refined", "refined"), ("left_out", "left out")):
        for verb, these, those in (("now", after, before), ("no longer", before, after)):
            changed = [run for run in these.get(name, []) if run not in those.get(name, [])]
            if changed:
                parts.append(f"{frames_text(changed)} {verb} {word}")
    return "; ".join(parts) or "other refined poses"


def frames_text(runs: Sequence[Sequence[int]]) -> str:
    """Return ``frames 0-11, 40``."""
    names = [f"{first}" if first == last else f"{first}-{last}" for first, last in runs]
    is_one = len(runs) == 1 and runs[0][0] == runs[0][1]
    return f"{'frame' if is_one else 'frames'} {', '.join(names)}"


def _runs(numbers: list[int], order: list[int]) -> list[list[int]]:
    """Return first and last of each run of consecutive frames."""
    runs = rows_of_runs(np.isin(order, numbers))
    return [[order[first], order[last]] for first, last in runs]
