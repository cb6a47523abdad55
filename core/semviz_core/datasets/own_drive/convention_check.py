"""Compare poses with what the images show: matches lie on epipolar lines, ahead of the camera.

Both are needed: along a straight road, the epipolar lines of inverted poses are the same, but the
matches then lie behind the camera.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.frame import Dataset
from semviz_core.base.pose import Pose, skew
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.conventions import FLIPPED, NAMED_EXTRINSICS
from semviz_core.datasets.own_drive.matching import matched_pixels

PAIRS = 5
LEAST_MATCHES = 60
LEAST_SHARE = 0.5
"""Of matches that agree; poses of a car's camera reach 0.8 and more."""
_APART_M = (0.2, 6.0)
_NEAR_LINE_PX = 2.0
_REMEDIES: dict[str, Callable[[Pose], Pose]] = {
    "another --direction": Pose.inverse,
    "another --camera-axes": lambda T: T @ FLIPPED,
    "--extrinsic flu": lambda T: T @ NAMED_EXTRINSICS["flu"],
    "--extrinsic frd": lambda T: T @ NAMED_EXTRINSICS["frd"],
    "no --extrinsic flu": lambda T: T @ NAMED_EXTRINSICS["flu"].inverse(),
    "no --extrinsic frd": lambda T: T @ NAMED_EXTRINSICS["frd"].inverse(),
}
"""By the option, how recorded poses would change with it."""


@dataclass(frozen=True)
class ConventionCheck:
    """How many matches between images agree with the poses."""

    matches: int
    share: float
    """Of the matches: within 2 px of their epipolar line, and ahead of both images."""
    remedy: str = ""
    """The option with which most matches would agree; empty if there is none."""

    @property
    def is_known(self) -> bool:
        """Whether there are enough matches between images apart to tell."""
        return self.matches >= LEAST_MATCHES

    @property
    def agrees(self) -> bool:
        return not self.is_known or self.share >= LEAST_SHARE


def check_against_images(
    dataset: Dataset, T_map_world: Pose, T_left_rectified: Pose
) -> ConventionCheck:
    """Match a few pairs of successive left images, and compare them with their poses.

    ``T_map_world`` and ``T_left_rectified`` are what was applied to the recorded poses.
    """
    matched = _matched(dataset)
    count = sum(len(motion.pixels) for motion in matched)
    if count < LEAST_MATCHES:
        return ConventionCheck(count, 0.0)
    camera = dataset.rig.left
    share = _agreeing(camera, matched) / count
    if share >= LEAST_SHARE:
        return ConventionCheck(count, share)
    world, turn = T_map_world.inverse(), T_left_rectified.inverse()
    shares = {}
    for remedy, change in _REMEDIES.items():

        def changed(T: Pose, change: Callable[[Pose], Pose] = change) -> Pose:
            return change(world @ T @ turn) @ T_left_rectified

        motions = [_Motion(m.pixels, changed(m.before), changed(m.now)) for m in matched]
        shares[remedy] = _agreeing(camera, motions) / count
    best = max(shares, key=lambda name: shares[name])
    fits = shares[best] >= max(LEAST_SHARE, 1.5 * share)
    return ConventionCheck(count, share, best if fits else "")


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
    rays = [
        np.column_stack([camera.normalize(pixels[:, side]), np.ones(len(pixels))])
        for side in (0, 1)
    ]
    R, t = T_now_before.rotation, T_now_before.translation
    lines = rays[0] @ (skew(t) @ R).T
    focal = camera.K[0, 0]
    apart = np.abs((lines * rays[1]).sum(axis=1)) / np.hypot(lines[:, 0], lines[:, 1]) * focal
    # Depths of both rays, by least squares of depth_now * ray_now = depth_before * R ray + t.
    turned = rays[0] @ R.T
    a, b, c = (
        (x * y).sum(axis=1) for x, y in ((turned, turned), (turned, rays[1]), (rays[1],) * 2)
    )
    d, e = turned @ t, rays[1] @ t
    determinant = np.maximum(a * c - b * b, 1e-12)
    before, now = (b * e - c * d) / determinant, (a * e - b * d) / determinant
    return np.asarray((apart < _NEAR_LINE_PX) & (before > 0.0) & (now > 0.0))
