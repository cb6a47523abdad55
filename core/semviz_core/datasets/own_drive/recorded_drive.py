"""Read a whole drive: images, calibration, times and poses, and state what was taken for granted.

`recorded_images` reads one camera or a stereo pair; here the cameras of a rig come together: with
one pinhole camera for all rectified images, and one map.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.cameras.calibration import CalibrationFile
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera, OriginalRig
from semviz_core.datasets.own_drive.images.color_orders import ColorOrder
from semviz_core.datasets.own_drive.images.image_files import ImageTimes, LeftOutImage
from semviz_core.datasets.own_drive.images.recorded_images import (
    Reading,
    RecordedImages,
    Statements,
    body_from_camera,
    not_imported,
    read_image_times,
    read_images,
    read_world_poses,
    without_pose,
)
from semviz_core.datasets.own_drive.images.rectification import (
    RectifiedRig,
    rectify_cameras,
    rectify_rig,
)
from semviz_core.datasets.own_drive.poses import conventions
from semviz_core.datasets.own_drive.recording import DriveFiles

_LOST_VIEW = 0.75
"""A camera of a rig that keeps less of its field of view is worth a warning."""


@dataclass(frozen=True, eq=False)
class RecordedCamera:
    """A camera of a rig of several."""

    folder: Path
    original: OriginalCamera
    T_first_camera: Pose | None
    """From this camera to the rig's first one; None if nothing says it."""


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A drive as it was read."""

    left_folder: Path
    """Of a rig: of its first camera."""
    right_folder: Path | None
    original: OriginalRig
    """Of a rig: its first camera."""
    rectified: RectifiedRig
    frames: tuple[Frame, ...]
    """In order of time, of a rig camera by camera; poses are those of the rectified (left) camera,
    in the map."""
    left: Mapping[int, str]
    """Names of images by the index of their frame."""
    right: Mapping[int, str]
    cameras: Mapping[str, RecordedCamera]
    """The cameras of a rig by name; empty for one camera or a stereo pair."""
    camera_of: Mapping[int, str]
    """Of a rig: name of the camera by the index of its frame."""
    statements: tuple[tuple[str, str], ...]
    """What was read and taken for granted: topic and text, for people."""
    warnings: tuple[str, ...]
    axes: conventions.WorldAxes | None
    """None without poses."""
    taken: conventions.PoseConventions | None
    """What poses were taken as, with the first camera's place; None without poses."""
    most_view_deg: float
    """As asked for."""
    left_out: tuple[LeftOutImage, ...]
    """Of the workspace, or of its maps and runs; frames without a pose by their left image."""
    colors: ColorOrder

    @property
    def first_frames(self) -> tuple[Frame, ...]:
        """The frames, of a rig those of its first camera."""
        first = next(iter(self.cameras), None)
        return tuple(one for one in self.frames if self.camera_of.get(one.index) == first)


@dataclass(frozen=True, eq=False)
class _Frames:
    """The frames of one camera or a stereo pair: numbers, rows of their images, times and poses."""

    numbers: Sequence[int]
    rows: Sequence[int]
    times: ImageTimes
    poses: Sequence[Pose | None]
    """``T_world_camera`` of each image."""


def read_drive(files: DriveFiles) -> RecordedDrive:
    """Read a drive. Raise SemvizError if a file is wrong, or says what semviz does not read.

    Start and end of each image are read; few are decoded.
    """
    statements = Statements()
    readings = _readings(files, statements)
    images = [read_images(reading) for reading in readings]
    first = images[0]
    if files.rig:
        rectified = rectify_cameras([one.original.left for one in images], files.most_view_deg)
        _warn_of_lost_view(readings, images, rectified)
    else:
        rectified = [rectify_rig(first.original, files.most_view_deg)]
    _state_rectification(statements, rectified)
    mounts = [_mount(first.calibration, one.calibration) for one in images]
    frames = _read_frames(readings, images, mounts)
    axes = _world_axes(files, statements, frames) if first.posed is not None else None
    for reading, one, its in zip(readings, images, frames, strict=True):
        _state_matched(reading, one, its)
    if files.colors == "bgr":
        statements.state("colours", "red and blue are swapped")
    elif files.colors != "rgb":
        statements.state("colours", f"raw images, {files.colors}")
    turn = rectified[0].T_left_rectified
    used = [
        (
            number,
            one.recording.names,
            row,
            Frame(number, float(its.times.time_s[row]), _in_map(axes, its.poses[row], turn)),
            reading.camera,
        )
        for reading, one, its in zip(readings, images, frames, strict=True)
        for number, row in zip(its.numbers, its.rows, strict=True)
    ]
    left_out = [
        image
        for reading, one, its in zip(readings, images, frames, strict=True)
        for image in _left_out(reading, one, its)
    ]
    return RecordedDrive(
        first.recording.images,
        first.recording.right,
        first.original,
        rectified[0],
        tuple(frame for *_, frame, _ in used),
        {number: names.left[row] for number, names, row, *_ in used},
        {number: names.right[row] for number, names, row, *_ in used if names.right},
        {
            reading.camera: RecordedCamera(one.recording.images, one.original.left, mount)
            for reading, one, mount in zip(readings, images, mounts, strict=True)
            if files.rig
        },
        {number: camera for number, *_, camera in used if files.rig},
        tuple(statements),
        tuple(statements.warnings),
        axes,
        _taken(files, first),
        files.most_view_deg,
        tuple(left_out),
        files.colors,
    )


