"""Localize a workspace's sequence frame by frame, and record the run.

For each frame: observe, simulate the prior, crop the map, localize, record. The prior is a GPS
fix that is off by a known distance, with gravity and optionally a compass. With odometry, the
tracker follows the camera, and its pose of each frame is recorded as a localization.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from semviz.presentation.terminal import announce_compiling, count_functions, track
from semviz.runs.diagnosis import frame_diagnosis
from semviz.runs.images import check_images_available, with_images
from semviz.runs.run import (
    RATES,
    TRACK,
    FrameRecord,
    Images,
    Observations,
    Run,
    RunInfo,
    detector_model,
)
from semviz.runs.writer import write_run
from semviz.workspace import observations
from semviz.workspace.chosen_frames import check_map_frame, posed_frames, select_frames
from semviz.workspace.detect import MODEL_FILE
from semviz.workspace.drive.rig_views import OdometrySource, RigViews, rig_views
from semviz.workspace.localization.frame_processes import localized_in_processes
from semviz.workspace.localization.measurements import Measurements
from semviz.workspace.localization.sequence_tracker import SequenceTracker
from semviz.workspace.localization.simulated_measurements import (
    PriorSource,
    simulated_odometry,
    simulated_prior,
)
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.proposal import ProcessedImages
from semviz_core.base.detector_model import DetectorCalibration, NoiseName
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Dataset, Frame, Prior
from semviz_core.base.localization import Localization
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.rig_cameras import cameras_by_frame
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.noise_estimate import NoiseEstimate

CROP_RADIUS_M: dict[Observations, float] = {"labels": 120.0, "detected": 120.0, "simulated": 50.0}
"""The simulated detector has a range of 40 m; labels and detections have no fixed range."""
WARM_UP_FRAMES = 2
"""The second is the first that a tracker predicts."""
NO_PRIOR = "No prior: the file has no fix for this frame."
NOISE_FRAMES = 24
"""Frames along a run from which the sigmas of its detections are estimated."""
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
    rig: bool = False
    """Estimate one pose from all cameras of the drive."""
    fit_sigmas: bool = False
    """Scale the sigmas of detections to the errors that frames along the run show."""
    observations: Observations = "labels"
    noise: NoiseName = "low"
    """Noise of the simulated detector."""
    least_score: float = 0.0
    """Minimum score of a detection."""
    prior_distance_m: tuple[float, float] = (5.0, 10.0)
    heading_sigma_deg: float | None = None
    priors: str | None = None
    """File of measured priors; None: they are simulated."""
    odometry: str | None = None
    """File of measured odometry; None: it is simulated, or unknown if priors are measured."""
    crop_radius_m: float = CROP_RADIUS_M["labels"]
    seed: int = 0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise SemvizError(f"seed {self.seed}: give 0 or more")
        if not 0.0 < self.crop_radius_m < np.inf:
            raise SemvizError(f"crop radius {self.crop_radius_m:g} m: give a positive number")
        if not 0.0 <= self.least_score <= 1.0:
            raise SemvizError(f"score {self.least_score:g}: give a number from 0 to 1")
        if self.rig and (self.track or self.method != "search"):
            raise SemvizError("--rig is for single frames and --method search; leave out --rig")
        if self.rig and self.observations == "simulated":
            raise SemvizError("--rig is for labels and detections; add --observations detected")

    @property
    def has_measurements(self) -> bool:
        """Whether priors or odometry are from files."""
        return self.priors is not None or self.odometry is not None

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
    odometry_of: OdometrySource
    localizer: Localizer
    options: LocalizeOptions
    processed: ProcessedImages | None = None
    """The detector whose detections are observed, if any."""
    calibration: DetectorCalibration | None = None
    """Its calibration, if it has one."""
    jobs: int = 1
    """Processes that localize."""
    again: "Callable[[], SequenceLocalization] | None" = None
    """Makes the same in another process; needed for several."""
    rig: RigViews | None = None
    """All cameras, if each pose is to follow from what all of them see."""

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise SemvizError(f"--jobs {self.jobs}: give 1 or more")
        if self.jobs > 1 and self.options.track:
            raise SemvizError("--jobs is for frames on their own; leave out --jobs or --track")
        check_map_frame(self.semantic_map, self.source)
        if not len(self.semantic_map):
            raise SemvizError(
                "the map is empty: label poles and signs, then run 'semviz map build'"
            )

    def __iter__(self) -> Iterator[FrameRecord]:
        self.warmup(count_functions)
        yield from self._localized(self.frames)

    def warmup(self, compile_: Callable[[Any], None] = lambda warmup: warmup()) -> None:
        """Compile, or load from disk, what localizes, observes and tracks.

        ``compile_`` calls the localizer's ``warmup``, to show how far it is.
        """
        compile_(self.localizer.warmup)
        for _ in self._localized(self.frames[:WARM_UP_FRAMES]):
            pass

    def localized(self, rows: range) -> Iterator[FrameRecord]:
        """Yield the records of some of the frames, each on its own."""
        return self._localized(self.frames[rows.start : rows.stop])

    @cached_property
    def noise(self) -> NoiseEstimate:
        """What frames along the run tell about the sigmas of its detections.

        It is the same in all processes, and whichever frames are localized."""
        estimate, search = NoiseEstimate(), replace(self.localizer, method="search", weights=None)
        for frame in self.frames[:: -(-len(self.frames) // NOISE_FRAMES)]:
            (stated, _), prior = self.observe(frame), self._prior(frame)
            if prior is not None:
                submap = self.semantic_map.crop(prior.position_m, self.options.crop_radius_m)
                request = estimate.applied(stated), submap, self.source.rig.left, prior
                estimate = estimate.after(search.localize(*request), stated, search.detector)
        return estimate

    def _with_sigmas(self, stated: Elements2D) -> Elements2D:
        """Return elements with the sigmas that they are localized with."""
        return self.noise.applied(stated) if self.options.fit_sigmas else stated

    def _localized(self, frames: tuple[Frame, ...]) -> Iterator[FrameRecord]:
        options = self.options
        tracker = self._tracker() if options.track else None
        for before, frame in zip((None, *frames), frames, strict=False):
            stated, element_id = self.observe(frame)
            observed = self._with_sigmas(stated)
            prior, odometry = self._prior(frame), None
            if tracker is None:
                result = self._localize(frame, observed, prior)
            else:
                odometry = None if before is None else self.odometry_of(before, frame)
                result = tracker.localize(observed, prior, odometry)
            measured = odometry if options.has_measurements else None
            yield FrameRecord(frame, result, element_id, odometry=measured)

    def _prior(self, frame: Frame) -> Prior | None:
        """Return the prior, if any, with the map's road around the fix."""
        prior = self.prior_of(frame)
        if prior is None:
            return None
        road_m = self.semantic_map.road_near(prior.position_m, ROAD_RADIUS_M)
        return replace(prior, road_m=road_m)

    def _localize(self, frame: Frame, observed: Elements2D, prior: Prior | None) -> Localization:
        """Localize a single frame; one without a prior is recorded as such."""
        camera = self.source.rig.left
        if prior is None:
            nothing = self.semantic_map.elements[:0]
            return Localization(
                self.localizer.method,
                camera,
                None,
                observed,
                nothing,
                "cannot",
                NO_PRIOR,
                None,
                None,
            )
        submap = self.semantic_map.crop(prior.position_m, self.options.crop_radius_m)
        if self.rig is not None:
            return self.rig.localize(
                frame, observed, submap, prior, self.localizer, self._with_sigmas
            )
        return self.localizer.localize(observed, submap, camera, prior)

    def _tracker(self) -> SequenceTracker:
        return SequenceTracker(
            self.source.rig.left,
            self.semantic_map,
            self.localizer,
            self.options.crop_radius_m,
        )


