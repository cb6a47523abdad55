"""Errors of estimated poses, and their summary over a run.

RTE is the distance between camera centres (m), RRE the angle between rotations (deg). Shares
refer to all frames with ground truth, with or without a pose. ``Outcome`` holds one evaluated
frame, for benchmark and reports.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import RANGE_M
from semviz_core.base.elements import Elements3D
from semviz_core.base.localization import Localization, Status
from semviz_core.base.pose import Pose, angle_between
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError

STATUSES: tuple[Status, ...] = ("ok", "ambiguous", "cannot")
MAX_NEES = float(chdtri(6, 0.001))
"""Squared Mahalanobis length of the 99.9 % ellipsoid of a pose."""
WRONG_M = 1.0
WRONG_DEG = 1.0


@dataclass(frozen=True)
class Spread:
    """Mean and quartiles; None without values."""

    mean: float | None
    q1: float | None
    q2: float | None
    q3: float | None

    @classmethod
    def of(cls, values: FloatArray) -> "Spread":
        if not len(values):
            return cls(None, None, None, None)
        q1, q2, q3 = np.percentile(values, [25.0, 50.0, 75.0])
        return cls(float(np.mean(values)), float(q1), float(q2), float(q3))


@dataclass(frozen=True)
class PoseAccuracy:
    """Errors of frames with a pose and ground truth, and shares of all frames with ground truth.

    In the shares, a frame without a pose counts as a failure; in the errors it does not count.
    """

    frames: int
    rte_m: Spread
    rre_deg: Spread
    share_below_1m: float | None
    """None without ground truth."""
    share_below_1deg: float | None

    @classmethod
    def of(
        cls, rte_m: FloatArray, rre_deg: FloatArray, with_truth: int, frames: int
    ) -> "PoseAccuracy":
        below_m = float((rte_m < 1.0).sum()) / with_truth if with_truth else None
        below_deg = float((rre_deg < 1.0).sum()) / with_truth if with_truth else None
        return cls(frames, Spread.of(rte_m), Spread.of(rre_deg), below_m, below_deg)


@dataclass(frozen=True)
class Summary:
    """Errors, shares and times of a run; see ``PoseAccuracy``."""

    accuracy: PoseAccuracy
    """Over all frames."""
    by_status: dict[Status, PoseAccuracy]
    time_ms_median: float | None
    time_ms_p95: float | None

    def as_json(self) -> dict[str, Any]:
        """Return the object that ``semviz evaluate --json`` prints, without the run's name."""
        values = asdict(self.accuracy)
        return {
            "frames": values.pop("frames"),
            "status": {status: self.by_status[status].frames for status in STATUSES},
            **values,
            "time_ms": {"median": self.time_ms_median, "p95": self.time_ms_p95},
            "by_status": {status: asdict(self.by_status[status]) for status in STATUSES},
        }

    def rows(self) -> list[dict[str, str | int | float | None]]:
        """Return one flat row for all frames and one for each status, for tables and CSV."""
        named = [("all", self.accuracy), *((status, self.by_status[status]) for status in STATUSES)]
        return [_flat(name, accuracy) for name, accuracy in named]

    def as_text(self) -> str:
        """Return an aligned table; shares are of all frames with a true pose."""
        lines = [_HEADER]
        lines += [_text_row(row) for row in self.rows()]
        if self.time_ms_median is not None and self.time_ms_p95 is not None:
            lines.append(
                f"time per frame: median {self.time_ms_median:.0f} ms, "
                f"p95 {self.time_ms_p95:.0f} ms"
            )
        return "\n".join(lines)


