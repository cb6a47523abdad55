"""The prior of a moment from measured fixes, headings and gravity, and the odometry to carry it.

A frame gets the newest measurement that had arrived by its time. One from earlier is carried to
the frame by odometry, or loses accuracy with the way driven since. A frame without a measurement
has no prior.

Odometry is a trajectory in any world, which may drift: only its steps count. Or it is speeds and
yaw rates, integrated as those of a body on level ground.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from semviz_core.base.frame import Frame, Odometry, OdometryNoise, Prior, check_sensor_sigma
from semviz_core.base.pose import Pose, heading_rad
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.measured_poses import (
    MeasuredPoses,
    Surroundings,
    poses_of_table,
    read_measured_poses,
    read_poses_or_table,
)
from semviz_core.datasets.own_drive.poses.conventions import body_axes
from semviz_core.datasets.own_drive.poses.sensor_table import SensorTable, read_table
from semviz_core.datasets.own_drive.recording import SAME_TIME_S, poses_at_times

TURN_RATE_RAD, TILT_RATE_RAD = float(np.deg2rad(10.0)), float(np.deg2rad(1.0))
"""Standard deviations of how fast a vehicle turns and tilts: an old heading or vertical is as
uncertain as that, without odometry."""
_LEVEL_CAMERA = np.array([0.0, -1.0, 0.0])
MotionBetween = Callable[[float, float], Odometry | None]
"""The motion of the camera from an earlier time (s) to a later one; None if unknown."""


@dataclass(frozen=True)
class PriorSigmas:
    """Standard deviations where a file has no column of them, and how old a fix may be."""

    horizontal_m: float = 5.5
    vertical_m: float = 0.3
    heading_rad: float = float(np.deg2rad(5.0))
    up_rad: float = float(np.deg2rad(0.5))
    most_age_s: float = 1.0

    def __post_init__(self) -> None:
        for name in ("horizontal_m", "vertical_m", "heading_rad", "up_rad"):
            check_sensor_sigma(getattr(self, name), f"priors: sigma {name}")
        if not 0.0 <= self.most_age_s < np.inf:
            raise SemvizError(f"priors: age {self.most_age_s:g} s: give 0 or more")


@dataclass(frozen=True, eq=False)
class MeasuredPriors:
    """The measurements of a file, ready for frames."""

    path: Path
    rows: tuple[Prior | None, ...]
    """(n,) None where there is no fix."""
    time_s: FloatArray | None
    """(n,) when they were measured; None if rows are those of frames."""
    arrived_s: FloatArray | None
    """(n,) when they were there."""
    by_frame: Mapping[int, int]
    """Row by the number of the frame, without times."""
    most_age_s: float
    ignored: tuple[str, ...]
    """Columns that are not read."""

    def prior_of(self, frame: Frame, motion: MotionBetween | None = None) -> Prior | None:
        """Return the prior of a frame, None without one; ``motion`` carries older ones."""
        if self.time_s is None or self.arrived_s is None:
            row = self.by_frame.get(frame.index)
            return None if row is None else self.rows[row]
        row = self._newest(frame.time_s)
        prior = None if row is None else self.rows[row]
        if row is None or prior is None:
            return None
        age_s = frame.time_s - float(self.time_s[row])
        if age_s <= SAME_TIME_S:
            return prior
        moved = None if motion is None else motion(float(self.time_s[row]), frame.time_s)
        return carried(prior, moved) if moved else aged(prior, age_s, self._speed(row))

    def _newest(self, moment_s: float) -> int | None:
        """Return the row measured last among those that had arrived, with a fix, not too old."""
        assert self.time_s is not None
        assert self.arrived_s is not None
        there = (self.arrived_s <= moment_s + SAME_TIME_S) & (
            self.time_s >= moment_s - self.most_age_s - SAME_TIME_S
        )
        usable = [row for row in np.flatnonzero(there).tolist() if self.rows[row] is not None]
        return usable[-1] if usable else None  # times ascend

    def _speed(self, row: int) -> float:
        """Return the speed (m/s) between a fix and the one before it."""
        assert self.time_s is not None
        here = self.rows[row]
        for other in (row - 1, row + 1):
            if not 0 <= other < len(self.rows) or here is None:
                continue
            there, apart_s = self.rows[other], abs(float(self.time_s[row] - self.time_s[other]))
            if there is not None and apart_s > 0.0:
                step_m = here.position_m[:2] - there.position_m[:2]
                return float(np.linalg.norm(step_m)) / apart_s
        return 0.0


def carried(prior: Prior, moved: Odometry) -> Prior:
    """Return the prior after a motion of the camera.

    Without a heading, the direction of the motion in the map is unknown: the position stays, and
    its sigma grows by the way.
    """
    R = moved.T_now_before.rotation
    variance = np.diag(moved.covariance)
    way_sigma_m, turn_sigma = np.sqrt(variance[:3].max()), np.sqrt(variance[3:].max())
    up_sigma = float(np.hypot(prior.up_sigma_rad, turn_sigma))
    up = None if prior.up_camera is None else R @ prior.up_camera
    if prior.heading_rad is None:
        way_m = float(np.linalg.norm(moved.T_now_before.translation))
        horizontal = float(np.hypot(prior.horizontal_sigma_m, way_m))
        return replace(prior, up_camera=up, up_sigma_rad=up_sigma, horizontal_sigma_m=horizontal)
    T_map_camera = _oriented(prior) @ moved.T_now_before.inverse()
    way_m = float(np.linalg.norm(T_map_camera.translation - prior.position_m))
    aside_m = way_m * prior.heading_sigma_rad
    return replace(
        prior,
        position_m=T_map_camera.translation,
        horizontal_sigma_m=float(
            np.sqrt(prior.horizontal_sigma_m**2 + way_sigma_m**2 + aside_m**2)
        ),
        up_camera=up,
        up_sigma_rad=up_sigma,
        heading_rad=heading_rad(T_map_camera),
        heading_sigma_rad=float(np.hypot(prior.heading_sigma_rad, turn_sigma)),
    )


def aged(prior: Prior, age_s: float, speed: float) -> Prior:
    """Return the prior ``age_s`` later, with larger sigmas; the motion since then is unknown."""
    return replace(
        prior,
        horizontal_sigma_m=float(np.hypot(prior.horizontal_sigma_m, speed * age_s)),
        up_sigma_rad=float(np.hypot(prior.up_sigma_rad, TILT_RATE_RAD * age_s)),
        heading_sigma_rad=float(np.hypot(prior.heading_sigma_rad, TURN_RATE_RAD * age_s)),
    )


def _oriented(prior: Prior) -> Pose:
    """Return T_map_camera at a prior with a heading; a camera without vertical looks level."""
    assert prior.heading_rad is not None
    up = _LEVEL_CAMERA if prior.up_camera is None else prior.up_camera
    ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up
    ahead /= np.linalg.norm(ahead)
    R_level_camera = np.array([ahead, np.cross(up, ahead), up])
    c, s = np.cos(prior.heading_rad), np.sin(prior.heading_rad)
    return Pose(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ R_level_camera,
                prior.position_m)  # fmt: skip


def read_priors(
    path: Path, around: Surroundings, sigmas: PriorSigmas, road_m: FloatArray
) -> MeasuredPriors:
    """Read priors from a table or a file of poses.

    ``road_m`` (k, 3) are camera centres of the mapping drive: a fix without height is as high as
    the nearest. Raise SemvizError if the file holds no fix.
    """
    measured = read_poses_or_table(path, around)
    if measured.table is not None:
        _check_positions(measured.table)
    rows = _priors(measured, sigmas, road_m)
    if all(row is None for row in rows):
        raise SemvizError(f"{path}: no line has a position; see docs/priors.md")
    arrived = measured.time_s
    if arrived is not None and measured.table is not None:
        received, latency = measured.table.columns("received", "latency").T
        arrived = np.where(np.isfinite(received), received, arrived + np.nan_to_num(latency))
    frames = () if measured.frame is None else measured.frame.tolist()
    return MeasuredPriors(
        path,
        rows,
        measured.time_s,
        arrived,
        {number: row for row, number in enumerate(frames)},
        sigmas.most_age_s,
        () if measured.table is None else measured.table.ignored,
    )


def _check_positions(table: SensorTable) -> None:
    if not (table.has("x", "y") or table.has("latitude", "longitude")):
        raise SemvizError(
            f"{table.path}: no columns x_m and y_m, or latitude and longitude; see docs/priors.md"
        )
    if not (table.has("time") or table.has("frame") or table.names is not None):
        raise SemvizError(f"{table.path}: no column time_s, frame or name; add one")


def _priors(
    measured: MeasuredPoses, sigmas: PriorSigmas, road_m: FloatArray
) -> tuple[Prior | None, ...]:
    """Return the prior of each row."""
    count = len(measured.position_m)
    stated = _stated_sigmas(measured.table, count, sigmas)
    up = _up_camera(measured)
    turned = measured.has_heading
    priors: list[Prior | None] = []
    for row, position in enumerate(measured.position_m):
        if not np.isfinite(position[:2]).all():
            priors.append(None)
            continue
        horizontal, vertical, heading, tilt = stated[row].tolist()
        rotation = Pose(measured.R_map_camera[row], np.zeros(3)) if turned[row] else None
        priors.append(
            Prior(
                _with_height(measured.path, position, road_m),
                horizontal,
                vertical,
                up[row] if np.isfinite(up[row]).all() else None,
                tilt,
                None if rotation is None else heading_rad(rotation),
                heading,
            )
        )
    return tuple(priors)


def _stated_sigmas(table: SensorTable | None, count: int, sigmas: PriorSigmas) -> FloatArray:
    """Return (n, 4) sigmas: horizontal, vertical, heading, vertical direction."""
    assumed = [sigmas.horizontal_m, sigmas.vertical_m, sigmas.heading_rad, sigmas.up_rad]
    if table is None:
        return np.tile(assumed, (count, 1))
    names = "horizontal_sigma", "vertical_sigma", "heading_sigma", "up_sigma"
    stated = table.columns(*names)
    return np.where(np.isfinite(stated), stated, assumed)


def _up_camera(measured: MeasuredPoses) -> FloatArray:
    """Return (n, 3) the map's z axis in camera coordinates, NaN where it was not measured."""
    up = np.where(measured.has_up[:, None], measured.R_map_camera[:, 2], np.nan)
    if measured.table is not None and measured.table.has("up_x", "up_y", "up_z"):
        given = measured.table.columns("up_x", "up_y", "up_z")
        length = np.linalg.norm(given, axis=1, keepdims=True)
        wrong = np.flatnonzero(np.abs(length[:, 0] - 1.0) > 0.05)
        if len(wrong):
            raise SemvizError(
                f"{measured.path}, row {wrong[0] + 1}: up_x, up_y, up_z have length "
                f"{length[wrong[0], 0]:.2f}, not 1: give a direction in the camera's axes"
            )
        up = np.where(np.isfinite(given).all(axis=1, keepdims=True), given / length, up)
    return np.asarray(up)


