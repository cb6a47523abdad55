"""An own drive is checked against its images as it is imported: rows, extrinsics, poses."""

import re
import shlex
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import call
from recorded_streets import LENSES, Recording, kalibr, record
from scipy.spatial.transform import Rotation
from streets import street

from semviz.reports import drive_import
from semviz.workspace.drive.drive_check_file import CHECKS, read_checks
from semviz.workspace.drive.drive_file import DriveFile, ImageFolders
from semviz.workspace.drive.motion_checks import motion_checks
from semviz.workspace.workspace import Workspace
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose, so3_exp, so3_log
from semviz_core.common.arrays import ByteImage
from semviz_core.datasets.kitti import KittiSequence
from semviz_core.datasets.own_drive.cameras.calibration_files import read_calibration
from semviz_core.datasets.own_drive.checks.match_checks import draw_rows
from semviz_core.datasets.own_drive.checks.pose_remedies import PoseAgreement, compare_poses
from semviz_core.datasets.own_drive.poses.conventions import NAMED_EXTRINSICS
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles
from semviz_core.pose_checks.comparison import DrivePoses
from semviz_core.pose_checks.faults import PoseCheck, check_drive
from semviz_core.pose_checks.image_motions import measure_motions
from semviz_core.pose_checks.whole_drive import shifted_in_time
from semviz_core.simulation.street import Street

TURNED = so3_exp(np.deg2rad([0.8, -1.2, 0.6]))
"""The right camera's axes, in those of the street's."""
ON_BGR, OFF_BGR = (230, 90, 40), (30, 40, 220)
Semviz = Callable[..., str]


@pytest.fixture(scope="module")
def source() -> Street:
    return street(3, 6)


@pytest.fixture
def semviz(capsys: pytest.CaptureFixture[str]) -> Semviz:
    def run(*arguments: object) -> str:
        code, out, err = call(capsys, *arguments)
        assert code == 0, err
        return out

    return run


