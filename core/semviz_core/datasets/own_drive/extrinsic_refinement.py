"""Refine where the right camera is, from matches between images of a stereo pair.

Epipolar lines tell the rotation between the cameras and the direction of the baseline, not its
length. They tell the turn about the vertical axis least, to which depth is most sensitive; its
uncertainty is returned.
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.camera import Rig
from semviz_core.base.frame import Dataset
from semviz_core.base.pose import Pose, skew, so3_exp
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.lens import OriginalRig
from semviz_core.datasets.own_drive.match_checks import matched_pairs
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive
from semviz_core.datasets.own_drive.rectification import rectify_rig

PAIRS = 20
LEAST_MATCHES = 200
_PRIOR = np.array([*np.deg2rad([1.0, 1.0, 1.0]), 0.02, 0.02])
"""Standard deviation of a calibration: turn about x, y and z (rad), baseline down, ahead."""
_MATCH_PX = 0.5
"""Of a match across its epipolar line; farther ones count less."""


@dataclass(frozen=True, eq=False)
class RefinedExtrinsics:
    """How the right camera lies, and how that differs from its calibration."""

    T_right_left: Pose
    """Of the recorded cameras."""
    turned_rad: FloatArray
    """(3,) rotation vector of the correction, in axes of the rectified cameras."""
    sigma_rad: FloatArray
    """(3,) standard deviation of it."""
    matches: int
    before_px: float
    """Median distance of matches from their epipolar lines."""
    after_px: float


def refine_extrinsics(dataset: Dataset, drive: RecordedDrive) -> RefinedExtrinsics:
    """Refine the pose of the right camera. Raise SemvizError if there are too few matches.

    ``dataset`` holds the rectified images of ``drive``.
    """
    from scipy.optimize import least_squares

    places = matched_pairs(dataset, PAIRS)
    if len(places) < LEAST_MATCHES:
        raise SemvizError(
            f"--refine-extrinsics: {len(places)} matches between left and right images, at least "
            f"{LEAST_MATCHES} are needed"
        )
    rig, rectified = dataset.rig, drive.rectified
    assert rectified.right is not None
    assert rig.T_right_left is not None
    rays = _rays(rig, places)
    focal_px = float(rig.left.K[0, 0])
    scale_px = _MATCH_PX / focal_px

    def residuals(parameters: FloatArray) -> FloatArray:
        apart = _apart(parameters, rays) / scale_px
        robust = np.sign(apart) * np.sqrt(2.0 * (np.sqrt(1.0 + apart**2) - 1.0))
        return np.concatenate([robust, parameters / _PRIOR])

    found = least_squares(residuals, np.zeros(5), x_scale=_PRIOR)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    baseline_m = float(np.linalg.norm(rig.T_right_left.translation))
    R, direction = _motion(found.x)
    turn_left = Pose(rectified.left.R_original_rectified, np.zeros(3))
    turn_right = Pose(rectified.right.R_original_rectified, np.zeros(3))
    return RefinedExtrinsics(
        turn_right @ Pose(R, baseline_m * direction) @ turn_left.inverse(),
        found.x[:3],
        np.sqrt(np.diag(covariance)[:3]),
        len(places),
        float(np.median(np.abs(_apart(np.zeros(5), rays)))) * focal_px,
        float(np.median(np.abs(_apart(found.x, rays)))) * focal_px,
    )


def with_extrinsics(drive: RecordedDrive, T_right_left: Pose) -> RecordedDrive:
    """Return a drive whose right camera lies elsewhere; poses of the left one stay."""
    original = OriginalRig(drive.original.left, drive.original.right, T_right_left)
    rectified = rectify_rig(original, drive.most_view_deg)
    turn = drive.rectified.T_left_rectified.inverse() @ rectified.T_left_rectified
    frames = tuple(
        frame
        if frame.T_map_camera is None
        else replace(frame, T_map_camera=frame.T_map_camera @ turn)
        for frame in drive.frames
    )
    return replace(drive, original=original, rectified=rectified, frames=frames)


def _rays(rig: Rig, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rays (n, 3) at depth 1 of matches (n, 2, 2), left and right."""
    assert rig.right is not None
    one = np.ones(len(places))
    left, right = (
        np.column_stack([camera.normalize(places[:, side]), one])
        for side, camera in enumerate((rig.left, rig.right))
    )
    return left, right


def _motion(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation (3, 3) and unit translation (3,), left to right, both rectified."""
    direction = np.array([-1.0, *parameters[3:]])
    return so3_exp(parameters[:3]), direction / np.linalg.norm(direction)


def _apart(parameters: FloatArray, rays: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return the signed distance (n,) of right rays from epipolar lines, at depth 1."""
    R, direction = _motion(parameters)
    lines = rays[0] @ (skew(direction) @ R).T
    return np.asarray((lines * rays[1]).sum(axis=1) / np.hypot(lines[:, 0], lines[:, 1]))
