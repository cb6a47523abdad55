"""The whole method: right where it answers, and honest where it can't."""

from dataclasses import replace

import numpy as np
import pytest

from semviz_core.elements import Elements2D, Elements3D
from semviz_core.errors import SemvizError
from semviz_core.evaluation.metrics import pose_error
from semviz_core.evaluation.problems import CAMERA, Difficulty, Problem, make_problem
from semviz_core.frame import Prior
from semviz_core.localization import Localization
from semviz_core.localize import Localizer
from semviz_core.pose import Pose
from semviz_core.solving.residuals import pair_residuals


def localized(problem: Problem) -> Localization:
    return Localizer().localize(problem.observed, problem.submap, problem.camera, problem.prior)


def rte_m(found: Localization, problem: Problem) -> float:
    assert found.T_camera_map is not None
    return pose_error(found.T_camera_map, problem.T_camera_map)[0]


def test_most_problems_are_solved_to_centimetres() -> None:
    problems = [make_problem(seed) for seed in range(500, 520)]
    problems = [one for one in problems if len(one.pairs) >= 6]
    found = [localized(one) for one in problems]
    errors = [rte_m(f, p) for f, p in zip(found, problems, strict=True) if f.status == "ok"]
    assert len(errors) >= len(problems) - 1
    assert max(errors) < 1.0
    assert np.median(errors) < 0.15


def test_the_result_holds_every_step() -> None:
    problem = make_problem(1)
    found = localized(problem)
    assert found.status == "ok", found.reason
    assert found.match is not None
    assert found.search is not None
    assert found.refinement is not None
    m, n = len(problem.observed), len(problem.submap)
    assert found.match.probability.shape == (m + 1, n + 1)
    np.testing.assert_allclose(found.match.probability[:m].sum(axis=1), 1.0)
    assert found.search.hypotheses > 100
    assert (np.diff(found.search.score) <= 0.0).all()
    assert set(found.time_ms) == {"search", "match", "refine"}
    assert f"of {m} elements fit" in found.reason
    again = pair_residuals(
        found.T_camera_map, CAMERA, problem.observed, problem.submap, found.refinement.pairs
    )
    np.testing.assert_array_equal(again.residual_px, found.refinement.residual_px)
    # the pairs that refinement settled on are those the probabilities prefer
    likely = found.match.probability[:m, :n][tuple(found.refinement.pairs.T)]
    assert np.median(likely) > 0.9


def test_same_seed_same_answer() -> None:
    problem = make_problem(2)
    first, second = localized(problem), localized(problem)
    assert first.T_camera_map is not None
    assert second.T_camera_map is not None
    np.testing.assert_array_equal(first.T_camera_map.as_matrix(), second.T_camera_map.as_matrix())


def test_without_gravity_and_with_heading() -> None:
    problem = make_problem(4, Difficulty(with_gravity=False))
    ahead = problem.T_camera_map.rotation[2]
    prior = replace(problem.prior, heading_rad=float(np.arctan2(ahead[1], ahead[0])))
    assert rte_m(localized(problem), problem) < 0.5
    assert rte_m(localized(replace(problem, prior=prior)), problem) < 0.5


def test_a_heading_prior_that_contradicts_is_not_overruled() -> None:
    problem = make_problem(4)
    ahead = problem.T_camera_map.rotation[2]
    back = float(np.arctan2(-ahead[1], -ahead[0]))
    found = localized(replace(problem, prior=replace(problem.prior, heading_rad=back)))
    assert found.status != "ok"


def test_an_element_moved_in_the_map_does_not_pull_the_pose() -> None:
    problem = make_problem(1, Difficulty(moved=0.0))
    before = localized(problem)
    anchor, end = problem.submap.anchor_m.copy(), problem.submap.end_m.copy()
    row = int(problem.pairs[0, 1])
    anchor[row, :2] += [1.4, -1.4]
    end[row, :2] += [1.4, -1.4]
    moved = replace(problem.submap, anchor_m=anchor, end_m=end)

    after = localized(replace(problem, submap=moved))

    assert after.status == "ok", after.reason
    assert after.refinement is not None
    assert row not in after.refinement.pairs[:, 1]
    assert rte_m(after, problem) < rte_m(before, problem) + 0.1


