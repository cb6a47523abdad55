"""What a method made of one frame: its errors, measured against the truth and the bound."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from scipy.special import chdtri, ndtri

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.elements import Elements3D
from semviz_core.evaluation.answers import Answer
from semviz_core.evaluation.metrics import pose_error
from semviz_core.evaluation.problems import Problem
from semviz_core.localization import Status
from semviz_core.pose import Pose
from semviz_core.sources.street.detector import RANGE_M

SURE_NEES = float(chdtri(6, 0.001))
"""Squared Mahalanobis length of the 99.9 % ellipsoid of a pose."""
WRONG_M = 1.0
WRONG_DEG = 1.0


@dataclass(frozen=True)
class Facts:
    """What is true of a frame, and how near to the truth it lets a method come."""

    detections: int
    true_matches: int | None = None
    """None where they are not counted: in drives."""
    recall: float | None = None
    """Share of the visible mapped elements that were detected; None where none is visible."""
    bound_m: float | None = None
    """Median error of the camera centre by an efficient estimator that is given what the method is;
    None where nothing fixes the pose, or the noise is not what is stated."""
    bound_rms_m: float | None = None
    """Root of its mean squared error."""


@dataclass(frozen=True)
class Outcome:
    """One method on one frame. Errors are None without a pose."""

    suite: str
    method: str
    noise: str
    frame: int
    """The problem's seed; in a drive, that of its first frame and so many frames on."""
    facts: Facts
    status: Status
    rte_m: float | None
    rre_deg: float | None
    nees: float | None
    """Normalized estimation error squared (6 on average where the covariance is right); None
    without a covariance."""
    total_ms: float
    """Wall time of the whole answer."""
    stages_ms: dict[str, float] = field(default_factory=dict)
    first_call_ms: float | None = None
    """Of the method's first call in the process, which compiles and loads; not on this frame."""
    timed_alone: bool = True
    """False where other processes of the benchmark shared the machine."""

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Outcome":
        return cls(**{**values, "facts": Facts(**values["facts"])})

    @property
    def succeeded(self) -> bool:
        """Below 1 m and 1 deg."""
        if self.rte_m is None or self.rre_deg is None:
            return False
        return self.rte_m < WRONG_M and self.rre_deg < WRONG_DEG

    @property
    def confidently_wrong(self) -> bool:
        """Answered ``ok``, off by 1 m or 1 deg or more, and outside of its own 99.9 % ellipsoid."""
        outside = self.nees is None or self.nees > SURE_NEES
        return self.status == "ok" and not self.succeeded and outside


def errors(answer: Answer, T_camera_map: Pose) -> tuple[float | None, float | None, float | None]:
    """RTE (m), RRE (deg) and NEES of an answer, given the truth; None where not defined."""
    if answer.T_camera_map is None:
        return None, None, None
    rte_m, rre_deg = pose_error(answer.T_camera_map, T_camera_map)
    if answer.covariance is None:
        return rte_m, rre_deg, None
    off = (T_camera_map @ answer.T_camera_map.inverse()).log()
    return rte_m, rre_deg, float(off @ np.linalg.solve(answer.covariance, off))


def facts_of(problem: Problem, covariance: FloatArray | None) -> Facts:
    """What is true of ``problem``, given its Cramer-Rao bound (6, 6)."""
    visible = len(visible_rows(problem.submap, problem.T_camera_map, problem.camera))
    return Facts(
        detections=len(problem.observed),
        true_matches=len(problem.pairs),
        recall=min(len(problem.pairs) / visible, 1.0) if visible else None,
        bound_m=None if covariance is None else median_length(covariance[:3, :3]),
        bound_rms_m=None if covariance is None else float(np.sqrt(np.trace(covariance[:3, :3]))),
    )


def visible_rows(submap: Elements3D, T_camera_map: Pose, camera: Camera) -> IntArray:
    """Rows of the submap that a detector without faults would find: in range and in the image."""
    end_m = np.where(submap.is_line[:, None], submap.end_m, submap.anchor_m)
    anchor_c, end_c = T_camera_map.apply(submap.anchor_m), T_camera_map.apply(end_m)
    anchor_px, end_px = camera.project(anchor_c), camera.project(end_c)
    highest, lowest = np.minimum(anchor_px, end_px), np.maximum(anchor_px, end_px)
    inside = (highest[:, 0] >= 0.0) & (lowest[:, 0] < camera.width)
    inside &= (lowest[:, 1] >= 0.0) & (highest[:, 1] < camera.height)
    in_range = (anchor_c[:, 2] > RANGE_M[0]) & (anchor_c[:, 2] < RANGE_M[1])
    return np.flatnonzero(inside & in_range)


def median_length(covariance: FloatArray) -> float:
    """Median of |x| for x ~ N(0, covariance) (3, 3), within 0.5 %."""
    eigenvalues = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    return float(np.sqrt(np.median(_unit_squares() @ eigenvalues)))


@cache
def _unit_squares() -> FloatArray:
    """(4096, 3) squares of standard normals, evenly spread over space (Roberts' R3 sequence)."""
    plastic = 1.2207440846057596  # the root of x^4 = x + 1
    uniform = (0.5 + np.arange(4096)[:, None] / plastic ** np.arange(1, 4)) % 1.0
    return np.asarray(ndtri(uniform) ** 2, dtype=np.float64)
