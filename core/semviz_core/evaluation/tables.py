"""From outcomes of single frames to the rows of the benchmark's tables. Pure."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from semviz_core.evaluation.metrics import Accuracy
from semviz_core.evaluation.outcomes import Facts, Outcome
from semviz_core.localize import NEEDED_ELEMENTS

ALL = "all"
STRATA: dict[str, Callable[[Facts], bool]] = {
    ALL: lambda one: _valid(one),
    "< 4 true": lambda one: _matches(one, 0, 3),
    "4-5 true": lambda one: _matches(one, 4, 5),
    ">= 6 true": lambda one: _matches(one, 6),
    ">= 8 true": lambda one: _matches(one, 8),
    "< 4 seen": lambda one: one.detections < NEEDED_ELEMENTS,
}
"""Frames by how many true matches there are (the truth serves for nothing else). Single frames
with fewer than four detections are in the last stratum only; in a drive they count like others."""


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
    accuracy: Accuracy
    """Errors of the frames with a pose; shares below 1 m and 1 deg of all frames."""
    bound_ratio_median: float | None
    """Median over frames of RTE over the bound's median error; a frame without a pose counts as
    infinitely far off. None where that is the median, or nothing bounds the error."""
    rms_over_bound: float | None
    """Root mean square of RTE over the bound's RMS, of the frames below 1 m and 1 deg."""
    nees_mean: float | None
    """Of frames answered ``ok`` but the confidently wrong, which are counted apart."""
    coverage: float
    """Share answered ``ok``."""
    ambiguous: float
    cannot: float
    confident_wrong: float
    """Share answered ``ok`` that is far off and outside of its own 99.9 % ellipsoid."""
    ok_above_1m: float
    success: float
    """Share below 1 m and 1 deg at once."""
    time_ms: Time
    stages_ms: dict[str, Time]
    first_call_ms: float | None
    timed_alone: bool

    def as_json(self) -> dict[str, Any]:
        """One of the ``rows`` that ``semviz benchmark --json`` prints."""
        values = asdict(self)
        accuracy: dict[str, Any] = values.pop("accuracy")
        return accuracy | values


def rows(outcomes: Iterable[Outcome]) -> list[Row]:
    """A row for each suite, noise, method and stratum with frames, as they come first."""
    groups: dict[tuple[str, str, str], list[Outcome]] = {}
    for one in outcomes:
        groups.setdefault((one.suite, one.noise, one.method), []).append(one)
    return [
        _row(stratum, members)
        for group in groups.values()
        for stratum, belongs in STRATA.items()
        if (members := [one for one in group if belongs(one.facts)])
    ]


def _row(stratum: str, outcomes: list[Outcome]) -> Row:
    first = outcomes[0]
    rte_m = np.array([one.rte_m for one in outcomes if one.rte_m is not None])
    rre_deg = np.array([one.rre_deg for one in outcomes if one.rre_deg is not None])
    first_ms = [one.first_call_ms for one in outcomes if one.first_call_ms is not None]

    def share(members: Iterable[bool]) -> float:
        return sum(members) / len(outcomes)

    return Row(
        suite=first.suite,
        method=first.method,
        noise=first.noise,
        stratum=stratum,
        accuracy=Accuracy.of(rte_m, rre_deg, len(outcomes), len(outcomes)),
        bound_ratio_median=_bound_ratio_median(outcomes),
        rms_over_bound=_rms_over_bound(outcomes),
        nees_mean=_nees_mean(outcomes),
        coverage=share(one.status == "ok" for one in outcomes),
        ambiguous=share(one.status == "ambiguous" for one in outcomes),
        cannot=share(one.status == "cannot" for one in outcomes),
        confident_wrong=share(one.confidently_wrong for one in outcomes),
        ok_above_1m=share(one.status == "ok" and (one.rte_m or 0.0) > 1.0 for one in outcomes),
        success=share(one.succeeded for one in outcomes),
        time_ms=Time.of([one.total_ms for one in outcomes]),
        stages_ms=_stages(outcomes),
        first_call_ms=max(first_ms, default=None),
        timed_alone=all(one.timed_alone for one in outcomes),
    )


def _valid(one: Facts) -> bool:
    return one.detections >= NEEDED_ELEMENTS or one.true_matches is None


def _matches(one: Facts, least: int, most: float = math.inf) -> bool:
    return _valid(one) and one.true_matches is not None and least <= one.true_matches <= most


def _bound_ratio_median(outcomes: list[Outcome]) -> float | None:
    ratios = [
        math.inf if one.rte_m is None else one.rte_m / one.facts.bound_m
        for one in outcomes
        if one.facts.bound_m is not None
    ]
    median = float(np.median(ratios)) if ratios else math.inf
    return median if math.isfinite(median) else None


def _rms_over_bound(outcomes: list[Outcome]) -> float | None:
    squares = [
        (one.rte_m / one.facts.bound_rms_m) ** 2
        for one in outcomes
        if one.rte_m is not None and one.facts.bound_rms_m is not None and one.succeeded
    ]
    mean = _mean(squares)
    return None if mean is None else math.sqrt(mean)


def _nees_mean(outcomes: list[Outcome]) -> float | None:
    trusted = [one for one in outcomes if one.status == "ok" and not one.confidently_wrong]
    return _mean([one.nees for one in trusted if one.nees is not None])


def _stages(outcomes: list[Outcome]) -> dict[str, Time]:
    """Of the frames that reached a stage, in the order of the frame that reached most."""
    order = dict.fromkeys(
        stage
        for one in sorted(outcomes, key=lambda one: -len(one.stages_ms))
        for stage in one.stages_ms
    )
    return {
        stage: Time.of([one.stages_ms[stage] for one in outcomes if stage in one.stages_ms])
        for stage in order
    }


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None
