"""Checks of an own drive by the motions of its images: where cameras are, scale, time, steps."""

from collections.abc import Iterator

import numpy as np

from semviz.workspace.drive.drive_check_file import DriveCheck, StepErrors, words_of
from semviz_core.base.camera import Rig
from semviz_core.pose_checks.comparison import BASELINE, RIGHT_U, DrivePoses
from semviz_core.pose_checks.faults import (
    LEAST_OFFSET_PX,
    LEAST_SCALE,
    LOCAL_KINDS,
    OFFSET_FLOOR_PX,
    SCALE_FLOOR,
    SIGMAS,
    PoseCheck,
    PoseFault,
)
from semviz_core.pose_checks.whole_drive import LEAST_LATE, shows_time, turned_camera

SCALE_AT_M = 30.0
"""Depth that a turned right camera changes is stated here."""
LEAST_TURN_RAD = float(np.deg2rad(0.5))
"""Of a camera in its body; the poses of good drives leave up to half of it."""
_MOST_TURN_RAD = float(np.deg2rad(20.0))
"""Of a camera that a person mounted about as stated."""
_OTHER_UNIT, _NEAR_POWER = 1.5, 0.1
"""A scale so far from 1 is another unit: of ten, a hundred or a thousand if it is so near."""
_STANDING, _LEAST_STEP_M = 0.01, 0.01
"""Poses that move so little of what the images do stand still; images that move less, too."""


def motion_checks(found: PoseCheck, rig: Rig, camera: str) -> Iterator[DriveCheck]:
    """Yield what the motions of images say about where cameras are, scale and time."""
    faults = {fault.kind: fault for fault in reversed(found.faults)}
    ratio = _length_ratio(found)
    if ratio is not None and not 1.0 / _OTHER_UNIT < ratio < _OTHER_UNIT:
        # nothing else can be told then
        stand = ratio < _STANDING
        yield _steps(found, camera) if stand else _unit(found, ratio, rig.baseline_m)
        return
    mount = _mount(found, camera)
    yield mount
    if found.motions.has_stereo:
        yield _extrinsics(found, rig, faults.get("right image"))
        yield _scale(found, faults.get("baseline"))
    yield _time(found, faults.get("time"), camera)
    if mount.passed:  # else no step follows
        yield _steps(found, camera)


def turned_check(found: PoseCheck, camera: str) -> list[DriveCheck]:
    """Return the check of the camera's place in its body, if poses with which few matches agree
    would agree with a camera turned by some degrees."""
    turn_rad, _ = turned_camera(DrivePoses.of(found.frames), found.comparison)
    mount = _mount(found, camera)
    small = np.linalg.norm(turn_rad) < _MOST_TURN_RAD
    return [mount] if small and not mount.passed else []