def _with_height(path: Path, position_m: FloatArray, road_m: FloatArray) -> FloatArray:
    """Return the position; a height that is not known is that of the nearest point of the road."""
    if np.isfinite(position_m[2]):
        return position_m
    if not len(road_m):
        raise SemvizError(f"{path}: has no heights, and the map no road; add a column of heights")
    apart = np.linalg.norm(road_m[:, :2] - position_m[:2], axis=1)
    return np.append(position_m[:2], road_m[int(apart.argmin()), 2])


@dataclass(frozen=True, eq=False)
class MeasuredOdometry:
    """A trajectory of the left camera in a world of its own."""

    path: Path
    T_world_camera: tuple[Pose, ...]
    """(n,)"""
    time_s: FloatArray | None
    """(n,) ascending; None if rows are those of frames."""
    by_frame: Mapping[int, int]
    """Row by the number of the frame, without times."""
    variance: FloatArray | None
    """(n, 2) sums of the variances (m2, rad2) of all steps up to each row; None without columns."""
    noise: OdometryNoise
    """Where the file states no sigmas."""
    most_gap_s: float
    """A motion between rows farther apart is not known."""

    def of_step(self, before: Frame, now: Frame) -> Odometry | None:
        """Return the motion of the camera between two frames; None where the file has none."""
        if self.time_s is not None:
            return self.between(before.time_s, now.time_s)
        rows = [self.by_frame.get(frame.index) for frame in (before, now)]
        if rows[0] is None or rows[1] is None:
            return None
        T_before, T_now = (self.T_world_camera[row] for row in rows if row is not None)
        sums = None if self.variance is None else self.variance[[rows[0], rows[1]]]
        return self._step(T_before, T_now, sums)

    def between(self, before_s: float, now_s: float) -> Odometry | None:
        """Return the motion of the camera between two times; None where the file has none."""
        if self.time_s is None:
            return None
        moments = np.array([before_s, now_s])
        T_before, T_now = poses_at_times(self.T_world_camera, self.time_s, moments, self.most_gap_s)
        if T_before is None or T_now is None or self._has_gap(before_s, now_s):
            return None
        sums = None
        if self.variance is not None:
            sums = np.column_stack(
                [np.interp(moments, self.time_s, column) for column in self.variance.T]
            )
        return self._step(T_before, T_now, sums)

    def _has_gap(self, before_s: float, now_s: float) -> bool:
        assert self.time_s is not None
        inside = self.time_s[(self.time_s > before_s) & (self.time_s < now_s)]
        return bool((np.diff(inside) > self.most_gap_s).any())

    def _step(self, T_before: Pose, T_now: Pose, sums: FloatArray | None) -> Odometry:
        T_now_before = T_now.inverse() @ T_before
        if sums is None:
            return self.noise.measured(T_now_before)
        variance = np.maximum(sums[1] - sums[0], [self.noise.rest_m**2, 1e-12])
        return Odometry(T_now_before, np.diag(np.repeat(variance, 3)))


