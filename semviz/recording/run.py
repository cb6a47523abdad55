"""A run: one localization of a sequence, with everything to redraw and measure it."""

from dataclasses import dataclass, field
from typing import Any, Literal

from semviz_core.arrays import IntArray, int_array
from semviz_core.camera import Rig
from semviz_core.frame import Frame
from semviz_core.localization import Localization
from semviz_core.pose import Pose
from semviz_core.semantic_map import SemanticMap

Images = Literal["embedded", "both", "reference", "none"]
"""A run's images: the left ones in its file, those of both cameras, only their names, or none."""


@dataclass(frozen=True, eq=False)
class RunInfo:
    """Where a run comes from, so that it can be made again.

    What the map says of itself (frame, classes, operation, digest) is in ``Run.semantic_map``.
    """

    name: str
    workspace: str
    """Folder of the workspace as the user gave it; empty without one."""
    method: str
    seed: int
    version: str
    """semviz's version."""
    created: str
    """When, as ISO 8601; given by the caller, so that equal runs can be equal files."""
    rig: Rig
    map_name: str
    observations: str = ""
    """Where observations come from, in words: ``labels``, what ``detected`` them, or the simulated
    detector and its noise."""
    options: dict[str, Any] = field(default_factory=dict)
    """JSON values: settings of the method, prior, crop and noise."""
    images: Images = "embedded"


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """One frame of a run."""

    frame: Frame
    localization: Localization
    element_id: IntArray
    """(m,) true map element of each observed row; -1 for a false detection, and for a label that
    is nothing in the map; -2 for a detection of which nobody knows."""
    image: bytes | None = None
    """The left image as JPEG, where it is in the run's file."""
    image_right: bytes | None = None
    """The right one, likewise."""
    image_file: str = ""
    """The left image's file, absolute or as seen from the run's folder; empty if not named."""
    image_right_file: str = ""

    def __post_init__(self) -> None:
        rows = len(self.localization.observed)
        object.__setattr__(self, "element_id", int_array(self.element_id, (rows,), "element_id"))


@dataclass(frozen=True, eq=False)
class Run:
    """What a run file holds."""

    info: RunInfo
    semantic_map: SemanticMap
    frames: tuple[FrameRecord, ...]
    """In order of their frame numbers."""
    complete: bool = True
    """False for a run that was interrupted; every frame in ``frames`` is whole all the same."""

    @property
    def note(self) -> str:
        """One line on what is missing; empty for a complete run."""
        if self.complete:
            return ""
        last = f"after frame {self.frames[-1].frame.index}" if self.frames else "before any frame"
        return f"This run was interrupted {last}; {len(self.frames)} frames are readable."

    @property
    def localizations(self) -> tuple[Localization, ...]:
        """Of every frame, in order."""
        return tuple(one.localization for one in self.frames)

    @property
    def truths(self) -> tuple[Pose | None, ...]:
        """The true T_camera_map of every frame, in order; None where unknown."""
        poses = (one.frame.T_map_camera for one in self.frames)
        return tuple(None if pose is None else pose.inverse() for pose in poses)
