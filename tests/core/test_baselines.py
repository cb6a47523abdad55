"""Peers get the same matches, solve what can be solved, and never pass a failure for a pose."""

from types import SimpleNamespace

import numpy as np
import pytest

from semviz_core.common.errors import SemvizError
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation import baselines
from semviz_core.research.evaluation.baselines import (
    MATCHED_METHODS,
    METHODS,
    Baseline,
    possible_pairs,
)
from semviz_core.research.evaluation.methods import make_matched_problem
from semviz_core.research.evaluation.problems import Difficulty

PROBLEM = make_matched_problem(
    4, difficulty=Difficulty(hidden_bottoms=0.0, moved=0.0, false_detections=0.0)
).problem


def matched(rows: int | None = None) -> SimpleNamespace:
    """The problem with its true matches, or the first few of them."""
    pairs = PROBLEM.pairs[:rows]
    return SimpleNamespace(problem=PROBLEM, pairs=pairs, score=np.full(len(pairs), 0.9))


@pytest.mark.parametrize("name", MATCHED_METHODS)
def test_true_matches_are_solved(name: str) -> None:
    method = MATCHED_METHODS[name]()
    answer = method.solve(matched())
    assert method.name == name
    assert answer.status == "ok"
    assert pose_error(answer.T_camera_map, PROBLEM.T_camera_map)[0] < 0.5
    assert answer.time_ms["solve"] > 0.0


@pytest.mark.parametrize("name", MATCHED_METHODS)
def test_one_match_gives_a_reason_and_no_pose(name: str) -> None:
    answer = MATCHED_METHODS[name]().solve(matched(1))
    assert answer.T_camera_map is None
    assert answer.status == "cannot"
    assert "needed" in answer.reason


@pytest.mark.parametrize(
    "found",
    [None, (np.full((3, 3), np.nan), np.zeros(3)), (np.eye(3), np.full(3, 1e14))],
    ids=["none", "NaN", "too far"],
)
def test_a_library_s_failure_is_no_pose(found: baselines.BaselinePose) -> None:
    answer = Baseline("library", lambda _: found).solve(matched())
    assert answer.status == "cannot"
    assert answer.reason == "library found no pose."


@pytest.mark.parametrize("name", METHODS)
def test_whole_frames_are_answered_or_not_but_never_break(name: str) -> None:
    answer = METHODS[name]().solve(PROBLEM)
    assert answer.reason
    assert (answer.T_camera_map is None) == (answer.status == "cannot")


def test_the_paper_s_back_end_with_the_true_p() -> None:
    errors = []
    for seed in range(8):
        problem = make_matched_problem(seed).problem
        answer = baselines.PaperBackEnd().solve(problem)
        if answer.T_camera_map is not None:
            errors.append(pose_error(answer.T_camera_map, problem.T_camera_map)[0])
    assert len(errors) >= 6
    assert np.median(errors) < 0.5


def test_possible_pairs_hold_the_true_ones_and_no_impossible_one() -> None:
    pairs = possible_pairs(PROBLEM)
    assert {*map(tuple, PROBLEM.pairs.tolist())} <= {*map(tuple, pairs.tolist())}
    i, j = pairs.T
    assert (PROBLEM.observed.class_id[i] == PROBLEM.submap.class_id[j]).all()


def test_a_missing_library_is_told_when_the_peer_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(
        baselines._SOLVERS, "pycolmap", ("no_such_library", baselines.pycolmap_points)
    )
    message = r"method pycolmap needs no_such_library: pip install 'semviz\[peers\]'"
    with pytest.raises(SemvizError, match=message):
        MATCHED_METHODS["pycolmap"]()
