"""Options of commands that take priors and odometry from files."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.workspace.measurements import MeasurementFiles


@dataclass(frozen=True)
class MeasurementOptions:
    """Priors and odometry from files instead of simulated ones; see docs/priors.md."""

    priors: parsing.OptionalPath = None
    """Fixes, headings and gravity: a table with named columns (CSV), or poses (TUM, KITTI and all
    other formats of 'semviz new --poses'). Default: simulated."""
    odometry: parsing.OptionalPath = None
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
    extrinsic: parsing.OptionalText = None
    """T_body_camera if the files hold poses of a body: camera, flu (x ahead, y left), frd, or a
    file with a 3x4 or 4x4 matrix. Default: camera; for headings and GNSS: flu."""
    anchor: parsing.OptionalText = None
    """LATITUDE,LONGITUDE[,HEIGHT] of the map's origin, for GNSS; default: the map's own."""
    anchor_heading: parsing.OptionalFloat = None
    """Compass direction of the map's x axis at the anchor, in degrees; default: 90 (east)."""

    def files(self, heading_sigma_deg: float | None) -> "MeasurementFiles":
        """Return the files with what these options say of them."""
        from semviz.workspace.measurements import MeasurementFiles
        from semviz_core.base.frame import OdometryNoise
        from semviz_core.datasets.measured.priors import PriorSigmas

        horizontal, vertical = parsing.parse_pair(self.fix_sigma, "--fix-sigma", "5.5:0.3", 0.3)
        percent, rotation_deg = parsing.parse_pair(
            self.odometry_noise, "--odometry-noise", "1:0.1", 0.1
        )
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
            parsing.parse_anchor(self.anchor, self.anchor_heading),
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
