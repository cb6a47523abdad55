"""The command new: make a workspace of an own drive, a KITTI sequence or a simulated street."""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.workspace.workspace import Workspace
    from semviz_core.base.frame import Dataset
    from semviz_core.datasets.own_drive.drive_files import DriveFiles
    from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive

_TOPIC_WIDTH = 13


@dataclass(frozen=True)
class NewCommand:
    """Create a workspace from your own images, KITTI odometry data or a simulated street."""

    folder: Positional[Path]
    """Folder to create."""
    images: parsing.OptionalPath = None
    """Folder of your own images (PNG or JPEG), of the left camera or the only one."""
    right: parsing.OptionalPath = None
    """Folder of the right camera's images, called like the left ones."""
    calibration: parsing.OptionalPath = None
    """Calibration of your cameras: Kalibr, ROS camera_info, EuRoC, OpenCV, or semviz's TOML; a
    model of COLMAP or nerfstudio; default: that in --poses, if it is such a model."""
    right_calibration: parsing.OptionalPath = None
    """Calibration of the right camera, if it has a file of its own."""
    poses: parsing.OptionalPath = None
    """Of your images: TUM, KITTI, EuRoC, KITTI-360, COLMAP's folder or nerfstudio's
    transforms.json. With --kitti: TUM or KITTI, instead of KITTI's own, for the left camera."""
    times: parsing.OptionalPath = None
    """Times of your images, a line for each; default: their names, if these are times."""
    extrinsic: parsing.OptionalText = None
    """Pose of the left camera in the body whose poses are given: a file with the matrix
    T_body_camera, 'calibration', 'camera', 'flu' or 'frd'. A body of 'flu' has x ahead, y left
    and z up, one of 'frd' y right and z down; the camera looks ahead."""
    direction: Literal["auto", "camera-to-world", "world-to-camera"] = "auto"
    """Of your poses; default: what their format says."""
    camera_axes: Literal["auto", "opencv", "opengl"] = "auto"
    """Of your poses: y down and z ahead, or y up and z back; default: what their format says."""
    quaternion: Literal["auto", "xyzw", "wxyz"] = "auto"
    """Order of the numbers of a rotation; default: what the format says."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Of all times; default: by their number of digits, as times since 1970."""
    up: Literal["auto", "cameras", "x", "-x", "y", "-y", "z", "-z"] = "auto"
    """Axis of the poses' world that is up; default: the one nearest to the cameras' up."""
    scale: parsing.OptionalFloat = None
    """Metres in one unit of length of the poses."""
    metric: bool = False
    """Take lengths in a model of COLMAP or nerfstudio as metres."""
    most_gap: float = 0.25
    """Longest time (s) between two poses across which one is interpolated."""
    rate: float = 10.0
    """Images a second, if nothing tells their times."""
    most_view: float = 110.0
    """Largest field of view (deg) of the rectified images, from 10 to 160."""
    strict: bool = False
    """Make nothing if there are warnings."""
    kitti: parsing.OptionalPath = None
    """Root of a KITTI odometry dataset, with sequences/ and poses/."""
    sequence: str = "02"
    """Sequence of the KITTI dataset."""
    cameras: str = "2,3"
    """Left and right camera, or one camera: 2,3 is the colour pair, 0,1 the grey pair."""
    simulate: parsing.OptionalInt = None
    """Seed of a simulated street."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP], END excluded; default: all frames, or 60 of a street."""
    trust_poses: bool = False
    """Accept poses that jump, or that go backwards all the way."""
    check_poses: bool = False
    """Also check the poses against the images, as 'semviz poses check' does: seconds per hundred
    frames."""

    def run(self) -> int:
        from semviz.workspace.outputs import check_new_folder

        check_new_folder(self.folder)
        if sum(source is not None for source in (self.images, self.kitti, self.simulate)) != 1:
            raise SemvizError(
                "give --images FOLDER, --kitti ROOT or --simulate SEED: the source of images"
            )
        if self.images is not None:
            return self._from_images(self.images)
        return self._from_known()

    def _from_known(self) -> int:
        """Make a workspace of KITTI or a simulated street."""
        from semviz.workspace.workspace import Workspace

        self._refuse_options_of_images()
        frames = parsing.parse_frames(self.frames)
        if self.kitti is not None:
            cameras = parsing.parse_cameras(self.cameras)
            workspace = Workspace.create_kitti(
                self.folder,
                self.kitti,
                self.sequence,
                cameras,
                frames,
                self.trust_poses,
                self.poses,
            )
        else:
            assert self.simulate is not None
            if self.poses is not None:
                raise SemvizError("--poses needs --kitti ROOT or --images FOLDER")
            workspace = Workspace.create_street(self.folder, self.simulate, frames)
        source = workspace.source
        print(f"{workspace.path}: {len(source.frames)} frames, {source.map_frame.name}")
        self._warn_of_poses(workspace)
        print(f"next: semviz annotate {self.folder}")
        return 0

    def _refuse_options_of_images(self) -> None:
        for name in ("right", "calibration", "right_calibration", "times", "extrinsic", "scale"):
            if getattr(self, name) is not None:
                raise SemvizError(f"--{name.replace('_', '-')} needs --images FOLDER")

    def _from_images(self, images: Path) -> int:
        """Make a workspace of an own drive; what was taken for granted is printed."""
        from semviz.workspace.workspace import Workspace
        from semviz_core.datasets.own_drive.recorded_drive import read_drive
        from semviz_core.datasets.validation import unusual_motion

        files = self._files(images)
        drive = read_drive(files)
        for topic, text in drive.statements:
            _print_topic(topic, text)
        warnings = [*drive.warnings, *self._check_images(files, drive)]
        if where := unusual_motion(drive.frames):
            warnings.append(
                f"the camera moves {where}: right for a camera that looks there, else poses of a "
                "body (--extrinsic) or of another --direction"
            )
        for warning in warnings:
            print(f"warning: {warning}", file=sys.stderr)
        if warnings and self.strict:
            raise SemvizError(
                f"--strict: {len(warnings)} warning{'s' * (len(warnings) > 1)}; nothing was made"
            )
        workspace = Workspace.create_images(self.folder, files, drive, self.trust_poses)
        self._print_summary(workspace, len(warnings))
        self._warn_of_poses(workspace)
        print(f"next: semviz annotate {self.folder}")
        return 0

    def _check_images(self, files: "DriveFiles", drive: "RecordedDrive") -> list[str]:
        """Compare calibration and poses with the images, print figures and return warnings."""
        from semviz.workspace.drive_file import DriveFile

        with tempfile.TemporaryDirectory() as cache:
            content = DriveFile.of(drive, "drive")
            dataset = content.dataset(files.images, files.right, Path(cache))
            warnings = [] if files.right is None else _row_warnings(dataset)
            return warnings if drive.axes is None else warnings + _pose_warnings(dataset, drive)

    def _files(self, images: Path) -> "DriveFiles":
        from semviz_core.datasets.own_drive.drive_files import DriveFiles

        return DriveFiles(
            images=images,
            right=self.right,
            calibration=self.calibration,
            right_calibration=self.right_calibration,
            poses=self.poses,
            times=self.times,
            extrinsic=self.extrinsic,
            direction=None if self.direction == "auto" else self.direction,
            axes=None if self.camera_axes == "auto" else self.camera_axes,
            quaternion=None if self.quaternion == "auto" else self.quaternion,
            time_unit=None if self.time_unit == "auto" else self.time_unit,
            up=self.up,
            scale=self.scale,
            metric=self.metric,
            most_gap_s=self.most_gap,
            rate_hz=self.rate,
            most_view_deg=self.most_view,
            frames=parsing.parse_frames(self.frames),
        )

    def _print_summary(self, workspace: "Workspace", warnings: int) -> None:
        import numpy as np

        frames = workspace.source.frames
        t = [frame.T_map_camera.translation for frame in frames if frame.T_map_camera is not None]
        length_m = float(np.linalg.norm(np.diff(t, axis=0), axis=1).sum()) if len(t) > 1 else 0.0
        length = f"{length_m / 1000.0:.1f} km" if length_m >= 1000.0 else f"{length_m:.1f} m"
        count = 1 if workspace.source.rig.right is None else 2
        print(
            f"{workspace.path}: {len(frames)} frames, {len(t)} with a pose, {length}, "
            f"{count} camera{'s' * (count > 1)}, {warnings} warning{'s' * (warnings != 1)}"
        )

    def _warn_of_poses(self, workspace: "Workspace") -> None:
        """Print a line for each fault of the poses; with images only if asked."""
        from semviz.presentation.progress import Steps
        from semviz.reports.pose_check import warning_lines
        from semviz.workspace.pose_check import check_poses
        from semviz_core.pose_checks.faults import suspicions

        frames = workspace.source.frames
        if self.check_poses:
            with Steps() as steps:
                check = check_poses(workspace, frames, steps.show)
            lines = warning_lines(check, workspace.path)
        else:
            more = f"see: semviz poses check {workspace.path}"
            lines = [f"poses: {suspicion}; {more}" for suspicion in suspicions(frames)]
        for line in lines:
            print(line, file=sys.stderr)