@dataclass(frozen=True)
class ProblemFacts:
    """Properties of a frame, and a lower bound of its pose error."""

    detections: int
    true_matches: int | None = None
    """None in sequences, where they are not counted."""
    recall: float | None = None
    """Share of the visible mapped elements that were detected; None if none is visible."""
    bound_m: float | None = None
    """Median error of the camera centre of an efficient estimator with the method's input; None if
    the pose is not determined, or the noise differs from the stated one."""
    bound_rms_m: float | None = None
    """Root mean square error of the same estimator."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of one method on one frame. Errors are None without a pose."""

    suite: str
    method: str
    noise: str
    frame: int
    """The problem's seed; in a sequence, the first frame's seed plus the number of frames since."""
    facts: ProblemFacts
    status: Status
    rte_m: float | None
    rre_deg: float | None
    nees: float | None
    """Normalized estimation error squared (mean 6 if the covariance is correct); None without a
    covariance."""
    total_ms: float
    """Wall time of the whole frame."""
    stages_ms: dict[str, float] = field(default_factory=dict)
    first_call_ms: float | None = None
    """Time of the first call in the process, on another frame; it compiles and loads."""
    timed_alone: bool = True
    """False if other processes of the benchmark ran at the same time."""
    translation_m: float | None = None
    """As DeepI2P measures: the distance of the translations of T_camera_map, about the fix."""
    euler_deg: float | None = None
    """As DeepI2P measures: the sum of the absolute Euler angles between both rotations."""

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Outcome":
        return cls(**{**values, "facts": ProblemFacts(**values["facts"])})

    @property
    def succeeded(self) -> bool:
        """Below 1 m and 1 deg."""
        if self.rte_m is None or self.rre_deg is None:
            return False
        return self.rte_m < WRONG_M and self.rre_deg < WRONG_DEG

    @property
    def confidently_wrong(self) -> bool:
        """Status ``ok``, but 1 m or 1 deg or more off, and outside its own 99.9 % ellipsoid."""
        outside = self.nees is None or self.nees > MAX_NEES
        return self.status == "ok" and not self.succeeded and outside


def pose_error(T_est_camera_map: Pose, T_true_camera_map: Pose) -> tuple[float, float]:
    """Return RTE, the distance of the camera centres (m), and RRE, the rotations' angle (deg)."""
    centers = [pose.inverse().translation for pose in (T_est_camera_map, T_true_camera_map)]
    angle = angle_between(T_est_camera_map.rotation, T_true_camera_map.rotation)
    return float(np.linalg.norm(centers[0] - centers[1])), float(np.rad2deg(angle))


def published_error(
    T_est_camera_map: Pose, T_true_camera_map: Pose, origin_m: FloatArray
) -> tuple[float, float]:
    """Return the errors by the published code of DeepI2P, with the map's origin at ``origin_m``.

    They are no smaller than those of ``pose_error`` where the rotation is wrong: translations then
    differ although the camera is in its place.
    """
    both = T_est_camera_map, T_true_camera_map
    estimated, true = (pose.apply(origin_m) for pose in both)
    turn = T_est_camera_map.rotation.T @ T_true_camera_map.rotation
    angles = Rotation.from_matrix(turn).as_euler("xzy", degrees=True)
    return float(np.linalg.norm(estimated - true)), float(np.abs(angles).sum())


def visible_rows(submap: Elements3D, T_camera_map: Pose, camera: Camera) -> IntArray:
    """Return the rows of the submap that a perfect detector finds: in range and in the image."""
    end_m = np.where(submap.is_line[:, None], submap.end_m, submap.anchor_m)
    anchor_c, end_c = T_camera_map.apply(submap.anchor_m), T_camera_map.apply(end_m)
    anchor_px, end_px = camera.project(anchor_c), camera.project(end_c)
    highest, lowest = np.minimum(anchor_px, end_px), np.maximum(anchor_px, end_px)
    inside = (highest[:, 0] >= 0.0) & (lowest[:, 0] < camera.width)
    inside &= (lowest[:, 1] >= 0.0) & (highest[:, 1] < camera.height)
    in_range = (anchor_c[:, 2] > RANGE_M[0]) & (anchor_c[:, 2] < RANGE_M[1])
    return np.flatnonzero(inside & in_range)


