"""Plant faults in real drives, and print what `semviz new` would say of them.

    python bench/import_checks.py DRIVES KITTI

DRIVES holds utbm_stereo, euroc_micro, kitti360_nerf and nuscenes_frame, KITTI odometry sequence
02; they are not part of the project. *left* is the radial distortion that is left in the images
(k of k r^2), found with one standard deviation; a fault is named beyond four of them and 0.03.
Pairs with a lens are rectified as the import does, with the distortion of their calibration times a
factor. The second table swaps red and blue. The third plants faults in the poses of KITTI's frames,
whose images' motions are measured once. The fourth plants wrong conventions: how many matches
agree, and what is named instead.
"""

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from semviz.workspace.drive.drive_file import DriveFile, ImageFolders
from semviz.workspace.drive.motion_checks import motion_checks
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Dataset, Frame, Side
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.datasets.kitti import KittiSequence
from semviz_core.datasets.own_drive.cameras.calibration_files import read_calibration
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera, OriginalRig
from semviz_core.datasets.own_drive.checks.color_checks import check_colors
from semviz_core.datasets.own_drive.checks.line_checks import check_lines
from semviz_core.datasets.own_drive.checks.pose_remedies import compare_poses
from semviz_core.datasets.own_drive.images.rectification import rectify_rig
from semviz_core.datasets.own_drive.poses.conventions import NAMED_EXTRINSICS, PoseConventions
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive, read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles
from semviz_core.datasets.rig_cameras import DatasetWithFrames
from semviz_core.pose_checks.comparison import DrivePoses
from semviz_core.pose_checks.faults import check_drive
from semviz_core.pose_checks.image_motions import measure_motions
from semviz_core.pose_checks.whole_drive import shifted_in_time

Change = Callable[[ByteImage], ByteImage]


@dataclass(frozen=True)
class Images:
    """A dataset of one camera's images, each changed as it is read."""

    rig: Rig
    paths: Sequence[Path]
    change: Change

    @property
    def map_frame(self) -> MapFrame:
        return MapFrame("bench")

    @property
    def frames(self) -> tuple[Frame, ...]:
        return tuple(Frame(index, float(index), None) for index in range(len(self.paths)))

    def image(self, index: int, side: Side) -> ByteImage:
        image: Any = cv2.imread(str(self.paths[index]))
        return np.ascontiguousarray(self.change(image[:, :, ::-1]))


def undistorted(K: FloatArray, terms: FloatArray, times: int = 1) -> Change:
    def change(image: ByteImage) -> ByteImage:
        found: Any = image
        for _ in range(times):
            found = cv2.undistort(found, K, terms)  # type: ignore[arg-type]
        return np.asarray(found, dtype=np.uint8)

    return change


def swapped(image: ByteImage) -> ByteImage:
    return image[:, :, ::-1]


def unchanged(image: ByteImage) -> ByteImage:
    return image


LENSES = ("UTBM", "EuRoC")
FACTORS = (1.0, 0.0, 0.5, 0.75, 1.25)


def pair_with_lens(name: str, root: Path) -> RecordedDrive:
    if name == "EuRoC":
        return read_drive(DriveFiles(root / "euroc_micro"))
    utbm = root / "utbm_stereo"
    left, right = utbm / "bb2_left", utbm / "bb2_right"
    return read_drive(DriveFiles(left, right=right, poses=utbm / "sparse", scale=1.0))


def rectified(drive: RecordedDrive, factor: float, cache: Path) -> Dataset:
    """Return the drive's images, rectified with so many times the distortion of its calibration."""

    def wrong(camera: OriginalCamera) -> OriginalCamera:
        return replace(camera, distortion=factor * camera.distortion)

    original, most_deg = drive.original, drive.most_view_deg
    assert original.right is not None
    wrong_rig = OriginalRig(wrong(original.left), wrong(original.right), original.T_right_left)
    drive = replace(drive, original=wrong_rig, rectified=rectify_rig(wrong_rig, most_deg))
    return DriveFile.of(drive, "bench").dataset(ImageFolders.of_drive(drive), cache)


