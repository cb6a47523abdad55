"""Check a sequence before it is used: image sizes, poses, stereo sides, calibration.

A check raises SemvizError only if the fault is certain. The error names the fault and states that
nothing was loaded. Swapped left and right images are recognized in a few image pairs. A workspace
stores the rig it was created with, in numbers rounded below the resolution of labels; later
sequences are compared with it.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Dataset, Frame
from semviz_core.base.pose import so3_log
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.common.errors import SemvizError

RESIZE_RATIO = 1.25
"""If image centre and principal point differ by this factor, about equally in both directions, the
images were resized after the calibration. Cropping changes one direction, or both differently."""
MAX_ASPECT_CHANGE = 1.15

STEP_M = 1.0
"""Length over which directions are measured: those of shorter steps are noise."""
MIN_STEPS = 5
MIN_STEADINESS = 0.9
MIN_STEADINESS_GAIN = 0.05
"""Steadiness is the length of the mean unit step: 1 if all steps have one direction. For KITTI, in
any window of 20 frames or more, inverted poses gain at most 0.02, and true poses have at least
0.89."""
MIN_SHARE = 0.8
"""Share of the steps in one wrong direction."""
JUMP_M_S = 60.0
JUMP = 5.0
"""A jump is faster than both 60 m/s and five times the median speed."""

MOST_CAR_M_S, MOST_CAR_M_S2 = 100.0, 15.0
STRAY_M = 0.5
"""Positions that a car could not reach by this much are named. KITTI's reach 0.08 m."""


def check_sizes(rig: Rig) -> None:
    """Raise SemvizError if a camera's calibration is clearly for images of another size."""
    for side, camera in (("left", rig.left), ("right", rig.right)):
        if camera is None:
            continue
        cx, cy = camera.K[:2, 2]
        across, down = (2.0 * cx + 1.0) / camera.width, (2.0 * cy + 1.0) / camera.height
        size = f"{camera.width}x{camera.height}"
        if not (0.0 < across < 2.0 and 0.0 < down < 2.0) or _resized(across, down):
            raise SemvizError(
                f"the {side} images are {size}, but the calibration is for about "
                f"{2.0 * cx:.0f}x{2.0 * cy:.0f} (principal point {cx:.1f} {cy:.1f}). Nothing was "
                "loaded; use the images' own size, or scale the calibration with them"
            )


def _resized(across: float, down: float) -> bool:
    smaller, larger = sorted((across, down))
    if smaller <= 0.0 or larger / smaller > MAX_ASPECT_CHANGE:
        return False
    return smaller > RESIZE_RATIO or larger < 1.0 / RESIZE_RATIO


def check_poses(frames: Sequence[Frame], looks_ahead: bool = True) -> None:
    """Raise SemvizError if poses jump or are inverted.

    A vehicle moves along a constant direction of its camera's axes. On curves, only correct poses
    (``T_map_camera``) show this, whichever way the camera looks, so inverted ones are recognized.
    On a straight or circular drive both show it; then the motion must lead ahead, if the camera
    ``looks_ahead``.
    """
    posed = [(frame, frame.T_map_camera) for frame in frames if frame.T_map_camera is not None]
    if len(posed) < 2:
        return
    R = np.array([pose.rotation for _, pose in posed])
    t = np.array([pose.translation for _, pose in posed])
    _check_direction(R, t, looks_ahead)
    _check_jumps([frame for frame, _ in posed], t)


def unusual_motion(frames: Sequence[Frame]) -> str:
    """Return in which direction a camera moves most of the time; empty if ahead, or too short."""
    poses = [frame.T_map_camera for frame in frames if frame.T_map_camera is not None]
    if len(poses) < 2:
        return ""
    t = np.array([pose.translation for pose in poses])
    rows = _spaced_rows(t)
    if len(rows) <= MIN_STEPS:
        return ""
    R = np.array([pose.rotation for pose in poses])
    return _wrong_direction(_directions(R[rows], t[rows]))


def unusual_speed_m_s(frames: Sequence[Frame]) -> float | None:
    """Return the median speed of a camera that is faster than any car; None if it is not."""
    posed = [(frame, frame.T_map_camera) for frame in frames if frame.T_map_camera is not None]
    gaps_s = np.diff([frame.time_s for frame, _ in posed])
    if not (gaps_s > 0.0).any():
        return None
    gaps_m = np.linalg.norm(np.diff([pose.translation for _, pose in posed], axis=0), axis=1)
    speed = float(np.median(gaps_m[gaps_s > 0.0] / gaps_s[gaps_s > 0.0]))
    return speed if speed > MOST_CAR_M_S else None


