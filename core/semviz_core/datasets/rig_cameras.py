"""The cameras of a rig of several, whose images are frames of one dataset, each of one camera.

Two frames of different cameras are no step of the drive. Whoever goes from frame to frame takes
those of one camera.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from semviz_core.base.camera import Rig
from semviz_core.base.frame import Dataset, Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown


@runtime_checkable
class RigDataset(Dataset, Protocol):
    """A ``Dataset`` that may be of a rig of several cameras.

    All cameras have one pinhole model, ``rig.left``; ``frames`` go camera by camera, in the order
    of ``camera_of``, each in order of time. Both mappings are empty for one camera or a
    stereo pair.
    """

    @property
    def camera_of(self) -> Mapping[int, str]:
        """The name of the camera by ``Frame.index``."""
        ...

    @property
    def mounts(self) -> Mapping[str, Pose]:
        """``T_first_camera`` by the name of the camera, of those that are known."""
        ...


@dataclass(frozen=True, eq=False)
class DatasetWithFrames:
    """A ``Dataset`` with the images of another: some of its frames, or frames with other poses."""

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


def cameras_by_frame(source: Dataset) -> Mapping[int, str]:
    """Return the name of each frame's camera; empty for one camera or a stereo pair."""
    return source.camera_of if isinstance(source, RigDataset) else {}


def frames_by_camera(
    source: Dataset, frames: Sequence[Frame] | None = None
) -> Mapping[str, tuple[Frame, ...]]:
    """Return the frames (None: all) of each camera by name, in order of time.

    One camera or a stereo pair has the empty name.
    """
    camera_of = cameras_by_frame(source)
    groups: dict[str, list[Frame]] = {}
    for frame in source.frames if frames is None else frames:
        groups.setdefault(camera_of.get(frame.index, ""), []).append(frame)
    return {name: tuple(group) for name, group in groups.items()}


def frames_of_camera(
    source: Dataset, camera: str | None, frames: Sequence[Frame] | None = None
) -> tuple[Frame, ...]:
    """Return the frames (None: all) of one camera, in order of time; None: of the first one.

    Raise SemvizError if there is no such camera.
    """
    known = camera_names(source)
    if camera is not None and camera not in known:
        text = shown(", ".join(known), 300) or "one camera, or one stereo pair: leave out --camera"
        raise SemvizError(f"no camera {shown(camera, 60)}; the drive has {text}")
    groups = frames_by_camera(source, frames)
    return groups.get(camera, ()) if camera is not None else next(iter(groups.values()), ())


def in_first_camera(source: Dataset, frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """Return frames of one camera with the poses that the first camera had at their times.

    Raise SemvizError if the drive does not say where that camera is.
    """
    names = camera_names(source)
    if not frames or not isinstance(source, RigDataset) or not names:
        return tuple(frames)
    camera = source.camera_of[frames[0].index]
    if camera == names[0]:
        return tuple(frames)
    if camera not in source.mounts:
        raise SemvizError(f"the drive does not say where camera {shown(camera, 60)} is")
    T_camera_first = source.mounts[camera].inverse()
    return tuple(
        frame
        if frame.T_map_camera is None
        else replace(frame, T_map_camera=frame.T_map_camera @ T_camera_first)
        for frame in frames
    )


def camera_names(source: Dataset) -> tuple[str, ...]:
    """Return the names of the cameras of a rig; empty for one camera or a stereo pair."""
    return tuple(dict.fromkeys(cameras_by_frame(source).values()))
