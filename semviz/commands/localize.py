"""The command localize."""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from semviz.commands import parsing
from semviz.commands.parsing import MeasurementOptions
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.runs.run import Observations
    from semviz.workspace.localization.localize import LocalizeOptions, SequenceLocalization
    from semviz.workspace.localization.measurements import MeasurementFiles, Measurements
    from semviz.workspace.workspace import Workspace
    from semviz_core.base.detector_model import DetectorCalibration
    from semviz_core.base.frame import Frame
    from semviz_core.base.semantic_map import SemanticMap


@dataclass(frozen=True)
class LocalizeCommand:
    """Localize the frames of a workspace in its map, and record the run.

    Examples: 'semviz localize town'; 'semviz localize town --observations detected --track';
    'semviz localize town --priors fixes.csv --odometry wheels.csv --track'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    out: parsing.OptionalPath = None
    """Run to write; default: runs/METHOD.rrd in the workspace, or runs/track.rrd with --track."""
    map: str = "main"
    """Name of the map."""
    collection: parsing.OptionalText = None
    """Localize in the map of a collection (a folder, or s3://BUCKET/PREFIX) instead of one of the
    workspace; what is around the drive is read, and stored in the run."""
    map_version: parsing.OptionalInt = None
    """Version of the collection's map; default: the newest."""
    method: str = "search"
    """search (prior-guided upright search); learned (a wider search, with poses rated by a
    network); direct (matches by class alone); paper, paper-no-semantics, bpnpnet or
    bpnpnet-semantic (learned matches)."""
    weights: parsing.OptionalPath = None
    """Weights of a learned method, written by 'semviz weights'; default: the shipped weights."""
    track: bool = False
    """Track the camera with odometry (simulated, 1 %, or from --odometry), also through frames with
    few elements. --method applies while the pose is unknown."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP], END excluded; default: all frames."""
    camera: parsing.OptionalText = None
    """Of a rig: the camera to localize; default: the first."""
    rig: bool = False
    """One pose from what all cameras of a rig, or of a stereo pair, see."""
    fit_sigmas: bool = False
    """Scale the sigmas of detections to the errors that frames along the run show."""
    observations: Annotated[
        Literal["labels", "detected", "simulated"] | None,
        arg(metavar="labels|detected|simulated", help_behavior_hint=""),
    ] = None
    """labels: the workspace's labels; detected: detections of 'semviz detect'; simulated: the
    street's simulated detector. Default: labels, if there are any."""
    least_score: parsing.OptionalFloat = None
    """Minimum score of a detection; default: that of its detector's calibration, or 0."""
    calibration: parsing.Calibration = None
    noise: Literal["paper", "low"] = "low"
    """Noise of the simulated detector: the paper's table, or 1 px and 0.3 deg."""
    prior_distance: str = "5:10"
    """LOW:HIGH: error of the simulated GPS fix, in metres."""
    heading_sigma_deg: parsing.OptionalFloat = None
    """Standard deviation of a simulated compass; default: heading unknown. With --priors, that of
    headings without a column of it; default: 5."""
    measurements: MeasurementOptions = field(default_factory=MeasurementOptions)
    crop_radius: parsing.OptionalFloat = None
    """Radius of the submap around the GPS fix, in metres; default: 50 for the simulated detector
    (range 40 m), 120 for labels and detections (unlimited range)."""
    seed: int = 0
    """Seed of the simulated priors and detections."""
    jobs: int = 1
    """Processes that localize frames on their own; the run is the same but for times."""
    force: parsing.Force = False
    images: Literal["embedded", "both", "reference", "none"] = "embedded"
    """embedded: the left images in the run (about 130 kB per frame); both: the right ones too;
    reference: their file names; none."""
    json: bool = False
    """Print one JSON object instead of lines: the run's file, and frames by status."""

    def run(self) -> int:
        from semviz.workspace.chosen_frames import select_frames
        from semviz.workspace.localization import localize

        self._check()
        workspace = parsing.open_workspace(self.workspace)
        observations = self.observations or workspace.default_observations
        calibration = self._calibration(workspace, observations)
        options = self._options(observations, calibration)
        frames = parsing.parse_frames(self.frames)
        path = self._checked_output(workspace)
        chosen = select_frames(workspace.source, frames, self.camera)
        files = self.measurements.files(self.heading_sigma_deg)
        semantic_map, map_name = self._map(workspace, chosen, options.crop_radius_m, files)
        measured = files.read(workspace, semantic_map)
        localization = localize.localize_workspace(
            workspace, semantic_map, options, frames, calibration, measured, self.camera, self.jobs
        )
        self._print_notes(localization, measured, len(chosen))
        counts = localize.record(
            localization,
            path,
            workspace=str(self.workspace),
            map_name=map_name,
            images=self.images,
        )
        print_run(path, counts, self.json)
        return 0

    def _check(self) -> None:
        """Refuse options that contradict each other."""
        if self.collection is None and self.map_version is not None:
            raise SemvizError("--map-version is for maps of collections; add --collection")
        if self.collection is not None and self.map != "main":
            raise SemvizError("--map is for maps of the workspace; leave out --map or --collection")
        self.measurements.check_used()
        if self.measurements.odometry is not None and not (self.track or self.rig):
            raise SemvizError("--odometry is for tracking and rigs; add --track or --rig")

    def _calibration(
        self, workspace: "Workspace", observations: str
    ) -> "DetectorCalibration | None":
        if observations == "detected":
            return parsing.read_calibration(workspace, self.calibration)
        if self.calibration is not None:
            raise SemvizError("--calibration is for detections; add --observations detected")
        return None

    def _options(
        self, observations: "Observations", calibration: "DetectorCalibration | None"
    ) -> "LocalizeOptions":
        from semviz.workspace.localization import localize

        given, least_score, crop_radius = self.measurements, self.least_score, self.crop_radius
        if least_score is None:
            least_score = 0.0 if calibration is None else calibration.least_score
        if crop_radius is None:
            crop_radius = localize.CROP_RADIUS_M[observations]
        return localize.LocalizeOptions(
            method=self.method,
            weights=None if self.weights is None else str(self.weights.resolve()),
            track=self.track,
            rig=self.rig,
            fit_sigmas=self.fit_sigmas,
            observations=observations,
            noise=self.noise,
            least_score=least_score,
            prior_distance_m=parsing.parse_interval(self.prior_distance, "--prior-distance"),
            heading_sigma_deg=self.heading_sigma_deg,
            priors=None if given.priors is None else str(given.priors),
            odometry=None if given.odometry is None else str(given.odometry),
            crop_radius_m=crop_radius,
            seed=self.seed,
        )

    def _checked_output(self, workspace: "Workspace") -> Path:
        from semviz.runs.run import TRACK
        from semviz.workspace import outputs

        path = self.out or workspace.run_path(TRACK if self.track else self.method)
        outputs.check_outputs(
            path,
            outputs.RUN,
            force=self.force,
            reads=[self.workspace, *self.measurements.reads],
            purpose="run",
        )
        return path

    def _map(
        self,
        workspace: "Workspace",
        chosen: "Sequence[Frame]",
        crop_radius_m: float,
        files: "MeasurementFiles",
    ) -> "tuple[SemanticMap, str]":
        """The map to localize in, and what the run calls it."""
        if self.collection is None:
            return workspace.read_map(self.map), self.map
        from semviz.collection.collection import Collection
        from semviz.collection.drive_map import map_along_drive

        tiles = Collection.open(self.collection).tiled_map(self.map_version)
        name = f"{Path(self.collection).name} version {tiles.version}"
        return map_along_drive(tiles, workspace, chosen, crop_radius_m, files), name

    def _print_notes(
        self, localization: "SequenceLocalization", measured: "Measurements", chosen: int
    ) -> None:
        """Say on stderr what a user would not expect of the run."""
        notes = list(measured.notes(localization.frames))
        mapped = set(localization.semantic_map.elements.class_id.tolist())
        untrained = localization.localizer.untrained_classes
        if names := [class_.name for class_ in untrained if class_.id in mapped]:
            notes.append(
                f"{self.method}: its network was not trained for {', '.join(names)}; it takes "
                "lines for poles and points for rectangular signs"
            )
        if left_out := chosen - len(localization.frames):
            notes.append(f"{left_out} frames without a pose are left out")
        for note in notes:
            print(note, file=sys.stderr)


def print_run(path: Path, counts: Mapping[str, int], as_json: bool) -> None:
    """Print the frames by status of a run that was written."""
    if as_json:
        print(
            json.dumps({"run": str(path), "frames": sum(counts.values()), "status": dict(counts)})
        )
        return
    print(f"{path}: " + ", ".join(f"{number} {status}" for status, number in counts.items()))
    print(f"next: semviz evaluate {path}; semviz serve {path}")