def _taken(files: DriveFiles, images: RecordedImages) -> conventions.PoseConventions | None:
    if images.posed is None:
        return None
    recorded = images.posed.poses
    T_body_camera, _ = body_from_camera(files, recorded, images.calibration)
    return conventions.PoseConventions(
        files.direction or recorded.direction,
        files.axes or recorded.axes,
        recorded.quaternion,
        T_body_camera,
    )


def _readings(files: DriveFiles, statements: Statements) -> list[Reading]:
    """Return what is to be read: the drive, or each camera of a rig on its own."""
    if not files.rig:
        return [Reading(files, statements)]
    extracted = files.extracted
    return [
        Reading(
            replace(
                files,
                cameras=(name,),
                extracted=None if extracted is None else extracted / f"camera-{number}",
            ),
            statements,
            name,
        )
        for number, name in enumerate(files.rig)
    ]


def _mount(first: CalibrationFile, camera: CalibrationFile) -> Pose | None:
    """Return ``T_first_camera`` of a camera of a rig; None if the calibrations do not say it."""
    if camera.T_first_left is not None:
        return camera.T_first_left
    if first.T_body_left is None or camera.T_body_left is None:
        return Pose.identity() if camera is first else None
    return first.T_body_left.inverse() @ camera.T_body_left


def _read_frames(
    readings: Sequence[Reading], images: Sequence[RecordedImages], mounts: Sequence[Pose | None]
) -> list[_Frames]:
    """Read times and poses, and number the frames: those of a rig's camera k begin at k * 10^d."""
    found = []
    most = max(len(one.recording.names.left) for one in images)
    step = 10 ** len(str(most - 1))
    for number, (reading, one, mount) in enumerate(zip(readings, images, mounts, strict=True)):
        files, names = reading.files, one.recording.names
        times = read_image_times(reading, one)
        by_time = files.times is not None
        order = np.argsort(times.time_s, kind="stable") if by_time else np.arange(len(names.left))
        chosen = range(len(order)) if files.frames is None else files.frames
        unusable = {row for row, _ in one.unusable}
        rows = [
            (index, int(order[index]))
            for index in chosen
            if index < len(order) and int(order[index]) not in unusable
        ]
        if not rows:
            last = len(order) - 1
            raise SemvizError(f"--frames: the drive has frames 0 to {last}, none usable of these")
        poses: list[Pose | None] = [None] * len(names.left)
        if one.posed is None:
            reading.state("poses", "none: images can be labelled, but no map built")
        else:
            poses = read_world_poses(reading, one, times, _placed(reading, images, number, mount))
        numbers = [number * step + index for index, _ in rows]
        found.append(_Frames(numbers, [row for _, row in rows], times, poses))
    return found


def _placed(
    reading: Reading, images: Sequence[RecordedImages], number: int, mount: Pose | None
) -> Pose | None:
    """Return ``T_body_camera`` of a further camera of a rig; None for the first, or if poses are
    those of each image."""
    first, recorded = images[0], images[number].posed
    assert recorded is not None
    if number == 0 or recorded.poses.names is not None:
        return None
    if mount is None:
        raise SemvizError(
            f"{images[number].calibration.path}: does not say where camera {reading.camera} is; "
            "give its pose in the body (T_cam_imu, T_BS, T_body_camera), or in the first camera "
            "(T_cn_cnm1)"
        )
    T_body_first, _ = body_from_camera(reading.files, recorded.poses, first.calibration)
    return T_body_first @ mount


