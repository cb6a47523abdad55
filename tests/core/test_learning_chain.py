"""The paper's chain: from P to a pose or the reason for none, and what people get to see of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from semviz_core.classes import DEFAULT_CLASSES, POLE, ClassSet
from semviz_core.errors import SemvizError
from semviz_core.evaluation.metrics import pose_error
from semviz_core.evaluation.problems import Difficulty, Problem, make_problem
from semviz_core.learning import chain, weights
from semviz_core.learning.drills import PAPER_DRILLS
from semviz_core.learning.inference import Matcher, SoftMatches
from semviz_core.learning.models import MODELS
from semviz_core.learning.paper_task import PaperTask
from semviz_core.learning.weights import Weights
from semviz_core.localization import Localization
from semviz_core.localize import Localizer, methods_at_hand
from semviz_core.matching.uniform import uniform_transport
from semviz_core.pose import Pose
from semviz_core.solving.pairing import Pairing

torch.set_num_threads(1)  # samples are small: more threads would wait for each other


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of every model, as they are before training."""
    folder = tmp_path_factory.mktemp("weights")
    for name in MODELS:
        torch.manual_seed(0)
        task = PaperTask(name, PAPER_DRILLS)
        tensors = {key: value.numpy() for key, value in task.network.state_dict().items()}
        Weights(name, task.options, tensors).save(folder / f"{name}.safetensors")
    return folder


@pytest.fixture(scope="module")
def problem() -> Problem:
    """Seven elements seen, all of them mapped."""
    level = Difficulty(false_detections=0.0, missing=0.0, moved=0.0, duplicated=0.0)
    problems = (make_problem(seed, level) for seed in range(1, 100))
    return next(one for one in problems if len(one.pairs) >= 7)


def solve(localizer: Localizer, problem: Problem, **more: object) -> Localization:
    given = problem.observed, problem.submap, problem.camera, problem.prior
    return localizer.localize(*given, **more)  # type: ignore[arg-type]


def knowing(monkeypatch: pytest.MonkeyPatch, problem: Problem) -> None:
    """Let every matcher know the true pairs, and nothing else."""
    learned = Matcher.match

    def match(self: Matcher, *given: object) -> SoftMatches:
        soft = learned(self, *given)  # type: ignore[arg-type]
        true = np.zeros_like(soft.probability)
        true[tuple(problem.pairs.T)] = 1.0 / len(problem.pairs)
        return replace(soft, probability=true)

    monkeypatch.setattr(Matcher, "match", match)


@pytest.mark.parametrize("name", MODELS)
def test_with_the_true_pairs_the_chain_finds_the_pose(
    name: str, folder: Path, problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    knowing(monkeypatch, problem)
    found = solve(Localizer(name, weights=folder / f"{name}.safetensors"), problem)
    assert found.status == "ok", found.reason
    assert found.T_camera_map is not None
    assert pose_error(found.T_camera_map, problem.T_camera_map)[0] < 0.5
    assert found.refinement is not None
    assert found.search is not None
    assert found.search.hypotheses > 100
    assert {tuple(pair) for pair in found.refinement.pairs.tolist()} <= {
        tuple(pair) for pair in problem.pairs.tolist()
    }
    assert list(found.time_ms) == ["match", "search", "refine"]


@pytest.mark.parametrize("name", MODELS)
def test_untrained_it_is_never_sure_and_always_says_why(
    name: str, folder: Path, problem: Problem
) -> None:
    localizer = Localizer(name, weights=folder / f"{name}.safetensors")
    found = solve(localizer, problem)
    assert found.status != "ok"
    assert found.reason.endswith(".")
    assert found.match is not None
    P = found.match.probability
    assert (P >= 0.0).all()
    assert P[-1, -1] == 0.0
    assert np.allclose(P[:-1].sum(axis=1), 1.0)
    assert np.allclose(P[:, :-1].sum(axis=0), 1.0)
    differing = problem.observed.class_id[:, None] != problem.submap.class_id
    assert np.isinf(found.match.cost[differing]).all() == MODELS[name].branches
    again = solve(localizer, problem)
    assert again.reason == found.reason
    assert np.array_equal(again.match.probability, P)  # type: ignore[union-attr]


def test_a_start_takes_the_place_of_ransac(
    folder: Path, problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    knowing(monkeypatch, problem)
    monkeypatch.setattr(chain, "most_inliers", None)
    near = Pose.exp(np.array([0.3, 0.0, 0.2, 0.0, 0.01, 0.0])) @ problem.T_camera_map
    localizer = Localizer("paper", weights=folder / "paper.safetensors")
    found = solve(localizer, problem, start=near)
    assert found.T_camera_map is not None
    assert pose_error(found.T_camera_map, problem.T_camera_map)[0] < 0.5


def test_suppositions_count(
    folder: Path, problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    knowing(monkeypatch, problem)
    localizer = Localizer("paper", weights=folder / "paper.safetensors")
    free = solve(localizer, problem).refinement
    assert free is not None
    i, j = free.pairs[0]
    without = solve(localizer, problem, pairing=Pairing(forbidden=[(i, j)]))
    assert without.match is not None
    assert without.match.probability[i, j] == 0.0
    assert [i, j] not in without.match.order.tolist()
    same = problem.submap.class_id == problem.observed.class_id[i]
    wrong = next(int(one) for one in np.flatnonzero(same) if one != j)
    against = solve(localizer, problem, pairing=Pairing(forced=[(i, wrong)]))
    assert against.match is not None
    assert against.match.probability[i, wrong] == 1.0
    assert against.status == "cannot"
    forced = solve(localizer, problem, pairing=Pairing(forced=[(i, j)]))
    assert forced.status == "ok", forced.reason


def test_in_a_simple_scene_the_transport_is_boolean() -> None:
    """One of each class seen and mapped, and one seen that is not mapped: eq. 8."""
    possible = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 0]], dtype=bool)
    cost = np.random.default_rng(0).uniform(0.0, 2.0, (3, 3))
    assert np.array_equal(uniform_transport(cost, possible), possible.astype(float))


def test_what_weights_lack_is_told_in_one_line(
    folder: Path, problem: Problem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = folder / "paper.safetensors"
    with pytest.raises(SemvizError, match="weights of paper; give those of bpnpnet"):
        Localizer("bpnpnet", weights=path)
    with pytest.raises(SemvizError, match="trained for the classes"):
        Localizer("paper", weights=path, classes=ClassSet((DEFAULT_CLASSES[POLE],)))
    with pytest.raises(SemvizError, match="weights is of type str; give a Path"):
        Localizer("paper", weights=str(folder))  # type: ignore[arg-type]
    with pytest.raises(SemvizError, match="method search has learned nothing"):
        Localizer(weights=path)
    read = weights.read_weights(path)
    other = replace(read, tensors={"seen.inlet.weight": np.zeros((2, 2), np.float32)})
    other.save(tmp_path / "other.safetensors")
    with pytest.raises(SemvizError, match="weights of another version of paper"):
        Localizer("paper", weights=tmp_path / "other.safetensors")
    monkeypatch.setattr(weights, "SHIPPED", tmp_path / "nowhere")
    with pytest.raises(SemvizError, match="no such weights"):
        Localizer("paper")
    assert not set(methods_at_hand()) & set(MODELS)
