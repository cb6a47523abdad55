"""The checks of an own drive at its import: what was measured on how much, and its limit.

``checks/checks.json`` keeps them; `semviz new` prints them, and `semviz annotate` shows them.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from semviz_core.base.frame import Dataset, Frame
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import MOST_TEXT_BYTES, read_limited, shown
from semviz_core.datasets.own_drive import match_checks
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive
from semviz_core.datasets.rig_cameras import DatasetWithFrames, frames_by_camera

CHECKS = Path("checks", "checks.json")
MOST_GAP_S = 0.5
_MANY_INTERVALS = 5.0
"""A gap is long if it is longer than ``MOST_GAP_S`` and than so many usual intervals."""
CheckKind = Literal["sides", "rows", "poses", "gaps"]


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


class DriveChecks(_Model):
    """The content of the file."""

    version: Literal[1] = 1
    checks: tuple[DriveCheck, ...]
    warnings: tuple[str, ...] = ()
    """Others than those of checks."""


def check_drive_files(dataset: Dataset, drive: RecordedDrive) -> Iterator[DriveCheck]:
    """Compare the calibration and poses of a drive with its images.

    ``dataset`` holds the rectified images of ``drive``.
    """
    if dataset.rig.right is not None:
        yield DriveCheck(
            kind="sides",
            name="left, right not swapped",
            measured="baseline",
            value=f"{dataset.rig.baseline_m:.3f} m",
            limit="over 0 m",
            passed=True,  # others were refused
        )
        yield _rows(dataset)
    if drive.axes is not None:
        for camera, frames in frames_by_camera(dataset).items():
            yield _poses(DatasetWithFrames(dataset, frames), drive, camera)
        for camera, frames in frames_by_camera(dataset).items():
            yield from _gaps(frames, camera)


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


def _poses(dataset: Dataset, drive: RecordedDrive, camera: str) -> DriveCheck:
    assert drive.axes is not None
    found = match_checks.check_poses(
        dataset, drive.axes.T_map_world, drive.rectified.T_left_rectified
    )
    of = f"{shown(camera, 60)}: " if camera else ""
    warning = ""
    if not found.agrees:
        remedy = f"{found.remedy} fits" if found.remedy else "poses of another drive, or other axes"
        warning = (
            f"{of}only {found.share:.0%} of the matches between images agree with the poses: "
            f"{remedy}"
        )
    return DriveCheck(
        kind="poses",
        name="poses against images" + (f", {shown(camera, 60)}" if camera else ""),
        measured=f"{found.matches} matches, that agree",
        value=f"{found.share:.0%}" if found.is_known else "-",
        limit=f"over {match_checks.LEAST_SHARE:.0%}",
        passed=found.agrees if found.is_known else None,
        warning=warning,
        option=found.remedy if found.remedy.startswith("--") else "",
        frame=dataset.frames[len(dataset.frames) // 2].index,
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
    of = f"{shown(camera, 60)}: " if camera else ""
    between = f"frames {posed[row].index} and {posed[row + 1].index}"
    yield DriveCheck(
        kind="gaps",
        name="gaps" + (f", {shown(camera, 60)}" if camera else ""),
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
