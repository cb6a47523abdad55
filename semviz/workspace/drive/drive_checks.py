"""The checks of an own drive at its import: what was measured on how much, and its limit.

`semviz new` prints them, and `semviz annotate` shows them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from semviz.workspace.drive.drive_check_file import DriveCheck, words_of
from semviz.workspace.drive.motion_checks import motion_checks, turned_check
from semviz_core.base.frame import Dataset, Frame
from semviz_core.common.limits import read_image
from semviz_core.datasets.own_drive.checks import (
    color_checks,
    line_checks,
    match_checks,
    pose_remedies,
)
from semviz_core.datasets.own_drive.images.color_orders import EXCHANGED, ColorOrder, mosaic_of
from semviz_core.datasets.own_drive.images.image_folder import ImageFolder
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive
from semviz_core.datasets.rig_cameras import DatasetWithFrames, frames_by_camera
from semviz_core.pose_checks.comparison import RIGHT_U, DrivePoses, rotation_vectors
from semviz_core.pose_checks.faults import PoseCheck, check_drive
from semviz_core.pose_checks.image_motions import measure_motions

MOST_GAP_S = 0.5
_MANY_INTERVALS = 5.0
"""A gap is long if it is longer than ``MOST_GAP_S`` and than so many usual intervals."""
MOTION_FRAMES, LEAST_MOTION_FRAMES = 40, 10
"""Successive ones whose motion is measured: seconds; fewer show no fault of a whole drive."""


@dataclass(frozen=True, eq=False)
class DriveFindings:
    """The checks of a drive, and what else they measured."""

    checks: tuple[DriveCheck, ...]
    motions: PoseCheck | None = None
    """Of the first camera; None if too little was seen."""


def check_drive_files(
    dataset: ImageFolder, drive: RecordedDrive, check_colors: bool = True
) -> DriveFindings:
    """Compare the calibration and poses of a drive with its images.

    ``dataset`` holds the rectified images of ``drive``. With ``check_colors``, nobody has said
    which of their colours is red.
    """
    cameras = {
        camera: DatasetWithFrames(dataset, frames)
        for camera, frames in frames_by_camera(dataset).items()
    }
    checks: list[DriveCheck] = []
    if check_colors:
        checks += [
            _mosaic(dataset, images.frames, camera) or _colors(images, camera, dataset.colors)
            for camera, images in cameras.items()
        ]
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
        elif motions is not None and not poses.option:
            checks += turned_check(motions, camera)
    checks += [gap for camera, images in cameras.items() for gap in _gaps(images.frames, camera)]
    return DriveFindings(tuple(checks), first)


def _mosaic(dataset: ImageFolder, frames: tuple[Frame, ...], camera: str) -> DriveCheck | None:
    """Return the check of raw images that were taken for grey ones; None for others."""
    frame = frames[len(frames) // 2].index
    if dataset.colors != "rgb":
        return None
    pattern = mosaic_of(read_image(dataset.original_path(frame, "left")))
    if pattern is None:
        return None
    name, of = words_of(camera)
    other = EXCHANGED[pattern]
    return DriveCheck(
        kind="mosaic",
        name="colours, not raw" + name,
        measured="neighbours in an image",
        value="raw",
        limit="none",
        passed=False,
        warning=f"{of}images are raw, with a colour for each pixel in turn (or {other}, if red and "
        "blue are swapped then)",
        option=f"--colors {pattern}",
        frame=frame,
    )


def _colors(dataset: Dataset, camera: str, colors: ColorOrder) -> DriveCheck:
    found = color_checks.check_colors(dataset)
    name, of = words_of(camera)
    is_swapped = found.is_swapped
    return DriveCheck(
        kind="colors",
        name="red, blue not swapped" + name,
        measured=f"sky of {found.images} images, blue over red",
        value="-" if is_swapped is None else f"{found.sky:+.0f}",
        limit=f"over {color_checks.ORANGE:.0f}",
        passed=None if is_swapped is None else not is_swapped,
        warning=f"{of}the sky is orange and leaves are bluish: red and blue are swapped"
        if is_swapped
        else "",
        option=f"--colors {EXCHANGED[colors]}" if is_swapped else "",
        frame=dataset.frames[len(dataset.frames) // 2].index,
    )


def _sides(dataset: Dataset) -> DriveCheck:
    return DriveCheck(
        kind="sides",
        name="left, right not swapped",
        measured="baseline",
        value=f"{dataset.rig.baseline_m:.3f} m",
        limit="over 0 m",
        passed=True,  # others were refused
    )


def _lines(dataset: Dataset, camera: str) -> DriveCheck:
    found = line_checks.check_lines(dataset)
    name, of = words_of(camera)
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
    name, of = words_of(camera)
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


def right_turn_rad(dataset: Dataset) -> float | None:
    """Return how far the poses say that the right camera is turned about its y axis.

    Matches of one pair tell that turn least. None if poses or images tell nothing sure.
    """
    found = _motions(dataset, MOTION_FRAMES)
    if found is None or all(fault.kind != "right image" for fault in found.faults):
        return None
    offset_px = float(found.comparison.rig.values[RIGHT_U])
    return float(np.arctan(offset_px / dataset.rig.left.K[0, 0]))


def _gaps(frames: Sequence[Frame], camera: str) -> Iterator[DriveCheck]:
    """Check the time between frames with a pose; none for a camera with two or less."""
    posed = [frame for frame in frames if frame.T_map_camera is not None]
    gaps_s = np.diff([frame.time_s for frame in posed])
    if len(gaps_s) < 2:
        return
    limit_s = max(MOST_GAP_S, _MANY_INTERVALS * float(np.median(gaps_s)))
    row = int(gaps_s.argmax())
    passed, longest_s = bool(gaps_s[row] <= limit_s), float(gaps_s[row])
    name, of = words_of(camera)
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