def read_odometry(
    path: Path, around: Surroundings, noise: OdometryNoise, most_gap_s: float
) -> MeasuredOdometry:
    """Read odometry from a table or a file of poses. Raise SemvizError if it holds none."""
    if not path.exists():
        raise SemvizError(f"{path}: no such file of odometry; name another with --odometry")
    if not 0.0 < most_gap_s < np.inf:
        raise SemvizError(f"--most-gap {most_gap_s:g}: give seconds above 0")
    own_world = replace(around, T_map_world=Pose.identity(), T_map_ecef=Pose.identity())
    table = None if path.is_dir() else read_table(path)
    if table is not None and table.has("time", "speed", "yaw_rate"):
        return _of_speeds(table, around, noise, most_gap_s)
    if table is None:
        measured = read_measured_poses(path, own_world)
    else:
        _check_columns(table)
        measured = poses_of_table(table, own_world)
    poses = measured.poses()
    rows = [row for row, pose in enumerate(poses) if pose is not None]
    if len(rows) < 2:
        raise SemvizError(f"{path}: fewer than two lines hold a whole pose; see docs/priors.md")
    frames = [] if measured.frame is None else measured.frame[rows].tolist()
    return MeasuredOdometry(
        path,
        tuple(pose for pose in poses if pose is not None),
        None if measured.time_s is None else measured.time_s[rows],
        {number: row for row, number in enumerate(frames)},
        None if measured.table is None else _summed(measured.table.rows(rows)),
        noise,
        most_gap_s,
    )


