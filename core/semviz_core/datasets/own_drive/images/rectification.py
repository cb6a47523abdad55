"""Make the images of a pinhole camera, or of a rectified stereo pair, from recorded ones.

A rectified camera keeps the focal length of the middle of the recorded image. Its image is the
largest upright rectangle without black borders, at most ``MOST_VIEW_DEG`` wide and high, so it may
have more pixels than the recorded one, or fewer. Both images of a stereo pair get the same camera;
their x axes lie along the baseline. All cameras of a rig get one camera, too, and keep their axes.
Cameras that need none of this are left as they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose, angle_between
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import check_pixels
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera, OriginalRig

_MOST_BASELINE_M = 20.0
MOST_VIEW_DEG = 110.0
"""A pinhole image of a wider view has few pixels in the middle and many outside."""
NARROWEST_VIEW_DEG, WIDEST_VIEW_DEG = 10.0, 160.0
ALIGNED_RAD = 1e-6
"""Stereo pairs that are turned less against each other are rectified already."""
_BORDER = 200
"""Points on each side of an image's border."""
_BLOCK_PIXELS = 2**21
"""Computed at once: 67 million pixels, the most that are read, would take 7 GB."""
_SHRINKING = np.linspace(1.0, 0.3, 141)


@dataclass(frozen=True, eq=False)
class Rectification:
    """How images of one recorded camera become those of a pinhole camera."""

    original: OriginalCamera
    camera: Camera
    R_original_rectified: FloatArray
    """(3, 3) from the axes of the rectified camera to those of the recorded one."""

    @property
    def is_identity(self) -> bool:
        """Whether the recorded images are those of the camera already."""
        return (
            self.original.is_pinhole
            and np.array_equal(self.R_original_rectified, np.eye(3))
            and np.array_equal(self.camera.K, self.original.K)
        )

    @property
    def view_deg(self) -> tuple[float, float]:
        """Horizontal and vertical field of view."""
        camera = self.camera
        corners = np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]])
        angles = np.rad2deg(np.arctan(camera.normalize(corners)))
        return float(angles[1, 0] - angles[0, 0]), float(angles[1, 1] - angles[0, 1])

    def to_original(self, pixels_px: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of the recorded image at pixels (n, 2) of the rectified one."""
        if self.is_identity:
            return np.array(pixels_px, dtype=np.float64).reshape(-1, 2)
        rays = np.column_stack([self.camera.normalize(pixels_px), np.ones(len(pixels_px))])
        return self.original.project(rays @ self.R_original_rectified.T)

    def to_rectified(self, pixels_px: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of the rectified image at pixels (n, 2) of the recorded one."""
        if self.is_identity:
            return np.array(pixels_px, dtype=np.float64).reshape(-1, 2)
        rays = np.column_stack([self.original.rays(pixels_px), np.ones(len(pixels_px))])
        return self.camera.project(rays @ self.R_original_rectified)

    def rectify(self, image: ByteImage) -> ByteImage:
        """Return the rectified image of a recorded one; colours outside of it are black."""
        import cv2

        if self.is_identity:
            return image
        u, v = self._source_pixels
        return np.asarray(cv2.remap(image, u, v, cv2.INTER_CUBIC), dtype=np.uint8)

    @cached_property
    def _source_pixels(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        camera = self.camera
        maps = np.empty((2, camera.height, camera.width), dtype=np.float32)
        step = max(1, _BLOCK_PIXELS // camera.width)
        for top in range(0, camera.height, step):
            rows = slice(top, min(top + step, camera.height))
            v, u = np.mgrid[rows, : camera.width].astype(np.float64)
            pixels = self.to_original(np.column_stack([u.ravel(), v.ravel()]))
            maps[:, rows] = np.nan_to_num(pixels, nan=-1e4).T.reshape(2, -1, camera.width)
        return maps[0], maps[1]


@dataclass(frozen=True, eq=False)
class RectifiedRig:
    """The rectifications of both cameras, and the rig of the rectified images."""

    left: Rectification
    right: Rectification | None
    rig: Rig

    def of(self, side: Side) -> Rectification:
        if side == "left":
            return self.left
        if self.right is None:
            raise SemvizError("the drive has one camera; there is no right image")
        return self.right

    @property
    def T_left_rectified(self) -> Pose:  # noqa: N802  the field's name of a transform
        """From the rectified left camera to the recorded one: a rotation."""
        return Pose(self.left.R_original_rectified, np.zeros(3))


def rectify_rig(original: OriginalRig, most_view_deg: float = MOST_VIEW_DEG) -> RectifiedRig:
    """Return how to rectify the images of a rig, with a field of view of at most this angle.

    Raise SemvizError if the angle is no such, the cameras of a pair are swapped, look in different
    directions, or see nothing in common.
    """
    _check_view(most_view_deg)
    if original.right is None or original.T_right_left is None:
        left = _mono(original.left, most_view_deg)
        return RectifiedRig(left, None, Rig(left.camera))
    _check_baseline(original.T_right_left)
    if _is_rectified(original):
        pair = [_unchanged(camera) for camera in (original.left, original.right)]
        T_right_left = original.T_right_left
    else:
        pair = _stereo(original, most_view_deg)
        baseline_m = float(np.linalg.norm(original.T_right_left.translation))
        T_right_left = Pose(np.eye(3), np.array([-baseline_m, 0.0, 0.0]))
    return RectifiedRig(pair[0], pair[1], Rig(pair[0].camera, pair[1].camera, T_right_left))


def rectify_cameras(
    originals: Sequence[OriginalCamera], most_view_deg: float = MOST_VIEW_DEG
) -> list[RectifiedRig]:
    """Return how to rectify the images of each camera of a rig: all to one pinhole camera.

    Its view is what all of them see, at most this angle. Raise SemvizError if the angle is no such.
    """
    _check_view(most_view_deg)
    first, *others = originals
    if all(camera.is_pinhole and _is_same_pinhole(camera, first) for camera in originals):
        found = [_unchanged(camera) for camera in originals]
    else:
        camera = _common_camera([first, *others], [np.eye(3)] * len(originals), most_view_deg)
        found = [Rectification(original, camera, np.eye(3)) for original in originals]
    return [RectifiedRig(one, None, Rig(one.camera)) for one in found]


def _check_view(most_view_deg: float) -> None:
    if not NARROWEST_VIEW_DEG <= most_view_deg <= WIDEST_VIEW_DEG:
        raise SemvizError(
            f"field of view {most_view_deg:g} deg: give {NARROWEST_VIEW_DEG:g} to "
            f"{WIDEST_VIEW_DEG:g}"
        )


def _is_same_pinhole(first: OriginalCamera, second: OriginalCamera) -> bool:
    sizes = {(camera.width, camera.height) for camera in (first, second)}
    return len(sizes) == 1 and np.array_equal(first.K, second.K)


def _unchanged(original: OriginalCamera) -> Rectification:
    camera = Camera(original.width, original.height, original.K)
    return Rectification(original, camera, np.eye(3))


def _mono(original: OriginalCamera, most_view_deg: float) -> Rectification:
    if original.is_pinhole:
        return _unchanged(original)
    camera = _common_camera([original], [np.eye(3)], most_view_deg)
    return Rectification(original, camera, np.eye(3))


def _is_rectified(original: OriginalRig) -> bool:
    """Whether rows of the images correspond: both pinholes, turned and shifted alike."""
    left, right, T_right_left = original.left, original.right, original.T_right_left
    assert right is not None
    assert T_right_left is not None
    across, down, ahead = np.abs(T_right_left.translation)
    return bool(
        left.is_pinhole
        and right.is_pinhole
        and angle_between(T_right_left.rotation, np.eye(3)) < ALIGNED_RAD
        and max(down, ahead) * left.focal_px < 0.05 * max(across, 1e-9) * left.focal_px
        and np.allclose(left.K[1], right.K[1], atol=0.01)
        and left.height == right.height
    )


def _check_baseline(T_right_left: Pose) -> None:
    """Raise SemvizError if cameras do not lie side by side, the right one to the right."""
    baseline = T_right_left.inverse().translation
    length_m = float(np.linalg.norm(baseline))
    if length_m < 1e-4:
        raise SemvizError(
            "left and right camera are in one place (baseline 0 m); check the calibration, "
            "or leave out --right"
        )
    if baseline[0] < 0.5 * length_m:
        swapped = baseline[0] < -0.5 * length_m
        raise SemvizError(
            f"left and right are swapped: baseline is {baseline[0]:.2f} m; exchange --images and "
            "--right, or invert the pose of the right camera in the calibration"
            if swapped
            else f"the right camera is {baseline[0]:.2f} m to the right of the left one, and "
            f"{np.hypot(*baseline[1:]):.2f} m elsewhere: no stereo pair; leave out --right"
        )
    if length_m > _MOST_BASELINE_M:
        raise SemvizError(
            f"left and right camera are {length_m:.0f} m apart: is their distance in the "
            "calibration in millimetres? Metres are needed"
        )


def _stereo(original: OriginalRig, most_view_deg: float) -> list[Rectification]:
    """Turn both cameras to a common x axis along the baseline and a mean viewing direction."""
    assert original.right is not None
    assert original.T_right_left is not None
    T_left_right = original.T_right_left.inverse()
    x = T_left_right.translation / np.linalg.norm(T_left_right.translation)
    ahead = np.array([0.0, 0.0, 1.0]) + T_left_right.rotation[:, 2]
    y = np.cross(ahead, x)
    if np.linalg.norm(y) < 0.5:
        raise SemvizError("left and right camera look in different directions; leave out --right")
    y /= np.linalg.norm(y)
    R_left = np.column_stack([x, y, np.cross(x, y)])
    R_right = original.T_right_left.rotation @ R_left
    originals, turns = [original.left, original.right], [R_left, R_right]
    camera = _common_camera(originals, turns, most_view_deg)
    return [
        Rectification(recorded, camera, turn)
        for recorded, turn in zip(originals, turns, strict=True)
    ]


def _common_camera(
    originals: list[OriginalCamera], turns: list[FloatArray], most_view_deg: float
) -> Camera:
    """Return the pinhole camera whose image all of ``originals`` fill, turned by ``turns``."""
    limit = float(np.tan(np.deg2rad(most_view_deg) / 2.0))
    low, high = np.array([-limit, -limit]), np.array([limit, limit])
    for original, turn in zip(originals, turns, strict=True):
        inner_low, inner_high = _inner_rectangle(original, turn)
        low, high = np.maximum(low, inner_low), np.minimum(high, inner_high)
    low, high = _shrunk(originals, turns, low, high)
    focal = float(np.mean([original.focal_px for original in originals]))
    width, height = np.floor((high - low) * focal).astype(int).tolist()
    if min(width, height) < 16:
        raise SemvizError("the rectified images would be empty; check the calibration")
    check_pixels(width, height, "rectified")
    cx, cy = -0.5 - focal * low
    return Camera(width, height, np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]]))


