"""Types and parsers of options: workspaces, frame ranges, cameras, intervals, anchors, priors."""

import math
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.workspace.localization.measurements import MeasurementFiles
    from semviz.workspace.workspace import Workspace
    from semviz_annotation.map_formats.georeference import Georeference
    from semviz_core.base.detector_model import DetectorCalibration

Json = Annotated[bool, arg(help="Print one JSON object; lines for people go to standard error.")]
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


def path_of_new_map(workspace: "Workspace", name: str, *, replace: bool) -> Path:
    """Return the file of a map to write. Raise SemvizError if it exists and is not to be replaced,
    or cannot be written."""
    from semviz.workspace.outputs import PARQUET, check_outputs

    path = workspace.map_path(name)
    if path.exists() and not replace:
        raise SemvizError(f"{path}: exists already; choose another name or use --replace")
    check_outputs(path, PARQUET, can_force=False, purpose="map")
    return path


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


@dataclass(frozen=True)
class MeasurementOptions:
    """Priors and odometry from files instead of simulated ones; see docs/priors.md."""

    priors: OptionalPath = None
    """Fixes, headings and gravity: a table with named columns (CSV), or poses (TUM, KITTI and all
    other formats of 'semviz new --poses'). Default: simulated."""
    odometry: OptionalPath = None
    """For --track: a trajectory in any world (CSV, TUM, ...), or speeds and yaw rates (CSV).
    Default: simulated; with --priors: none."""
    fix_sigma: str = "5.5:0.3"
    """HORIZONTAL[:VERTICAL] standard deviation (m) of fixes without a column of it."""
    gravity_sigma_deg: float = 0.5
    """Standard deviation of a measured vertical without a column of it."""
    odometry_noise: str = "1:0.1"
    """PERCENT:DEG standard deviations of odometry without columns of them: share of the way, and
    rotation per step between frames."""
    most_age: float = 1.0
    """A fix older than this (s) is not used."""
    most_gap: float = 0.25
    """A motion between lines of --odometry farther apart (s) is unknown."""
    coordinates: Literal["recorded", "map"] = "recorded"
    """recorded: files are in the coordinates of the poses that the workspace was made with (for
    KITTI and simulated streets the map's); map: in those of the map."""
    extrinsic: OptionalText = None
    """T_body_camera if the files hold poses of a body: camera, flu (x ahead, y left), frd, or a
    file with a 3x4 or 4x4 matrix. Default: camera; for headings and GNSS: flu."""
    anchor: OptionalText = None
    """LATITUDE,LONGITUDE[,HEIGHT] of the map's origin, for GNSS; default: the map's own."""
    anchor_heading: OptionalFloat = None
    """Compass direction of the map's x axis at the anchor, in degrees; default: 90 (east)."""

    def files(self, heading_sigma_deg: float | None) -> "MeasurementFiles":
        """Return the files with what these options say of them."""
        from semviz.workspace.localization.measurements import MeasurementFiles
        from semviz_core.base.frame import OdometryNoise
        from semviz_core.datasets.measured_priors import PriorSigmas

        horizontal, vertical = parse_pair(self.fix_sigma, "--fix-sigma", "5.5:0.3", 0.3)
        percent, rotation_deg = parse_pair(self.odometry_noise, "--odometry-noise", "1:0.1", 0.1)
        heading_deg = 5.0 if heading_sigma_deg is None else heading_sigma_deg
        sigmas = PriorSigmas(
            horizontal,
            vertical,
            math.radians(heading_deg),
            math.radians(self.gravity_sigma_deg),
            self.most_age,
        )
        return MeasurementFiles(
            self.priors,
            self.odometry,
            sigmas,
            OdometryNoise(percent / 100.0, math.radians(rotation_deg)),
            self.most_gap,
            self.coordinates,
            self.extrinsic,
            parse_anchor(self.anchor, self.anchor_heading),
        )

    def check_used(self) -> None:
        """Raise SemvizError if a file does not exist, before any work."""
        for option, path in (("--priors", self.priors), ("--odometry", self.odometry)):
            if path is not None and not path.exists():
                raise SemvizError(f"{option} {path}: no such file")

    @property
    def reads(self) -> list[Path]:
        """The files that are read."""
        return [path for path in (self.priors, self.odometry) if path is not None]


@contextmanager
def text_aside(as_json: bool) -> Iterator[None]:
    """Send printed lines to standard error if standard output is for one JSON object."""
    with redirect_stdout(sys.stderr) if as_json else nullcontext():
        yield
