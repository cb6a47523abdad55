"""A run: one localization of a sequence, with everything to redraw, measure and repeat it.

Writer and reader share the file layout here, and the values that follow from RunInfo:
observations and detector model.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from weakref import WeakKeyDictionary

from semviz_core.base.camera import Rig
from semviz_core.base.detector_model import (
    LABELS,
    SHIPPED_DETECTOR,
    SIMULATED_DETECTOR,
    DetectorModel,
)
from semviz_core.base.frame import Frame, Odometry
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray, int_array
from semviz_core.diagnosis.fault import FrameDiagnosis

Images = Literal["embedded", "both", "reference", "none"]
"""A run's images: the left ones in its file, those of both cameras, only their names, or none."""
Observations = Literal["labels", "detected", "simulated"]
TRACK = "track"
"""Method of runs that tracked the camera, and of their localizations."""


@dataclass(frozen=True, eq=False)
class RunInfo:
    """Origin of a run, so that it can be repeated.

    Frame, classes, operation and digest of the map are in ``Run.semantic_map``.
    """

    name: str
    workspace: str
    """Folder of the workspace as the user gave it; empty without one."""
    method: str
    seed: int
    version: str
    """Version of semviz."""
    created: str
    """Time as ISO 8601; given by the caller, so that equal runs can be equal files."""
    rig: Rig
    map_name: str
    observations: str = ""
    """Source of the observations in words: ``labels``, ``detected by ...``, or the simulated
    detector and its noise."""
    options: dict[str, Any] = field(default_factory=dict)
    """JSON values: settings of the method, prior, crop and noise."""
    images: Images = "embedded"
    camera: str = ""
    """Of a rig: the camera that was localized."""


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """One frame of a run."""

    frame: Frame
    localization: Localization
    element_id: IntArray
    """(m,) true map element of each observed row; -1 for a false positive and for a label without
    map element; -2 for a detection of unknown truth."""
    image: bytes | None = None
    """The left image as JPEG; None if it is not embedded."""
    image_right: bytes | None = None
    """The right image as JPEG; None if it is not embedded."""
    image_file: str = ""
    """Path of the left image, absolute or relative to the run's folder; empty if not recorded."""
    image_right_file: str = ""
    odometry: Odometry | None = None
    """Motion of the camera since the frame before, if it was measured and used."""

    def __post_init__(self) -> None:
        rows = len(self.localization.observed)
        object.__setattr__(self, "element_id", int_array(self.element_id, (rows,), "element_id"))


KNOWN_DIAGNOSES: WeakKeyDictionary[FrameRecord, FrameDiagnosis] = WeakKeyDictionary()
"""Diagnoses of frames, as read or made: a frame that failed takes milliseconds to diagnose."""


