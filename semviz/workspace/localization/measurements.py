"""Priors and odometry from files, for the frames of a workspace.

Files are in the coordinates of the poses that the workspace was made with. For KITTI's sequences
and simulated streets these are the map's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from semviz.workspace.drive.drive_file import DRIVE_FILE, read_drive_file
from semviz.workspace.settings import ImagesSettings
from semviz.workspace.workspace import Workspace
from semviz_annotation.map_formats.georeference import Georeference
from semviz_core.base.frame import FileDataset, Frame, Odometry, OdometryNoise, Prior
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.datasets import measured_priors
from semviz_core.datasets.measured_poses import Surroundings
from semviz_core.datasets.own_drive.poses.conventions import (
    NAMED_EXTRINSICS,
    map_on_earth,
    read_matrix,
)

Coordinates = Literal["recorded", "map"]
FAR_M = 2000.0
"""Priors farther from the map's elements are in other coordinates."""


@dataclass(frozen=True)
class MeasurementFiles:
    """Files of priors and odometry, and what they do not say themselves."""

    priors: Path | None = None
    odometry: Path | None = None
    sigmas: measured_priors.PriorSigmas = field(default_factory=measured_priors.PriorSigmas)
    noise: OdometryNoise = field(default_factory=OdometryNoise)
    most_gap_s: float = 0.25
    coordinates: Coordinates = "recorded"
    extrinsic: str | None = None
    """T_body_camera: a name or a file, as in ``semviz new --extrinsic``."""
    anchor: Georeference | None = None
    """Where the map is on Earth; None: as the map says."""

    def read(self, workspace: Workspace, semantic_map: SemanticMap) -> "Measurements":
        """Read the files. Raise SemvizError if one is wrong."""
        around = self.around(workspace, semantic_map)
        road_m = semantic_map.trajectory_m
        return Measurements(
            None
            if self.priors is None
            else measured_priors.read_priors(self.priors, around, self.sigmas, road_m),
            None
            if self.odometry is None
            else measured_priors.read_odometry(self.odometry, around, self.noise, self.most_gap_s),
        )

    def around(self, workspace: Workspace, semantic_map: SemanticMap) -> Surroundings:
        T_map_world: Pose | None = Pose.identity()
        if self.coordinates == "recorded" and isinstance(workspace.settings.source, ImagesSettings):
            T_map_world = read_drive_file(workspace.path / DRIVE_FILE).world
        anchor = self.anchor or Georeference.of(semantic_map.frame)
        T_map_ecef = None
        if anchor is not None:
            T_map_ecef = map_on_earth(anchor.origin, anchor.x_heading_deg)
        return Surroundings(T_map_world, T_map_ecef, self._extrinsic(), _images(workspace))

    def _extrinsic(self) -> Pose | None:
        if self.extrinsic is None:
            return None
        if self.extrinsic in NAMED_EXTRINSICS:
            return NAMED_EXTRINSICS[self.extrinsic]
        return read_matrix(Path(self.extrinsic))


def _images(workspace: Workspace) -> dict[int, Path]:
    source = workspace.source
    if not isinstance(source, FileDataset):
        return {}
    return {frame.index: source.original_path(frame.index, "left") for frame in source.frames}


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measured priors and odometry; None for what is simulated."""

    priors: measured_priors.MeasuredPriors | None = None
    odometry: measured_priors.MeasuredOdometry | None = None

    @property
    def is_any(self) -> bool:
        """Whether anything is measured: then no odometry is simulated."""
        return self.priors is not None or self.odometry is not None

    def prior_of(self, frame: Frame) -> Prior | None:
        """Return the measured prior of a frame, carried there by the odometry."""
        if self.priors is None:
            return None
        motion = None if self.odometry is None else self.odometry.between
        return self.priors.prior_of(frame, motion)

    def odometry_of(self, before: Frame, now: Frame) -> Odometry | None:
        """Return the measured motion between two frames."""
        return None if self.odometry is None else self.odometry.of_step(before, now)

    def check(self, semantic_map: SemanticMap, frames: Sequence[Frame]) -> None:
        """Raise SemvizError if no frame has a prior or a motion, or the priors are far away."""
        if self.priors is not None:
            _check_priors(self.priors, [self.prior_of(frame) for frame in frames], semantic_map)
            if all(self.prior_of(frame) is None for frame in frames):
                raise SemvizError(_no_times(self.priors, "prior", frames))
        if self.odometry is None or len(frames) < 2:
            return
        if all(self.odometry_of(*step) is None for step in pairwise(frames)):
            raise SemvizError(_no_times(self.odometry, "motion", frames))

    def notes(self, frames: Sequence[Frame]) -> list[str]:
        """Return what the files hold for the frames, a line each, for people."""
        notes = []
        if self.priors is not None:
            priors = [prior for frame in frames if (prior := self.prior_of(frame)) is not None]
            heading = sum(prior.heading_rad is not None for prior in priors)
            gravity = sum(prior.up_camera is not None for prior in priors)
            notes.append(
                f"{self.priors.path}: {len(priors)} of {len(frames)} frames have a prior, "
                f"{heading} with heading, {gravity} with gravity"
            )
            if self.priors.ignored:
                notes.append(f"{self.priors.path}: not read: {', '.join(self.priors.ignored)}")
        if self.odometry is not None:
            known = sum(self.odometry_of(*step) is not None for step in pairwise(frames))
            notes.append(f"{self.odometry.path}: {known} of {len(frames) - 1} motions are known")
        return notes


def _check_priors(
    measured: measured_priors.MeasuredPriors,
    priors: Sequence[Prior | None],
    semantic_map: SemanticMap,
) -> None:
    fixes = [prior.position_m[:2] for prior in priors if prior is not None]
    if not fixes or not len(semantic_map):
        return
    anchors = semantic_map.elements.anchor_m[:, :2]
    apart_m = float(min(np.linalg.norm(anchors - fix, axis=1).min() for fix in fixes))
    if apart_m > FAR_M:
        raise SemvizError(
            f"{measured.path}: the nearest fix is {apart_m / 1000:.0f} km from the map: other "
            "coordinates? Try --coordinates map or recorded, or check --anchor"
        )


def _no_times(
    measured: measured_priors.MeasuredPriors | measured_priors.MeasuredOdometry,
    what: str,
    frames: Sequence[Frame],
) -> str:
    """Say that a file has nothing for any frame, and why if it has times."""
    text, time_s = f"{measured.path}: no {what} for any frame", measured.time_s
    if time_s is not None:
        text += (
            f": its times are {time_s.min():.3f} to {time_s.max():.3f} s, the frames' "
            f"{frames[0].time_s:.3f} to {frames[-1].time_s:.3f} s; another clock or unit, or too "
            "far apart (--most-age, --most-gap)?"
        )
    return text