def largest_jump(frames: Sequence[Frame]) -> str:
    """Return where a camera is farthest from where a car could be between its two neighbours.

    Empty if it is nowhere ``STRAY_M`` off.
    """
    posed = [(frame, frame.T_map_camera) for frame in frames if frame.T_map_camera is not None]
    if len(posed) < 3:
        return ""
    gaps_s = np.diff([frame.time_s for frame, _ in posed])
    steps = np.diff([pose.translation for _, pose in posed], axis=0)
    velocity = steps / np.maximum(gaps_s, 1e-6)[:, None]
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    shorter_s, mean_s = np.minimum(gaps_s[:-1], gaps_s[1:]), (gaps_s[:-1] + gaps_s[1:]) / 2.0
    stray_m = 0.5 * (change - MOST_CAR_M_S2 * mean_s) * np.maximum(shorter_s, 0.0)
    worst = int(stray_m.argmax())
    if stray_m[worst] <= STRAY_M:
        return ""
    before, at, after = (frame.index for frame, _ in posed[worst : worst + 3])
    return (
        f"frame {at} is {stray_m[worst]:.1f} m from where a car could be between frames {before} "
        f"and {after}"
    )


def _check_direction(R: FloatArray, t: FloatArray, looks_ahead: bool) -> None:
    """Raise SemvizError if ``T_map_camera`` (R (n, 3, 3), t (n, 3)) is inverted."""
    rows = _spaced_rows(t)
    if len(rows) <= MIN_STEPS:
        return
    R, t = R[rows], t[rows]
    R_inverse = R.transpose(0, 2, 1)
    given = _directions(R, t)
    inverted = _directions(R_inverse, -np.einsum("nij,nj->ni", R_inverse, t))
    gain = _steadiness(inverted) - _steadiness(given)
    if gain > MIN_STEADINESS_GAIN and _steadiness(inverted) > MIN_STEADINESS:
        raise SemvizError(
            "the poses are inverted (T_camera_map where T_map_camera is expected): as given, the "
            "camera moves in changing directions; inverted, always in the same one. "
            "Nothing was loaded"
        )
    if looks_ahead and abs(gain) <= MIN_STEADINESS_GAIN and (where := _wrong_direction(given)):
        raise SemvizError(
            f"the camera moves {where}: the poses are inverted (T_camera_map where T_map_camera "
            "is expected). Nothing was loaded"
        )


def _check_jumps(frames: Sequence[Frame], t: FloatArray) -> None:
    gaps_m = np.linalg.norm(np.diff(t, axis=0), axis=1)
    gaps_s = np.diff([frame.time_s for frame in frames])
    speeds = gaps_m / np.maximum(gaps_s, max(float(np.median(gaps_s)), 1e-3))
    worst = int(speeds.argmax())
    if speeds[worst] > max(JUMP_M_S, JUMP * float(np.median(speeds))):
        first, second = frames[worst], frames[worst + 1]
        raise SemvizError(
            f"the poses jump: frame {second.index} is {gaps_m[worst]:.1f} m from "
            f"frame {first.index}, {gaps_s[worst]:.2f} s later. Nothing was loaded"
        )


def _spaced_rows(t: FloatArray) -> IntArray:
    """Return rows of ``t`` (n, 3), each at least ``STEP_M`` from the previous one."""
    rows = [0]
    for row in range(1, len(t)):
        if np.abs(step := t[row] - t[rows[-1]]).sum() >= STEP_M and step @ step >= STEP_M**2:
            rows.append(row)
    return np.array(rows)


def _directions(R: FloatArray, t: FloatArray) -> FloatArray:
    """Return (k, 3) unit steps of ``T_map_camera`` (R (n, 3, 3), t (n, 3)) in camera axes."""
    steps = np.einsum("nij,ni->nj", R[:-1], np.diff(t, axis=0))
    lengths = np.linalg.norm(steps, axis=1)
    return np.asarray(steps[lengths > 0.0] / lengths[lengths > 0.0, None])


def _steadiness(directions: FloatArray) -> float:
    return float(np.linalg.norm(directions.mean(axis=0))) if len(directions) else 0.0


def _wrong_direction(directions: FloatArray) -> str:
    """Return the direction of most steps; empty if ahead, within 60 deg of the optical axis."""
    z = directions[:, 2]
    for where, share in (("backwards", (z < -0.5).mean()), ("sideways", (np.abs(z) <= 0.5).mean())):
        if share >= MIN_SHARE:
            return f"{where} in {share:.0%} of its steps"
    return ""


PAIRS_READ = 2
CORNERS = 150
PATCH_PX = 9
"""At half size."""
MIN_CORRELATION = 0.9
"""Normalized cross-correlation of a patch with its match."""
MIN_CORRELATION_GAP = 0.1
"""Difference of the correlations by which one side wins."""
MIN_VOTES = 15
VOTE_RATIO = 6
"""Least number of corners that vote for swapped images, and least ratio to those that vote
against."""