def drives(root: Path, kitti: Path) -> dict[str, tuple[list[Path], FloatArray]]:
    """Return images and K of each drive."""
    found = {}
    for name, file, images in (
        ("UTBM", "utbm_stereo/bb2_left.yaml", "utbm_stereo/bb2_left/*"),
        ("EuRoC", "euroc_micro/mav0/cam0/sensor.yaml", "euroc_micro/mav0/cam?/data/*.png"),
    ):
        found[name] = sorted(root.glob(images)), read_calibration(root / file).cameras[0].K
    for name, paths, focal, u, v in (
        ("KITTI-360", sorted(root.glob("kitti360_nerf/*.png")), 552.55, 682.05, 238.77),
        ("nuScenes", sorted(root.glob("nuscenes_frame/samples/CAM_*T/*")), 1260.0, 800.0, 450.0),
        ("KITTI 02", sorted(kitti.glob("sequences/02/image_2/*"))[::2], 718.86, 607.19, 185.2),
    ):
        K = np.array([[focal, 0.0, u], [0.0, focal, v], [0.0, 0.0, 1.0]])
        found[name] = paths, K
    return found


def planted(frames: Sequence[Frame]) -> dict[str, tuple[Frame, ...]]:
    """Return frames with faults in their poses."""

    def moved(change: Callable[[Pose], Pose]) -> tuple[Frame, ...]:
        return tuple(
            frame
            if frame.T_map_camera is None
            else replace(frame, T_map_camera=change(frame.T_map_camera))
            for frame in frames
        )

    def late(share: float) -> tuple[Frame, ...]:
        poses = shifted_in_time(DrivePoses.of(frames), -share)
        rows = zip(frames, poses.rotation, poses.center_m, poses.known, strict=True)
        return tuple(
            replace(frame, T_map_camera=Pose(R, c) if known else None)
            for frame, R, c, known in rows
        )

    def turned(degrees: Sequence[float]) -> tuple[Frame, ...]:
        turn = Pose(so3_exp(np.deg2rad(degrees)), np.zeros(3))
        return moved(lambda T: T @ turn)

    return {
        "none": tuple(frames),
        "scale 1.04": moved(lambda T: Pose(T.rotation, 1.04 * T.translation)),
        "40 ms late": late(0.4),
        "100 ms late": late(1.0),
        "100 ms early": late(-1.0),
        "camera turned by 1 deg right": turned([0.0, 1.0, 0.0]),
        "camera turned by 1 deg up": turned([1.0, 0.0, 0.0]),
    }


def print_motions(kitti: Path) -> None:
    source = KittiSequence(kitti, "02", (2, 3), range(20))
    motions = measure_motions(source, source.frames)
    kinds = ("mount", "extrinsics", "scale", "time", "steps")
    print(f"\n| planted | {' | '.join(kinds)} |")
    print("|---" + "|--:" * len(kinds) + "|")
    for name, frames in planted(source.frames).items():
        found = check_drive(frames, motions, source.rig)
        checks = {one.kind: one for one in motion_checks(found, source.rig, "")}
        texts = [
            "" if kind not in checks else checks[kind].value + " !" * (checks[kind].passed is False)
            for kind in kinds
        ]
        print(f"| {name} | {' | '.join(texts)} |")


EXTRINSIC = NAMED_EXTRINSICS["flu"] @ Pose(so3_exp(np.array([0.0, 0.1, 0.0])), np.array([0, 0, 1]))
"""T_body_camera of a camera ahead of its body, and turned in it."""
C2W = PoseConventions("camera-to-world", "opencv")


def with_numbers_in_order(T: Pose) -> Pose:
    """Return a pose whose quaternion, w first, was read with w last."""
    numbers = np.roll(T.as_quaternion(), 1)
    return Pose(Rotation.from_quat(numbers).as_matrix(), T.translation)


def mirrored(T: Pose) -> Pose:
    """Return a pose in a world whose y axis points the other way."""
    flip = np.diag([1.0, -1.0, 1.0])
    return Pose(flip @ T.rotation @ flip, flip @ T.translation)


