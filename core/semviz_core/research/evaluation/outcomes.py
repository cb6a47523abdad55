"""Measure one method on one frame, and aggregate outcomes to benchmark table rows.

Errors are measured against ground truth and the Cramer-Rao bound: RTE (m), RRE (deg) and NEES.
Shares refer to all frames of a method. Aggregation is pure.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.special import ndtri

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.localization.localizer import NEEDED_ELEMENTS
from semviz_core.metrics.pose_errors import (
    Outcome,
    PoseAccuracy,
    ProblemFacts,
    Spread,
    pose_error,
    published_error,
    visible_rows,
)
from semviz_core.research.evaluation.methods import MethodResult
from semviz_core.research.evaluation.problems import LocalizationProblem


def errors(
    result: MethodResult, T_camera_map: Pose
) -> tuple[float | None, float | None, float | None]:
    """Return RTE (m), RRE (deg) and NEES of a result; None where not defined."""
    if result.T_camera_map is None:
        return None, None, None
    rte_m, rre_deg = pose_error(result.T_camera_map, T_camera_map)
    if result.covariance is None:
        return rte_m, rre_deg, None
    error = (T_camera_map @ result.T_camera_map.inverse()).log()
    return rte_m, rre_deg, float(error @ np.linalg.solve(result.covariance, error))


def published_errors(
    result: MethodResult, T_camera_map: Pose, origin_m: FloatArray
) -> tuple[float, float] | tuple[None, None]:
    """Return the errors (m, deg) as DeepI2P measures them, about ``origin_m`` (3,); None without a
    pose."""
    if result.T_camera_map is None:
        return None, None
    return published_error(result.T_camera_map, T_camera_map, origin_m)


def facts_of(problem: LocalizationProblem, covariance: FloatArray | None) -> ProblemFacts:
    """Return the facts about ``problem``, given its Cramer-Rao bound (6, 6)."""
    visible = len(visible_rows(problem.submap, problem.T_camera_map, problem.camera))
    return ProblemFacts(
        detections=len(problem.observed),
        true_matches=len(problem.pairs),
        recall=min(len(problem.pairs) / visible, 1.0) if visible else None,
        bound_m=None if covariance is None else median_length(covariance[:3, :3]),
        bound_rms_m=None if covariance is None else float(np.sqrt(np.trace(covariance[:3, :3]))),
    )


def median_length(covariance: FloatArray) -> float:
    """Return the median of |x| for x ~ N(0, covariance) (3, 3), within 0.5 %."""
    eigenvalues = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    return float(np.sqrt(np.median(_unit_squares() @ eigenvalues)))


@cache
def _unit_squares() -> FloatArray:
    """Return squares (4096, 3) of standard normals, quasi-random (Roberts' R3 sequence)."""
    plastic = 1.2207440846057596  # the root of x^4 = x + 1
    uniform = (0.5 + np.arange(4096)[:, None] / plastic ** np.arange(1, 4)) % 1.0
    return np.asarray(ndtri(uniform) ** 2, dtype=np.float64)


ALL = "all"
STRATA: dict[str, Callable[[ProblemFacts], bool]] = {
    ALL: lambda facts: _valid(facts),
    "< 4 true": lambda facts: _matches(facts, 0, 3),
    "4-5 true": lambda facts: _matches(facts, 4, 5),
    ">= 6 true": lambda facts: _matches(facts, 6),
    ">= 8 true": lambda facts: _matches(facts, 8),
    "< 4 seen": lambda facts: facts.detections < NEEDED_ELEMENTS,
}
"""Frames by their number of true matches. Single frames with fewer than four detections are in the
last stratum only; in a sequence they count like others."""


@dataclass(frozen=True)
class Time:
    """Milliseconds of wall time; None where nothing was timed."""

    median: float | None
    p95: float | None

    @classmethod
    def of(cls, times_ms: Sequence[float]) -> "Time":
        if not times_ms:
            return cls(None, None)
        median, p95 = np.percentile(times_ms, [50.0, 95.0])
        return cls(float(median), float(p95))


@dataclass(frozen=True)
class Row:
    """One method on one stratum of one suite. Shares are of all its frames."""

    suite: str
    method: str
    noise: str
    stratum: str
    accuracy: PoseAccuracy
    """Errors of the frames with a pose; shares below 1 m and 1 deg of all frames."""
    bound_ratio_median: float | None
    """Median over frames of RTE over the bound's median error; infinite without a pose. None if the
    median is infinite, or nothing bounds the error."""
    rms_over_bound: float | None
    """Root mean square of RTE over the bound's RMS, of the frames below 1 m and 1 deg."""
    nees_mean: float | None
    """Of frames with status ``ok``, without the confidently wrong, which are counted apart."""
    coverage: float
    """Share with status ``ok``."""
    ambiguous: float
    cannot: float
    confident_wrong: float
    """Share with status ``ok`` whose pose is far off and outside its own 99.9 % ellipsoid."""
    ok_above_1m: float
    success: float
    """Share below 1 m and 1 deg at once."""
    time_ms: Time
    stages_ms: dict[str, Time]
    first_call_ms: float | None
    timed_alone: bool
    translation_m: Spread
    """As DeepI2P measures, like the next two; see ``Outcome``."""
    euler_deg: Spread
    below_2m_5deg: float

    def as_json(self) -> dict[str, Any]:
        """Return one of the ``rows`` that ``semviz benchmark --json`` prints."""
        values = asdict(self)
        accuracy: dict[str, Any] = values.pop("accuracy")
        return accuracy | values


def rows(outcomes: Iterable[Outcome]) -> list[Row]:
    """Return a row for each suite, noise, method and stratum with frames, as they appear."""
    groups: dict[tuple[str, str, str], list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault((outcome.suite, outcome.noise, outcome.method), []).append(outcome)
    return [
        _row(stratum, members)
        for group in groups.values()
        for stratum, belongs in STRATA.items()
        if (members := [outcome for outcome in group if belongs(outcome.facts)])
    ]


def _row(stratum: str, outcomes: list[Outcome]) -> Row:
    first = outcomes[0]
    rte_m = np.array([outcome.rte_m for outcome in outcomes if outcome.rte_m is not None])
    rre_deg = np.array([outcome.rre_deg for outcome in outcomes if outcome.rre_deg is not None])
    first_ms = [outcome.first_call_ms for outcome in outcomes if outcome.first_call_ms is not None]

    def share(members: Iterable[bool]) -> float:
        return sum(members) / len(outcomes)

    return Row(
        suite=first.suite,
        method=first.method,
        noise=first.noise,
        stratum=stratum,
        accuracy=PoseAccuracy.of(rte_m, rre_deg, len(outcomes), len(outcomes)),
        bound_ratio_median=_bound_ratio_median(outcomes),
        rms_over_bound=_rms_over_bound(outcomes),
        nees_mean=_nees_mean(outcomes),
        coverage=share(outcome.status == "ok" for outcome in outcomes),
        ambiguous=share(outcome.status == "ambiguous" for outcome in outcomes),
        cannot=share(outcome.status == "cannot" for outcome in outcomes),
        confident_wrong=share(outcome.confidently_wrong for outcome in outcomes),
        ok_above_1m=share(
            outcome.status == "ok" and (outcome.rte_m or 0.0) > 1.0 for outcome in outcomes
        ),
        success=share(outcome.succeeded for outcome in outcomes),
        time_ms=Time.of([outcome.total_ms for outcome in outcomes]),
        stages_ms=_stages(outcomes),
        first_call_ms=max(first_ms, default=None),
        timed_alone=all(outcome.timed_alone for outcome in outcomes),
        translation_m=_spread(outcome.translation_m for outcome in outcomes),
        euler_deg=_spread(outcome.euler_deg for outcome in outcomes),
        below_2m_5deg=share(
            outcome.translation_m is not None
            and outcome.euler_deg is not None
            and outcome.translation_m < 2.0
            and outcome.euler_deg < 5.0
            for outcome in outcomes
        ),
    )


def _valid(facts: ProblemFacts) -> bool:
    return facts.detections >= NEEDED_ELEMENTS or facts.true_matches is None


def _matches(facts: ProblemFacts, least: int, most: float = math.inf) -> bool:
    return _valid(facts) and facts.true_matches is not None and least <= facts.true_matches <= most


def _bound_ratio_median(outcomes: list[Outcome]) -> float | None:
    ratios = [
        math.inf if outcome.rte_m is None else outcome.rte_m / outcome.facts.bound_m
        for outcome in outcomes
        if outcome.facts.bound_m is not None
    ]
    median = float(np.median(ratios)) if ratios else math.inf
    return median if math.isfinite(median) else None


def _rms_over_bound(outcomes: list[Outcome]) -> float | None:
    squares = [
        (outcome.rte_m / outcome.facts.bound_rms_m) ** 2
        for outcome in outcomes
        if outcome.rte_m is not None and outcome.facts.bound_rms_m is not None and outcome.succeeded
    ]
    mean = _mean(squares)
    return None if mean is None else math.sqrt(mean)


def _nees_mean(outcomes: list[Outcome]) -> float | None:
    trusted = [
        outcome for outcome in outcomes if outcome.status == "ok" and not outcome.confidently_wrong
    ]
    return _mean([outcome.nees for outcome in trusted if outcome.nees is not None])


def _stages(outcomes: list[Outcome]) -> dict[str, Time]:
    """Return the times of each stage over the frames that reached it, in the order of the frame
    with the most stages."""
    order = dict.fromkeys(
        stage
        for outcome in sorted(outcomes, key=lambda outcome: -len(outcome.stages_ms))
        for stage in outcome.stages_ms
    )
    return {
        stage: Time.of(
            [outcome.stages_ms[stage] for outcome in outcomes if stage in outcome.stages_ms]
        )
        for stage in order
    }


def _spread(values: Iterable[float | None]) -> Spread:
    return Spread.of(np.array([value for value in values if value is not None]))


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None