def localize_workspace(
    workspace: Workspace,
    given_map: SemanticMap | str,
    options: LocalizeOptions,
    frames: range | None = None,
    calibration: DetectorCalibration | None = None,
    measured: Measurements | None = None,
    camera: str | None = None,
    jobs: int = 1,
) -> SequenceLocalization:
    """Return the localization of a workspace's frames (None: all) in a map, or its map of a name.

    Of a rig, those of one camera: see ``select_frames``. Frames without a pose are left out, unless
    their priors are ``measured``. ``calibration`` is that of the observed detections; without one,
    rates are assumed. ``jobs`` processes localize frames on their own.
    """
    again = partial(
        _localize_again, workspace.path, given_map, options, frames, calibration, measured, camera
    )
    source = workspace.source
    semantic_map = workspace.read_map(given_map) if isinstance(given_map, str) else given_map
    localizer = Localizer(
        options.method,
        options.seed,
        semantic_map.classes,
        detector_model(options.observations)
        if calibration is None
        else calibration.detector_model(options.least_score),
        options.weights_path,
    )
    measured = measured or Measurements()
    selected = select_frames(source, frames, camera)
    if measured.priors is None:
        selected = posed_frames(selected)
    observe_in, processed = _observing(workspace, semantic_map, options, selected, calibration)
    odometry_of = measured.odometry_of if measured.is_any else simulated_odometry(options.seed)
    measured.check(semantic_map, selected)
    return SequenceLocalization(
        source,
        semantic_map,
        selected,
        observe_in(),
        measured.prior_of if measured.priors else simulated_prior(options),
        odometry_of,
        localizer,
        options,
        processed,
        calibration,
        jobs,
        again,
        rig_views(source, selected, observe_in, odometry_of) if options.rig else None,
    )