class FrameFigures(NamedTuple):
    """What is summarized of n frames."""

    status: NDArray[np.str_]
    """(n,)"""
    errors: FloatArray
    """(n, 2) metres and degrees; NaN without a pose or a true one."""
    has_truth: BoolArray
    """(n,) whether the true pose is known."""
    time_ms: FloatArray
    """(n,) NaN if it was not measured."""

    def summary(self) -> Summary:
        """Return errors, shares and times over all frames, and by status."""

        def accuracy(rows: BoolArray) -> PoseAccuracy:
            rte_m, rre_deg = self.errors[rows & np.isfinite(self.errors[:, 0])].T
            with_truth = int((rows & self.has_truth).sum())
            return PoseAccuracy.of(rte_m, rre_deg, with_truth, int(rows.sum()))

        times = self.time_ms[np.isfinite(self.time_ms)]
        return Summary(
            accuracy=accuracy(np.ones(len(self.status), dtype=bool)),
            by_status={name: accuracy(self.status == name) for name in STATUSES},
            time_ms_median=float(np.median(times)) if len(times) else None,
            time_ms_p95=float(np.percentile(times, 95)) if len(times) else None,
        )


def _figures(result: Localization, true: Pose | None) -> tuple[str, float, float, bool, float]:
    estimate = result.T_camera_map
    errors = (np.nan, np.nan) if estimate is None or true is None else pose_error(estimate, true)
    time_ms = sum(result.time_ms.values()) if result.time_ms else np.nan
    return result.status, *errors, true is not None, time_ms


def summarize(localizations: Iterable[Localization], truths: Iterable[Pose | None]) -> Summary:
    """Summarize a run; ``truths`` holds each frame's true T_camera_map, None if unknown.

    Both are gone through once, together: frames of a long run need not be in memory.
    """
    try:
        frames = [_figures(*pair) for pair in zip(localizations, truths, strict=True)]
    except ValueError:
        raise SemvizError("not as many true poses as localizations; give one for each") from None
    return FrameFigures(
        np.array([frame[0] for frame in frames], dtype=np.str_),
        np.array([frame[1:3] for frame in frames]).reshape(-1, 2),
        np.array([frame[3] for frame in frames], dtype=bool),
        np.array([frame[4] for frame in frames], dtype=np.float64),
    ).summary()


_HEADER = (
    f"{'status':<10}{'frames':>7} | {'RTE m mean':>10}{'q1':>7}{'q2':>7}{'q3':>7}{'<1 m':>7} | "
    f"{'RRE deg mean':>12}{'q1':>7}{'q2':>7}{'q3':>7}{'<1 deg':>8}"
)


def _flat(name: str, accuracy: PoseAccuracy) -> dict[str, str | int | float | None]:
    flat: dict[str, str | int | float | None] = {"status": name, "frames": accuracy.frames}
    flat |= {f"rte_m_{key}": value for key, value in asdict(accuracy.rte_m).items()}
    flat["share_below_1m"] = accuracy.share_below_1m
    flat |= {f"rre_deg_{key}": value for key, value in asdict(accuracy.rre_deg).items()}
    flat["share_below_1deg"] = accuracy.share_below_1deg
    return flat


def _text_row(row: dict[str, str | int | float | None]) -> str:
    def number(key: str, width: int) -> str:
        value = row[key]
        return f"{'-' if value is None else format(value, '.3f'):>{width}}"

    def share(key: str, width: int) -> str:
        value = row[key]
        return f"{'-' if value is None else format(value, '.1%'):>{width}}"

    quartiles = ("q1", "q2", "q3")
    return (
        f"{row['status']:<10}{row['frames']:>7} | {number('rte_m_mean', 10)}"
        + "".join(number(f"rte_m_{q}", 7) for q in quartiles)
        + f"{share('share_below_1m', 7)} | {number('rre_deg_mean', 12)}"
        + "".join(number(f"rre_deg_{q}", 7) for q in quartiles)
        + share("share_below_1deg", 8)
    )
