"""The command new: make a workspace of an own drive, a KITTI sequence or a simulated street."""

import json
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional, UseAppendAction

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from collections.abc import Callable

    from semviz.workspace.workspace import Workspace
    from semviz_core.datasets.own_drive.recording import DriveFiles


@dataclass(frozen=True)
class RelinkCommand:
    """Say where the images of a workspace are now, after they or it were moved.

    Nothing changes unless all images are there, with the calibration and size of the labels'; what
    they show is not compared. Example:
    'semviz relink town --images /disk/left --right /disk/right'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    root: parsing.OptionalPath = None
    """KITTI's folder, which holds sequences."""
    images: parsing.OptionalPath = None
    """Folder of the left, or the only, camera's images; of a rig: the folder that holds the folders
    of all its cameras."""
    right: parsing.OptionalPath = None
    """Folder of the right camera's images."""
    poses: parsing.OptionalPath = None
    """File of poses that replace KITTI's."""
    camera: UseAppendAction[tuple[str, ...]] = ()
    """NAME=FOLDER: folder of a further camera's images; may be repeated."""
    json: bool = False
    """Print one JSON object instead of a line."""

    def run(self) -> int:
        from semviz.workspace.settings import places_of, relink

        given = {"root": self.root, "images": self.images, "right": self.right, "poses": self.poses}
        places = {name: place for name, place in given.items() if place is not None}
        for text in self.camera:
            name, equals, folder = text.partition("=")
            if not equals or not folder:
                raise SemvizError(f"--camera {text}: write NAME=FOLDER")
            places[name] = Path(folder)
        workspace = relink(parsing.open_workspace(self.workspace), places)
        now, frames = places_of(workspace.settings.source), len(workspace.source.frames)
        if self.json:
            print(json.dumps({"workspace": str(self.workspace), "frames": frames, "places": now}))
        else:
            where = ", ".join(f"{name} {path}" for name, path in now.items())
            print(f"{self.workspace}: {frames} frames, {where}")
        return 0


