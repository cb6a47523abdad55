"""Localize a workspace's sequence frame by frame, and record the run.

For each frame: observe, simulate the prior, crop the map, localize, record. The prior is a GPS
fix that is off by a known distance, with gravity and optionally a compass. With odometry, the
tracker follows the camera, and its pose of each frame is recorded as a localization.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from semviz.presentation.progress import announce_compiling, count_functions, track
from semviz.runs.images import check_images_available, with_images
from semviz.runs.run import RATES, TRACK, FrameRecord, Images, Observations, RunInfo, detector_model
from semviz.runs.writer import write_run
from semviz.workspace import observations
from semviz.workspace.detect import MODEL_FILE
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.proposal import ProcessedImages
from semviz_core.base.camera import Camera
from semviz_core.base.detector_calibration import DetectorCalibration
from semviz_core.base.detector_model import NoiseName
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Dataset, Frame, Odometry, OdometryNoise, Prior
from semviz_core.base.localization import Localization, Refinement
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.residuals import pair_residuals
from semviz_core.tracking.tracker import TrackedPose, Tracker

ODOMETRY_NOISE = OdometryNoise()
_ODOMETRY_SEED = 2  # 0 and 1 seed the prior and the detector


@dataclass
class SequenceTracker:
    """Localizes the frames of one sequence by tracking; give them in order."""

    camera: Camera
    semantic_map: SemanticMap
    localizer: Localizer
    """Localizes single frames while the pose is unknown."""
    crop_m: float
    seed: int
    """Seed of the simulated odometry."""
    _tracker: Tracker = field(init=False)
    _previous: Pose | None = None
    """True T_map_camera of the previous frame."""

    def __post_init__(self) -> None:
        self._tracker = Tracker(
            self.camera,
            self.semantic_map,
            self.localizer.detector,
            self.localizer,
            crop_m=self.crop_m,
        )

    def localize(self, frame: Frame, observed: Elements2D, prior: Prior) -> Localization:
        """Return the tracked pose as ``ok``, or ``cannot`` while it is starting or lost."""
        odometry = self._odometry(frame)
        self._previous = frame.T_map_camera
        start = perf_counter()
        tracked = self._tracker.step(observed, odometry, prior)
        time_ms = (perf_counter() - start) * 1e3
        return self._as_localization(tracked, observed, prior, time_ms)

    def _odometry(self, frame: Frame) -> Odometry | None:
        """Return the true motion since the previous frame with noise; None for the first."""
        pose, previous = frame.T_map_camera, self._previous
        if pose is None or previous is None:
            return None
        rng = np.random.default_rng([self.seed, frame.index, _ODOMETRY_SEED])
        return ODOMETRY_NOISE.measure(pose.inverse() @ previous, rng)

    def _as_localization(
        self, tracked: TrackedPose, observed: Elements2D, prior: Prior, time_ms: float
    ) -> Localization:
        single, pose = tracked.localization, tracked.T_camera_map
        submap = single.submap if single else self._submap(pose, prior)
        stages = single.time_ms if single else {}
        return Localization(
            TRACK,
            self.camera,
            prior,
            observed,
            submap,
            status="cannot" if pose is None else "ok",
            reason=_reason(tracked),
            T_camera_map=pose,
            covariance=tracked.covariance,
            match=single.match if single else None,
            search=single.search if single else None,
            refinement=None if pose is None else _fit(tracked, pose, self.camera, observed, submap),
            alternatives=single.alternatives if single else (),
            time_ms={**stages, "track": time_ms - sum(stages.values())},
        )

    def _submap(self, T_camera_map: Pose | None, prior: Prior) -> Elements3D:
        center_m = prior.position_m if T_camera_map is None else T_camera_map.inverse().translation
        return self.semantic_map.crop(center_m, self.crop_m)


def _reason(tracked: TrackedPose) -> str:
    if tracked.status == "ok":
        return tracked.reason
    state = "Starting" if tracked.status == "starting" else "Lost"
    return f"{state}: {tracked.reason[0].lower()}{tracked.reason[1:]}"


def _fit(
    tracked: TrackedPose,
    T_camera_map: Pose,
    camera: Camera,
    observed: Elements2D,
    submap: Elements3D,
) -> Refinement:
    """Return the tracked pairs and their residuals against the map at the tracked pose."""
    pairs = np.argwhere(tracked.element_id[:, None] == submap.id)
    residuals = pair_residuals(T_camera_map, camera, observed, submap, pairs)
    cost = np.array([np.minimum(residuals.chi2, 1e9).sum()])  # nothing was iterated
    return Refinement(pairs, residuals.residual_px, residuals.chi2, residuals.inlier, cost)


PriorSource = Callable[[Frame], Prior]
"""Returns the prior of a frame."""
CROP_RADIUS_M: dict[Observations, float] = {"labels": 120.0, "detected": 120.0, "simulated": 50.0}
"""The simulated detector has a range of 40 m; labels and detections have no fixed range."""
WARM_UP_FRAMES = 2
"""The second is the first that a tracker predicts."""
ROAD_RADIUS_M = 60.0
"""The prior holds the road within this distance of the fix."""


@dataclass(frozen=True)
class LocalizeOptions:
    """Settings of the localization of a sequence; they are stored in its run."""

    method: str = "search"
    weights: str | None = None
    """Weights file of a learned method; None: the shipped weights."""
    track: bool = False
    """Track the camera from frame to frame; ``method`` then applies while the pose is unknown."""
    observations: Observations = "labels"
    noise: NoiseName = "low"
    """Noise of the simulated detector."""
    least_score: float = 0.0
    """Minimum score of a detection."""
    prior_distance_m: tuple[float, float] = (5.0, 10.0)
    heading_sigma_deg: float | None = None
    crop_radius_m: float = CROP_RADIUS_M["labels"]
    seed: int = 0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise SemvizError(f"seed {self.seed}: give 0 or more")
        if not 0.0 < self.crop_radius_m < np.inf:
            raise SemvizError(f"crop radius {self.crop_radius_m:g} m: give a positive number")
        if not 0.0 <= self.least_score <= 1.0:
            raise SemvizError(f"score {self.least_score:g}: give a number from 0 to 1")

    @property
    def weights_path(self) -> Path | None:
        return None if self.weights is None else Path(self.weights)


@dataclass(frozen=True, eq=False)
class SequenceLocalization:
    """One pass over a sequence. Iterate to localize; records have no images yet."""

    source: Dataset
    semantic_map: SemanticMap
    frames: tuple[Frame, ...]
    observe: observations.Observe
    prior_of: PriorSource
    localizer: Localizer
    options: LocalizeOptions
    processed: ProcessedImages | None = None
    """The detector whose detections are observed, if any."""
    calibration: DetectorCalibration | None = None
    """Its calibration, if it has one."""

    def __post_init__(self) -> None:
        check_map_frame(self.semantic_map, self.source)
        if not len(self.semantic_map):
            raise SemvizError(
                "the map is empty: label poles and signs, then run 'semviz map build'"
            )

    def __iter__(self) -> Iterator[FrameRecord]:
        self._warm_up()
        localize = self._tracker().localize if self.options.track else self._localize
        for frame in self.frames:
            observed, element_id = self.observe(frame)
            result = localize(frame, observed, self._prior(frame))
            yield FrameRecord(frame, result, element_id)

    def _warm_up(self) -> None:
        """Localize an example and the first frames once, so that compilation is in no frame's
        time."""
        with count_functions() as tell:
            self.localizer.warmup(tell)
        localize = self._tracker().localize if self.options.track else self._localize
        for frame in self.frames[:WARM_UP_FRAMES]:
            observed, _ = self.observe(frame)
            localize(frame, observed, self._prior(frame))

    def _prior(self, frame: Frame) -> Prior:
        """Return the prior, with the map's road around the fix."""
        prior = self.prior_of(frame)
        road_m = self.semantic_map.road_near(prior.position_m, ROAD_RADIUS_M)
        return replace(prior, road_m=road_m)

    def _localize(self, frame: Frame, observed: Elements2D, prior: Prior) -> Localization:
        """Localize a single frame."""
        submap = self.semantic_map.crop(prior.position_m, self.options.crop_radius_m)
        return self.localizer.localize(observed, submap, self.source.rig.left, prior)

    def _tracker(self) -> SequenceTracker:
        options, camera = self.options, self.source.rig.left
        return SequenceTracker(
            camera, self.semantic_map, self.localizer, options.crop_radius_m, options.seed
        )


