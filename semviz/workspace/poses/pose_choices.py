"""What people chose for frames with wrong poses: the file ``pose_choices.json`` of a workspace.

The file holds the operations in order, each a choice for a stretch of frames: use refined poses,
leave the frames out, keep the given poses, or ask again. Refined poses are stored with the choice.
The given poses stay as they are; ``Workspace.source`` applies the choices to them. Operations can
be undone and redone. The file is written as a whole, with a checksum.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_args

import numpy as np
from pydantic import Field

from semviz.workspace.checked_file import CheckedModel, read_checked
from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz_core.pose_checks.faults import PoseFault

FILE = "pose_choices.json"
Choice: TypeAlias = Literal["refine", "leave out", "keep", "ask"]
"""``ask``: no choice; a check names the fault again."""
Subject: TypeAlias = Literal["frames", "axes", "time", "heights", "baseline", "right image"]
"""What a choice is about: single frames, or a fault of the whole drive."""
_Matrix = Annotated[tuple[float, ...], Field(min_length=12, max_length=12)]
"""A pose: the 12 numbers of a 3x4 matrix, row by row."""
_RIG: tuple[Subject, ...] = ("baseline", "right image")
"""Faults that no pose can repair."""


class RefinedPose(CheckedModel):
    """The refined pose of one frame."""

    frame: int = Field(ge=0, lt=2**31)
    T_map_camera: _Matrix

    @classmethod
    def of(cls, frame: Frame) -> "RefinedPose":
        assert frame.T_map_camera is not None
        matrix = frame.T_map_camera.as_matrix()[:3]
        return cls(frame=frame.index, T_map_camera=tuple(matrix.ravel().tolist()))

    @property
    def pose(self) -> Pose:
        return Pose.from_matrix(np.reshape(self.T_map_camera, (3, 4)))


class PoseOperation(CheckedModel):
    """One choice for the frames ``first`` to ``last``."""

    choice: Choice
    first: int = Field(ge=0, lt=2**31)
    last: int = Field(ge=0, lt=2**31)
    subject: Subject = "frames"
    author: str
    time: str
    """UTC, ISO 8601."""
    request_id: str = ""
    """Of the page's request, so that one that is sent twice is applied once."""
    given: str | None = None
    """Digest of the given poses that were refined; None without refined poses."""
    poses: tuple[RefinedPose, ...] = ()

    def model_post_init(self, _: Any) -> None:
        if self.last < self.first:
            raise ValueError("the last frame is before the first")
        if (self.choice == "refine") != bool(self.poses and self.given):
            raise ValueError("refined poses belong to the choice 'refine', and to no other")

    def fits(self, frames: Sequence[Frame]) -> bool:
        """Whether its refined poses, if any, were refined from those of ``frames``."""
        refined = {pose.frame for pose in self.poses}
        given = [frame for frame in frames if frame.index in refined]
        return self.given is None or self.given == digest_of(given)

    @property
    def where(self) -> str:
        """``frame 5`` or ``frames 0-11``."""
        if self.first == self.last:
            return f"frame {self.first}"
        return f"frames {self.first}-{self.last}"

    def as_dict(self) -> dict[str, Any]:
        """For JSON, without the poses themselves."""
        return self.model_dump(exclude={"poses", "given", "request_id"})


class PoseChoices(CheckedModel):
    """The content of the file. The first ``standing`` operations count; later ones are undone."""

    version: Literal[1] = 1
    standing: int = Field(default=0, ge=0)
    operations: tuple[PoseOperation, ...] = ()

    def model_post_init(self, _: Any) -> None:
        if self.standing > len(self.operations):
            raise ValueError("more operations stand than there are")

    @property
    def present(self) -> tuple[PoseOperation, ...]:
        """The operations that are not undone, oldest first."""
        return self.operations[: self.standing]

    def choice_for(self, fault: "PoseFault") -> PoseOperation | None:
        """Return the choice that answers a fault; None if it is open.

        Refining the whole drive answers all faults that poses can have.
        """
        subject = subject_of(fault)
        for operation in reversed(self.present):
            is_refined = operation.choice == "refine" and operation.subject != "frames"
            about_it = operation.subject == subject or (is_refined and subject not in _RIG)
            if about_it and operation.first <= fault.first and fault.last <= operation.last:
                return None if operation.choice == "ask" else operation
        return None

    def applied(self, frames: Sequence[Frame]) -> tuple[Frame, ...]:
        """Return the frames with the chosen poses. Frames left out have none.

        Raise SemvizError if poses were refined from other ones than those of ``frames``.
        """
        whole: dict[int, Pose | None] = {}
        single: dict[int, Pose | None] = {}
        for operation in self.present:
            if not operation.fits(frames):
                raise SemvizError(
                    f"the poses of {operation.where} were refined from other poses than the drive "
                    "has now; restore those, or delete the file to choose again"
                )
            if operation.subject in _RIG:
                continue
            target = single if operation.subject == "frames" else whole
            covered = range(operation.first, operation.last + 1)
            for index in [index for index in target if index in covered]:
                del target[index]
            if operation.subject != "frames":
                single = {} if operation.choice in ("refine", "leave out") else single
            if operation.choice == "refine":
                target |= {refined.frame: refined.pose for refined in operation.poses}
            elif operation.choice == "leave out":
                target |= {frame.index: None for frame in frames if frame.index in covered}
        chosen = whole | single
        return tuple(
            replace(
                frame,
                T_map_camera=chosen[frame.index],
                left_out=chosen[frame.index] is None,
            )
            if frame.index in chosen
            else frame
            for frame in frames
        )

    def with_operation(self, operation: PoseOperation) -> "PoseChoices":
        """Return the choices after another one; undone ones are dropped."""
        operations = (*self.present, operation)
        return PoseChoices(standing=len(operations), operations=operations)

    def moved(self, by: Literal[-1, 1]) -> "PoseChoices":
        """Return the choices with the last one undone (-1), or the last undone one redone (1).

        Raise SemvizError if there is none.
        """
        standing = self.standing + by
        if not 0 <= standing <= len(self.operations):
            word = "undo" if by < 0 else "redo"
            raise SemvizError(f"there is no choice of poses to {word}")
        return self.model_copy(update={"standing": standing})


def subject_of(fault: "PoseFault") -> Subject:
    """Return what a choice about a fault is about."""
    subjects: dict[str, Subject] = {name: name for name in get_args(Subject)}
    return subjects.get(fault.kind, "frames")


def digest_of(frames: Sequence[Frame]) -> str:
    """Return SHA-256 (hex) of the numbers and poses of ``frames``."""
    hasher = hashlib.sha256()
    for frame in frames:
        pose = frame.T_map_camera
        hasher.update(f"{frame.index} ".encode())
        hasher.update(b"" if pose is None else pose.as_matrix().tobytes())
    return hasher.hexdigest()


def now() -> str:
    """Return the present time as operations store it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def read_choices(path: Path) -> PoseChoices:
    """Return the choices in the file ``path``; none if there is no such file.

    Raise SemvizError if it is damaged, or of a newer version.
    """
    return read_checked(path, PoseChoices, "choices", "all poses are then used as given")
