"""The camera of every image of the sequence, and where it stood."""

from collections.abc import Iterable

from semviz_annotation.view import View, rig_view
from semviz_core.camera import Rig
from semviz_core.frame import Frame
from semviz_core.pose import Pose
from semviz_core.sources.source import Side


class Cameras:
    """Views by frame and side, each made once."""

    def __init__(self, rig: Rig, frames: Iterable[Frame]) -> None:
        self.rig = rig
        self.T_map_camera = {one.index: one.T_map_camera for one in frames}
        """Of the left camera, by frame in order of time; None where it is not known."""
        self._views: dict[tuple[int, Side], View] = {}

    def T_camera_map(self, frame_index: int) -> Pose | None:  # noqa: N802 - the frames' names
        """Pose of a frame's left camera; None where it is not known."""
        pose = self.T_map_camera[frame_index]
        return None if pose is None else pose.inverse()

    def view(self, frame_index: int, side: Side) -> View:
        """In the map frame; in the coordinates of the left camera where that has no pose."""
        key = frame_index, side
        if key not in self._views:
            self._views[key] = rig_view(self.rig, side, self.T_camera_map(frame_index))
        return self._views[key]
