"""The two images on the page, and the camera of every image.

They are a frame's left and right image or images of two frames, of one camera or of two of a rig;
the page calls them left and right.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semviz.web.protocol import Part, RefusedError
from semviz_annotation.labels.views import PosedView, rig_view
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError


class Cameras:
    """Views by frame and side, cached."""

    def __init__(
        self, rig: Rig, frames: Iterable[Frame], camera_of: Mapping[int, str] | None = None
    ) -> None:
        """``camera_of``: names of the cameras of a rig by frame, see ``RigDataset``."""
        frames = tuple(frames)
        self.rig = rig
        self.camera_of = camera_of or {}
        self.time_s = {frame.index: frame.time_s for frame in frames}
        self.T_map_camera = {frame.index: frame.T_map_camera for frame in frames}
        """Pose of the left camera by frame, in order of time; None if it is unknown."""
        self.rank = {index: rank for rank, index in enumerate(self.T_map_camera)}
        """Place of each frame in time."""
        self._views: dict[tuple[int, Side], PosedView] = {}
        self._depths: dict[Pane, FloatArray] = {}
        """(4,) depth in an image over its focal length, of homogeneous points in the map frame."""

    @property
    def sides(self) -> tuple[Side, ...]:
        """The images of a frame."""
        return self.rig.sides

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


LEAST_ANGLE_RAD = float(np.deg2rad(1.8))
"""Least angle between the rays of both images, if there is no right camera, to a point
``REFERENCE_M`` ahead and aside. Driving straight ahead, that needs 4 m to an earlier frame and 3 m
to a later one; for a camera that looks aside, it needs 1 m."""
REFERENCE_M = np.array([[4.0, 0.0, 20.0], [-4.0, 0.0, 20.0]])
LEAST_APART_M = 0.3
MOST_FRAMES_APART = 20


@dataclass(frozen=True)
class Pane:
    """One image: its frame and its camera."""

    frame_index: int
    side: Side


class SecondImage(Part):
    """The wish for another second image than the usual one."""

    camera: str | None = None
    """Of a rig: the image of this camera that was taken nearest in time."""
    step: int | None = None
    """The image of the same camera this many images later; negative: earlier."""


class Panes:
    """Chooses the two images of a page; the page calls them left and right.

    Without a wish they are a frame's left and right image. With one camera the second is an image
    from which the same things are seen at an angle.
    """

    def __init__(self, cameras: Cameras) -> None:
        self._cameras = cameras
        self._indices = tuple(cameras.T_map_camera)
        self._by_camera: dict[str, list[int]] = {}
        for index in self._indices:
            self._by_camera.setdefault(self.camera(index), []).append(index)
        self._rank = {
            index: rank for group in self._by_camera.values() for rank, index in enumerate(group)
        }
        self._second: dict[int, int] = {}

    def camera(self, frame_index: int) -> str:
        """Return the name of a frame's camera; empty if the drive is of one camera or pair."""
        return self._cameras.camera_of.get(frame_index, "")

    def at_that_time(self, frame_index: int) -> dict[str, int]:
        """Return the frames of the other cameras of the rig that were taken nearest in time."""
        here = self.camera(frame_index)
        others = [name for name in self._by_camera if name != here]
        return {name: self._nearest(name, frame_index) for name in others}

    def _nearest(self, camera: str, frame_index: int) -> int:
        time_s = self._cameras.time_s
        return min(self._by_camera[camera], key=lambda i: abs(time_s[i] - time_s[frame_index]))

    def chosen(self, frame_index: int, wish: SecondImage | None) -> int | None:
        """Return the frame of the wished second image; None for the usual one, also if there is
        none as wished, or one of both has no pose."""
        found: int | None = None
        if wish is not None and wish.camera is not None:
            found = self.at_that_time(frame_index).get(wish.camera)
        elif wish is not None and wish.step:
            group = self._by_camera[self.camera(frame_index)]
            rank = self._rank[frame_index] + wish.step
            found = group[rank] if 0 <= rank < len(group) else None
        return found if found is not None and self._fit(frame_index, found) else None

    def _fit(self, frame_index: int, second: int) -> bool:
        """Whether two frames can be shown together: both have poses."""
        poses = [self._cameras.T_map_camera.get(index) for index in (frame_index, second)]
        return second != frame_index and all(pose is not None for pose in poses)

    def show(self, frame_index: int, second: int | None) -> None:
        """Let the left image of frame ``second`` be the second image of a frame; None: the usual.

        Raise RefusedError if there is no such frame, or one of both has no pose.
        """
        if second is None:
            self._second.pop(frame_index, None)
        elif self._fit(frame_index, second):
            self._second[frame_index] = second
        else:
            raise RefusedError("not_found", f"frame {second} cannot be shown beside {frame_index}")

    def of(self, frame_index: int) -> Mapping[Side, Pane]:
        """Return the images of a frame; left alone if there is no second image."""
        panes: dict[Side, Pane] = {"left": Pane(frame_index, "left")}
        second = self._second.get(frame_index)
        if second is None and self._cameras.rig.right is not None:
            return panes | {"right": Pane(frame_index, "right")}
        if second is None:
            second = self._companion(frame_index)
        return panes if second is None else panes | {"right": Pane(second, "left")}

    def pane(self, frame_index: int, shown_as: Side) -> Pane:
        """Return the image shown as ``shown_as``. Raise SemvizError if there is none."""
        try:
            return self.of(frame_index)[shown_as]
        except KeyError:
            raise SemvizError(f"frame {frame_index} has no second image") from None

    def _companion(self, frame_index: int) -> int | None:
        """Return the nearest earlier frame (or else later one) of the same camera at a useful
        angle, or the furthest.

        Elements ahead of a frame are ahead of earlier ones too, and those are labelled already.
        """
        group, rank = self._by_camera[self.camera(frame_index)], self._rank[frame_index]
        first, end = max(0, rank - MOST_FRAMES_APART), rank + MOST_FRAMES_APART + 1
        around = group[first:rank][::-1] + group[rank + 1 : end]
        T_here_map = self._cameras.T_camera_map(frame_index)
        if T_here_map is None:
            return None
        poses = [(index, self._cameras.T_map_camera[index]) for index in around]
        centers = {
            index: T_here_map.apply(pose.translation[None])[0]
            for index, pose in poses
            if pose is not None
        }
        apart = {index: float(np.linalg.norm(center)) for index, center in centers.items()}
        if max(apart.values(), default=0.0) < LEAST_APART_M:
            return None
        useful = (i for i, center in centers.items() if _angle_rad(center) > LEAST_ANGLE_RAD)
        return next(useful, max(apart, key=lambda index: apart[index]))


def _angle_rad(center_m: FloatArray) -> float:
    """Return the mean angle at ``REFERENCE_M`` between rays to a camera and to another one, at
    ``center_m`` (3,) in its axes."""
    here, there = REFERENCE_M, REFERENCE_M - center_m
    lengths = np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1)
    cosines = np.clip((here * there).sum(axis=1) / np.maximum(lengths, 1e-9), -1.0, 1.0)
    return float(np.arccos(cosines).mean())
