"""The commands map build, check, diff and localizability."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from semviz.commands import parsing
from semviz.commands.poses import known_pose_review
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.workspace.poses.pose_review import PoseReview
    from semviz.workspace.workspace import Workspace
    from semviz_annotation.labels.proposals import Proposals
    from semviz_annotation.mapping.association.detection_tracks import TrackOptions
    from semviz_annotation.mapping.build import BuildOptions, BuildReport
    from semviz_annotation.mapping.paper_baseline import PaperOptions
    from semviz_core.base.frame import Frame
    from semviz_core.base.semantic_map import SemanticMap
    from semviz_core.common.jit import Stopwatch
    from semviz_core.localizability.route import Conditions

_METHOD_OPTIONS = {
    "joint": ("min_frames", "pose_sigma_m", "pose_sigma_deg", "refine_poses"),
    "paper": ("eps_m", "min_points"),
}
"""Options that apply to one method only."""


@dataclass(frozen=True)
class MapBuildCommand:
    """Build a map from labels or detections: triangulate, associate elements of one landmark,
    reject outliers.

    Examples: 'semviz map build town'; 'semviz map build town --from detections'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    name: parsing.OptionalText = None
    """Name of the map in the workspace; default: main, or from-detections."""
    source: Annotated[
        Literal["labels", "detections"], arg(name="from", metavar="labels|detections")
    ] = "labels"
    """detections: also map what 'semviz detect' found and nobody has labelled or rejected."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP]: use only these frames."""
    least_score: parsing.OptionalFloat = None
    """Minimum score of a detection (default: 0, all that the detector stored)."""
    calibration: parsing.Calibration = None
    method: Literal["joint", "paper"] = "joint"
    """joint: all labels together; paper: each stereo pair alone, then DBSCAN, as a baseline."""
    sigma_px: float = 1.0
    """Standard deviation of labels: 1 for people, 2 to 4 for imported labels of a detector."""
    min_frames: parsing.OptionalInt = None
    """Leave out landmarks seen in fewer frames (default: 1; of detections: 4,
    or 3 if those of one camera lie 1.8 m apart or more)."""
    pose_sigma_m: parsing.OptionalFloat = None
    """Pose error from one pass to the next (default: 0.05)."""
    pose_sigma_deg: parsing.OptionalFloat = None
    """With --refine-poses: rotation error of poses (default: 0.02)."""
    refine_poses: bool = False
    """Bundle adjustment: also move the poses, by about --pose-sigma-m (default: 0.01)."""
    eps_m: parsing.OptionalFloat = None
    """Method paper: radius of DBSCAN (default: 1.0)."""
    min_points: parsing.OptionalInt = None
    """Method paper: core size of DBSCAN, in stereo pairs (default: 1)."""
    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        from semviz.presentation.terminal import Steps, announce_compiling
        from semviz.workspace.observations import read_detections
        from semviz.workspace.outputs import PARQUET, check_outputs
        from semviz.workspace.poses.pose_review import pose_errors, with_used_poses
        from semviz_annotation.mapping.build import DEFAULT_TRACKING, build_map
        from semviz_core.base.map_file import save_map
        from semviz_core.common.jit import Stopwatch

        tracking = self._tracking()
        options = self._options()
        workspace = parsing.open_workspace(self.workspace)
        name = self.name or ("main" if tracking is None else "from-detections")
        labels, path = workspace.read_labels(), workspace.map_path(name)
        check_outputs(path, PARQUET, can_force=False, purpose="map")
        detections = None
        if tracking is not None:
            detections = read_detections(workspace, ())
            calibration = parsing.read_calibration(workspace, self.calibration)
            tracking = replace(tracking, calibration=calibration)
            announce_compiling("the search for tracks")
        frames, watch = parsing.parse_frames(self.frames), Stopwatch()
        with Steps() as steps:
            built, report = build_map(
                labels,
                workspace.source,
                options,
                frames,
                on_progress=steps.show,
                detections=detections,
                tracking=tracking or DEFAULT_TRACKING,
                poses=pose_errors(workspace),
                watch=watch,
            )
        built = with_used_poses(built, workspace)
        save_map(built, path)
        self._print(built, path, report, known_pose_review(workspace), detections, watch)
        return 0

    def _print(
        self,
        built: "SemanticMap",
        path: Path,
        report: "BuildReport",
        poses: "PoseReview | None",
        detections: "Proposals | None",
        watch: "Stopwatch",
    ) -> None:
        from semviz.reports.pose_check import review_as_dict, review_lines

        report = replace(report, in_wrong_poses=poses.wrong_observations if poses else frozenset())
        if self.json:
            said = {} if poses is None else {"poses": review_as_dict(poses)}
            if detections is not None:
                said["ms"] = watch.time_ms
            print(json.dumps({"map": str(path), **report.as_dict(), **said}))
            return
        for line in [] if poses is None else review_lines(poses):
            print(line)
        print(report)
        if detections is not None:
            frames = parsing.parse_frames(self.frames)
            rows = (row for row in detections.rows() if not frames or row.frame_index in frames)
            images = {(row.frame_index, row.side) for row in rows}
            seconds = watch.time_ms["linking"] / 1e3
            print(f"linked the detections in {len(images)} images in {seconds:.1f} s")
        print(f"{path}: {len(built)} elements, {path.stat().st_size / 1000:.0f} kB")

    def _options(self) -> "BuildOptions | PaperOptions":
        from semviz_annotation.mapping.build import BuildOptions
        from semviz_annotation.mapping.paper_baseline import PaperOptions
        from semviz_annotation.mapping.placement.bundle_adjustment import RefineOptions

        for method, names in _METHOD_OPTIONS.items():
            for name in names:
                if method != self.method and getattr(self, name) not in (None, False):
                    option = name.replace("_", "-")
                    raise SemvizError(f"--{option} is for --method {method}; leave it out")
        values = {name: getattr(self, name) for name in _METHOD_OPTIONS[self.method]}
        given = {name: value for name, value in values.items() if value is not None}
        if self.source == "detections":
            given.pop("min_frames", None)
        if self.method == "paper":
            return PaperOptions(sigma_px=self.sigma_px, **given)
        sigma_deg = given.pop("pose_sigma_deg", None)
        if given.pop("refine_poses"):
            prior = RefineOptions()
            sigma_m = given.get("pose_sigma_m", prior.pose_sigma_m)
            sigma_deg = prior.pose_sigma_deg if sigma_deg is None else sigma_deg
            given["refine"] = replace(prior, pose_sigma_m=sigma_m, pose_sigma_deg=sigma_deg)
        elif sigma_deg is not None:
            raise SemvizError("--pose-sigma-deg is for --refine-poses; add that, or leave it out")
        return BuildOptions(sigma_px=self.sigma_px, **given)

    def _tracking(self) -> "TrackOptions | None":
        """Return how detections become tracks; None for a map of labels alone."""
        from semviz_annotation.mapping.association.detection_tracks import TrackOptions

        if self.source == "labels":
            for name in ("least_score", "calibration"):
                if getattr(self, name) is not None:
                    option = name.replace("_", "-")
                    raise SemvizError(f"--{option} is for --from detections; leave it out")
            return None
        if self.method != "joint":
            raise SemvizError("--from detections is for --method joint; leave one of them out")
        default = TrackOptions()
        return TrackOptions(
            default.least_score if self.least_score is None else self.least_score,
            self.min_frames,
        )


