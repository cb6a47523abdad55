"""Tables of the benchmark: every figure from outcomes whose figures are known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from semviz_core.base.localization import Status
from semviz_core.base.pose import Pose
from semviz_core.metrics.pose_errors import Outcome, ProblemFacts
from semviz_core.research.evaluation.methods import MethodResult
from semviz_core.research.evaluation.outcomes import ALL, Row, Time, errors, median_length, rows


def outcome(
    rte_m: float | None, *, status: Status = "ok", true: int | None = 6, seen: int = 8,
    nees: float | None = 6.0, rre_deg: float = 0.2, **values: object,
) -> Outcome:  # fmt: skip
    """One frame; the bound is 0.1 m in the median, 0.2 m in the mean square."""
    facts = ProblemFacts(seen, true, 0.7, 0.1, 0.2)
    without = rte_m is None
    frame = Outcome(
        "set", "search", "low", 0, facts, "cannot" if without else status, rte_m,
        None if without else rre_deg, None if without else nees, 10.0,
    )  # fmt: skip
    return replace(frame, **values)


def row_of(outcomes: list[Outcome], stratum: str = ALL) -> Row:
    (row,) = (row for row in rows(outcomes) if row.stratum == stratum)
    return row


def test_frames_are_counted_in_the_strata_of_their_true_matches() -> None:
    frames = [outcome(0.1, true=true) for true in (0, 3, 4, 5, 6, 7, 8, 12)]
    frames.append(outcome(None, true=3, seen=3))  # no valid frame: apart from all others
    counts = {row.stratum: row.accuracy.frames for row in rows(frames)}
    assert counts == {
        ALL: 8, "< 4 true": 2, "4-5 true": 2, ">= 6 true": 4, ">= 8 true": 2, "< 4 seen": 1,
    }  # fmt: skip


def test_in_drives_every_frame_counts_and_is_in_no_stratum_of_matches() -> None:
    frames = [outcome(0.1, true=None, seen=seen) for seen in (0, 3, 9)]
    counts = {row.stratum: row.accuracy.frames for row in rows(frames)}
    assert counts[ALL] == 3
    assert not any("true" in stratum for stratum in counts)


def test_suites_noises_and_methods_are_rows_apart_in_the_order_they_come() -> None:
    frames = [
        outcome(0.1, suite=suite, method=method, noise=noise, true=4)
        for suite in ("b", "a") for noise in ("low", "paper") for method in ("search", "direct")
    ]  # fmt: skip
    found = [(row.suite, row.noise, row.method) for row in rows(frames) if row.stratum == ALL]
    assert found == [(frame.suite, frame.noise, frame.method) for frame in frames]


def test_shares_are_of_all_frames() -> None:
    frames = [
        outcome(0.1),
        outcome(0.3, rre_deg=1.5),  # near, but turned: no success
        outcome(2.0, nees=5.0),  # far, but said so
        outcome(3.0, nees=100.0),  # far and sure
        outcome(4.0, nees=None),  # far, and of no covariance: as bad
        outcome(0.2, status="ambiguous"),
        outcome(9.0, status="ambiguous", nees=900.0),
        outcome(None),
    ]
    row = row_of(frames)
    assert row.accuracy.frames == 8
    assert (row.coverage, row.ambiguous, row.cannot) == (5 / 8, 2 / 8, 1 / 8)
    assert row.confident_wrong == 2 / 8
    assert row.ok_above_1m == 3 / 8
    assert row.success == 2 / 8
    assert row.accuracy.share_below_1m == 3 / 8
    assert row.nees_mean == pytest.approx((6.0 + 6.0 + 5.0) / 3)  # of ok, but the wrong


def test_a_frame_turned_too_far_is_confidently_wrong_too() -> None:
    assert row_of([outcome(0.1, rre_deg=2.0, nees=50.0)]).confident_wrong == 1.0
    assert row_of([outcome(0.1, rre_deg=2.0, nees=10.0)]).confident_wrong == 0.0


def test_a_frame_without_a_pose_is_infinitely_far_off_in_the_median() -> None:
    errors = [0.1, 0.2, 0.3, None]
    assert row_of([outcome(error) for error in errors]).bound_ratio_median == pytest.approx(2.5)
    assert row_of([outcome(value) for value in (0.1, None, None)]).bound_ratio_median is None
    free = ProblemFacts(8, 6)
    unbounded = [outcome(0.1, facts=free), outcome(0.4)]
    assert row_of(unbounded).bound_ratio_median == pytest.approx(4.0)
    assert row_of(unbounded[:1]).bound_ratio_median is None


def test_root_mean_square_over_the_bound_is_of_successes() -> None:
    row = row_of([outcome(0.2), outcome(0.6), outcome(5.0), outcome(None)])
    assert row.rms_over_bound == pytest.approx(np.sqrt((1.0 + 9.0) / 2.0))
    assert row_of([outcome(5.0)]).rms_over_bound is None


def test_errors_as_efficient_as_the_bound_give_ratios_of_one_and_nees_six() -> None:
    """Errors drawn from bounds of all shapes and sizes; within three sigma."""
    rng, count = np.random.default_rng(0), 2_000
    frames = []
    for _ in range(count):
        scale = rng.uniform(0.01, 0.1, 6) * [1.0, 1.0, 1.0, 0.03, 0.03, 0.03]
        mixing = scale[:, None] * np.linalg.qr(rng.normal(size=(6, 6)))[0]
        covariance, truth = mixing @ mixing.T, Pose.exp(rng.normal(size=6))
        answer = MethodResult(
            Pose.exp(mixing @ rng.normal(size=6)) @ truth, covariance, "ok", "drawn"
        )
        rte_m, rre_deg, nees = errors(answer, truth)
        own = covariance[:3, :3]
        facts = ProblemFacts(8, 6, 0.7, median_length(own), float(np.sqrt(np.trace(own))))
        frames.append(outcome(rte_m, facts=facts, rre_deg=rre_deg or 0.0, nees=nees))
    row = row_of(frames)
    assert row.success == 1.0
    assert row.rms_over_bound == pytest.approx(1.0, abs=1.5 / np.sqrt(count))
    assert row.bound_ratio_median == pytest.approx(1.0, abs=3.0 / np.sqrt(count))
    assert row.nees_mean == pytest.approx(6.0, abs=3.0 * np.sqrt(12.0 / count))


def test_median_length_of_known_gaussians() -> None:
    assert median_length(0.04 * np.eye(3)) == pytest.approx(0.2 * 1.5382, rel=5e-3)
    assert median_length(np.diag([0.09, 0.0, 0.0])) == pytest.approx(0.3 * 0.6745, rel=5e-3)


def test_times_are_of_the_frames_that_reached_a_stage() -> None:
    times = [
        outcome(0.1, total_ms=float(ms), stages_ms={"search": ms - 1.0, "refine": 1.0})
        for ms in range(1, 101)
    ]
    early = outcome(None, total_ms=0.0, stages_ms={"search": 0.0}, first_call_ms=900.0)
    row = row_of([early, *times])
    assert row.time_ms == Time(50.0, 95.0)
    assert [*row.stages_ms] == ["search", "refine"]
    assert row.stages_ms["refine"] == Time(1.0, 1.0)
    assert row.stages_ms["search"].median == 49.0
    assert row.first_call_ms == 900.0
    assert row.timed_alone
    assert not row_of([early, replace(early, timed_alone=False)]).timed_alone
    assert Time.of([]) == Time(None, None)


def test_a_row_is_json_without_nan() -> None:
    for frames in ([outcome(0.1), outcome(None)], [outcome(None)]):
        values = row_of(frames).as_json()
        assert json.loads(json.dumps(values, allow_nan=False)) == values
        assert values["frames"] == len(frames)
        assert "accuracy" not in values