def _row_warnings(dataset: "Dataset") -> list[str]:
    """Print how far rows of a stereo pair are apart; return a warning if they are."""
    from semviz_core.datasets.own_drive.row_check import LEAST_MATCHES, check_rows

    rows = check_rows(dataset)
    if rows.matches < LEAST_MATCHES:
        _print_topic("rows", f"not checked: {rows.matches} matches")
        return []
    _print_topic(
        "rows", f"{rows.matches} matches, off their row by {rows.apart_px:.2f} px (median)"
    )
    if rows.agrees:
        return []
    return [
        f"rows of both images are {rows.apart_px:.1f} px apart (right {rows.offset_px:+.1f} px "
        "lower): the calibration is not that of these images, or the cameras have moved"
    ]


def _pose_warnings(dataset: "Dataset", drive: "RecordedDrive") -> list[str]:
    """Print how many matches between images agree with the poses; return a warning if few do."""
    from semviz_core.datasets.own_drive.pose_check import check_against_images

    assert drive.axes is not None
    found = check_against_images(dataset, drive.axes.T_map_world, drive.rectified.T_left_rectified)
    if not found.is_known:
        _print_topic("motion", f"not checked: {found.matches} matches between images apart")
        return []
    _print_topic("motion", f"{found.share:.0%} of {found.matches} matches agree with the poses")
    if found.agrees:
        return []
    remedy = f"{found.remedy} fits" if found.remedy else "poses of another drive, or other axes"
    return [f"only {found.share:.0%} of the matches between images agree with the poses: {remedy}"]


def _print_topic(topic: str, text: str) -> None:
    print(f"  {topic:<{_TOPIC_WIDTH}}{text}")
