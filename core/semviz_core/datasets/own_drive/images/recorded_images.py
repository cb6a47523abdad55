"""Read the images of one camera of a drive, or of its stereo pair: calibration, times and poses.

What is read and taken for granted is stated; cameras of a rig that say the same say it once.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.adapters.data_sets import (
    is_comma,
    read_comma_poses,
    read_recording,
)
from semviz_core.datasets.own_drive.cameras.calibration import CalibrationFile
from semviz_core.datasets.own_drive.cameras.colmap_model import is_colmap, read_colmap
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera, OriginalRig
from semviz_core.datasets.own_drive.cameras.recorded_cameras import (
    is_nerfstudio,
    read_cameras,
    read_nerfstudio,
    rows_of_images,
)
from semviz_core.datasets.own_drive.images.image_files import (
    ImageNames,
    ImageTimes,
    LeftOutImage,
    UnusableImages,
    read_times,
    times_from_names,
)
from semviz_core.datasets.own_drive.poses import conventions
from semviz_core.datasets.own_drive.poses.conventions import PosedCameras, RecordedPoses
from semviz_core.datasets.own_drive.poses.pose_files import read_pose_folder, read_poses
from semviz_core.datasets.own_drive.recording import (
    DriveFiles,
    Recording,
    poses_at_times,
    why_without_pose,
)


@dataclass
class Statements:
    """What is read and taken for granted, by topic, and the cameras that say it."""

    _texts: dict[str, dict[str, list[str]]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def state(self, topic: str, text: str, camera: str = "") -> None:
        texts = self._texts.setdefault(topic, {})
        texts.setdefault(shown(text, 400), []).append(camera)  # file names may be no text

    def __iter__(self) -> Iterator[tuple[str, str]]:
        """Yield topics and texts, for people; a text is of all cameras if none is named."""
        for topic, texts in self._texts.items():
            for text, cameras in texts.items():
                yield topic, text if len(texts) == 1 else f"{', '.join(cameras)}: {text}"


@dataclass
class Reading:
    """The files of one camera or a stereo pair, and what is stated while they are read."""

    files: DriveFiles
    statements: Statements
    camera: str = ""
    """Name of the camera of a rig; empty for one camera or a stereo pair."""

    def state(self, topic: str, text: str) -> None:
        self.statements.state(topic, text, self.camera)

    def warn(self, text: str) -> None:
        self.statements.warnings.append(f"{self.camera}: {text}" if self.camera else text)


@dataclass(frozen=True, eq=False)
class RecordedImages:
    """The images of one camera or a stereo pair, and what their sources say."""

    recording: Recording
    posed: PosedCameras | None
    original: OriginalRig
    calibration: CalibrationFile
    unusable: UnusableImages


def read_images(reading: Reading) -> RecordedImages:
    """Read images, poses as recorded, and calibration. Raise SemvizError if a file is wrong."""
    recording = read_recording(reading.files)
    _state_images(reading, recording)
    posed = _read_posed(reading.files, recording)
    original, calibration, unusable = read_cameras(reading.files, recording, posed)
    _state_calibration(reading, original, calibration)
    if unusable:
        _, first = unusable[0]
        reading.warn(
            f"{_images(len(unusable))} unusable, such as {shown(first.file, 80)} "
            f"({first.reason}): left out"
        )
    return RecordedImages(recording, posed, original, calibration, unusable)


def _state_images(reading: Reading, recording: Recording) -> None:
    names = recording.names
    extracted = reading.files.extracted
    is_bag = extracted is not None and recording.images.is_relative_to(extracted)
    place = reading.files.images if is_bag else recording.images
    text = f"{len(names.left)} in {shown(place, 60)}"
    if names.right:
        text = f"{len(names.left)} pairs, {names.paired}"
    if names.unpaired:
        reading.warn(f"{_images(len(names.unpaired))} without one on the other side: left out")
    if names.missing:
        reading.warn(f"{_images(len(names.missing))} missing in the recording: left out")
    reading.state("images", text)


def _images(count: int) -> str:
    return f"{count} image{'s' * (count > 1)}"


def _read_posed(files: DriveFiles, recording: Recording) -> PosedCameras | None:
    """Return the poses, with cameras if their file has some; None without poses."""
    path, own = files.poses, recording.poses
    if path is None or (own is not None and own.path == path):  # a topic of the recording
        return None if own is None else PosedCameras(own, {})
    if is_colmap(path):
        return read_colmap(path)
    if is_nerfstudio(path):
        return read_nerfstudio(path)
    if is_comma(path):
        return PosedCameras(read_comma_poses(path), {})
    if path.is_dir():
        found = read_pose_folder(path)
        if found is None:
            raise SemvizError(
                f"{path}: a folder without a model of COLMAP (images.txt or images.bin, also in 0),"
                " comma2k19's frame_positions, or a text file for each image; name a file"
            )
        return PosedCameras(found, {})
    return PosedCameras(read_poses(path, files.quaternion, files.time_unit), {})


def _state_calibration(
    reading: Reading, original: OriginalRig, calibration: CalibrationFile
) -> None:
    left = original.left
    text = f"{calibration.path.name} {calibration.format}, {_lens_text(left)}"
    if original.T_right_left is not None:
        baseline_m = float(np.linalg.norm(original.T_right_left.translation))
        text += f", 2 cameras {baseline_m:.3f} m apart"
    reading.state("calibration", f"{text}, {left.width}x{left.height}")


def _lens_text(camera: OriginalCamera) -> str:
    if camera.is_pinhole:
        return "pinhole without distortion"
    terms = ", ".join(f"{value:.3g}" for value in camera.distortion)
    return f"{camera.model} ({terms})"


def read_image_times(reading: Reading, images: RecordedImages) -> ImageTimes:
    """Return the time of each image, or pair. Raise SemvizError if poses need times not there."""
    recording, posed = images.recording, images.posed
    files, names = reading.files, recording.names
    if files.times is not None:
        times = read_times(files.times, names.left, files.time_unit)
    elif recording.times is not None:
        times = recording.times
    else:
        found = times_from_names(names.left, files.time_unit)
        needed = posed is not None and posed.poses.time_s is not None
        if found is None and needed:
            assert posed is not None
            raise SemvizError(
                f"{posed.poses.path}: {posed.poses.format} poses have times, the images none; give "
                f"--times FILE with a time for each image{_own_times(posed.poses, len(names.left))}"
            )
        if found is None:
            seconds = np.arange(len(names.left)) / files.rate_hz
            found = ImageTimes(seconds, f"unknown, counted as {files.rate_hz:g} images a second")
        times = found
    if same := int((np.diff(np.sort(times.time_s)) == 0.0).sum()):
        reading.warn(f"same time for different images, {same} times: repair {times.source}")
    unit = "" if times.unit is None else f", in {times.unit}"
    span = float(times.time_s[-1] - times.time_s[0])
    reading.state("times", f"{times.source}{unit}, {span:.1f} s")
    return times


def _own_times(poses: RecordedPoses, images: int) -> str:
    if len(poses.matrices) != images:
        return f" ({len(poses.matrices)} poses, {images} images)"
    return f"; if its {images} lines are those of the {images} images: --times {poses.path}"


def read_world_poses(
    reading: Reading, images: RecordedImages, times: ImageTimes, T_body_camera: Pose | None = None
) -> list[Pose | None]:
    """Return ``T_world_camera`` in metres of each image of the (left) camera; None without a pose.

    ``T_body_camera`` None: as ``--extrinsic`` and the formats say. Raise SemvizError if that is not
    known, or no image has a pose.
    """
    assert images.posed is not None
    files, recorded, recording = reading.files, images.posed.poses, images.recording
    given, of_what = body_from_camera(files, recorded, images.calibration)
    if reading.camera and recorded.names is None:
        body = "a body" if recorded.of_body or files.extrinsic else "the first camera"
        of_what = f"{body}, moved to each camera by its calibration"
    elif reading.camera:
        of_what = "the cameras"
    T_body_camera = given if T_body_camera is None else T_body_camera
    if not files.metric and not recorded.note:  # of degrees made metres
        conventions.refuse_degrees(recorded.path, recorded.matrices[:, :, 3])
    T = conventions.camera_poses(recorded, files.direction, files.axes)
    meters = _meters(files, recorded)
    T = [Pose(pose.rotation, pose.translation * meters) @ T_body_camera for pose in T]
    found = _of_images(files, recorded, T, recording, times)
    _state_poses(reading, recorded, of_what)
    return found


def body_from_camera(
    files: DriveFiles, recorded: RecordedPoses, calibration: CalibrationFile
) -> tuple[Pose, str]:
    """Return T_body_camera and whose poses these are, for people."""
    name = files.extrinsic
    if name is None and recorded.of_body:
        if calibration.T_body_left is None:
            raise SemvizError(
                f"{recorded.path}: {recorded.format} holds poses of a body, not of the camera; "
                "give --extrinsic FILE with T_body_camera, or flu or frd"
            )
        name = conventions.CALIBRATION_EXTRINSIC
    if name is None:
        return Pose.identity(), "the left camera"
    pose, source = conventions.read_extrinsic(name, calibration)
    return pose, f"a body, moved to the left camera by {source}"


def _meters(files: DriveFiles, recorded: RecordedPoses) -> float:
    """Return the metres in a unit of length of the poses."""
    if files.scale is not None:
        return files.scale
    if not recorded.metric and not files.metric:
        raise SemvizError(
            f"{recorded.path}: a model of {recorded.format} has no unit of length; give --scale "
            "METRES for one unit, or --metric if its unit is the metre"
        )
    return 1.0


def _of_images(
    files: DriveFiles,
    recorded: RecordedPoses,
    T_world_camera: Sequence[Pose],
    recording: Recording,
    times: ImageTimes,
) -> list[Pose | None]:
    """Return the recorded pose of each image. Raise SemvizError if no image has one."""
    names = recording.names
    count = len(names.left)
    if recorded.names is not None:
        rows = rows_of_images(recording.images, names.left, recorded)
        return [None if row is None else T_world_camera[row] for row in rows]
    if recorded.time_s is not None:
        found = poses_at_times(T_world_camera, recorded.time_s, times.time_s, files.most_gap_s)
        if all(pose is None for pose in found):
            raise SemvizError(
                f"{recorded.path}: no pose is at the time of an image: its times are "
                f"{recorded.time_s.min():.3f} to {recorded.time_s.max():.3f} s, the images' "
                f"{times.time_s.min():.3f} to {times.time_s.max():.3f} s. Another clock, another "
                "unit (--time-unit), or poses farther apart than --most-gap"
            )
        return found
    if recorded.indices is not None:
        return _by_number(recorded, T_world_camera, names)
    if len(T_world_camera) != count:
        raise SemvizError(
            f"{recorded.path}: {len(T_world_camera)} poses for {count} images, and nothing says "
            "which belong together: poses of another drive? Give poses with times (TUM)"
        )
    return list(T_world_camera)


def _by_number(
    recorded: RecordedPoses, T_world_camera: Sequence[Pose], names: ImageNames
) -> list[Pose | None]:
    """Return poses of images whose names are the numbers in the file."""
    assert recorded.indices is not None
    by_number = dict(zip(recorded.indices.tolist(), T_world_camera, strict=True))
    stems = [Path(name).stem for name in names.left]
    if not all(stem.isdecimal() for stem in stems):
        raise SemvizError(
            f"{recorded.path}: holds poses by the number of a frame, but images are called like "
            f"{shown(names.left[0], 60)}; name them by number"
        )
    found = [by_number.get(int(stem)) for stem in stems]
    if all(pose is None for pose in found):
        raise SemvizError(f"{recorded.path}: has no pose of any image's number; another drive?")
    return found


def _state_poses(reading: Reading, recorded: RecordedPoses, of_what: str) -> None:
    files = reading.files
    direction = files.direction or recorded.direction
    order = files.quaternion or recorded.quaternion
    unit = "" if recorded.time_unit is None else f", times in {recorded.time_unit}"
    reading.state("poses", f"{recorded.path.name} {recorded.format}, of {of_what}")
    if recorded.doubt:
        reading.warn(f"{recorded.path.name}: {recorded.doubt}")
    reading.state(
        "taken as",
        f"{direction}, {files.axes or recorded.axes} camera axes"
        + ("" if order is None else f", quaternions {order}")
        + unit
        + (f", {recorded.note}" if recorded.note else ""),
    )


def not_imported(files: DriveFiles, recording: Recording, times: ImageTimes) -> list[LeftOutImage]:
    """Return the images that are not in the workspace, with the times that their names are."""
    images = [*recording.names.unpaired, *recording.names.missing]
    if files.times is not None or recording.times is not None or times.unit is None:
        return images  # times are not those of names
    found = [times_from_names([image.file], times.unit) for image in images]
    return [
        image if own is None else replace(image, time_s=float(own.time_s[0]))
        for image, own in zip(images, found, strict=True)
    ]


def without_pose(
    files: DriveFiles,
    recorded: RecordedPoses,
    names: ImageNames,
    times: ImageTimes,
    rows: Sequence[int],
) -> list[LeftOutImage]:
    """Return the images of ``rows``, which have no pose, each with what is known of why."""
    images = []
    for row in rows:
        moment_s = float(times.time_s[row])
        reason = "no pose"
        if recorded.time_s is not None and recorded.names is None:
            reason += f", {why_without_pose(recorded.time_s, moment_s, files.most_gap_s)}"
        reason += ": kept for labels, left out of maps and runs"
        images.append(LeftOutImage(names.left[row], "left", moment_s, reason))
    return images
