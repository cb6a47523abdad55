"""The checks of an own drive at its import: what was measured on how much, and its limit.

``checks/checks.json`` keeps them; `semviz new` prints them, and `semviz annotate` shows them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from semviz_core.base.camera import Rig
from semviz_core.base.frame import Dataset, Frame
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import MOST_TEXT_BYTES, read_limited, shown
from semviz_core.datasets.own_drive import line_checks, match_checks, pose_remedies
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive
from semviz_core.datasets.rig_cameras import DatasetWithFrames, frames_by_camera
from semviz_core.pose_checks.comparison import (
    BASELINE,
    LIMIT,
    RIGHT_U,
    DrivePoses,
    rotation_vectors,
)
from semviz_core.pose_checks.faults import (
    LEAST_OFFSET_PX,
    LEAST_SCALE,
    LOCAL_KINDS,
    OFFSET_FLOOR_PX,
    SCALE_FLOOR,
    SIGMAS,
    PoseCheck,
    PoseFault,
    check_drive,
)
from semviz_core.pose_checks.image_motions import measure_motions
from semviz_core.pose_checks.whole_drive import LEAST_LATE, shows_time, turned_camera

CHECKS = Path("checks", "checks.json")
MOST_GAP_S = 0.5
_MANY_INTERVALS = 5.0
"""A gap is long if it is longer than ``MOST_GAP_S`` and than so many usual intervals."""
MOTION_FRAMES, LEAST_MOTION_FRAMES = 40, 10
"""Successive ones whose motion is measured: seconds; fewer show no fault of a whole drive."""
SCALE_AT_M = 30.0
"""Depth that a turned right camera changes is stated here."""
LEAST_TURN_RAD = float(np.deg2rad(0.5))
"""Of a camera in its body; the poses of good drives leave up to half of it."""
CheckKind = Literal[
    "sides", "lines", "rows", "poses", "mount", "extrinsics", "scale", "time", "steps", "gaps"
]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DriveCheck(_Model):
    """One check, as texts for people."""

    kind: CheckKind
    name: str
    measured: str
    """On what: ``3203 matches, off their row, median``."""
    value: str
    limit: str
    passed: bool | None
    """None: there was too little to measure it on."""
    warning: str = ""
    """If it did not pass: what that does to the user."""
    option: str = ""
    """Of `semviz new`, which is the remedy; empty if there is none."""
    remedy: str = ""
    """The command with that option."""
    frame: int | None = None
    """Where to look."""


class StepErrors(_Model):
    """How far the steps of n poses are from those of the images."""

    frames: tuple[int, ...]
    """(n,) at which the steps end."""
    turn_deg: tuple[float, ...]
    shift_m: tuple[float, ...]
    wrong: tuple[bool, ...]
    """Whether the images contradict a step."""
    usual: tuple[float, float]
    """One standard deviation of good steps: deg and m."""

    @classmethod
    def of(cls, check: PoseCheck) -> "StepErrors":
        compared = check.comparison.compared
        rows, sigma = np.flatnonzero(compared), check.comparison.pose_sigma
        innovation = check.comparison.innovation[rows]
        turn_deg = np.rad2deg(np.linalg.norm(innovation[:, 3:], axis=1))
        return cls(
            frames=tuple(check.frames[row + 1].index for row in rows.tolist()),
            turn_deg=tuple(turn_deg.round(4).tolist()),
            shift_m=tuple(np.linalg.norm(innovation[:, :3], axis=1).round(4).tolist()),
            wrong=tuple((check.comparison.chi2[rows] > LIMIT).tolist()),
            usual=(float(np.rad2deg(sigma[3:].max())), float(sigma[:3].max())),
        )


class DriveChecks(_Model):
    """The content of the file."""

    version: Literal[1] = 1
    checks: tuple[DriveCheck, ...]
    warnings: tuple[str, ...] = ()
    """Others than those of checks."""
    steps: StepErrors | None = None
    """Of the first camera, where they were measured."""
    command: str = ""
    """That made the workspace: given once more, it goes on where it was stopped."""


@dataclass(frozen=True, eq=False)
class DriveFindings:
    """The checks of a drive, and what else they measured."""

    checks: tuple[DriveCheck, ...]
    motions: PoseCheck | None = None
    """Of the first camera; None if too little was seen."""


def check_drive_files(dataset: Dataset, drive: RecordedDrive) -> DriveFindings:
    """Compare the calibration and poses of a drive with its images.

    ``dataset`` holds the rectified images of ``drive``.
    """
    cameras = {
        camera: DatasetWithFrames(dataset, frames)
        for camera, frames in frames_by_camera(dataset).items()
    }
    checks: list[DriveCheck] = []
    if dataset.rig.right is not None:
        checks.append(_sides(dataset))
    checks += [_lines(images, camera) for camera, images in cameras.items()]
    if dataset.rig.right is not None:
        checks.append(_rows(dataset))
    if drive.axes is None:
        return DriveFindings(tuple(checks))
    first: PoseCheck | None = None
    for camera, images in cameras.items():
        motions = _motions(images, MOTION_FRAMES // len(cameras))
        poses = _poses(images, drive, camera, motions)
        checks.append(poses)
        if motions is not None and poses.passed is not False:
            checks += motion_checks(motions, images.rig, camera)
            first = motions if first is None else first
    checks += [gap for camera, images in cameras.items() for gap in _gaps(images.frames, camera)]
    return DriveFindings(tuple(checks), first)


def _sides(dataset: Dataset) -> DriveCheck:
    return DriveCheck(
        kind="sides",
        name="left, right not swapped",
        measured="baseline",
        value=f"{dataset.rig.baseline_m:.3f} m",
        limit="over 0 m",
        passed=True,  # others were refused
    )


def _of(camera: str) -> tuple[str, str]:
    """Return what names a camera of a rig behind the name of a check, and before a warning."""
    return (f", {shown(camera, 60)}", f"{shown(camera, 60)}: ") if camera else ("", "")


def _lines(dataset: Dataset, camera: str) -> DriveCheck:
    found = line_checks.check_lines(dataset)
    name, of = _of(camera)
    warning = ""
    if not found.is_straight:
        bent = f"{of}straight edges bend by {found.bent_px:.1f} px (median of {found.edges}), as in"
        warning = (
            f"{bent} a barrel: the calibration's distortion is too weak, or not that of these "
            "images; calibrate again"
            if found.k < 0.0
            else f"{bent} a cushion: the calibration's distortion is too strong, or the images "
            "had none any more; if they were rectified before, give a calibration without "
            "distortion"
        )
    return DriveCheck(
        kind="lines",
        name="distortion removed" + name,
        measured=f"{found.edges} long edges, bent, median",
        value=f"{found.bent_px:.2f} px" if found.is_known else "-",
        limit=f"{found.limit_px:.2f} px" if found.is_known else "",
        passed=found.is_straight if found.is_known else None,
        warning=warning,
        frame=dataset.frames[len(dataset.frames) // 2].index,
    )


def _rows(dataset: Dataset) -> DriveCheck:
    rows = match_checks.check_rows(dataset)
    known = rows.matches >= match_checks.LEAST_ROW_MATCHES
    warning = ""
    if not rows.agrees:
        warning = (
            f"rows of both images are {rows.apart_px:.1f} px apart (right {rows.offset_px:+.1f} px "
            "lower): the calibration is not that of these images, or the cameras have moved"
        )
    return DriveCheck(
        kind="rows",
        name="rows agree",
        measured=f"{rows.matches} matches, off their row, median",
        value=f"{rows.apart_px:.2f} px" if known else "-",
        limit=f"{match_checks.MOST_APART_PX:.2f} px",
        passed=rows.agrees if known else None,
        warning=warning,
        option="" if rows.agrees else "--refine-extrinsics",
        frame=dataset.frames[len(dataset.frames) // 2].index,
    )


def _poses(
    dataset: Dataset, drive: RecordedDrive, camera: str, motions: PoseCheck | None
) -> DriveCheck:
    assert drive.axes is not None
    assert drive.taken is not None
    mount = drive.cameras[camera].T_first_camera if camera else None
    taken = drive.taken if mount is None else drive.taken.of_camera(mount)
    found = pose_remedies.compare_poses(
        dataset, drive.axes.T_map_world, drive.rectified.T_left_rectified, taken
    )
    name, of = _of(camera)
    axes = [fault.text for fault in motions.faults if fault.kind == "axes"] if motions else []
    passed = found.agrees and not axes if found.is_known else None
    warning = ""
    if passed is False:
        remedy = "poses of another drive, or other axes"
        if found.remedies:
            remedy = f"{' or '.join(found.remedies)} fits"
        elif axes:
            remedy = f"{axes[0]}; convert the file of poses"
        warning = (
            f"{of}only {found.share:.0%} of the matches between images agree with the poses: "
            f"{remedy}"
        )
    option = found.remedies[0] if found.remedies else ""
    return DriveCheck(
        kind="poses",
        name="poses against images" + name,
        measured=f"{found.matches} matches, that agree",
        value=f"{found.share:.0%}" if found.is_known else "-",
        limit=f"over {pose_remedies.LEAST_SHARE:.0%}",
        passed=passed,
        warning=warning,
        option=option if option.startswith("--") else "",
        frame=dataset.frames[len(dataset.frames) // 2].index,
    )


def _motions(dataset: Dataset, count: int) -> PoseCheck | None:
    """Compare the motions of ``count`` successive frames with those of their images.

    Those where the poses turn most: a straight drive shows neither time nor axes. None if they
    are too few, or the images show too little.
    """
    poses = DrivePoses.of(dataset.frames)
    count = min(max(count, LEAST_MOTION_FRAMES), len(poses))
    turn = np.linalg.norm(rotation_vectors(poses.motions()[0]), axis=1) * poses.pair_known
    if count < LEAST_MOTION_FRAMES or poses.pair_known.sum() < LEAST_MOTION_FRAMES - 1:
        return None
    first = int(np.convolve(turn, np.ones(count - 1), "valid").argmax())
    frames = dataset.frames[first : first + count]
    found = check_drive(frames, measure_motions(dataset, frames), dataset.rig)
    return found if found.is_checked else None


def motion_checks(found: PoseCheck, rig: Rig, camera: str) -> Iterator[DriveCheck]:
    """Yield what the motions of images say about where cameras are, scale and time."""
    faults = {fault.kind: fault for fault in reversed(found.faults)}
    mount = _mount(found, camera)
    yield mount
    if found.motions.has_stereo:
        yield _extrinsics(found, rig, faults.get("right image"))
        yield _scale(found, faults.get("baseline"))
    yield _time(found, faults.get("time"), camera)
    if mount.passed:  # else no step follows
        yield _steps(found, camera)


def right_turn_rad(dataset: Dataset) -> float | None:
    """Return how far the poses say that the right camera is turned about its y axis.

    Matches of one pair tell that turn least. None if poses or images tell nothing sure.
    """
    found = _motions(dataset, MOTION_FRAMES)
    if found is None or all(fault.kind != "right image" for fault in found.faults):
        return None
    offset_px = float(found.comparison.rig.values[RIGHT_U])
    return float(np.arctan(offset_px / dataset.rig.left.K[0, 0]))


def _mount(found: PoseCheck, camera: str) -> DriveCheck:
    turn_rad, sigma_rad = turned_camera(DrivePoses.of(found.frames), found.comparison)
    angle, limit = float(np.linalg.norm(turn_rad)), max(LEAST_TURN_RAD, SIGMAS * sigma_rad)
    name, of = _of(camera)
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
        frame=found.frames[len(found.frames) // 2].index,
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
        frame=found.frames[len(found.frames) // 2].index,
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
        frame=found.frames[len(found.frames) // 2].index,
    )


def _time(found: PoseCheck, fault: PoseFault | None, camera: str) -> DriveCheck:
    name, of = _of(camera)
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
        frame=found.frames[len(found.frames) // 2].index,
    )


def _steps(found: PoseCheck, camera: str) -> DriveCheck:
    steps = StepErrors.of(found)
    name, of = _of(camera)
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
        frame=local[0].first if local else found.frames[len(found.frames) // 2].index,
    )


def _gaps(frames: Sequence[Frame], camera: str) -> Iterator[DriveCheck]:
    """Check the time between frames with a pose; none for a camera with two or less."""
    posed = [frame for frame in frames if frame.T_map_camera is not None]
    gaps_s = np.diff([frame.time_s for frame in posed])
    if len(gaps_s) < 2:
        return
    limit_s = max(MOST_GAP_S, _MANY_INTERVALS * float(np.median(gaps_s)))
    row = int(gaps_s.argmax())
    passed, longest_s = bool(gaps_s[row] <= limit_s), float(gaps_s[row])
    name, of = _of(camera)
    between = f"frames {posed[row].index} and {posed[row + 1].index}"
    yield DriveCheck(
        kind="gaps",
        name="gaps" + name,
        measured="longest time without image or pose",
        value=f"{longest_s:.1f} s",
        limit=f"{limit_s:.1f} s",
        passed=passed,
        warning="" if passed else f"{of}{longest_s:.1f} s without image or pose, between {between}",
        frame=posed[row].index,
    )


def save_checks(checks: DriveChecks, path: Path) -> None:
    """Write the file. Raise SemvizError if it cannot be written."""
    path.parent.mkdir(exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_text(checks.model_dump_json(indent=1), encoding="utf-8")


def read_checks(path: Path) -> DriveChecks | None:
    """Return the content of the file; None if there is none. Raise SemvizError if it is damaged."""
    if not path.is_file():
        return None
    try:
        return DriveChecks.model_validate_json(read_limited(path, MOST_TEXT_BYTES))
    except ValidationError:
        raise SemvizError(f"{path}: damaged; delete it, or run 'semviz new' again") from None
