"""semviz localize"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from semviz.commands.parsing import (
    OptionalFloat,
    OptionalPath,
    OptionalText,
    parse_frames,
    parse_interval,
)


@dataclass(frozen=True)
class Localize:
    """Localize the frames of a workspace in its map and record the run."""

    workspace: Positional[Path]
    """The workspace."""
    out: OptionalPath = None
    """The run to write; runs/METHOD.rrd in the workspace if not given, runs/track.rrd
    with --track."""
    map: str = "main"
    """Name of the map."""
    method: str = "search"
    """search (prior-guided upright search); wide (with more effort, for a fix 30 m off or clutter);
    learned (wide, and a network tells which answer is right); direct (classes alone fix the
    matches); paper, paper-no-semantics, bpnpnet or bpnpnet-semantic (learned matches)."""
    weights: OptionalPath = None
    """What a learned method has learned, a file of 'semviz weights'; what comes with semviz if not
    given."""
    track: bool = False
    """Follow the camera from frame to frame: odometry (simulated, 1 %) ties the frames together,
    and those with few elements are used too. --method is for frames while the pose is not known."""
    frames: OptionalText = None
    """FIRST:END[:STEP]; all frames if not given."""
    observations: Annotated[
        Literal["labels", "detected", "simulated"] | None,
        arg(metavar="labels|detected|simulated", help_behavior_hint=""),
    ] = None
    """What is seen: the workspace's labels; what 'semviz detect' found in its images; or what the
    street's simulated detector would. If not given, labels where there are some."""
    least_score: float = 0.0
    """Detections with less are not seen."""
    noise: Literal["paper", "low"] = "low"
    """Noise of the simulated detector: the paper's table, or 1 px and 0.3 deg."""
    prior_distance: str = "5:10"
    """How far the simulated GPS fix is off, in metres."""
    heading_sigma_deg: OptionalFloat = None
    """Standard deviation of a simulated compass; the heading is unknown if not given."""
    crop_radius: OptionalFloat = None
    """Radius of the submap round the GPS fix, in metres; 50 for the simulated detector, which
    sees 40 m far, and 120 for labels and detections, which reach as far as can be seen."""
    seed: int = 0
    """Seed of the simulated priors and detections."""
    images: Literal["embedded", "both", "reference", "none"] = "embedded"
    """embedded: the left images in the run (about 130 kB a frame); both: the right ones too;
    reference: the names of their files; none."""

    def run(self) -> int:
        from semviz.drive import CROP_RADIUS_M, DriveOptions, drive_workspace, record
        from semviz.follow import METHOD
        from semviz.workspace import Workspace

        workspace = Workspace.open(self.workspace)
        observations = self.observations or workspace.default_observations
        crop_radius = self.crop_radius
        if crop_radius is None:
            crop_radius = CROP_RADIUS_M[observations]
        options = DriveOptions(
            method=self.method,
            weights=None if self.weights is None else str(self.weights.resolve()),
            track=self.track,
            observations=observations,
            noise=self.noise,
            least_score=self.least_score,
            prior_distance_m=parse_interval(self.prior_distance, "--prior-distance"),
            heading_sigma_deg=self.heading_sigma_deg,
            crop_radius_m=crop_radius,
            seed=self.seed,
        )
        drive = drive_workspace(workspace, self.map, options, parse_frames(self.frames))
        path = self.out or workspace.run_path(METHOD if self.track else self.method)
        counts = record(
            drive, path, workspace=str(self.workspace), map_name=self.map, images=self.images
        )
        print(f"{path}: " + ", ".join(f"{number} {status}" for status, number in counts.items()))
        print(f"next: semviz evaluate {path}; semviz serve {path}")
        return 0
