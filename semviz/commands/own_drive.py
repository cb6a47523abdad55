"""What ``semviz new --images`` checks, prints and writes of a drive.

Calibration and poses are compared with the images. Each line of output is a topic and a finding.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from semviz.presentation.terminal import track
from semviz.workspace.drive_file import LEFT_OUT, DriveFile, calibration_toml
from semviz.workspace.workspace import Workspace
from semviz_core.base.frame import Dataset, Side
from semviz_core.base.pose import angle_between
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.datasets.own_drive import match_checks
from semviz_core.datasets.own_drive.image_folder import ImageFolder
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive

ROW_PICTURE = Path("checks", "rows.png")
REFINED = "calibration-refined.toml"
_TOPIC_WIDTH = 13


def print_topic(topic: str, text: str) -> None:
    """Print what was read or measured."""
    print(f"  {topic:<{_TOPIC_WIDTH}}{text}")


def check_against_images(drive: RecordedDrive, refine: bool) -> tuple[RecordedDrive, list[str]]:
    """Compare calibration and poses with the images, print figures and return warnings.

    With ``refine``, the drive that is returned has the refined pose of the right camera.
    """
    with tempfile.TemporaryDirectory() as cache:
        if refine:
            drive = _refined(drive, Path(cache) / "calibrated")
        dataset = _dataset(drive, Path(cache) / "used")
        warnings = [] if drive.right_folder is None else _row_warnings(dataset)
        return drive, warnings if drive.axes is None else warnings + _pose_warnings(dataset, drive)


def _dataset(drive: RecordedDrive, cache: Path) -> ImageFolder:
    content = DriveFile.of(drive, "drive")
    return content.dataset(drive.left_folder, drive.right_folder, cache)


def _refined(drive: RecordedDrive, cache: Path) -> RecordedDrive:
    if drive.original.T_right_left is None:
        raise SemvizError("--refine-extrinsics needs a right camera: give --right")
    found = match_checks.refine_extrinsics(_dataset(drive, cache), drive)
    said = _refinement_said(found, drive)
    for topic, text in said:
        print_topic(topic, text)
    changed = match_checks.with_extrinsics(drive, found.T_right_left)
    return replace(changed, statements=(*changed.statements, *said))


def _refinement_said(
    found: match_checks.RefinedExtrinsics, drive: RecordedDrive
) -> tuple[tuple[str, str], tuple[str, str]]:
    assert drive.original.T_right_left is not None
    R, before = found.T_right_left.rotation, drive.original.T_right_left.rotation
    turn = ", ".join(
        f"{axis} {angle:+.3f} ({sigma:.3f})"
        for axis, angle, sigma in zip(
            "xyz", np.rad2deg(found.turned_rad), np.rad2deg(found.sigma_rad), strict=True
        )
    )
    turned_deg = np.rad2deg(angle_between(R, before))
    return (
        ("refined", f"right camera turned by {turned_deg:.3f} deg: {turn}"),
        (
            "lines",
            f"{found.matches} matches, off their epipolar line by {found.before_px:.2f} px before, "
            f"{found.after_px:.2f} px now (median)",
        ),
    )


def write_refined(workspace: Workspace, drive: RecordedDrive) -> None:
    """Write the refined calibration as a file that 'semviz new --calibration' reads."""
    path = workspace.path / REFINED
    with replacing(path) as temporary:
        temporary.write_text(calibration_toml(drive.original), encoding="utf-8")
    print_topic("written", str(path))


def write_row_picture(workspace: Workspace) -> None:
    """Write the picture of the middle pair's rows and matches."""
    import cv2

    source = workspace.source
    index = source.frames[len(source.frames) // 2].index
    picture = match_checks.draw_rows(source.image(index, "left"), source.image(index, "right"))
    path = workspace.path / ROW_PICTURE
    path.parent.mkdir(exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes())
    print_topic("picture", f"{path} rows and matches of frame {index}")


def print_left_out(workspace: Workspace) -> None:
    """Print the file that names what was left out, if anything was."""
    path = workspace.path / LEFT_OUT
    if path.is_file():
        print_topic("left out", f"{path} which images, and why")


def rectify_all(workspace: Workspace) -> None:
    """Make all rectified images, with a bar; one that was made before is kept."""
    source = workspace.source
    assert isinstance(source, ImageFolder)
    sides: tuple[Side, ...] = ("left",) if source.rig.right is None else ("left", "right")
    images = [(frame.index, side) for frame in source.frames for side in sides]
    for index, side in track(images, "rectifying", len(images)):
        source.image_path(index, side)


def _row_warnings(dataset: Dataset) -> list[str]:
    """Print how far rows of a stereo pair are apart; return a warning if they are."""
    rows = match_checks.check_rows(dataset)
    if rows.matches < match_checks.LEAST_ROW_MATCHES:
        print_topic("rows", f"not checked: {rows.matches} matches")
        return []
    print_topic("rows", f"{rows.matches} matches, off their row by {rows.apart_px:.2f} px (median)")
    if rows.agrees:
        return []
    return [
        f"rows of both images are {rows.apart_px:.1f} px apart (right {rows.offset_px:+.1f} px "
        "lower): the calibration is not that of these images, or the cameras have moved"
    ]


def _pose_warnings(dataset: Dataset, drive: RecordedDrive) -> list[str]:
    """Print how many matches between images agree with the poses; return a warning if few do."""
    assert drive.axes is not None
    found = match_checks.check_poses(
        dataset, drive.axes.T_map_world, drive.rectified.T_left_rectified
    )
    if not found.is_known:
        print_topic("motion", f"not checked: {found.matches} matches between images apart")
        return []
    print_topic("motion", f"{found.share:.0%} of {found.matches} matches agree with the poses")
    if found.agrees:
        return []
    remedy = f"{found.remedy} fits" if found.remedy else "poses of another drive, or other axes"
    return [f"only {found.share:.0%} of the matches between images agree with the poses: {remedy}"]
