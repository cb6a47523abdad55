"""Types and parsers of options: workspaces, frame ranges, cameras, intervals, anchors."""

import shlex
import sys
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.workspace.workspace import Workspace
    from semviz_annotation.map_formats.georeference import Georeference
    from semviz_core.base.detector_model import DetectorCalibration

OptionalPath = Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="")]
OptionalText = Annotated[str | None, arg(metavar="TEXT", help_behavior_hint="")]
OptionalInt = Annotated[int | None, arg(metavar="INT", help_behavior_hint="")]
OptionalFloat = Annotated[float | None, arg(metavar="FLOAT", help_behavior_hint="")]

Force = Annotated[
    bool, arg(help="Replace an existing file that this command did not write before.")
]

Calibration = Annotated[
    str | None,
    arg(
        metavar="TEXT",
        help_behavior_hint="",
        help="File of 'semviz detect choose': what the detections' scores and sigmas mean, and "
        "their rates; 'none': take them as they are. Default: the file beside the model, or in the "
        "workspace.",
    ),
]

ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB")
}
"""Environment of benchmarks, which time one core. Set it before numpy is imported; processes
inherit it."""


def open_workspace(path: Path) -> "Workspace":
    """Return the workspace in a folder. Raise SemvizError if there is none."""
    from semviz.workspace.workspace import Workspace

    return Workspace.open(path)


def read_calibration(workspace: "Workspace", given: str | None) -> "DetectorCalibration | None":
    """Return the calibration of the workspace's detections, by option ``Calibration``, and say
    which it is."""
    from semviz.workspace.detect import find_calibration

    found = find_calibration(workspace, given)
    if found is None:
        return None
    path, calibration = found
    print(f"{path}: scores and rates as on {calibration.truth}", file=sys.stderr)
    return calibration


def parse_frames(text: str | None) -> range | None:
    """Return the frame numbers of ``0:20`` or ``0:20:2`` (end excluded); None means all."""
    if text is None:
        return None
    try:
        numbers = [int(part) for part in text.split(":")]
        first, end, step = (*numbers, 1)[:3] if len(numbers) in (2, 3) else (0, 0, 0)
        frames = range(first, end, step)
    except ValueError:
        frames = range(0)
    if not frames:
        raise SemvizError(f"--frames {text}: write FIRST:END or FIRST:END:STEP, for example 0:20:2")
    return frames


def parse_cameras(text: str) -> tuple[int, ...]:
    """Return the cameras of ``2,3`` (left, right) or ``2``."""
    try:
        cameras = tuple(int(part) for part in text.split(","))
    except ValueError:
        cameras = ()
    if len(cameras) not in (1, 2):
        raise SemvizError(f"--cameras {text}: write LEFT,RIGHT, for example 2,3, or one camera")
    return cameras


def parse_interval(text: str, option: str) -> tuple[float, float]:
    """Return both limits (m) of ``5:10``; the first must not exceed the second."""
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        low, high = 1.0, 0.0
    if not 0.0 <= low <= high:
        raise SemvizError(f"{option} {text}: write LOW:HIGH in metres, for example 5:10")
    return low, high


def parse_pair(text: str, option: str, example: str, second: float) -> tuple[float, float]:
    """Return both numbers of ``5.5:0.3``; the other is ``second`` if there is only one."""
    try:
        numbers = [float(part) for part in text.split(":")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 2) or not all(0.0 < number < 1e6 for number in numbers):
        raise SemvizError(f"{option} {text}: write numbers above 0, for example {example}")
    return numbers[0], (*numbers, second)[1]


def parse_anchor(text: str | None, x_heading_deg: float | None) -> "Georeference | None":
    """Return the georeference of ``49.0,8.4,115``: WGS84 latitude, longitude, optional height (m).

    ``x_heading_deg`` is the compass direction of the map's x axis there; None means east.
    """
    from semviz_annotation.map_formats.georeference import Georeference

    if text is None:
        if x_heading_deg is not None:
            raise SemvizError("--anchor-heading needs --anchor LATITUDE,LONGITUDE[,HEIGHT]")
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise SemvizError(
            f"--anchor {text}: write LATITUDE,LONGITUDE[,HEIGHT], for example 49.0,8.4"
        )
    latitude, longitude, height = (*numbers, 0.0)[:3]
    heading = 90.0 if x_heading_deg is None else x_heading_deg
    return Georeference(latitude, longitude, height, heading)


def command_text(command: object) -> str:
    """Return the arguments that make a command, as a shell takes them; defaults are left out."""
    assert is_dataclass(command)
    words = []
    for field in fields(command):
        value = getattr(command, field.name)
        if field.default is MISSING:
            words.append(str(value))  # a positional argument
        elif value is True:
            words.append(f"--{field.name.replace('_', '-')}")
        elif value != field.default:
            words += [f"--{field.name.replace('_', '-')}", str(value)]
    return shlex.join(words)