@dataclass(frozen=True)
class MapCheckCommand:
    """Check a map: its errors against the labels (or its detections) per class, the labels that
    agree least with the others, and the findings of lint.

    Example: 'semviz map check town'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    map: str = "main"
    """Name of the map."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP]: measure only in these frames."""
    gate: bool = False
    """Exit with status 1, and a line per class, if the map exceeds a limit."""
    max_rmse_px: float = 1.0
    """With --gate: signs' RMSE and poles' lateral RMSE must be below this."""
    max_angle_deg: float = 1.0
    """With --gate: poles' angular RMSE must be below this."""
    json: bool = False
    """Print one JSON object instead of tables."""

    def run(self) -> int:
        import sys

        from semviz.reports.pose_check import review_as_dict, review_lines
        from semviz.workspace.observations import read_labels_of
        from semviz.workspace.poses.pose_review import pose_change
        from semviz_annotation.mapping.quality.check import Gate, check_map

        workspace = parsing.open_workspace(self.workspace)
        semantic_map = workspace.read_map(self.map)
        poses = known_pose_review(workspace)
        labels, sigma_ratio = read_labels_of(workspace, semantic_map)
        frames = parsing.parse_frames(self.frames)
        wrong_poses = () if poses is None else poses.wrong_frames
        check = check_map(semantic_map, labels, workspace.source, frames, sigma_ratio, wrong_poses)
        if self.json:
            said = {} if poses is None else {"poses": review_as_dict(poses)}
            print(json.dumps(check.as_dict() | said))
        else:
            for line in [] if poses is None else review_lines(poses):
                print(line)
            print(check.as_text())
        if check.is_old:
            print(
                f"the map is older than its labels (operation {check.semantic_map.operation}, "
                f"labels {check.labels_operation}): rebuild it",
                file=sys.stderr,
            )
        if change := pose_change(semantic_map, workspace):
            print(f"the map was built with other poses ({change}): rebuild it", file=sys.stderr)
        if not self.gate:
            return 0
        failures = Gate(self.max_rmse_px, self.max_angle_deg).failures(check.accuracy)
        for line in failures:
            print(f"limit exceeded: {line}", file=sys.stderr)
        return 1 if failures else 0