def _observing(
    workspace: Workspace,
    semantic_map: SemanticMap,
    options: LocalizeOptions,
    selected: Sequence[Frame],
    calibration: DetectorCalibration | None,
) -> tuple[Callable[..., observations.Observe], ProcessedImages | None]:
    """Return what observes the elements in the images of a camera, the left one unless it is told
    another, and what is known of the images that a detector has processed."""
    if options.observations == "labels":
        return partial(observations.observe_labels, workspace, semantic_map), None
    if options.observations != "detected":
        noise, seed = options.noise, options.seed
        return partial(observations.observe_simulated, workspace, semantic_map, noise, seed), None
    detections = observations.read_detections(workspace, selected)
    scores = options.least_score, calibration
    observe = partial(observations.observe_detected, workspace, semantic_map, detections, *scores)
    return observe, detections.processed


def _localize_again(path: Path, *arguments: Any) -> SequenceLocalization:
    """Return ``localize_workspace`` of the workspace in a folder."""
    return localize_workspace(Workspace.open(path), *arguments)


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
        options=_stored(options)
        | _detector_options(processed)
        | _calibration_options(localization)
        | _sigma_options(localization),
        images=images,
        camera=cameras_by_frame(localization.source).get(localization.frames[0].index, ""),
    )
    frames = _RecordedFrames(localization, Run(info, localization.semantic_map, ()), path.parent)
    records = track(frames.all(), "localizing", len(localization.frames))
    counts = write_run(records, path, info, localization.semantic_map)
    if said := localization.noise.scales.sentence:
        scaled = "sigmas are scaled" if options.fit_sigmas else "--fit-sigmas scales the sigmas"
        print(f"{said} ({scaled})", file=sys.stderr)
    return counts


@dataclass(frozen=True, eq=False)
class _RecordedFrames:
    """The localized frames as they are in a run, with their images."""

    localization: SequenceLocalization
    run: Run
    """Has no frames."""
    folder: Path
    """Of the run."""

    def all(self) -> Iterator[FrameRecord]:
        """Localize all frames, in several processes if there are to be ``jobs``."""
        localization = self.localization
        if localization.jobs == 1 or localization.again is None:
            yield from map(self._with_images, localization)
            return
        localization.warmup(count_functions)  # once, and not in each process
        again = partial(_record_again, localization.again, self.run, self.folder)
        yield from localized_in_processes(again, len(localization.frames), localization.jobs)

    def warmup(self) -> None:
        self.localization.warmup()

    def localized(self, rows: range) -> Iterator[FrameRecord]:
        """Yield some of the frames, each on its own; their diagnoses are then known."""
        for record in map(self._with_images, self.localization.localized(rows)):
            frame_diagnosis(self.run, record)
            yield record

    def _with_images(self, record: FrameRecord) -> FrameRecord:
        return with_images(record, self.localization.source, self.run.info.images, self.folder)


def _record_again(
    again: Callable[[], SequenceLocalization], run: Run, folder: Path
) -> _RecordedFrames:
    return _RecordedFrames(again(), run, folder)


def _stored(options: LocalizeOptions) -> dict[str, Any]:
    """Return options as a run holds them; what earlier versions do not know, only if it is set."""
    later = {"rig", "fit_sigmas"}
    return {name: value for name, value in asdict(options).items() if value or name not in later}


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


def _sigma_options(localization: SequenceLocalization) -> dict[str, Any]:
    """Return by how much sigmas were scaled as options of a run."""
    return (
        {"sigma_scales": localization.noise.scales._asdict()}
        if localization.options.fit_sigmas
        else {}
    )