def _world_axes(
    files: DriveFiles, statements: Statements, frames: Sequence[_Frames]
) -> conventions.WorldAxes:
    """Return the map's axes, which are those of all cameras."""
    posed = [pose for its in frames for pose in its.poses if pose is not None]
    axes = conventions.world_axes(posed, files.up)
    up = "the cameras' mean" if axes.up == "cameras" else axes.up
    origin = "".join(f" {value:.0f}" for value in axes.origin_m)
    moved = f", origin moved to{origin} m" if any(axes.origin_m) else ""
    statements.state("world", f"up is {up} (cameras tilted {axes.tilt_deg:.0f} deg){moved}")
    return axes


def _state_matched(reading: Reading, images: RecordedImages, its: _Frames) -> None:
    if images.posed is None:
        return
    count, posed = len(its.poses), sum(pose is not None for pose in its.poses)
    reading.state("matched", f"{posed} of {count} images have a pose ({images.posed.poses.order})")
    if posed < count:
        reading.warn(
            f"{count - posed} of {count} images have no pose: they can be labelled, and are left "
            f"out of maps{_why_most(reading, images, its)}"
        )


def _why_most(reading: Reading, images: RecordedImages, its: _Frames) -> str:
    """Say why images have no pose, if most of them are between poses too far apart."""
    assert images.posed is not None
    pose_s = images.posed.poses.time_s
    if pose_s is None or images.posed.poses.names is not None or len(pose_s) < 2:
        return ""
    moments = its.times.time_s[[pose is None for pose in its.poses]]
    after = np.searchsorted(pose_s, moments)
    between = (after > 0) & (after < len(pose_s))
    if between.sum() < 0.5 * len(moments):
        return ""
    apart_s = float(np.median(np.diff(pose_s)[after[between] - 1]))
    if apart_s <= reading.files.most_gap_s:
        return ""
    return (
        f". Poses around them are {apart_s:.2f} s apart: --most-gap {1.1 * apart_s:.2g} would "
        "interpolate between these, as if the car drove straight"
    )


def _in_map(
    axes: conventions.WorldAxes | None, pose: Pose | None, T_camera_rectified: Pose
) -> Pose | None:
    if axes is None or pose is None:
        return None
    return axes.T_map_world @ pose @ T_camera_rectified


def _left_out(reading: Reading, images: RecordedImages, its: _Frames) -> list[LeftOutImage]:
    files, recording = reading.files, images.recording
    found = not_imported(files, recording, its.times)
    found += [replace(image, time_s=float(its.times.time_s[row])) for row, image in images.unusable]
    if images.posed is not None:
        lacking = [row for row in its.rows if its.poses[row] is None]
        found += without_pose(files, images.posed.poses, recording.names, its.times, lacking)
    return [replace(image, camera=reading.camera) for image in found]


def _state_rectification(statements: Statements, rectified: Sequence[RectifiedRig]) -> None:
    left, right = rectified[0].left, rectified[0].right
    if left.is_identity:
        statements.state("rectified", "not needed: images are used as they are")
        return
    across, down = left.view_deg
    camera = left.camera
    text = f"{camera.width}x{camera.height}, field of view {across:.0f} x {down:.0f} deg"
    if right is not None:
        text += ", rows of both images agree"
    if len(rectified) > 1:
        text += f", one pinhole camera for all {len(rectified)}"
    statements.state("rectified", text)


def _warn_of_lost_view(
    readings: Sequence[Reading],
    images: Sequence[RecordedImages],
    rectified: Sequence[RectifiedRig],
) -> None:
    """Warn if a camera alone would see much more than the one that all are rectified to."""
    for reading, one, common in zip(readings, images, rectified, strict=True):
        alone = rectify_rig(one.original, reading.files.most_view_deg).left.view_deg
        kept = common.left.view_deg
        if min(kept[0] / alone[0], kept[1] / alone[1]) < _LOST_VIEW:
            reading.warn(
                f"sees {alone[0]:.0f} x {alone[1]:.0f} deg, of which {kept[0]:.0f} x "
                f"{kept[1]:.0f} are left in the camera that all are rectified to; without the "
                "narrowest camera of the rig there would be more"
            )
