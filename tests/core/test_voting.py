"""Votes in vector loops equal the plain formula, and what both ends share is not counted twice."""

from typing import Any

import numpy as np
import pytest
from problem_frames import frames

from semviz_core.common.arrays import FloatArray
from semviz_core.localization.heading_votes import DEFAULT_EFFORT
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.upright import (
    FALSE_SLOPE,
    FALSE_TURN,
    HIDDEN_CHI2,
    UprightView,
    compare_slopes,
    likely_ups,
    slope_variances,
    upright_elements,
    upright_view,
)
from semviz_core.localization.voting import (
    BIN_RAD,
    BINS,
    HEADING_SIGMA_RAD,
    HEIGHT_SIGMA_M,
    MOST_SIGMAS,
    NEAREST_M,
    STEP_SIGMAS,
    fill_voters,
    room_for_voters,
    vote_at,
    vote_weights,
)
from semviz_core.research.evaluation.problems import DETECTOR

STEP_M, REACH_M = DEFAULT_EFFORT.step_m, 44.0


@pytest.mark.parametrize(("x_m", "y_m"), [(0.0, 0.0), (3.0, -3.0)])
def test_votes_are_the_best_gains_of_all_observed_elements(x_m: float, y_m: float) -> None:
    for problem in frames(4):
        scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
        ups, sigma_rad = likely_ups(scene, PriorRecord.of(problem.prior))
        view = upright_view(scene, ups[0], sigma_rad)
        elements, _ = upright_elements(scene)
        near = np.arange(len(elements))
        weights = vote_weights(view, STEP_M)
        voters = room_for_voters(len(view.seen), len(view.seen) * len(near))
        middle = tuple(problem.prior.position_m.tolist())
        fill_voters(scene.setting, view, elements, scene.compatible, near, middle, weights, voters)
        vote_at(voters, weights, x_m, y_m, REACH_M)
        plain = plain_votes(scene, view, elements, middle, (x_m, y_m))
        assert plain.max() > 10.0
        np.testing.assert_allclose(voters.total, plain, atol=0.05)


def plain_votes(
    scene: PoseProblem,
    view: UprightView,
    elements: Any,
    middle_m: tuple[float, ...],
    place_m: tuple[float, float],
) -> FloatArray:
    """Return (BINS,) what ``vote_at`` should find, by loops over all matches."""
    best = np.zeros((len(view.seen), BINS))
    bins = np.arange(BINS) + 0.5
    for i, j in np.argwhere(scene.compatible):
        seen, mapped = view.seen[i], elements[j]
        from_middle = mapped["position_m"] - middle_m[:2]
        east, north = from_middle - place_m
        distance = np.hypot(east, north)
        if not NEAREST_M < distance < REACH_M:
            continue
        about = max(int(np.hypot(*from_middle)) + 0.5, NEAREST_M)  # sigmas are by whole metres
        gain, off_anchor = FALSE_TURN, None
        gain -= 0.5 * np.log((STEP_SIGMAS * STEP_M / about) ** 2 + HEADING_SIGMA_RAD**2)
        args = 1.0 / about, view.up_sigma_rad, STEP_SIGMAS * STEP_M, HEIGHT_SIGMA_M
        variance, common = slope_variances(seen, *args)
        for end in range(2):
            if not (seen["known"][end] and mapped["known"][end]):
                continue
            off = (mapped["height_m"][end] - middle_m[2]) / distance - seen["slope"][end]
            of_end = variance[end]
            if off_anchor is not None:
                off, of_end = off - common * off_anchor, variance[2]
            if end == 1 and off < 0.0 and off * off > HIDDEN_CHI2 * of_end:
                gain += np.log(DETECTOR.hidden_bottoms)
                continue
            gain += np.log1p(-DETECTOR.hidden_bottoms) if end == 1 else 0.0
            gain += FALSE_SLOPE - 0.5 * (np.log(of_end) + off * off / of_end)
            off_anchor = off if end == 0 else off_anchor
        if gain <= 0.0:
            continue
        turn = (STEP_SIGMAS * STEP_M / distance / BIN_RAD) ** 2 + (HEADING_SIGMA_RAD / BIN_RAD) ** 2
        heading = (np.arctan2(north, east) - seen["azimuth_rad"]) / BIN_RAD
        off_bins = (bins - heading + BINS / 2.0) % BINS - BINS / 2.0
        value = gain - 0.5 * off_bins**2 / turn
        reaches = np.abs(off_bins) <= np.sqrt(turn * min(2.0 * gain, MOST_SIGMAS**2))
        best[i] = np.maximum(best[i], np.where(reaches, value, 0.0))
    return best.sum(axis=0)


def test_an_error_that_both_ends_share_costs_once() -> None:
    """A camera that looks up by a sigma moves both ends alike; one end moved alone does not fit."""
    problem = frames(1)[0]
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    ups, sigma_rad = likely_ups(scene, PriorRecord.of(problem.prior))
    view = upright_view(scene, ups[0], sigma_rad)
    seen = view.seen[np.flatnonzero(view.seen["known"].all(axis=1))[0]].copy()
    seen["slope"], seen["slope_sigma"], near = [0.1, -0.06], 0.002, 1.0 / 25.0
    mapped = upright_elements(scene)[0][:1].copy()[0]
    mapped["known"] = True
    up_rad = np.deg2rad(1.2)

    def chi2(moved: tuple[float, float]) -> float:
        mapped["height_m"] = (seen["slope"] + moved) / near
        args = near, 0.0, up_rad, 0.3, 0.08, 0.0
        return float(compare_slopes(scene.setting, seen, mapped, *args)[0])

    assert chi2((0.0, 0.0)) == pytest.approx(0.0)
    assert 0.5 < chi2((up_rad, up_rad)) < 1.5
    assert chi2((0.0, up_rad)) > 6.0
