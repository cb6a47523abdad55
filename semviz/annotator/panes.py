"""The two images on the page, and the camera of every image.

They are a frame's left and right image or, with one camera, images of two frames; the page
calls them left and right.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz_annotation.labels.views import PosedView, rig_view
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError


class Cameras:
    """Views by frame and side, cached."""

    def __init__(self, rig: Rig, frames: Iterable[Frame]) -> None:
        self.rig = rig
        self.T_map_camera = {frame.index: frame.T_map_camera for frame in frames}
        """Pose of the left camera by frame, in order of time; None if it is unknown."""
        self.rank = {index: rank for rank, index in enumerate(self.T_map_camera)}
        """Place of each frame in time."""
        self._views: dict[tuple[int, Side], PosedView] = {}
        self._depths: dict[Pane, FloatArray] = {}
        """(4,) depth in an image over its focal length, of homogeneous points in the map frame."""

    def T_camera_map(self, frame_index: int) -> Pose | None:  # noqa: N802 - the frames' names
        """Return the pose of a frame's left camera; None if it is unknown."""
        pose = self.T_map_camera[frame_index]
        return None if pose is None else pose.inverse()

    def view(self, frame_index: int, side: Side) -> PosedView:
        """Return a view in the map frame; in left camera coordinates if the frame has no pose."""
        key = frame_index, side
        if key not in self._views:
            self._views[key] = rig_view(self.rig, side, self.T_camera_map(frame_index))
        return self._views[key]

    def sizes_px(self, element: Triangulated, panes: Sequence["Pane"]) -> FloatArray:
        """Return (n,) the size of an element in images, px per metre; 0 behind the camera."""
        depths = np.array([self._depth(pane) for pane in panes]) @ np.append(element.anchor_m, 1.0)
        return np.asarray(np.where(depths > 0.0, 1.0 / np.where(depths > 0.0, depths, 1.0), 0.0))

    def _depth(self, pane: "Pane") -> FloatArray:
        if pane not in self._depths:
            view = self.view(pane.frame_index, pane.side)
            pose = view.T_camera_map
            depth = np.append(pose.rotation[2], pose.translation[2])
            self._depths[pane] = depth / view.camera.K[0, 0]
        return self._depths[pane]


APART_M = 4.0
"""Baseline of the second image if there is no right camera. A pole 20 m ahead and 4 m aside is then
seen from directions 2.5 degrees apart, and is still on screen."""
LEAST_APART_M = 0.3
MOST_FRAMES_APART = 20


@dataclass(frozen=True)
class Pane:
    """One image: its frame and its camera."""

    frame_index: int
    side: Side


class Panes:
    """Chooses the two images of a page; the page calls them left and right."""

    def __init__(self, cameras: Cameras) -> None:
        self._cameras = cameras
        self._indices = tuple(cameras.T_map_camera)
        self._rank = {index: rank for rank, index in enumerate(self._indices)}

    def of(self, frame_index: int) -> Mapping[Side, Pane]:
        """Return the images of a frame; left alone if there is no second image."""
        if self._cameras.rig.right is not None:
            return {"left": Pane(frame_index, "left"), "right": Pane(frame_index, "right")}
        panes: dict[Side, Pane] = {"left": Pane(frame_index, "left")}
        companion = self._companion(frame_index)
        return panes if companion is None else panes | {"right": Pane(companion, "left")}

    def pane(self, frame_index: int, shown_as: Side) -> Pane:
        """Return the image shown as ``shown_as``. Raise SemvizError if there is none."""
        try:
            return self.of(frame_index)[shown_as]
        except KeyError:
            raise SemvizError(f"frame {frame_index} has no second image") from None

    def _companion(self, frame_index: int) -> int | None:
        """The nearest earlier frame (or else later one) at least ``APART_M`` away, or the furthest.

        Elements ahead of a frame are ahead of earlier ones too, and those are labelled already.
        """
        rank = self._rank[frame_index]
        first, end = max(0, rank - MOST_FRAMES_APART), rank + MOST_FRAMES_APART + 1
        around = np.r_[np.arange(first, rank)[::-1], np.arange(rank + 1, end)]
        around = around[around < len(self._indices)]
        gaps = np.linalg.norm(self._centers[around] - self._centers[rank], axis=1)
        if np.nanmax(gaps, initial=0.0) < LEAST_APART_M:
            return None
        far = np.flatnonzero(gaps >= APART_M)
        return self._indices[int(around[far[0] if len(far) else np.nanargmax(gaps)])]

    @cached_property
    def _centers(self) -> FloatArray:
        """(n, 3) m; NaN without a pose."""
        nowhere = np.full(3, np.nan)
        return np.array(
            [
                nowhere if pose is None else pose.translation
                for pose in self._cameras.T_map_camera.values()
            ]
        )