@dataclass(frozen=True)
class MapDiffCommand:
    """List the differences of two maps: elements moved, new, gone, merged, split, renumbered.

    Example: 'semviz map diff town main other'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    base: Annotated[Positional[str], arg(metavar="BASE")]
    """Name of a map in the workspace, or a file (.parquet)."""
    other: Annotated[Positional[str], arg(metavar="OTHER")]
    """Map to compare with BASE: a name or a file."""
    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        from semviz_annotation.mapping.quality.diff import diff_maps

        workspace = parsing.open_workspace(self.workspace)
        diff = diff_maps(_read(workspace, self.base), _read(workspace, self.other))
        print(json.dumps(diff.as_dict()) if self.json else diff.as_text())
        return 0


def _read(workspace: "Workspace", name: str) -> "SemanticMap":
    from semviz_core.base.map_file import load_map

    return load_map(name) if name.endswith(".parquet") else workspace.read_map(name)


@dataclass(frozen=True)
class MapLocalizabilityCommand:
    """Predict localization from the map alone: expected error along the route, ambiguous stretches,
    and the new elements that help most.

    Example: 'semviz map localizability town --plot route.png'."""

    workspace: Positional[Path]
    """Workspace: its camera, and the route by its poses (without poses, by the map)."""
    map: str = "main"
    """Name of the map."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP]: along these frames."""
    camera: parsing.OptionalText = None
    """Of a rig: the camera that is to localize; default: the first."""
    plot: parsing.OptionalPath = None
    """Also write a plot along the route to this PNG file."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object with every position instead of a table."""

    def run(self) -> int:
        from semviz.presentation.terminal import announce_compiling, track
        from semviz.workspace import outputs
        from semviz.workspace.chosen_frames import check_map_frame, select_frames
        from semviz.workspace.localization import localizability
        from semviz_core.localizability.predict import predict

        if self.plot is not None:
            localizability.check_plot_path(self.plot)
            outputs.check_outputs(self.plot, outputs.PNG, force=self.force, reads=[self.workspace])
        workspace = parsing.open_workspace(self.workspace)
        semantic_map, source = workspace.read_map(self.map), workspace.source
        check_map_frame(semantic_map, source)
        frames = select_frames(source, parsing.parse_frames(self.frames), self.camera)
        conditions = _conditions(workspace, semantic_map, frames)
        announce_compiling()
        poses = localizability.positions(frames, semantic_map)
        predicted = predict(semantic_map, source.rig.left, poses, conditions, track)
        described = predicted, semantic_map.classes, conditions.detector
        if self.json:
            print(json.dumps(localizability.localizability_json(*described)))
        else:
            print(localizability.localizability_text(*described))
        if self.plot is not None:
            localizability.draw_localizability(predicted, self.plot)
        return 0


def _conditions(
    workspace: "Workspace", semantic_map: "SemanticMap", frames: "Sequence[Frame]"
) -> "Conditions":
    """Return the conditions of ``semviz localize``, with the recall of the labels if there are
    any."""
    from semviz.workspace.localization.localizability import conditions_of, with_measured_recall
    from semviz.workspace.localization.localize import CROP_RADIUS_M, LocalizeOptions
    from semviz.workspace.observations import observe_labels

    kind = workspace.default_observations
    assumed = conditions_of(LocalizeOptions(observations=kind, crop_radius_m=CROP_RADIUS_M[kind]))
    if kind != "labels":
        return assumed
    observe = observe_labels(workspace, semantic_map)
    observed = [
        (frame.T_map_camera, observe(frame)[1])
        for frame in frames
        if frame.T_map_camera is not None
    ]
    return with_measured_recall(assumed, semantic_map, workspace.source.rig.left, observed)
