"""How far poses are off, and what that adds up to over a run."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.errors import SemvizError
from semviz_core.localization import Localization, Status
from semviz_core.pose import Pose, angle_between

STATUSES: tuple[Status, ...] = ("ok", "ambiguous", "cannot")


@dataclass(frozen=True)
class Spread:
    """Mean and quartiles; None where there is nothing to summarize."""

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
class Accuracy:
    """Errors of the frames that have a pose and a true one, and shares of ALL frames with truth.

    A frame without a pose counts as not below 1 m in the shares, and not at all in the errors.
    """

    frames: int
    rte_m: Spread
    rre_deg: Spread
    share_below_1m: float | None
    """None without truth."""
    share_below_1deg: float | None

    @classmethod
    def of(cls, rte_m: FloatArray, rre_deg: FloatArray, with_truth: int, frames: int) -> "Accuracy":
        below_m = float((rte_m < 1.0).sum()) / with_truth if with_truth else None
        below_deg = float((rre_deg < 1.0).sum()) / with_truth if with_truth else None
        return cls(frames, Spread.of(rte_m), Spread.of(rre_deg), below_m, below_deg)


@dataclass(frozen=True)
class Summary:
    """A run in numbers. Errors and shares as in ``Accuracy``."""

    accuracy: Accuracy
    """Over all frames."""
    by_status: dict[Status, Accuracy]
    time_ms_median: float | None
    time_ms_p95: float | None

    def as_json(self) -> dict[str, Any]:
        """The object that ``semviz evaluate --json`` prints, but for the run's name."""
        values = asdict(self.accuracy)
        return {
            "frames": values.pop("frames"),
            "status": {status: self.by_status[status].frames for status in STATUSES},
            **values,
            "time_ms": {"median": self.time_ms_median, "p95": self.time_ms_p95},
            "by_status": {status: asdict(self.by_status[status]) for status in STATUSES},
        }

    def rows(self) -> list[dict[str, str | int | float | None]]:
        """One flat row for all frames and one for each status: for tables and CSV."""
        named = [("all", self.accuracy), *((one, self.by_status[one]) for one in STATUSES)]
        return [_flat(name, accuracy) for name, accuracy in named]

    def as_text(self) -> str:
        """An aligned table for people; shares are of all frames with a true pose."""
        lines = [_HEADER]
        lines += [_text_row(row) for row in self.rows()]
        if self.time_ms_median is not None and self.time_ms_p95 is not None:
            lines.append(
                f"time per frame: median {self.time_ms_median:.0f} ms, "
                f"p95 {self.time_ms_p95:.0f} ms"
            )
        return "\n".join(lines)


def pose_error(T_est_camera_map: Pose, T_true_camera_map: Pose) -> tuple[float, float]:
    """RTE: distance between the camera centres (m). RRE: angle between the rotations (deg)."""
    centers = [one.inverse().translation for one in (T_est_camera_map, T_true_camera_map)]
    angle = angle_between(T_est_camera_map.rotation, T_true_camera_map.rotation)
    return float(np.linalg.norm(centers[0] - centers[1])), float(np.rad2deg(angle))


def summarize(localizations: Sequence[Localization], truths: Sequence[Pose | None]) -> Summary:
    """Summary of a run; ``truths`` holds each frame's true T_camera_map, None where unknown."""
    if len(localizations) != len(truths):
        raise SemvizError(f"{len(localizations)} localizations but {len(truths)} true poses")
    status = np.array([one.status for one in localizations], dtype="U9")
    errors = np.array(
        [
            (np.nan, np.nan) if one.T_camera_map is None or true is None
            else pose_error(one.T_camera_map, true)
            for one, true in zip(localizations, truths, strict=True)
        ]
    ).reshape(-1, 2)  # fmt: skip
    known = np.array([true is not None for true in truths], dtype=bool)
    times = np.array([sum(one.time_ms.values()) for one in localizations if one.time_ms])

    def accuracy(rows: BoolArray) -> Accuracy:
        found = errors[rows & np.isfinite(errors[:, 0])]
        return Accuracy.of(found[:, 0], found[:, 1], int((rows & known).sum()), int(rows.sum()))

    return Summary(
        accuracy=accuracy(np.ones(len(status), dtype=bool)),
        by_status={one: accuracy(status == one) for one in STATUSES},
        time_ms_median=float(np.median(times)) if len(times) else None,
        time_ms_p95=float(np.percentile(times, 95)) if len(times) else None,
    )


_HEADER = (
    f"{'status':<10}{'frames':>7} | {'RTE m mean':>10}{'q1':>7}{'q2':>7}{'q3':>7}{'<1 m':>7} | "
    f"{'RRE deg mean':>12}{'q1':>7}{'q2':>7}{'q3':>7}{'<1 deg':>8}"
)


def _flat(name: str, one: Accuracy) -> dict[str, str | int | float | None]:
    flat: dict[str, str | int | float | None] = {"status": name, "frames": one.frames}
    flat |= {f"rte_m_{key}": value for key, value in asdict(one.rte_m).items()}
    flat["share_below_1m"] = one.share_below_1m
    flat |= {f"rre_deg_{key}": value for key, value in asdict(one.rre_deg).items()}
    flat["share_below_1deg"] = one.share_below_1deg
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
