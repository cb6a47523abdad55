"""What ``semviz new --images`` checks, prints and writes of a drive.

Calibration and poses are compared with the images. Each line of output is a topic and a finding.
"""

import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TextIO

import numpy as np

from semviz.presentation.terminal import track
from semviz.workspace.drive.drive_check_file import CHECKS, DriveCheck, read_checks
from semviz.workspace.drive.drive_checks import DriveFindings, check_drive_files, right_turn_rad
from semviz.workspace.drive.drive_file import LEFT_OUT, DriveFile, ImageFolders, calibration_toml
from semviz.workspace.workspace import Workspace
from semviz_core.base.frame import Side
from semviz_core.base.pose import angle_between
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.datasets.own_drive.checks import match_checks
from semviz_core.datasets.own_drive.images.image_folder import ImageFolder
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive

ROW_PICTURE = Path("checks", "rows.png")
REFINED = "calibration-refined.toml"
_TOPIC_WIDTH = 13
_YELLOW, _BLUE, _DIM = "33", "34", "2"


def print_topic(topic: str, text: str) -> None:
    """Print what was read or measured."""
    print(f"  {topic:<{_TOPIC_WIDTH}}{text}")


def check_against_images(
    drive: RecordedDrive, refine: bool, check_colors: bool
) -> tuple[RecordedDrive, DriveFindings]:
    """Compare calibration, poses and, with ``check_colors``, colours with the images, and print
    the checks.

    With ``refine``, the drive that is returned has the refined pose of the right camera.
    """
    with tempfile.TemporaryDirectory() as cache:
        if refine:
            drive = _refined(drive, Path(cache) / "calibrated")
        found = check_drive_files(_dataset(drive, Path(cache) / "used"), drive, check_colors)
    _print_checks(found.checks)
    return drive, found


def _print_checks(checks: Sequence[DriveCheck]) -> None:
    """Print a line for each check, in colour on a terminal."""
    signs = ("\u25cf", "\u25c6", "\u25cb")
    if not _can_print("".join(signs), sys.stdout):
        signs = ("+", "!", "-")
    named, measured, valued, limited = (
        max(len(getattr(check, field)) for check in checks)
        for field in ("name", "measured", "value", "limit")
    )
    width = named + measured + 6
    print(f"  {'checks':<{width}}{'is':>{valued}}  {'limit':>{limited}}")
    for check in checks:
        sign = signs[2 if check.passed is None else 0 if check.passed else 1]
        color = _YELLOW if check.passed is False else _BLUE
        print(
            f"  {_colored(sign, color, sys.stdout)} {check.name:<{named}}  "
            f"{check.measured:<{measured}}  {check.value:>{valued}}  {check.limit:>{limited}}"
        )


def print_warning(text: str, remedy: str = "") -> None:
    """Print a warning, and the command that repairs it: one line, or two on a terminal."""
    if not sys.stderr.isatty():
        more = f"; remedy: {remedy}" if remedy else ""
        print(f"warning: {text}{more}", file=sys.stderr)
        return
    sign = "\u25c6" if _can_print("\u25c6", sys.stderr) else "warning:"
    print(f"{_colored(sign, _YELLOW, sys.stderr)} {text}", file=sys.stderr)
    if remedy:
        print(f"  {_colored('remedy:', _DIM, sys.stderr)}  {remedy}", file=sys.stderr)


def _colored(text: str, color: str, stream: TextIO) -> str:
    shows = stream.isatty() and "NO_COLOR" not in os.environ
    return f"\x1b[{color}m{text}\x1b[0m" if shows else text


def _can_print(text: str, stream: TextIO) -> bool:
    try:
        text.encode(stream.encoding or "ascii")
    except UnicodeEncodeError:
        return False
    return True


def _dataset(drive: RecordedDrive, cache: Path) -> ImageFolder:
    content = DriveFile.of(drive, "drive")
    return content.dataset(ImageFolders.of_drive(drive), cache)


def _refined(drive: RecordedDrive, cache: Path) -> RecordedDrive:
    """Return the drive with the right camera as matches put it, and then the poses."""
    if drive.original.T_right_left is None:
        raise SemvizError("--refine-extrinsics needs a right camera: give --right")
    found = match_checks.refine_extrinsics(_dataset(drive, cache / "given"), drive)
    said = list(_refinement_said(found, drive))
    drive = match_checks.with_extrinsics(drive, found.T_right_left)
    turn_rad = right_turn_rad(_dataset(drive, cache / "matched"))
    if turn_rad is not None:
        drive = match_checks.with_extrinsics(drive, match_checks.turned_right(drive, turn_rad))
        said.append(("by the poses", f"turned by y {np.rad2deg(turn_rad):+.3f} deg more"))
    for topic, text in said:
        print_topic(topic, text)
    return replace(drive, statements=(*drive.statements, *said))


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
    try:
        left, right = source.image(index, "left"), source.image(index, "right")
    except SemvizError as error:
        print_warning(f"no picture of rows: {error}")
        return
    picture = match_checks.draw_rows(left, right)
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
    images = _images_of(source)
    try:
        for index, side in track(images, "rectifying", len(images)):
            source.image_path(index, side)
    except KeyboardInterrupt:
        made = sum(source.is_rectified(*image) for image in images)
        print(
            f"{made} of {len(images)} images are rectified; the same command goes on",
            file=sys.stderr,
        )
        raise


def stopped_workspace(path: Path, command: str) -> Workspace | None:
    """Return the workspace that this command made at ``path`` without all rectified images."""
    found = read_checks(path / CHECKS)
    if found is None or found.command != command:
        return None
    workspace = Workspace.open(path)
    source = workspace.source
    assert isinstance(source, ImageFolder)
    made = all(source.is_rectified(index, side) for index, side in _images_of(source))
    return None if made else workspace


def _images_of(source: ImageFolder) -> list[tuple[int, Side]]:
    sides = source.rig.sides
    return [(frame.index, side) for frame in source.frames for side in sides]
