"""The motion between two moments, from a trajectory of visual odometry or from wheel speeds.

A trajectory may be in any world and may drift: only its steps count. Speeds and yaw rates are
integrated as those of a body on level ground.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from semviz_core.base.frame import Frame, Odometry, OdometryNoise
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.measured.poses_of import (
    Surroundings,
    poses_of_table,
    read_measured_poses,
)
from semviz_core.datasets.measured.table import SensorTable, read_table
from semviz_core.datasets.own_drive.pose_files import body_axes
from semviz_core.datasets.own_drive.recording import poses_at_times


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