def test_rows_that_disagree_are_measured_and_warned_about(
    tmp_path: Path, source: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    """The right camera is pitched by 0.2 deg since its calibration: 2.1 px at its focal length."""
    pitched = so3_exp(np.deg2rad([0.2, 0.0, 0.0]))
    recording = record(tmp_path, source, LENSES["brown"], range(2), pitched)
    arguments = (
        "new", tmp_path / "town", "--images", recording.left, "--right", recording.right,
        "--poses", recording.poses, "--calibration",
    )  # fmt: skip
    code, out, err = call(capsys, *arguments, recording.kalibr, "--strict")
    assert (code, err) == (0, "")
    apart = re.search(r"off their row, median +(\d\.\d\d) px", out)
    assert apart is not None
    assert float(apart[1]) < 0.3
    shutil.rmtree(tmp_path / "town")
    old = tmp_path / "old.yaml"
    old.write_text(kalibr(LENSES["brown"], source.rig.T_right_left or Pose.identity()))
    code, out, err = call(capsys, *arguments, old, "--strict")
    assert code == 2
    found = re.match(r"warning: rows of both images are (\d\.\d) px apart", err)
    assert found is not None
    assert float(found[1]) == pytest.approx(2.1, abs=0.3)
    remedy = re.search(r"remedy: semviz (new .*-2 .*--refine-extrinsics --strict)\n", err)
    assert remedy is not None
    code, _, err = call(capsys, *shlex.split(remedy[1]))
    assert (code, err) == (0, "")
    checks = read_checks(tmp_path / "town-2" / CHECKS)
    assert checks is not None
    passed = {check.kind: check.passed for check in checks.checks}
    assert (passed["sides"], passed["rows"]) == (True, True)


def test_extrinsics_are_refined_from_images(tmp_path: Path, source: Street, semviz: Semviz) -> None:
    """The right camera is turned by (0.2, 0.1, -0.15) deg since its calibration."""
    turned = np.deg2rad([0.2, 0.1, -0.15])
    recording = record(tmp_path, source, LENSES["brown"], range(6), so3_exp(turned))
    old = tmp_path / "old.yaml"
    truth = source.rig.T_right_left
    assert truth is not None
    old.write_text(kalibr(LENSES["brown"], truth))
    arguments = (
        "--images", recording.left, "--right", recording.right, "--poses", recording.poses,
        "--calibration",
    )  # fmt: skip
    out = semviz("new", tmp_path / "town", *arguments, old, "--refine-extrinsics", "--strict")
    said = re.search(r"by (\d\.\d\d) px before, (\d\.\d\d) px now", out)
    assert said is not None
    assert float(said[1]) > 5.0 * float(said[2])
    refined = read_calibration(tmp_path / "town" / "calibration-refined.toml")
    assert refined.T_right_left is not None
    wrong = refined.T_right_left @ (Pose(so3_exp(turned).T, np.zeros(3)) @ truth).inverse()
    left_deg = np.rad2deg(so3_log(wrong.rotation))
    assert np.abs(left_deg[[0, 2]]).max() < 0.02
    assert abs(left_deg[1]) < 0.1  # what rows tell least
    assert np.linalg.norm(refined.T_right_left.translation) == pytest.approx(0.54, abs=1e-3)
    again = read_drive(
        DriveFiles(
            recording.left,
            right=recording.right,
            poses=recording.poses,
            calibration=tmp_path / "town" / "calibration-refined.toml",
        )
    )
    first = Workspace.open(tmp_path / "town").source
    for one, other in zip(first.frames, again.frames, strict=True):
        assert one.T_map_camera is not None
        assert other.T_map_camera is not None
        np.testing.assert_allclose(
            one.T_map_camera.as_matrix(), other.T_map_camera.as_matrix(), atol=1e-9
        )
    assert re.search(r"off their row, median +0\.", out)


def test_the_import_writes_a_picture_and_all_rectified_images(
    tmp_path: Path, short: Recording, semviz: Semviz
) -> None:
    town = tmp_path / "town"
    semviz(
        "new", town, "--images", short.left, "--right", short.right, "--calibration", short.kalibr,
        "--rectify",
    )  # fmt: skip
    names = [f"{index:06d}.png" for index in range(4)]
    for side in ("left", "right"):
        assert sorted(path.name for path in (town / "rectified" / side).iterdir()) == names
    left = cv2.imread(str(town / "rectified" / "left" / names[2]))
    picture = cv2.imread(str(town / "checks" / "rows.png"))
    assert left is not None
    assert picture is not None
    assert picture.shape == (left.shape[0], 2 * left.shape[1], 3)
    on, off = on_and_off(picture)
    assert on > 5 * off
    right = cv2.imread(str(town / "rectified" / "right" / names[2]))
    assert right is not None
    shifted = draw_rows(left, np.roll(right, 3, axis=0).astype(np.uint8))
    on, off = on_and_off(shifted[:, :, ::-1])
    assert off > 5 * on


def on_and_off(picture: ByteImage) -> tuple[int, ...]:
    """Pixels (BGR) in the colours of matches on their row and off it."""
    return tuple(int((picture == colour).all(axis=2).sum()) for colour in (ON_BGR, OFF_BGR))


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory, source: Street) -> Recording:
    return record(tmp_path_factory.mktemp("short"), source, LENSES["brown"], range(4), TURNED)