def check_sides(dataset: Dataset) -> None:
    """Raise SemvizError if a few image pairs show that left and right images are swapped.

    Corners of the left image are matched along their epipolar lines, ahead of the cameras and
    behind them: in swapped images nearly all matches lie behind.
    """
    if dataset.rig.right is None:
        return
    ahead = behind = 0
    frames = dataset.frames
    for position in np.linspace(0, len(frames) - 1, PAIRS_READ + 2)[1:-1]:
        index = frames[round(position)].index
        try:
            left, right = dataset.image(index, "left"), dataset.image(index, "right")
        except SemvizError:  # raised again when this image is shown
            continue
        votes = _votes(dataset.rig, left, right)
        ahead, behind = ahead + votes[0], behind + votes[1]
    if behind >= max(MIN_VOTES, VOTE_RATIO * ahead):
        raise SemvizError(
            f"left and right images are swapped: baseline is {-dataset.rig.baseline_m:.2f} m by "
            f"{behind} of {ahead + behind} corners found in both. Nothing was loaded; exchange "
            "the two image folders"
        )


def _votes(rig: Rig, left: ByteImage, right: ByteImage) -> tuple[int, int]:
    """Return the numbers of corners matched clearly ahead of the cameras and behind them."""
    corners, places = _candidates(rig, left)
    if not len(corners):
        return 0, 0
    scores = _correlations(_half(left), _half(right), corners, places)
    middle = scores.shape[1] // 2
    at_infinity = scores[:, middle - 1 : middle + 2].max(axis=1)
    behind, ahead = scores[:, : middle - 1].max(axis=1), scores[:, middle + 2 :].max(axis=1)
    best = np.maximum(ahead, behind)
    clear = (
        (best > MIN_CORRELATION)
        & (np.abs(ahead - behind) > MIN_CORRELATION_GAP)
        & (best > at_infinity)
    )
    return int((clear & (ahead > behind)).sum()), int((clear & (behind > ahead)).sum())