def check_map_frame(semantic_map: SemanticMap, source: Dataset) -> None:
    """Raise SemvizError if a map and the poses of a sequence are in different map frames."""
    map_frame, sequence_frame = semantic_map.frame.name, source.map_frame.name
    if map_frame != sequence_frame:
        raise SemvizError(
            f"the map is in frame '{map_frame}', the sequence in '{sequence_frame}': "
            "build a map from this sequence, or choose another with --map"
        )


def select_frames(source: Dataset, numbers: range | None) -> tuple[Frame, ...]:
    """Return the frames with these numbers (None: all). Raise SemvizError if there are none."""
    selected = tuple(frame for frame in source.frames if numbers is None or frame.index in numbers)
    if not selected:
        raise SemvizError("--frames: the sequence has none of these frames")
    return selected


def posed_frames(frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
    """Return the frames with a pose: the prior is simulated from it, and the error measured by it.

    Raise SemvizError if there are none.
    """
    posed = tuple(frame for frame in frames if frame.T_map_camera is not None)
    if not posed:
        raise SemvizError(
            "none of the frames has a pose, so no prior can be simulated; make the workspace "
            "again with --poses"
        )
    return posed


def localize_workspace(
    workspace: Workspace,
    map_name: str,
    options: LocalizeOptions,
    frames: range | None = None,
    calibration: DetectorCalibration | None = None,
) -> SequenceLocalization:
    """Return the localization of a workspace's frames (None: all) in its map ``map_name``.

    Frames without a pose are left out. ``calibration`` is that of the observed detections; without
    one, rates are assumed.
    """
    source = workspace.source
    semantic_map = workspace.read_map(map_name)
    detector = (
        detector_model(options.observations)
        if calibration is None
        else calibration.detector_model(options.least_score)
    )
    localizer = Localizer(
        options.method, options.seed, semantic_map.classes, detector, options.weights_path
    )
    selected = posed_frames(select_frames(source, frames))
    processed: ProcessedImages | None = None
    if options.observations == "labels":
        observe = observations.observe_labels(workspace, semantic_map)
    elif options.observations == "detected":
        detections = observations.read_detections(workspace, selected)
        observe = observations.observe_detected(
            workspace, semantic_map, detections, options.least_score, calibration
        )
        processed = detections.processed
    else:
        observe = observations.observe_simulated(
            workspace, semantic_map, options.noise, options.seed
        )
    prior_of = simulated_prior(options)
    return SequenceLocalization(
        source,
        semantic_map,
        selected,
        observe,
        prior_of,
        localizer,
        options,
        processed,
        calibration,
    )


def prior_options(options: LocalizeOptions) -> PriorOptions:
    """Return the accuracy of the simulated GPS and compass."""
    heading_deg = options.heading_sigma_deg
    return PriorOptions(
        distance_m=options.prior_distance_m,
        heading_sigma_rad=None if heading_deg is None else float(np.deg2rad(heading_deg)),
    )


def simulated_prior(options: LocalizeOptions) -> PriorSource:
    """Simulate a GPS fix that is off by a known distance, gravity, and optionally a compass."""
    accuracy = prior_options(options)

    def prior_of(frame: Frame) -> Prior:
        if frame.T_map_camera is None:
            raise SemvizError(f"frame {frame.index} has no pose to simulate a GPS fix from")
        return simulate_prior(frame.T_map_camera, accuracy, (options.seed, frame.index))

    return prior_of


def record(
    localization: SequenceLocalization,
    path: Path,
    *,
    workspace: str,
    map_name: str,
    images: Images = "embedded",
) -> Counter[str]:
    """Localize and write the run to ``path``, with a progress bar. Return frames by status.

    Raise SemvizError as ``write_run`` does, or if ``images`` are not available.
    """
    if path.suffix != ".rrd":
        raise SemvizError(f"{path}: name a file that ends in .rrd, for example runs/first.rrd")
    check_images_available(localization.source, images)
    announce_compiling()
    options, processed = localization.options, localization.processed
    info = RunInfo(
        name=path.stem,
        workspace=workspace,
        method=TRACK if options.track else options.method,
        seed=options.seed,
        version=version("semviz"),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        rig=localization.source.rig,
        map_name=map_name,
        observations=_observations(options, processed),
        options=asdict(options) | _detector_options(processed) | _calibration_options(localization),
        images=images,
    )
    records = (
        with_images(record, localization.source, images, path.parent)
        for record in track(localization, "localizing", len(localization.frames))
    )
    return write_run(records, path, info, localization.semantic_map)


def _observations(options: LocalizeOptions, processed: ProcessedImages | None) -> str:
    """Return ``RunInfo.observations``."""
    if options.observations == "labels":
        return "labels"
    if options.observations == "simulated":
        return f"simulated detector, noise {options.noise}"
    return "detected elsewhere" if processed is None else f"detected by {processed.detector}"


def _detector_options(processed: ProcessedImages | None) -> dict[str, Any]:
    """Return a detector and its settings as options of a run."""
    if processed is None:
        return {}
    settings = {
        f"detector_{name}": value
        for name, value in processed.settings.items()
        if name != MODEL_FILE
    }
    return {"detector": processed.detector} | settings


def _calibration_options(localization: SequenceLocalization) -> dict[str, Any]:
    """Return the calibrated rates as options of a run, so that it can be repeated without files."""
    if localization.calibration is None:
        return {}
    rates = localization.localizer.detector._asdict()
    return {RATES: rates, "detector_calibration": localization.calibration.truth}