@pytest.mark.parametrize("direction", ["auto", "world-to-camera"])
def test_poses_are_compared_with_the_images(
    short: Recording, tmp_path: Path, direction: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = call(
        capsys, "new", tmp_path / "town", "--images", short.left, "--right", short.right,
        "--calibration", short.kalibr, "--poses", short.poses, "--strict",
        "--direction", direction,
    )  # fmt: skip
    share = re.search(r"poses against images +(\d+) matches, that agree +(\d+)%", out)
    assert share is not None
    if direction == "auto":
        assert (code, err) == (0, "")
        assert int(share[2]) > 70
    else:
        remedy = "--direction camera-to-world"
        assert code == 2
        assert int(share[2]) < 50
        assert f"matches between images agree with the poses: {remedy} fits; remedy: " in err
        assert f" {remedy}" in err.partition("remedy: semviz new ")[2]


Compared = Callable[..., PoseAgreement]


@pytest.fixture
def compared(short: Recording, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    """What a drive's images say of its poses, as an import would ask; options replace files.

    The left camera is turned by the rectification.
    """
    cache = tmp_path_factory.getbasetemp() / "short-rectified"

    def run(**options: Any) -> PoseAgreement:
        files = DriveFiles(
            short.left, right=short.right, calibration=short.kalibr, poses=short.poses
        )
        drive = read_drive(replace(files, **options))
        assert drive.axes is not None
        assert drive.taken is not None
        dataset = DriveFile.of(drive, "short").dataset(ImageFolders.of_drive(drive), cache)
        turn = drive.rectified.T_left_rectified
        return compare_poses(dataset, drive.axes.T_map_world, turn, drive.taken)

    return run


@pytest.mark.parametrize(
    ("option", "value", "remedy"),
    [
        ("axes", "opengl", "--camera-axes opencv"),
        ("quaternion", "wxyz", "--quaternion xyzw"),
        ("extrinsic", "flu", "--extrinsic camera"),
    ],
)
def test_the_convention_that_fits_is_found(
    compared: Compared, option: str, value: str, remedy: str
) -> None:
    found = compared(**{option: value})
    assert found.share < 0.5
    assert found.remedies == (remedy,)


def test_an_inverted_extrinsic_is_named(
    short: Recording, tmp_path: Path, compared: Compared
) -> None:
    """Of poses of a camera 1.5 m ahead of its body, and turned in it."""
    T_body_camera = NAMED_EXTRINSICS["flu"] @ Pose(so3_exp(np.array([0.0, 0.7, 0.2])), [0, 0, 1.5])
    rows = np.loadtxt(short.poses)
    for row in rows:
        pose = Pose(Rotation.from_quat(row[4:]).as_matrix(), row[1:4]) @ T_body_camera.inverse()
        row[1:] = [*pose.translation, *pose.as_quaternion()]
    np.savetxt(tmp_path / "poses.txt", rows, "%.9f")
    np.savetxt(tmp_path / "extrinsic.txt", T_body_camera.inverse().as_matrix())
    found = compared(poses=tmp_path / "poses.txt", extrinsic=str(tmp_path / "extrinsic.txt"))
    assert found.remedies == ("the inverse of the pose in --extrinsic",)


def test_transposed_rotations_are_named(
    short: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    conjugate = np.array([1, 1, 1, 1, -1, -1, -1, 1])
    np.savetxt(tmp_path / "poses.txt", np.loadtxt(short.poses) * conjugate, "%.9f")
    code, _, err = call(
        capsys, "new", tmp_path / "town", "--images", short.left, "--right", short.right,
        "--calibration", short.kalibr, "--poses", tmp_path / "poses.txt", "--strict",
    )  # fmt: skip
    assert code == 2
    assert "agree with the poses: a transpose of the rotations fits\n" in err


@pytest.fixture(scope="module")
def measured(kitti_root: Path) -> PoseCheck:
    """Twenty real stereo frames, with the motions of their images."""
    source = KittiSequence(kitti_root, "02", (2, 3), range(20))
    return check_drive(source.frames, measure_motions(source, source.frames), source.rig)


@pytest.fixture(scope="module")
def rig(kitti_root: Path) -> Rig:
    return KittiSequence(kitti_root, "02", (2, 3), range(1)).rig


def moved(check: PoseCheck, change: Callable[[Pose], Pose]) -> tuple[Frame, ...]:
    return tuple(
        replace(frame, T_map_camera=change(frame.T_map_camera))
        for frame in check.frames
        if frame.T_map_camera is not None
    )


def late(check: PoseCheck, frames: float) -> tuple[Frame, ...]:
    poses = shifted_in_time(DrivePoses.of(check.frames), -frames)
    places = zip(check.frames, poses.rotation, poses.center_m, poses.known, strict=True)
    return tuple(replace(frame, T_map_camera=Pose(R, c) if known else None)
                 for frame, R, c, known in places)  # fmt: skip


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("planted", "kind", "value"),
    [
        (lambda check: check.frames, "", ""),
        (lambda check: moved(check, lambda T: Pose(T.rotation, 1.04 * T.translation)), "scale", ""),
        (lambda check: late(check, 1.0), "time", r"\+(9|10|11)\d ms"),
        (
            lambda check: moved(
                check, lambda T: T @ Pose(so3_exp(np.deg2rad([0, 1.5, 0])), [0] * 3)
            ),
            "mount",
            r"1\.[3-7]\d deg",
        ),
    ],
)
def test_motions_of_real_images_tell_scale_time_and_a_turned_camera(
    measured: PoseCheck,
    rig: Rig,
    planted: Callable[..., tuple[Frame, ...]],
    kind: str,
    value: str,
) -> None:
    """KITTI's right camera is known to be turned by 0.03 deg against its calibration."""
    found = check_drive(planted(measured), measured.motions, rig)
    checks = {str(check.kind): check for check in motion_checks(found, rig, "")}
    wrong = {name for name, check in checks.items() if check.passed is False}
    assert wrong == {"extrinsics", kind} - {""}
    assert checks["extrinsics"].value.startswith("0.02")
    if kind:
        assert checks[kind].warning
        assert re.match(value, checks[kind].value)


@pytest.mark.realdata
@pytest.mark.parametrize(("unit", "option"), [(100.0, "--scale 0.01"), (0.3048, "--scale 3.4")])
def test_poses_in_another_unit_are_told_their_scale(
    measured: PoseCheck, rig: Rig, unit: float, option: str
) -> None:
    frames = moved(measured, lambda T: Pose(T.rotation, unit * T.translation))
    found = check_drive(frames, measured.motions, rig)
    (check,) = motion_checks(found, rig, "")
    assert (check.kind, check.passed) == ("scale", False)
    assert check.option.startswith(option)


@pytest.mark.realdata
def test_poses_that_stand_still_are_told_nothing_else(measured: PoseCheck, rig: Rig) -> None:
    frames = moved(measured, lambda _: Pose.identity())
    (check,) = motion_checks(check_drive(frames, measured.motions, rig), rig, "")
    assert (check.kind, check.passed) == ("steps", False)
    assert "stands still while the images move" in check.warning


def test_a_stopped_import_goes_on_by_the_same_command(
    short: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Stopped while it checks, it leaves nothing; stopped at the third rectified image, those."""
    words = (
        "new", tmp_path / "town", "--images", short.left, "--right", short.right, "--calibration",
        short.kalibr, "--rectify",
    )  # fmt: skip

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as stopping:
        stopping.setattr(drive_import, "check_drive_files", stop)
        assert call(capsys, *words)[0] == 130
        assert not list(tmp_path.iterdir())

    def three(items: Iterable[object], *_: object) -> Iterator[object]:
        yield from islice(items, 3)
        raise KeyboardInterrupt

    with monkeypatch.context() as stopping:
        stopping.setattr(drive_import, "track", three)
        code, _, err = call(capsys, *words)
        assert code == 130
    assert re.search(r"[1-7] of 8 images are rectified; the same command goes on", err)
    code, out, _ = call(capsys, *words)
    assert (code, out) == (0, f"{tmp_path / 'town'}: the rest of the images is rectified\n")
    assert len(list((tmp_path / "town" / "rectified").glob("*/*.png"))) == 8
    code, _, err = call(capsys, *words)
    assert code == 2
    assert "exists and is not empty" in err