@dataclass(frozen=True, eq=False)
class Run:
    """The content of a run file."""

    info: RunInfo
    semantic_map: SemanticMap
    frames: Sequence[FrameRecord]
    """In order of their frame numbers; in memory, or read from the file one by one."""
    complete: bool = True
    """False for an interrupted run; every frame in ``frames`` is complete all the same."""
    damaged: tuple[int, ...] = ()
    """Numbers of the frames whose checksum differs; they are not in ``frames``."""
    lost: int = 0
    """Number of frames that were written but are not in ``frames``: damaged or unreadable."""
    checked: bool = True
    """False for a run of an earlier version of semviz, which has no checksums."""

    @property
    def note(self) -> str:
        """One or two sentences on an interrupted or damaged run; empty for a sound one."""
        return " ".join(filter(None, (self._interruption(), self._damage())))

    def _interruption(self) -> str:
        if self.complete:
            return ""
        last = f"after frame {self.frames[-1].frame.index}" if self.frames else "before any frame"
        return f"This run was interrupted {last}; {len(self.frames)} frames are readable."

    def _damage(self) -> str:
        if not self.lost:
            return ""
        numbers = ", ".join(map(str, self.damaged[:10])) + (", ..." if self.damaged[10:] else "")
        which = f" (frame {numbers})" if self.damaged else ""
        frames = "1 frame is" if self.lost == 1 else f"{self.lost} frames are"
        return (
            f"{frames} damaged and left out{which}: restore the file from a copy, localize again, "
            "or keep the other frames with 'semviz repair'."
        )

    def _repr_html_(self) -> str:
        """Show the frames by status, and where they are, in a notebook."""
        from semviz_core.base.notebook import drive_html

        counts = Counter(result.status for result in self.localizations)
        by_status = ", ".join(f"{number} {status}" for status, number in counts.items())
        title = f"Run {self.info.name}: {len(self.frames)} frames, {by_status}, {self.info.method}"
        estimates = [
            (result.T_camera_map.inverse().translation, str(result.status))
            for result in self.localizations
            if result.T_camera_map is not None
        ]
        truth_m = [pose.inverse().translation for pose in self.truths if pose is not None]
        return drive_html(title, self.semantic_map, truth_m, estimates)

    @property
    def localizations(self) -> tuple[Localization, ...]:
        """The localization of every frame, in order."""
        return tuple(frame.localization for frame in self.frames)

    @property
    def truths(self) -> tuple[Pose | None, ...]:
        """The true T_camera_map of every frame, in order; None where unknown."""
        poses = (frame.frame.T_map_camera for frame in self.frames)
        return tuple(None if pose is None else pose.inverse() for pose in poses)


def observations_of(described: str) -> Observations:
    """Return the kind of observations that ``RunInfo.observations`` describes."""
    if described.startswith("detected"):
        return "detected"
    return "labels" if described == "labels" else "simulated"


RATES = "detector_rates"
"""Option of a run: the rates of a calibrated detector, by the fields of ``DetectorModel``."""


def assumed_detector(info: RunInfo) -> DetectorModel:
    """Return the rates that a run assumed: calibrated ones, or those of its observations."""
    rates = info.options.get(RATES)
    if rates is not None:
        return DetectorModel(**rates).checked()
    return detector_model(observations_of(info.observations))


def detector_model(observations: Observations) -> DetectorModel:
    """Return the assumed rates of a kind of observations."""
    if observations == "labels":
        return LABELS
    return SHIPPED_DETECTOR if observations == "detected" else SIMULATED_DETECTOR


FORMAT_VERSION = 4
"""2: priors hold the road. 3: correspondences of each pose of the search, steps of refinement.
4: the map's definition of triangular signs, and their heights in observations.
Older versions are read, newer ones refused."""
APPLICATION = "semviz"
"""Application id of all runs, so that rerun keeps one layout of views for all of them."""

EXACT = "/semviz"
"""Entities below it hold the exact values. All others, except for images, are for rerun only."""
INFO, MAP, FRAME, END = f"{EXACT}/info", f"{EXACT}/map", f"{EXACT}/frame", f"{EXACT}/end"
DIAGNOSIS = f"{EXACT}/diagnosis"
"""Of the frames that need one. Read if the same version of semviz wrote it."""
TABLE = f"{EXACT}/table"
"""Small columns of all frames of a complete run, and the places of the frames in the file."""
STRUCTURE = "structure"
"""Component with the codec's JSON."""
CHECKSUM = "crc32"
"""Component with the checksum of its row; missing in runs of earlier versions of semviz."""
ORDINAL = "ordinal"
"""Component of a frame: how many frames were written before it."""

CAMERA = "/map/camera_estimate"
IMAGE = f"{CAMERA}/image"
RIGHT_CAMERA = f"{CAMERA}/right"
IMAGE_RIGHT = f"{RIGHT_CAMERA}/image"
"""In runs with the images of both cameras."""


def run_names(paths: Sequence[Path]) -> list[str]:
    """Return file names without ending, with as many parent folders as distinguish them."""
    whole = [path.resolve().with_suffix("").parts for path in paths]
    names = [parts[-1] for parts in whole]
    depth = 1
    while len(set(names)) < len(set(whole)):
        depth += 1
        names = ["/".join(parts[-depth:]) for parts in whole]
    return names