def _middle(found: PoseCheck) -> int:
    """Return the frame that a check of the whole drive shows."""
    return found.frames[len(found.frames) // 2].index


def _length_ratio(found: PoseCheck) -> float | None:
    """Return how many times the lengths of the images' motions those of the poses are.

    None if only one camera measures, or the images stand still.
    """
    rows = found.comparison.compared
    if not found.motions.has_stereo or not rows.any():
        return None
    by_poses = float(np.median(DrivePoses.of(found.frames).step_m()[rows]))
    by_images = float(np.median(np.linalg.norm(found.motions.translation_m[rows], axis=1)))
    return by_poses / by_images if by_images > _LEAST_STEP_M else None


def _unit(found: PoseCheck, ratio: float, baseline_m: float) -> DriveCheck:
    """Return the check of the scale where poses are not in metres."""
    power = 10.0 ** round(np.log10(ratio))
    scale = 1.0 / (power if abs(ratio / power - 1.0) < _NEAR_POWER else ratio)
    return DriveCheck(
        kind="scale",
        name="scale of poses",
        measured=f"{len(found.frames)} frames, poses against stereo",
        value=f"{ratio:.3g} times",
        limit=f"{_OTHER_UNIT:g} times",
        passed=False,
        warning=f"distances between poses are {ratio:.3g} times those that stereo measures: poses "
        f"are not in metres, or the baseline is not {baseline_m:.3g} m",
        option=f"--scale {scale:.4g}",
        frame=_middle(found),
    )


def _mount(found: PoseCheck, camera: str) -> DriveCheck:
    turn_rad, sigma_rad = turned_camera(DrivePoses.of(found.frames), found.comparison)
    angle, limit = float(np.linalg.norm(turn_rad)), max(LEAST_TURN_RAD, SIGMAS * sigma_rad)
    name, of = words_of(camera)
    words = ", ".join(
        f"{axis} {value:+.1f}" for axis, value in zip("xy", np.rad2deg(turn_rad), strict=True)
    )
    passed = angle <= limit
    return DriveCheck(
        kind="mount",
        name="poses are the camera's" + name,
        measured=f"{len(found.frames)} frames, camera turned against them",
        value=f"{np.rad2deg(angle):.2f} deg",
        limit=f"{np.rad2deg(limit):.2f} deg",
        passed=passed,
        warning=""
        if passed
        else f"{of}the camera is turned by {np.rad2deg(angle):.1f} deg ({words}) against the "
        "poses: correct its pose in the body (--extrinsic, or in the calibration) by that",
        frame=_middle(found),
    )


def _extrinsics(found: PoseCheck, rig: Rig, fault: PoseFault | None) -> DriveCheck:
    offset_px, focal_px = float(found.comparison.rig.values[RIGHT_U]), float(rig.left.K[0, 0])
    sigma_px = float(found.comparison.rig.sigma[RIGHT_U])
    limit_px = max(LEAST_OFFSET_PX, SIGMAS * float(np.hypot(sigma_px, OFFSET_FLOOR_PX)))
    wrong = fault is not None and abs(offset_px) > limit_px
    turn_deg, limit_deg = np.rad2deg(np.arctan(np.array([abs(offset_px), limit_px]) / focal_px))
    share = abs(offset_px) * SCALE_AT_M / (focal_px * rig.baseline_m)
    much = "long" if offset_px > 0.0 else "short"
    return DriveCheck(
        kind="extrinsics",
        name="extrinsics",
        measured=f"{len(found.frames)} frames, right camera turned about y",
        value=f"{turn_deg:.3f} deg",
        limit=f"{limit_deg:.3f} deg",
        passed=not wrong,
        warning=f"depth is {share:.1%} too {much} at {SCALE_AT_M:.0f} m: the right camera is "
        f"turned by {turn_deg:.3f} deg about y against its calibration"
        if wrong
        else "",
        option="--refine-extrinsics" if wrong else "",
        frame=_middle(found),
    )


def _scale(found: PoseCheck, fault: PoseFault | None) -> DriveCheck:
    ratio = float(np.expm1(found.comparison.rig.values[BASELINE]))
    sigma = float(np.hypot(found.comparison.rig.sigma[BASELINE], SCALE_FLOOR))
    return DriveCheck(
        kind="scale",
        name="scale of poses",
        measured=f"{len(found.frames)} frames, stereo against poses",
        value=f"{abs(ratio):.1%}",
        limit=f"{max(LEAST_SCALE, SIGMAS * sigma):.1%}",
        passed=fault is None,
        warning="" if fault is None else f"{fault.text}; {fault.remedy}",
        frame=_middle(found),
    )


def _time(found: PoseCheck, fault: PoseFault | None, camera: str) -> DriveCheck:
    name, of = words_of(camera)
    interval_ms = 1e3 * float(np.median(np.diff([frame.time_s for frame in found.frames])))
    late_ms = 0.0 if fault is None or fault.value is None else fault.value * interval_ms
    is_known = fault is not None or shows_time(DrivePoses.of(found.frames), found.motions)
    word = "late" if late_ms > 0.0 else "early"
    return DriveCheck(
        kind="time",
        name="time offset" + name,
        measured=f"{len(found.frames)} frames, poses against images",
        value=f"{late_ms:+.0f} ms" if is_known else "-",
        limit=f"{LEAST_LATE * interval_ms:.0f} ms",
        passed=fault is None if is_known else None,
        warning=""
        if fault is None
        else f"{of}the poses are {abs(late_ms):.0f} ms {word}: correct their times by that",
        frame=_middle(found),
    )


def _steps(found: PoseCheck, camera: str) -> DriveCheck:
    steps = StepErrors.of(found)
    name, of = words_of(camera)
    local = [fault for fault in found.faults if fault.kind in LOCAL_KINDS]
    return DriveCheck(
        kind="steps",
        name="steps of poses" + name,
        measured=f"{len(steps.frames)} steps, that do not follow the images",
        value=f"{sum(steps.wrong)}",
        limit="no run",
        passed=not local,
        warning=""
        if not local
        else of
        + "; ".join(fault.text for fault in local[:2])
        + (f", and {len(local) - 2} more stretches" if len(local) > 2 else "")
        + "; refine them or leave them out: semviz annotate, Poses (F4)",
        frame=local[0].first if local else _middle(found),
    )