@dataclass(frozen=True)
class NewCommand:
    """Create a workspace from your own images, KITTI odometry data or a simulated street.

    Examples: 'semviz new town --kitti /data/kitti --frames 0:20'; 'semviz new drive --images left
    --right right --calibration rig.yaml --poses poses.tum'."""

    folder: Positional[Path]
    """Folder to create."""
    images: parsing.OptionalPath = None
    """Folder of your own images (PNG or JPEG), of the left camera or the only one; or a recording:
    a bag (.mcap, .bag, ROS 2 folder), nuScenes, KITTI raw or 360, EuRoC, Argoverse 2, Boreas."""
    right: parsing.OptionalPath = None
    """Folder of the right camera's images, called like the left ones."""
    calibration: parsing.OptionalPath = None
    """Calibration of your cameras: Kalibr, ROS camera_info, EuRoC, OpenCV, ORB-SLAM, VINS-Fusion,
    DSO, or semviz's TOML; a matrix K; a model of COLMAP or nerfstudio; default: that in --poses, if
    it is such a model."""
    right_calibration: parsing.OptionalPath = None
    """Calibration of the right camera, if it has a file of its own."""
    poses: parsing.OptionalPath = None
    """Of your images: TUM, KITTI, EuRoC, KITTI-360, a table with named columns, COLMAP's folder or
    nerfstudio's transforms.json. With --kitti: TUM or KITTI, instead of KITTI's own, for the left
    camera."""
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
    colors: Literal["auto", "rgb", "bgr", "rggb", "bggr", "gbrg", "grbg"] = "auto"
    """Of your images: red first; red and blue swapped, as if OpenCV's pixels were stored; or raw,
    by the first two pixels of two rows. Default: red first, checked against sky and leaves."""
    rate: float = 10.0
    """Images a second, if nothing tells their times."""
    most_view: float = 110.0
    """Largest field of view (deg) of the rectified images, from 10 to 160."""
    refine_extrinsics: bool = False
    """Take where the right camera is from matches in the images; the calibration is the start."""
    rectify: bool = False
    """Make all rectified images now; default: each when it is first needed."""
    strict: bool = False
    """Make nothing if there are warnings."""
    kitti: parsing.OptionalPath = None
    """Root of a KITTI odometry dataset, with sequences/ and poses/."""
    sequence: parsing.OptionalText = None
    """Sequence of the KITTI dataset, default 02; scene or sequence of a recording of several."""
    cameras: parsing.OptionalText = None
    """Left and right camera, or one camera. KITTI's 2,3 is the colour pair (default), 0,1 the grey
    pair; a recording's are its own names, for example topics of a bag, or CAM_FRONT. Three or more
    are a rig; of plain images, the names of folders in --images."""
    rig: bool = False
    """Take two --cameras as a rig, each on its own, and not as a stereo pair."""
    simulate: parsing.OptionalInt = None
    """Seed of a simulated street."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP], END excluded; default: all frames, or 60 of a street."""
    trust_poses: bool = False
    """Accept poses that jump, or that go backwards all the way."""
    check_poses: bool = False
    """Also check the poses against the images, as 'semviz poses check' does: seconds per hundred
    frames."""
    json: parsing.Json = False

    def run(self) -> int:
        with parsing.text_aside(self.json):
            self._make()
        if self.json:
            source = parsing.open_workspace(self.folder).source
            said = {"path": str(self.folder), "frames": len(source.frames)}
            has_right = source.rig.right is not None
            print(json.dumps(said | {"map_frame": source.map_frame.name, "stereo": has_right}))
        return 0

    def _make(self) -> None:
        from semviz.workspace.outputs import check_new_folder

        check_new_folder(self.folder)
        if sum(source is not None for source in (self.images, self.kitti, self.simulate)) != 1:
            raise SemvizError(
                "give --images FOLDER, --kitti ROOT or --simulate SEED: the source of images"
            )
        if self.images is not None:
            self._from_images(self.images)
        else:
            self._from_known()

    def _from_known(self) -> None:
        """Make a workspace of KITTI or a simulated street."""
        from semviz.workspace.workspace import Workspace

        self._refuse_options_of_images()
        frames = parsing.parse_frames(self.frames)
        if self.kitti is not None:
            cameras = parsing.parse_cameras(self.cameras or "2,3")
            workspace = Workspace.create_kitti(
                self.folder,
                self.kitti,
                self.sequence or "02",
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

    def _refuse_options_of_images(self) -> None:
        for name in ("right", "calibration", "right_calibration", "times", "extrinsic", "scale"):
            if getattr(self, name) is not None:
                raise SemvizError(f"--{name.replace('_', '-')} needs --images FOLDER")

    def _from_images(self, images: Path) -> None:
        """Make a workspace of an own drive; what was taken for granted is printed.

        The command that made it, stopped while it rectified images, goes on.
        """
        from semviz.reports.drive_import import (
            print_left_out,
            rectify_all,
            stopped_workspace,
            write_row_picture,
        )
        from semviz.workspace.outputs import check_empty

        command = self._command()
        if self.rectify and (stopped := stopped_workspace(self.folder, command)) is not None:
            rectify_all(stopped)
            print(f"{self.folder}: the rest of the images is rectified")
            return
        check_empty(self.folder)
        parent = self.folder.resolve().parent
        with tempfile.TemporaryDirectory(
            prefix=f".{self.folder.name}-", dir=parent if parent.is_dir() else None
        ) as folder:
            workspace, count = self._read_images(images, Path(folder) / "recorded")
        self._print_summary(workspace, count)
        print_left_out(workspace)
        if workspace.source.rig.right is not None:
            write_row_picture(workspace)
        if self.rectify:
            rectify_all(workspace)
        self._warn_of_poses(workspace)
        print(f"next: semviz annotate {self.folder}   (F9 there shows these checks as pictures)")

    def _read_images(self, images: Path, extracted: Path) -> "tuple[Workspace, int]":
        """Return the new workspace and the number of warnings; a bag's images go through
        ``extracted``."""
        from semviz.presentation.terminal import Steps
        from semviz.reports.drive_import import (
            check_against_images,
            print_topic,
            print_warning,
            write_refined,
        )
        from semviz.workspace.drive.drive_check_file import (
            CHECKS,
            DriveChecks,
            StepErrors,
            save_checks,
        )
        from semviz.workspace.workspace import Workspace
        from semviz_core.datasets.own_drive.recorded_drive import read_drive
        from semviz_core.datasets.validation import unusual_motion

        with Steps() as steps:
            files = self._files(images, extracted, steps.show)
            drive = read_drive(files)
        for topic, text in drive.statements:
            print_topic(topic, text)
        drive, found = check_against_images(
            drive, self.refine_extrinsics, check_colors=self.colors not in ("rgb", "bgr")
        )
        others = list(drive.warnings)
        if where := unusual_motion(drive.first_frames):
            others.append(
                f"the camera moves {where}: right for a camera that looks there, else poses of a "
                "body (--extrinsic) or of another --direction"
            )
        checks = [
            check.model_copy(update={"remedy": self._again_with(check.option)})
            if check.option
            else check
            for check in found.checks
        ]
        failed = [check for check in checks if check.passed is False]
        for text in others:
            print_warning(text)
        for check in failed:
            print_warning(check.warning, check.remedy)
        count = len(others) + len(failed)
        if count and self.strict:
            raise SemvizError(f"--strict: {count} warning{'s' * (count > 1)}; nothing was made")
        workspace = Workspace.create_images(self.folder, drive, self.trust_poses, extracted)
        stored = DriveChecks(
            checks=tuple(checks),
            warnings=tuple(others),
            steps=None if found.motions is None else StepErrors.of(found.motions),
            command=self._command(),
        )
        save_checks(stored, workspace.path / CHECKS)
        if self.refine_extrinsics:
            write_refined(workspace, drive)
        return workspace, count

    def _command(self) -> str:
        """Return this command as text that a file can hold, whatever its names are."""
        return parsing.command_text(self).encode("ascii", "backslashreplace").decode()

    def _again_with(self, option: str) -> str:
        """Return this command with another option, for another folder: this one will exist."""
        name, _, value = option.removeprefix("--").partition(" ")
        again = replace(
            self,
            folder=self.folder.with_name(f"{self.folder.name}-2"),
            **{name.replace("-", "_"): value or True},  # type: ignore[arg-type]
        )
        return f"semviz new {parsing.command_text(again)}"

    def _files(
        self, images: Path, extracted: Path, show: "Callable[[str, int, int], None]"
    ) -> "DriveFiles":
        from semviz_core.datasets.own_drive.recording import DriveFiles

        cameras = tuple(self.cameras.split(",")) if self.cameras else ()
        is_rig = self.rig or len(cameras) > 2
        return DriveFiles(
            images=images,
            right=self.right,
            cameras=() if is_rig else cameras,
            rig=cameras if is_rig else (),
            sequence=self.sequence,
            extracted=extracted,
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
            colors="rgb" if self.colors == "auto" else self.colors,
            most_gap_s=self.most_gap,
            rate_hz=self.rate,
            most_view_deg=self.most_view,
            frames=parsing.parse_frames(self.frames),
            show=show,
        )

    def _print_summary(self, workspace: "Workspace", warnings: int) -> None:
        import numpy as np

        from semviz_core.datasets.rig_cameras import camera_names, frames_of_camera

        source = workspace.source
        frames, cameras = frames_of_camera(source, None), camera_names(source)
        t = [frame.T_map_camera.translation for frame in frames if frame.T_map_camera is not None]
        length_m = float(np.linalg.norm(np.diff(t, axis=0), axis=1).sum()) if len(t) > 1 else 0.0
        length = f"{length_m / 1000.0:.1f} km" if length_m >= 1000.0 else f"{length_m:.1f} m"
        count = len(cameras) or (1 if source.rig.right is None else 2)
        each = " each" if cameras else ""
        print(
            f"{workspace.path}: {len(frames)} frames{each}, {len(t)} with a pose, {length}, "
            f"{count} camera{'s' * (count > 1)}, {warnings} warning{'s' * (warnings != 1)}"
        )

    def _warn_of_poses(self, workspace: "Workspace") -> None:
        """Print a line for each fault of the poses; with images only if asked."""
        from semviz.presentation.terminal import Steps
        from semviz.reports.pose_check import warning_lines
        from semviz.workspace.poses.pose_review import check_poses
        from semviz_core.datasets.rig_cameras import frames_of_camera
        from semviz_core.pose_checks.faults import suspicions

        frames = frames_of_camera(workspace.source, None)
        if self.check_poses:
            with Steps() as steps:
                check = check_poses(workspace, frames, steps.show)
            lines = warning_lines(check, workspace.path)
        else:
            more = f"see: semviz poses check {workspace.path}"
            lines = [f"poses: {suspicion}; {more}" for suspicion in suspicions(frames)]
        for line in lines:
            print(line, file=sys.stderr)
