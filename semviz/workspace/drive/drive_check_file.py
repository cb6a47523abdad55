"""The checks of an own drive as ``checks/checks.json`` keeps them, for people to read."""

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import MOST_TEXT_BYTES, read_limited, shown
from semviz_core.pose_checks.comparison import LIMIT
from semviz_core.pose_checks.faults import PoseCheck

CHECKS = Path("checks", "checks.json")
CheckKind = Literal[
    "mosaic",
    "colors",
    "sides",
    "lines",
    "rows",
    "poses",
    "mount",
    "extrinsics",
    "scale",
    "time",
    "steps",
    "gaps",
]


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


class StepErrors(_Model):
    """How far the steps of n poses are from those of the images."""

    frames: tuple[int, ...]
    """(n,) at which the steps end."""
    turn_deg: tuple[float, ...]
    shift_m: tuple[float, ...]
    wrong: tuple[bool, ...]
    """Whether the images contradict a step."""
    usual: tuple[float, float]
    """One standard deviation of good steps: deg and m."""

    @classmethod
    def of(cls, check: PoseCheck) -> "StepErrors":
        compared = check.comparison.compared
        rows, sigma = np.flatnonzero(compared), check.comparison.pose_sigma
        innovation = check.comparison.innovation[rows]
        turn_deg = np.rad2deg(np.linalg.norm(innovation[:, 3:], axis=1))
        return cls(
            frames=tuple(check.frames[row + 1].index for row in rows.tolist()),
            turn_deg=tuple(turn_deg.round(4).tolist()),
            shift_m=tuple(np.linalg.norm(innovation[:, :3], axis=1).round(4).tolist()),
            wrong=tuple((check.comparison.chi2[rows] > LIMIT).tolist()),
            usual=(float(np.rad2deg(sigma[3:].max())), float(sigma[:3].max())),
        )


class DriveChecks(_Model):
    """The content of the file."""

    version: Literal[1] = 1
    checks: tuple[DriveCheck, ...]
    warnings: tuple[str, ...] = ()
    """Others than those of checks."""
    steps: StepErrors | None = None
    """Of the first camera, where they were measured."""
    command: str = ""
    """That made the workspace: given once more, it goes on where it was stopped."""


def words_of(camera: str) -> tuple[str, str]:
    """Return what names a camera of a rig behind the name of a check, and before a warning."""
    return (f", {shown(camera, 60)}", f"{shown(camera, 60)}: ") if camera else ("", "")


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
