"""Match images of a drive; check the calibration by matches, or refine it.

Rows of a rectified pair must agree; ``pose_remedies`` compares matches with the poses.

Epipolar lines of a stereo pair tell the rotation between the cameras and the direction of the
baseline, not its length. They tell the turn about the vertical axis least, to which depth is most
sensitive; its uncertainty is returned.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Dataset
from semviz_core.base.pose import Pose, skew, so3_exp
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.cameras.lens import OriginalRig
from semviz_core.datasets.own_drive.images.rectification import rectify_rig
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive

REFINED_PAIRS = 20
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

    places = matched_pairs(dataset, REFINED_PAIRS)
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


def turned_right(drive: RecordedDrive, turn_rad: float) -> Pose:
    """Return ``T_right_left`` of the recorded cameras with the right one turned about its rectified
    y axis; it stays in its place."""
    assert drive.rectified.right is not None
    assert drive.original.T_right_left is not None
    R = drive.rectified.right.R_original_rectified
    return Pose(R @ so3_exp(np.array([0.0, turn_rad, 0.0])) @ R.T, np.zeros(3)) @ (
        drive.original.T_right_left
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


_FEATURES = 2000
_KEPT_IMAGES = 12
_RATIO = 0.8
"""Largest ratio of the best to the second best distance (Lowe 2004)."""
PAIRS = 5
"""Of images, along the drive."""

MOST_APART_PX = 1.0
"""Rows: a median beyond this harms matching along them, and depth."""
LEAST_ROW_MATCHES = 50
_REACH_PX = 20.0
"""Matches farther off their row are wrong matches, or those of no pair at all."""
_LINE_EVERY_PX, _MAGNIFIED = 40, 10.0
_LINE_RGB, _ON_RGB, _OFF_RGB = (255, 255, 255), (40, 90, 230), (220, 40, 30)


def matched_pixels(first: ByteImage, second: ByteImage) -> FloatArray:
    """Return (n, 2, 2): the pixel of each match in both images. Some matches are wrong."""
    import cv2

    grays = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (first, second))
    (points, features), (others, candidates) = (
        _features(gray.tobytes(), gray.shape[1]) for gray in grays
    )
    if len(features) == 0 or len(candidates) < 2:
        return np.zeros((0, 2, 2))
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(features, candidates, k=2)
    clear = [(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < _RATIO * b.distance]
    rows = np.array(clear, dtype=np.int64).reshape(-1, 2)
    return np.stack([points[rows[:, 0]], others[rows[:, 1]]], axis=1)


@lru_cache(_KEPT_IMAGES)
def _features(gray: bytes, width: int) -> tuple[FloatArray, np.ndarray]:
    """Return pixels (n, 2) and descriptors (n, 128) of an image's features.

    They are kept for a while, as several checks match the same images.
    """
    import cv2

    image = np.frombuffer(gray, np.uint8).reshape(-1, width)
    sift = cv2.SIFT.create(_FEATURES)  # to a fraction of a pixel, unlike ORB
    points, features = sift.detectAndCompute(image, None)
    pixels = np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2)
    return pixels, np.zeros((0, 128)) if features is None else features


@dataclass(frozen=True)
class RowCheck:
    """Matches of a few pairs, and how far they are off their row."""

    matches: int
    apart_px: float
    """Median of the absolute distances; NaN below ``LEAST_ROW_MATCHES``."""
    offset_px: float
    """Median distance, right minus left: of one sign if a camera is pitched or shifted."""

    @property
    def agrees(self) -> bool:
        """Whether rows agree; True if there are too few matches to tell."""
        return self.matches < LEAST_ROW_MATCHES or self.apart_px <= MOST_APART_PX


def check_rows(dataset: Dataset) -> RowCheck:
    """Match corners of up to ``PAIRS`` pairs of a stereo dataset; images that are damaged, not."""
    distances = rows_apart(matched_pairs(dataset, PAIRS))
    if len(distances) < LEAST_ROW_MATCHES:
        return RowCheck(len(distances), float("nan"), float("nan"))
    return RowCheck(
        len(distances), float(np.median(np.abs(distances))), float(np.median(distances))
    )


def matched_pairs(dataset: Dataset, pairs: int) -> FloatArray:
    """Return the matches (n, 2, 2), left and right, of up to ``pairs`` pairs along the drive."""
    rows = np.unique(np.linspace(0, len(dataset.frames) - 1, pairs).round().astype(int))
    found = [np.zeros((0, 2, 2))]
    for row in rows.tolist():
        index = dataset.frames[row].index
        try:
            left, right = dataset.image(index, "left"), dataset.image(index, "right")
        except SemvizError:  # raised again when this image is shown
            continue
        found.append(matches_near_rows(left, right))
    return np.concatenate(found)


def matches_near_rows(left: ByteImage, right: ByteImage) -> FloatArray:
    """Return the matches (n, 2, 2) of a rectified pair that lie ahead and near one row."""
    places = matched_pixels(left, right)
    ahead = places[:, 0, 0] > places[:, 1, 0]
    return np.asarray(places[ahead & (np.abs(rows_apart(places)) < _REACH_PX)], dtype=np.float64)


def rows_apart(places: FloatArray) -> FloatArray:
    """Return the row in the right image minus that in the left one, of each match (n,)."""
    return np.asarray(places[:, 1, 1] - places[:, 0, 1], dtype=np.float64)


def draw_rows(left: ByteImage, right: ByteImage) -> ByteImage:
    """Return both images side by side: rows as lines, matches blue on their row, red off it.

    A line beside each match shows how far it is off, ten times as long.
    """
    import cv2

    places = matches_near_rows(left, right)
    picture = np.ascontiguousarray(np.hstack([left, right]))
    height, width = picture.shape[:2]
    for row in range(_LINE_EVERY_PX // 2, height, _LINE_EVERY_PX):
        cv2.line(picture, (0, row), (width - 1, row), _LINE_RGB, 1)
    shift = left.shape[1]
    for (u, v), (u_right, v_right) in places.tolist():
        apart = v_right - v
        colour = _OFF_RGB if abs(apart) > MOST_APART_PX else _ON_RGB
        end = (round(u_right + shift), round(v_right + _MAGNIFIED * apart))
        cv2.circle(picture, (round(u), round(v)), 3, colour, 1, cv2.LINE_AA)
        cv2.circle(picture, (round(u_right + shift), round(v_right)), 3, colour, 1, cv2.LINE_AA)
        cv2.line(picture, (round(u_right + shift), round(v_right)), end, colour, 1, cv2.LINE_AA)
    return np.asarray(picture, dtype=np.uint8)


def off_epipolar_lines(camera: Camera, pixels: FloatArray, T_now_before: Pose) -> FloatArray:
    """Return the signed distance (n,) px of matches (n, 2, 2), before and now, from the epipolar
    lines of the motion in the image of now."""
    rays = _rays_of(camera, pixels)
    lines = rays[0] @ (skew(T_now_before.translation) @ T_now_before.rotation).T
    lengths = np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-12)
    return np.asarray((lines * rays[1]).sum(axis=1) / lengths * camera.K[0, 0])


def _rays_of(camera: Camera, pixels: FloatArray) -> list[FloatArray]:
    """Return the rays (n, 3) at depth 1 of matches (n, 2, 2), before and now."""
    one = np.ones(len(pixels))
    return [np.column_stack([camera.normalize(pixels[:, side]), one]) for side in (0, 1)]


def depths_by_motion(
    camera: Camera, pixels: FloatArray, T_now_before: Pose
) -> tuple[FloatArray, FloatArray]:
    """Return the depths (n,), (n,) m of matches (n, 2, 2) in both images; below 0 behind them.

    By least squares of depth_now * ray_now = depth_before * R ray_before + t.
    """
    rays = _rays_of(camera, pixels)
    R, t = T_now_before.rotation, T_now_before.translation
    turned = rays[0] @ R.T
    a, b, c = (
        (x * y).sum(axis=1) for x, y in ((turned, turned), (turned, rays[1]), (rays[1],) * 2)
    )
    d, e = turned @ t, rays[1] @ t
    determinant = np.maximum(a * c - b * b, 1e-12)
    return (b * e - c * d) / determinant, (a * e - b * d) / determinant