def _check_columns(table: SensorTable) -> None:
    turned = table.has("qx", "qy", "qz", "qw") or table.has("heading")
    if not (table.has("x", "y", "z") and turned):
        raise SemvizError(
            f"{table.path}: neither speed_mps and yaw_rate_degps, nor a trajectory (x_m, y_m, z_m "
            "with qx, qy, qz, qw); see docs/priors.md"
        )
    if not (table.has("time") or table.has("frame") or table.names is not None):
        raise SemvizError(f"{table.path}: no column time_s, frame or name; add one")


def _of_speeds(
    table: SensorTable, around: Surroundings, noise: OdometryNoise, most_gap_s: float
) -> MeasuredOdometry:
    """Integrate speeds and yaw rates of a body: constant between rows, at their mean."""
    speed, rate = table.columns("speed", "yaw_rate").T
    rows = np.flatnonzero(np.isfinite(speed) & np.isfinite(rate))
    rows = rows[np.argsort(table.values["time"][rows], kind="stable")]
    if len(rows) < 2:
        raise SemvizError(f"{table.path}: fewer than two lines hold a speed and a yaw rate")
    time_s = table.values["time"][rows]
    step_s = np.diff(time_s)
    turn = 0.5 * (rate[rows][1:] + rate[rows][:-1]) * step_s
    way_m = 0.5 * (speed[rows][1:] + speed[rows][:-1]) * step_s
    yaw = np.append(0.0, np.cumsum(turn))
    middle = yaw[:-1] + 0.5 * turn  # a chord of the arc
    x = np.append(0.0, np.cumsum(way_m * np.cos(middle)))
    y = np.append(0.0, np.cumsum(way_m * np.sin(middle)))
    R = body_axes(yaw, np.zeros_like(yaw), np.zeros_like(yaw))
    T_body_camera = around.extrinsic(of_body=True)
    T = (Pose(R[k], np.array([x[k], y[k], 0.0])) @ T_body_camera for k in range(len(rows)))
    sums = _summed(table.rows(rows.tolist()))
    return MeasuredOdometry(table.path, tuple(T), time_s, {}, sums, noise, most_gap_s)


def _summed(table: SensorTable) -> FloatArray | None:
    """Return the sums of the stated variances (n, 2); None if not all are stated."""
    sigmas = table.columns("translation_sigma", "rotation_sigma")
    return np.cumsum(sigmas**2, axis=0) if np.isfinite(sigmas).all() else None
