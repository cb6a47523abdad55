"""Compare poses of a drive with matches between its images, and find what they would agree with.

Matches of successive images must lie on epipolar lines and ahead of the camera. Both are needed:
along a straight road, the epipolar lines of inverted poses are the same, but the matches then lie
behind the camera. Where poses disagree, every other convention of the recorded poses is tried. On a
straight drive several agree: inverted poses look like those of a camera that is turned round.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.frame import Dataset
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.checks.match_checks import (
    PAIRS,
    depths_by_motion,
    matched_pixels,
    off_epipolar_lines,
)
from semviz_core.datasets.own_drive.poses.conventions import (
    NAMED_EXTRINSICS,
    CameraAxes,
    Direction,
    PoseConventions,
    QuaternionOrder,
)

LEAST_POSE_MATCHES = 60
LEAST_SHARE = 0.5
"""Poses: of the matches that agree with them; poses of a car's camera reach 0.8 and more."""
_APART_M = (0.2, 6.0)
_NEAR_LINE_PX = 2.0
_SURE_SHARE, _BETTER = 0.8, 1.25
"""Poses with which fewer agree are wrong if with others so many times more would."""
_AS_GOOD = 0.03
"""Remedies with which so little less of all matches agree fit as well as the best."""
_SAME = 1e-6


@dataclass(frozen=True)
class PoseAgreement:
    """How many matches between images agree with the poses."""

    matches: int
    share: float
    """Of the matches: within 2 px of their epipolar line, and ahead of both images."""
    remedies: tuple[str, ...] = ()
    """Options, or changes of the file, with which most matches would agree."""

    @property
    def is_known(self) -> bool:
        """Whether there are enough matches between images apart to tell."""
        return self.matches >= LEAST_POSE_MATCHES

    @property
    def agrees(self) -> bool:
        return not self.is_known or (self.share >= LEAST_SHARE and not self.remedies)


def compare_poses(
    dataset: Dataset, T_map_world: Pose, T_left_rectified: Pose, taken: PoseConventions
) -> PoseAgreement:
    """Match a few pairs of successive left images, and compare them with their poses.

    ``T_map_world`` and ``T_left_rectified`` are what was applied to the poses of cameras.
    """
    matched = _matched(dataset)
    count = sum(len(motion.pixels) for motion in matched)
    if count < LEAST_POSE_MATCHES:
        return PoseAgreement(count, 0.0)
    camera = dataset.rig.left
    share = _agreeing(camera, matched) / count
    if share >= _SURE_SHARE:
        return PoseAgreement(count, share)
    world, turn = T_map_world.inverse(), T_left_rectified.inverse()
    shares = {}
    for remedy, change in _remedies(taken).items():

        def changed(T: Pose, change: Change = change) -> Pose:
            return change(taken.recorded_pose(world @ T @ turn)) @ T_left_rectified

        motions = [_Motion(m.pixels, changed(m.before), changed(m.now)) for m in matched]
        shares[remedy] = _agreeing(camera, motions) / count
    least = max(LEAST_SHARE, _BETTER * share, max(shares.values()) - _AS_GOOD)
    return PoseAgreement(count, share, tuple(name for name in shares if shares[name] >= least))


Change: TypeAlias = Callable[[Pose], Pose]
"""From a pose as recorded to ``T_world_camera``."""


def _remedies(taken: PoseConventions) -> dict[str, Change]:
    """Return what recorded poses may be instead, by the option or the change of a file."""
    directions: tuple[Direction, ...] = ("camera-to-world", "world-to-camera")
    axes: tuple[CameraAxes, ...] = ("opencv", "opengl")
    orders: tuple[QuaternionOrder, ...] = ("xyzw", "wxyz")
    places = {"the inverse of the pose in --extrinsic": taken.T_body_camera.inverse()}
    places |= {f"--extrinsic {name}": place for name, place in NAMED_EXTRINSICS.items()}
    others = {f"--direction {name}": replace(taken, direction=name) for name in directions}
    others |= {f"--camera-axes {name}": replace(taken, axes=name) for name in axes}
    others |= {name: replace(taken, T_body_camera=place) for name, place in places.items()}
    found: dict[str, Change] = {
        name: other.camera_pose for name, other in others.items() if _differs(other, taken)
    }
    if taken.quaternion is not None:
        step = -1 if taken.quaternion == "xyzw" else 1
        name = f"--quaternion {orders[taken.quaternion == 'xyzw']}"
        found[name] = lambda T: taken.camera_pose(_reordered(T, step))
    found["a transpose of the rotations"] = lambda T: taken.camera_pose(
        Pose(T.rotation.T, T.translation)
    )
    return found


def _differs(other: PoseConventions, taken: PoseConventions) -> bool:
    apart = other.T_body_camera.as_matrix() - taken.T_body_camera.as_matrix()
    same = other.direction == taken.direction and other.axes == taken.axes
    return not same or bool(np.abs(apart).max() > _SAME)


def _reordered(T: Pose, step: int) -> Pose:
    """Return a pose with the numbers of its quaternion in another order."""
    from scipy.spatial.transform import Rotation

    quaternion = np.roll(T.as_quaternion(), step)
    return Pose(Rotation.from_quat(quaternion).as_matrix(), T.translation)


class _Motion(NamedTuple):
    """Matches (n, 2, 2) between two images, and the poses of these."""

    pixels: FloatArray
    before: Pose
    now: Pose


def _matched(dataset: Dataset) -> list[_Motion]:
    """Return the matches of up to ``PAIRS`` pairs of successive images with poses."""
    pairs = [
        (first.index, second.index, first.T_map_camera, second.T_map_camera)
        for first, second in pairwise(dataset.frames)
        if first.T_map_camera is not None
        and second.T_map_camera is not None
        and _APART_M[0] <= _distance_m(first.T_map_camera, second.T_map_camera) <= _APART_M[1]
    ]
    rows = np.unique(np.linspace(0, len(pairs) - 1, PAIRS).round().astype(int)).tolist()
    matched = []
    for row in rows if pairs else ():
        before, now, T_before, T_now = pairs[row]
        try:
            images = dataset.image(before, "left"), dataset.image(now, "left")
        except SemvizError:  # raised again when this image is shown
            continue
        matched.append(_Motion(matched_pixels(*images), T_before, T_now))
    return matched


def _distance_m(first: Pose, second: Pose) -> float:
    return float(np.linalg.norm(first.translation - second.translation))


def _agreeing(camera: Camera, matched: Sequence[_Motion]) -> int:
    """Return the number of all matches that agree with the poses."""
    return sum(
        int(_agrees(camera, motion.pixels, motion.now.inverse() @ motion.before).sum())
        for motion in matched
    )


def _agrees(camera: Camera, pixels: FloatArray, T_now_before: Pose) -> BoolArray:
    """Return (n,) whether matches (n, 2, 2), before and now, agree with the motion."""
    apart = np.abs(off_epipolar_lines(camera, pixels, T_now_before))
    before, now = depths_by_motion(camera, pixels, T_now_before)
    return np.asarray((apart < _NEAR_LINE_PX) & (before > 0.0) & (now > 0.0))
