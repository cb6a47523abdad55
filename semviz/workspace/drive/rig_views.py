"""All cameras of a drive, for one pose from what they see at about the same time.

A frame of a workspace is one image of one camera. Beside a frame of the camera that is localized,
each other camera has the frame that is nearest in time; a stereo pair has its right image.
"""

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from semviz.workspace.observations import Observe
from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Dataset, Frame, Odometry, Prior
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.rig_cameras import RigDataset, camera_names, frames_by_camera
from semviz_core.localization.camera_views import STANDING, BodyMotion, CameraView
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.rig import localize_rig

OdometrySource = Callable[[Frame, Frame], Odometry | None]
"""Returns the motion of the camera from a frame to the next one; None if it is not known."""
Scaled = Callable[[Elements2D], Elements2D]
MOST_APART_S, AT_ONCE_S = 0.1, 0.001
"""Images further apart than the first are not used together, nor images further apart than the
second where the motion is not known."""
LONGEST_STEP_S = 1.0
"""The motion over a longer step is not that at its ends."""


@dataclass(frozen=True, eq=False)
class OtherCamera:
    """A camera beside the one that is localized."""

    camera: Camera
    T_first_camera: Pose
    """Where it is, in the axes of the one that is localized."""
    frames: tuple[Frame, ...]
    """In order of time."""
    observe: Observe

    def view_at(self, frame: Frame, motion: BodyMotion | None, scaled: Scaled) -> CameraView | None:
        """Return what it sees at about the time of a frame, if it does."""
        row = bisect_left(self.frames, frame.time_s, key=lambda each: each.time_s)
        near = self.frames[max(row - 1, 0) : row + 1]
        nearest = min(near, key=lambda each: abs(each.time_s - frame.time_s))
        late_s = nearest.time_s - frame.time_s
        if abs(late_s) > (AT_ONCE_S if motion is None else MOST_APART_S):
            return None
        return CameraView(
            scaled(self.observe(nearest)[0]), self.camera, self.T_first_camera, late_s
        )


@dataclass(frozen=True, eq=False)
class RigViews:
    """The cameras of a drive, and how the one that is localized moves."""

    camera: Camera
    others: tuple[OtherCamera, ...]
    motion_of: Mapping[int, BodyMotion]
    """By the index of a frame, as far as it is known."""

    def localize(
        self,
        frame: Frame,
        observed: Elements2D,
        submap: Elements3D,
        prior: Prior,
        localizer: Localizer,
        scaled: Scaled,
    ) -> Localization:
        """Return the result of the camera that is localized; its pose follows from all cameras.

        ``scaled`` gives the elements of the other cameras the sigmas that those ``observed`` have.
        """
        motion = self.motion_of.get(frame.index)
        views = [other.view_at(frame, motion, scaled) for other in self.others]
        return localize_rig(
            [CameraView(observed, self.camera), *(view for view in views if view is not None)],
            submap,
            prior,
            motion=motion or STANDING,
            classes=localizer.classes,
            detector=localizer.detector,
        )[0]


def rig_views(
    source: Dataset,
    frames: Sequence[Frame],
    observe_in: Callable[..., Observe],
    odometry_of: OdometrySource,
) -> RigViews:
    """Return all cameras, for the localization of ``frames``, which are those of one.

    ``observe_in`` makes what observes an image of a ``side``, by default the left one. Raise
    SemvizError if there is one camera only, or if the drive does not say where one is.
    """
    left, right, T_right_left = source.rig.left, source.rig.right, source.rig.T_right_left
    if isinstance(source, RigDataset) and camera_names(source):
        others = _others(source, frames[0], observe_in())
    elif right is not None and T_right_left is not None:
        others = (
            OtherCamera(right, T_right_left.inverse(), tuple(frames), observe_in(side="right")),
        )
    else:
        raise SemvizError("--rig: the drive has one camera; leave out --rig")
    return RigViews(left, others, _motions(frames, odometry_of))


def _others(source: RigDataset, of: Frame, observe: Observe) -> tuple[OtherCamera, ...]:
    first, groups = source.camera_of[of.index], frames_by_camera(source)
    for name in groups:
        if name not in source.mounts:
            raise SemvizError(f"--rig: the drive does not say where camera {shown(name, 60)} is")
    T_first_rig = source.mounts[first].inverse()
    return tuple(
        OtherCamera(source.rig.left, T_first_rig @ source.mounts[name], frames, observe)
        for name, frames in groups.items()
        if name != first
    )


def _motions(frames: Sequence[Frame], odometry_of: OdometrySource) -> dict[int, BodyMotion]:
    """Return the motion at each frame: over the step before it, else over that after it."""
    motions: dict[int, BodyMotion] = {}
    for before, now in pairwise(frames):
        step, duration_s = odometry_of(before, now), now.time_s - before.time_s
        if step is None or not 0.0 < duration_s <= LONGEST_STEP_S:
            continue
        motions[now.index] = BodyMotion.of_step(step, duration_s)
        motions.setdefault(before.index, motions[now.index])
    return motions
