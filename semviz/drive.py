"""Localize a sequence, frame by frame: observe, know beforehand, crop, localize, record."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from semviz import follow
from semviz.observing import (
    Noise,
    Observations,
    Observe,
    detected,
    detector_model,
    observe_detected,
    observe_labels,
    observe_simulated,
)
from semviz.progress import tell_of_compiling, track
from semviz.recording.pictures import check_offered, with_pictures
from semviz.recording.run import FrameRecord, Images, RunInfo
from semviz.recording.writer import write_run
from semviz.workspace import Workspace
from semviz_annotation.looked import Looked
from semviz_core.elements import Elements2D
from semviz_core.errors import SemvizError
from semviz_core.frame import Frame, Prior
from semviz_core.localization import Localization
from semviz_core.localize import Localizer
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.priors import PriorOptions, simulate_prior
from semviz_core.sources.source import Source

Know = Callable[[Frame], Prior]
"""What is known of a frame's pose beforehand."""
CROP_RADIUS_M: dict[Observations, float] = {"labels": 120.0, "detected": 120.0, "simulated": 50.0}
"""The simulated detector sees 40 m far; people and detectors, as far as things are large enough."""
ROAD_RADIUS_M = 60.0
"""Of the road round the fix that the prior holds."""


@dataclass(frozen=True)
class DriveOptions:
    """Settings of a drive; they are stored in its run."""

    method: str = "search"
    weights: str | None = None
    """File of what a learned method has learned; what comes with semviz if none."""
    track: bool = False
    """Follow the camera from frame to frame; ``method`` is then for frames by themselves."""
    observations: Observations = "labels"
    noise: Noise = "low"
    """Of the simulated detector."""
    least_score: float = 0.0
    """What is detected with less is not seen."""
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
class Drive:
    """One pass over a sequence; iterate for the records, which have no images yet."""

    source: Source
    semantic_map: SemanticMap
    frames: tuple[Frame, ...]
    observe: Observe
    know: Know
    localizer: Localizer
    options: DriveOptions
    looked: Looked | None = None
    """Which detector's finds are observed, where they are."""

    def __post_init__(self) -> None:
        check_same_frame(self.semantic_map, self.source)
        if not len(self.semantic_map):
            raise SemvizError("the map is empty: label some poles and signs, then 'map build'")

    def __iter__(self) -> Iterator[FrameRecord]:
        localize = self._follower().localize if self.options.track else self._localize
        for frame in self.frames:
            observed, element_id = self.observe(frame)
            result = localize(frame, observed, self._prior(frame))
            yield FrameRecord(frame, result, element_id)

    def _prior(self, frame: Frame) -> Prior:
        """What is known, with the road of the map round the fix."""
        known = self.know(frame)
        road_m = self.semantic_map.road_near(known.position_m, ROAD_RADIUS_M)
        return replace(known, road_m=road_m)

    def _localize(self, frame: Frame, observed: Elements2D, prior: Prior) -> Localization:
        """The frame by itself."""
        submap = self.semantic_map.crop(prior.position_m, self.options.crop_radius_m)
        return self.localizer.localize(observed, submap, self.source.rig.left, prior)

    def _follower(self) -> follow.Follower:
        options, camera = self.options, self.source.rig.left
        return follow.Follower(
            camera, self.semantic_map, self.localizer, options.crop_radius_m, options.seed
        )


def check_same_frame(semantic_map: SemanticMap, source: Source) -> None:
    """SemvizError where a map and the poses of a sequence have different coordinates."""
    have, want = semantic_map.frame.name, source.map_frame.name
    if have != want:
        raise SemvizError(
            f"the map is in frame '{have}', the sequence in '{want}': "
            "build a map from this sequence, or choose another with --map"
        )


def chosen_frames(source: Source, numbers: range | None) -> tuple[Frame, ...]:
    """The frames of a sequence in ``numbers``, all for None; SemvizError where that leaves none."""
    chosen = tuple(one for one in source.frames if numbers is None or one.index in numbers)
    if not chosen:
        raise SemvizError("no frames are left: --frames names none that the sequence has")
    return chosen


def drive_workspace(
    workspace: Workspace, map_name: str, options: DriveOptions, frames: range | None = None
) -> Drive:
    """The drive through a workspace's frames (those in ``frames``), in its map ``map_name``."""
    source = workspace.source
    semantic_map = workspace.read_map(map_name)
    detector = detector_model(options.observations)
    localizer = Localizer(
        options.method, options.seed, semantic_map.classes, detector, options.weights_path
    )
    chosen = chosen_frames(source, frames)
    looked: Looked | None = None
    if options.observations == "labels":
        observe = observe_labels(workspace, semantic_map)
    elif options.observations == "detected":
        found = detected(workspace, chosen)
        observe = observe_detected(workspace, semantic_map, found, options.least_score)
        looked = found.looked
    else:
        observe = observe_simulated(workspace, options.noise, options.seed)
    know = simulated_prior(options)
    return Drive(source, semantic_map, chosen, observe, know, localizer, options, looked)


def prior_options(options: DriveOptions) -> PriorOptions:
    """How good the simulated GPS and compass are."""
    heading_deg = options.heading_sigma_deg
    return PriorOptions(
        distance_m=options.prior_distance_m,
        heading_sigma_rad=None if heading_deg is None else float(np.deg2rad(heading_deg)),
    )


def simulated_prior(options: DriveOptions) -> Know:
    """A GPS fix that is off by a known distance, gravity, and perhaps a compass."""
    known = prior_options(options)

    def know(frame: Frame) -> Prior:
        if frame.T_map_camera is None:
            raise SemvizError(f"frame {frame.index} has no pose to simulate a GPS fix from")
        return simulate_prior(frame.T_map_camera, known, (options.seed, frame.index))

    return know


def record(
    drive: Drive, path: Path, *, workspace: str, map_name: str, images: Images = "embedded"
) -> Counter[str]:
    """Write the run to ``path`` with a progress bar, as ``write_run`` does."""
    if path.suffix != ".rrd":
        raise SemvizError(f"{path}: name a file that ends in .rrd, such as runs/first.rrd")
    check_offered(drive.source, images)
    tell_of_compiling()
    options = drive.options
    info = RunInfo(
        name=path.stem,
        workspace=workspace,
        method=follow.METHOD if options.track else options.method,
        seed=options.seed,
        version=version("semviz"),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        rig=drive.source.rig,
        map_name=map_name,
        observations=_observations(options, drive.looked),
        options=asdict(options) | _detector(drive.looked),
        images=images,
    )
    records = track(drive, "localizing", len(drive.frames))
    pictured = (with_pictures(one, drive.source, images, path.parent) for one in records)
    return write_run(pictured, path, info, drive.semantic_map)


def _observations(options: DriveOptions, looked: Looked | None) -> str:
    """As ``RunInfo.observations`` tells them."""
    if options.observations == "labels":
        return "labels"
    if options.observations == "simulated":
        return f"simulated detector, noise {options.noise}"
    return "detected elsewhere" if looked is None else f"detected by {looked.detector}"


def _detector(looked: Looked | None) -> dict[str, Any]:
    """What made the detections, as options of a run."""
    if looked is None:
        return {}
    settings = {f"detector_{name}": value for name, value in looked.settings.items()}
    return {"detector": looked.detector} | settings