def conventions() -> dict[str, tuple[Callable[[Pose], Pose], PoseConventions]]:
    """Return how poses of a camera are written, and what they are taken as."""
    quaternions = replace(C2W, quaternion="xyzw")
    body = replace(C2W, T_body_camera=EXTRINSIC)
    inverse = replace(C2W, T_body_camera=EXTRINSIC.inverse())
    return {
        "none": (lambda T: T, quaternions),
        "world to camera": (replace(C2W, direction="world-to-camera").recorded_pose, quaternions),
        "OpenGL's axes": (replace(C2W, axes="opengl").recorded_pose, quaternions),
        "w first": (with_numbers_in_order, quaternions),
        "of a body, no extrinsic": (body.recorded_pose, quaternions),
        "extrinsic inverted": (body.recorded_pose, replace(inverse, quaternion="xyzw")),
        "rotations transposed": (lambda T: Pose(T.rotation.T, T.translation), C2W),
        "mirrored world": (mirrored, C2W),
    }


def print_conventions(kitti: Path) -> None:
    source = KittiSequence(kitti, "02", (2, 3), range(20))
    print("\n| written | agree | named |")
    print("|---|--:|---|")
    for name, (write, taken) in conventions().items():
        frames = tuple(
            replace(frame, T_map_camera=taken.camera_pose(write(frame.T_map_camera)))
            for frame in source.frames
            if frame.T_map_camera is not None
        )
        found = compare_poses(
            DatasetWithFrames(source, frames), Pose.identity(), Pose.identity(), taken
        )
        print(f"| {name} | {found.share:.0%} | {' or '.join(found.remedies)} |", flush=True)


def print_lines(root: Path, kitti: Path) -> None:
    print("| drive | images | distortion | edges | left, k | named |")
    print("|---|--:|---|--:|--:|---|")
    for name in LENSES:
        drive = pair_with_lens(name, root)
        for factor in FACTORS:
            with tempfile.TemporaryDirectory() as cache:
                images = rectified(drive, factor, Path(cache))
                print_line_row(name, 2 * len(images.frames), f"{factor:g} of its own", images)
    for name, (paths, K) in drives(root, kitti).items():
        rig = camera_of(paths, K)
        terms = np.array([-0.3, 0.0, 0.0, 0.0])
        if name not in LENSES:
            print_line_row(name, len(paths), "none, its own", Images(rig, paths, unchanged))
            print_line_row(name, len(paths), "-0.3", Images(rig, paths, undistorted(K, terms)))


def camera_of(paths: Sequence[Path], K: FloatArray) -> Rig:
    height, width = np.asarray(cv2.imread(str(paths[0]))).shape[:2]
    return Rig(Camera(width, height, K))


def print_line_row(name: str, count: int, case: str, images: Dataset) -> None:
    found = check_lines(images)
    k = f"{found.k:+.3f} ({found.sigma:.3f})" if found.is_known else "too few"
    named = "no" if found.is_straight else "yes"
    print(f"| {name} | {count} | {case} | {found.edges} | {k} | {named} |", flush=True)


def print_colors(root: Path, kitti: Path) -> None:
    print("\n| drive | images | sky | leaves | as recorded | red and blue swapped |")
    print("|---|--:|--:|--:|---|---|")
    words = {None: "cannot be told", False: "right", True: "named"}
    for name, (paths, K) in drives(root, kitti).items():
        rig = camera_of(paths, K)
        found, other = (check_colors(Images(rig, paths, change)) for change in (unchanged, swapped))
        print(
            f"| {name} | {found.images} | {found.sky:+.0f} | {found.leaves:+.0f} "
            f"| {words[found.is_swapped]} | {words[other.is_swapped]} |"
        )


def main() -> None:
    root, kitti = map(Path, sys.argv[1:3])
    print_lines(root, kitti)
    print_colors(root, kitti)
    print_motions(kitti)
    print_conventions(kitti)


if __name__ == "__main__":
    main()