def row_of_poles() -> tuple[Elements2D, Elements3D, Prior, Pose]:
    """Equal poles every 6 m on both sides: moved by 6 m the street looks the same."""
    x = np.repeat(np.arange(-48.0, 61.0, 6.0), 2)
    y = np.tile([-4.0, 4.0], len(x) // 2)
    foot = np.column_stack([x, y, np.zeros(len(x))])
    peak = foot + np.array([0.0, 0.0, 4.0])
    submap = Elements3D.from_ends(np.arange(len(x)), peak, foot, np.zeros(len(x), dtype=int))
    axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    pose = Pose(axes, -axes @ np.array([0.7, 0.3, 1.65]))
    near = (x > 12.0) & (x < 32.0)
    observed = Elements2D.from_ends(
        CAMERA.project(pose.apply(peak[near])),
        CAMERA.project(pose.apply(foot[near])),
        np.zeros(int(near.sum()), dtype=int),
    )
    return observed, submap, Prior(np.array([2.0, 1.0, 1.65]), up_camera=axes[:, 2]), pose


def test_a_row_of_equal_poles_is_ambiguous() -> None:
    observed, submap, prior, pose = row_of_poles()
    found = Localizer().localize(observed, submap, CAMERA, prior)
    assert found.status == "ambiguous", found.reason
    assert "poses fit: scores" in found.reason
    assert "m apart" in found.reason
    candidates = [found.T_camera_map, *(one.T_camera_map for one in found.alternatives)]
    assert min(pose_error(one, pose)[0] for one in candidates if one is not None) < 0.2


@pytest.mark.parametrize("seed", range(5))
def test_a_prior_far_off_is_never_confidently_wrong(seed: int) -> None:
    found = localized(make_problem(seed, Difficulty(gps_offset_m=60.0)))
    assert found.status != "ok", found.reason
    assert found.reason


def test_too_few_elements() -> None:
    problem = make_problem(1)
    found = localized(replace(problem, observed=problem.observed[[0, 1, 2]]))
    assert found.status == "cannot"
    assert found.reason == "3 elements seen, 4 needed."
    assert found.T_camera_map is None
    assert found.covariance is None


def test_an_empty_submap() -> None:
    problem = make_problem(1)
    found = localized(replace(problem, submap=problem.submap[[]]))
    assert found.status == "cannot"
    assert "submap is empty" in found.reason


def test_no_class_in_common() -> None:
    problem = make_problem(1)
    only_poles = problem.observed[problem.observed.class_id == 0]
    only_signs = problem.submap[problem.submap.class_id > 0]
    found = localized(replace(problem, observed=only_poles, submap=only_signs))
    assert found.status == "cannot"
    assert found.search is not None
    assert len(found.search.T_camera_map) == 0


def test_unknown_methods_and_classes_are_named() -> None:
    with pytest.raises(SemvizError, match="known are search, direct"):
        Localizer("magic")
    problem = make_problem(1)
    odd = replace(problem.observed, class_id=np.full(len(problem.observed), 99))
    with pytest.raises(SemvizError, match="99"):
        localized(replace(problem, observed=odd))


@pytest.mark.parametrize("seed", range(4))
def test_where_the_map_has_its_origin_does_not_matter(seed: int) -> None:
    """UTM coordinates give the same answer as local ones."""
    problem = make_problem(seed)
    offset = np.array([500_000.0, 5_000_000.0, 300.0])
    submap, prior = problem.submap, problem.prior
    far = replace(
        problem,
        submap=replace(submap, anchor_m=submap.anchor_m + offset, end_m=submap.end_m + offset),
        prior=replace(prior, position_m=prior.position_m + offset),
    )
    here, there = localized(problem), localized(far)
    assert (there.status, there.reason) == (here.status, here.reason)
    assert here.T_camera_map is not None
    assert there.T_camera_map is not None
    moved = there.T_camera_map.inverse().translation - here.T_camera_map.inverse().translation
    np.testing.assert_allclose(moved, offset, atol=1e-4)
    np.testing.assert_allclose(here.T_camera_map.rotation, there.T_camera_map.rotation, atol=1e-6)


def _everywhere(submap: Elements3D, anchor: object, length_m: float) -> Elements3D:
    """The submap's elements at other places, its poles ``length_m`` long."""
    anchor_m = np.broadcast_to(np.asarray(anchor, dtype=np.float64), submap.anchor_m.shape)
    end_m = np.where(submap.is_line[:, None], anchor_m - [0.0, 0.0, length_m], np.nan)
    return replace(submap, anchor_m=anchor_m, end_m=end_m)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("place", ["point", "post", "line", "behind", "camera", "far", "flat"])
def test_degenerate_maps_have_no_answer(place: str) -> None:
    """Nothing that numpy complains of, and no made-up pose."""
    problem = make_problem(0)
    submap, along = problem.submap, np.arange(len(problem.submap))[:, None]
    places: dict[str, tuple[object, float]] = {
        "point": ([10.0, 2.0, 3.0], 0.0),
        "post": ([10.0, 2.0, 3.0], 3.0),
        "line": (along * [1.0, 0.0, 0.0] + [0.0, 0.0, 3.0], 3.0),
        "behind": (submap.anchor_m - [500.0, 0.0, 0.0], 3.0),
        "camera": (problem.T_camera_map.inverse().translation, 2.0),
        "far": (submap.anchor_m * 1e10, 3.0),
        "flat": (submap.anchor_m, 0.0),
    }
    found = localized(replace(problem, submap=_everywhere(submap, *places[place])))
    assert found.status == "cannot", found.reason
    assert found.reason


def test_a_covariance_that_is_none_is_refused() -> None:
    """Every variance is positive, but two ends correlate by more than all."""
    problem = make_problem(0)
    covariance = problem.submap.covariance_m2.copy()
    covariance[0, 0, 1] = covariance[0, 1, 0] = 2.0 * covariance[0, 0, 0]
    with pytest.raises(SemvizError, match=f"map element {problem.submap.id[0]}"):
        localized(replace(problem, submap=replace(problem.submap, covariance_m2=covariance)))