def _inner_rectangle(original: OriginalCamera, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners (2,), (2,) of the largest rectangle within the image's own border.

    In image-plane coordinates of the turned camera. A side that no ray reaches does not count.
    """
    low, high = np.array([-np.inf, -np.inf]), np.array([np.inf, np.inf])
    u, v = (np.linspace(0.0, size - 1.0, _BORDER) for size in (original.width, original.height))
    zero = np.zeros(_BORDER)
    for axis, pixels in (
        (0, np.column_stack([zero, v])),
        (0, np.column_stack([zero + original.width - 1.0, v])),
        (1, np.column_stack([u, zero])),
        (1, np.column_stack([u, zero + original.height - 1.0])),
    ):
        rays = np.column_stack([original.rays(pixels), np.ones(_BORDER)]) @ turn
        rays = rays[np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.05)]
        side = rays[:, axis] / rays[:, 2]
        if len(side) and side.mean() < 0.0:
            low[axis] = max(low[axis], side.max())
        elif len(side):
            high[axis] = min(high[axis], side.min())
    return low, high


def _shrunk(
    originals: list[OriginalCamera], turns: list[FloatArray], low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the rectangle, drawn in until all of its border is in all images."""
    for scale in _SHRINKING:
        border = _border(low * scale, high * scale)
        if all(_sees(original, border @ turn.T) for original, turn in zip(originals, turns)):  # noqa: B905
            return low * scale, high * scale
    raise SemvizError(
        "no part of the image is left after undistortion: the calibration is not that of a lens; "
        "check its model and its coefficients"
    )


def _border(low: FloatArray, high: FloatArray) -> FloatArray:
    """Return rays (n, 3) along the border of a rectangle in the image plane."""
    x, y = (np.linspace(low[axis], high[axis], _BORDER) for axis in (0, 1))
    one = np.ones(_BORDER)
    sides = [(x, low[1] * one), (x, high[1] * one), (low[0] * one, y), (high[0] * one, y)]
    return np.concatenate([np.column_stack([*side, one]) for side in sides])


def _sees(original: OriginalCamera, rays: FloatArray) -> bool:
    pixels = original.project(rays)
    corner = [original.width - 0.49, original.height - 0.49]
    return bool(((pixels >= -0.51) & (pixels <= corner)).all())