def _candidates(rig: Rig, left: ByteImage) -> tuple[IntArray, IntArray]:
    """Return corners (n, 2) of the left image and candidates (n, k, 2) of each in the right one.

    Both in px at half size; the k candidates go from behind the cameras over infinity to ahead.
    """
    import cv2

    assert rig.right is not None
    assert rig.T_right_left is not None
    reach = rig.left.width // 10  # px of disparity; KITTI's is 4 m ahead
    half = _half(left)
    mask = np.zeros(half.shape, np.uint8)
    mask[PATCH_PX:-PATCH_PX, reach // 2 + PATCH_PX : -(reach // 2 + PATCH_PX)] = 1
    detected = cv2.goodFeaturesToTrack(half, CORNERS, 0.02, 8.0, mask=mask)
    if detected is None or reach < PATCH_PX:
        return np.zeros((0, 2), np.int64), np.zeros((0, 0, 2), np.int64)
    corners = np.rint(detected.reshape(-1, 2)).astype(np.int64)
    full_size_px = corners.astype(np.float64) * 2.0 + 0.5
    rays = np.column_stack([rig.left.normalize(full_size_px), np.ones(len(corners))])
    steps = np.arange(-reach, reach + 1, 2) / (rig.left.K[0, 0] * rig.baseline_m)
    towards = rays @ rig.T_right_left.rotation.T
    points = towards[:, None] + steps[None, :, None] * rig.T_right_left.translation
    pixels = rig.right.project(points.reshape(-1, 3)).reshape(len(corners), -1, 2)
    places = np.rint((np.nan_to_num(pixels, nan=-1e6) - 0.5) / 2.0)
    return corners, places.astype(np.int64)


def _half(image: ByteImage) -> ByteImage:
    """Return the grey image (h/2, w/2)."""
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return np.asarray(half, dtype=np.uint8)


def _correlations(
    left: ByteImage, right: ByteImage, corners: IntArray, places: IntArray
) -> FloatArray:
    """Return (n, k) normalized cross-correlations of corners and candidates; -1 outside."""
    patches = _patches(left, corners)
    inside = _inside(right, places)
    candidates = _patches(right, np.where(inside[..., None], places, PATCH_PX))
    scores = np.einsum("np,nkp->nk", patches, candidates)
    return np.where(inside, scores, -1.0).astype(np.float64)


def _patches(image: ByteImage, centers: IntArray) -> NDArray[np.float32]:
    """Return patches (..., p) around centers (..., 2), of mean 0 and length 1 (flat: zeros)."""
    offsets = np.arange(PATCH_PX) - PATCH_PX // 2
    u = centers[..., 0, None, None] + offsets
    v = centers[..., 1, None, None] + offsets[:, None]
    patches = image[v, u].astype(np.float32).reshape(*centers.shape[:-1], -1)
    patches -= patches.mean(axis=-1, keepdims=True)
    lengths = np.linalg.norm(patches, axis=-1, keepdims=True)
    return np.asarray(patches / np.maximum(lengths, 1.0), dtype=np.float32)


def _inside(image: ByteImage, centers: IntArray) -> BoolArray:
    height, width = image.shape
    margin = PATCH_PX // 2
    u, v = centers[..., 0], centers[..., 1]
    inside = (u >= margin) & (u < width - margin) & (v >= margin) & (v < height - margin)
    return np.asarray(inside, dtype=np.bool_)


@dataclass(frozen=True)
class Calibration:
    """A rig in numbers rounded below the resolution of labels, as stored in a workspace."""

    hash: str
    """SHA-256 of all other fields, 16 hex digits."""
    left_size_px: tuple[int, int]
    left_intrinsics_px: tuple[float, float, float, float, float]
    """fx, fy, cx, cy, skew."""
    left_distortion: tuple[float, ...]
    right_size_px: tuple[int, int] | None = None
    right_intrinsics_px: tuple[float, float, float, float, float] | None = None
    right_distortion: tuple[float, ...] | None = None
    right_position_m: tuple[float, float, float] | None = None
    """Of the right camera, in the left one's axes."""
    right_rotation_rad: tuple[float, float, float] | None = None
    """Axis-angle, from the right camera's axes to the left one's."""

    @classmethod
    def of(cls, rig: Rig) -> "Calibration":
        numbers = _camera_numbers("left", rig.left)
        if rig.right is not None and rig.T_right_left is not None:
            T_left_right = rig.T_right_left.inverse()
            numbers |= _camera_numbers("right", rig.right)
            numbers["right_position_m"] = _rounded(T_left_right.translation, 4)
            numbers["right_rotation_rad"] = _rounded(so3_log(T_left_right.rotation), 5)
        text = json.dumps(numbers, sort_keys=True)
        return cls(hash=hashlib.sha256(text.encode()).hexdigest()[:16], **numbers)

    def differences(self, new: "Calibration") -> tuple[str, ...]:
        """Return the fields that differ in ``new``, as text: ``focal length 718.9 -> 720 px``."""
        if self.right_size_px is None and new.right_size_px is not None:
            return ("there was no right camera",)
        if self.right_size_px is not None and new.right_size_px is None:
            return ("the right camera is gone",)
        texts: dict[str, None] = {}  # in order, each once: both cameras may have changed alike
        before, after = asdict(self), asdict(new)
        for field in fields(self):
            if field.name != "hash" and before[field.name] != after[field.name]:
                texts |= dict.fromkeys(
                    _difference(field.name, before[field.name], after[field.name])
                )
        return tuple(texts)


def _camera_numbers(side: str, camera: Camera) -> dict[str, Any]:
    K = camera.K
    lengths = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1]])
    return {
        f"{side}_size_px": (camera.width, camera.height),
        f"{side}_intrinsics_px": _rounded(lengths, 3),
        f"{side}_distortion": _rounded(camera.distortion, 6),
    }


def _rounded(values: FloatArray, digits: int) -> tuple[float, ...]:
    return tuple(round(float(value), digits) + 0.0 for value in values)  # no -0.0


def _difference(name: str, old: tuple[float, ...], new: tuple[float, ...]) -> list[str]:
    """Return a field's difference as text."""
    side, what = name.split("_", 1)
    match what:
        case "size_px":
            return [f"{side} images {old[0]}x{old[1]} -> {new[0]}x{new[1]} px"]
        case "intrinsics_px":
            parts = {
                "focal length": (old[:2], new[:2]),
                "principal point": (old[2:4], new[2:4]),
                "skew": (old[4:], new[4:]),
            }
            return [
                f"{part} {_text(before)} -> {_text(after)} px"
                for part, (before, after) in parts.items()
                if before != after
            ]
        case "position_m":
            if old[0] != new[0]:
                return [f"baseline {old[0]:.4f} -> {new[0]:.4f} m"]
            return [f"position of the right camera {_text(old)} -> {_text(new)} m"]
        case "rotation_rad":
            angles = (np.rad2deg(np.linalg.norm(rotvec)) for rotvec in (old, new))
            return [f"rotation of the right camera {next(angles):.3f} -> {next(angles):.3f} deg"]
    return [f"{side} distortion {_text(old)} -> {_text(new)}"]


def _text(values: tuple[float, ...]) -> str:
    """Return the numbers as text, or a single one if all are equal."""
    distinct = values[:1] if len(set(values)) == 1 else values
    return ", ".join(f"{value:g}" for value in distinct) or "none"
