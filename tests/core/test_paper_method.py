"""The paper's chain: from P to a pose or the reason for none, and what people get to see of it."""

from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import numpy as np
import pytest
import torch

from semviz_core.base import weights
from semviz_core.base.classes import DEFAULT_CLASSES, POLE, ClassSet
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.weights import NetworkWeights
from semviz_core.common.errors import SemvizError
from semviz_core.localization import localizer as localize
from semviz_core.localization.association import PairConstraints
from semviz_core.localization.localizer import Localizer, available_methods, known_methods
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import Difficulty, LocalizationProblem, make_problem
from semviz_core.research.paper import method
from semviz_core.research.paper.matcher import MODELS, Matcher, SoftMatches, uniform_transport
from semviz_core.research.paper.training import PaperTask
from semviz_core.research.training.simulated_samples import PAPER_DISTRIBUTION

torch.set_num_threads(1)  # samples are small: more threads would wait for each other


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of every model, as they are before training."""
    folder = tmp_path_factory.mktemp("weights")
    for name in MODELS:
        torch.manual_seed(0)
        task = PaperTask(name, PAPER_DISTRIBUTION)
        tensors = {key: value.numpy() for key, value in task.network.state_dict().items()}
        NetworkWeights(name, task.options, tensors).save(folder / f"{name}.safetensors")
    return folder


@pytest.fixture(scope="module")
def problem() -> LocalizationProblem:
    """Seven elements seen, all of them mapped."""
    level = Difficulty(false_detections=0.0, missing=0.0, moved=0.0, duplicated=0.0)
    problems = (make_problem(seed, level) for seed in range(1, 100))
    return next(example for example in problems if len(example.pairs) >= 7)


def solve(localizer: Localizer, problem: LocalizationProblem, **more: object) -> Localization:
    given = problem.observed, problem.submap, problem.camera, problem.prior
    return localizer.localize(*given, **more)  # type: ignore[arg-type]


def knowing(monkeypatch: pytest.MonkeyPatch, problem: LocalizationProblem) -> None:
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
    name: str, folder: Path, problem: LocalizationProblem, monkeypatch: pytest.MonkeyPatch
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
    name: str, folder: Path, problem: LocalizationProblem
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
    folder: Path, problem: LocalizationProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    knowing(monkeypatch, problem)
    monkeypatch.setattr(method, "most_inliers", None)
    near = Pose.exp(np.array([0.3, 0.0, 0.2, 0.0, 0.01, 0.0])) @ problem.T_camera_map
    localizer = Localizer("paper", weights=folder / "paper.safetensors")
    found = solve(localizer, problem, start=near)
    assert found.T_camera_map is not None
    assert pose_error(found.T_camera_map, problem.T_camera_map)[0] < 0.5


def test_suppositions_count(
    folder: Path, problem: LocalizationProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    knowing(monkeypatch, problem)
    localizer = Localizer("paper", weights=folder / "paper.safetensors")
    free = solve(localizer, problem).refinement
    assert free is not None
    i, j = free.pairs[0]
    without = solve(localizer, problem, pairing=PairConstraints(forbidden=[(i, j)]))
    assert without.match is not None
    assert without.match.probability[i, j] == 0.0
    assert [i, j] not in without.match.order.tolist()
    same = problem.submap.class_id == problem.observed.class_id[i]
    wrong = next(int(row) for row in np.flatnonzero(same) if row != j)
    against = solve(localizer, problem, pairing=PairConstraints(forced=[(i, wrong)]))
    assert against.match is not None
    assert against.match.probability[i, wrong] == 1.0
    assert against.status == "cannot"
    forced = solve(localizer, problem, pairing=PairConstraints(forced=[(i, j)]))
    assert forced.status == "ok", forced.reason


def test_in_a_simple_scene_the_transport_is_boolean() -> None:
    """One of each class seen and mapped, and one seen that is not mapped: eq. 8."""
    possible = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 0]], dtype=bool)
    cost = np.random.default_rng(0).uniform(0.0, 2.0, (3, 3))
    assert np.array_equal(uniform_transport(cost, possible), possible.astype(float))


def test_what_weights_lack_is_told_in_one_line(
    folder: Path, problem: LocalizationProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = folder / "paper.safetensors"
    with pytest.raises(SemvizError, match="weights of paper; give those of bpnpnet"):
        Localizer("bpnpnet", weights=path)
    with pytest.raises(SemvizError, match="trained for the classes"):
        Localizer("paper", weights=path, classes=ClassSet((DEFAULT_CLASSES[POLE],)))
    with pytest.raises(SemvizError, match="weights is of type str; give a Path"):
        Localizer("paper", weights=str(folder))  # type: ignore[arg-type]
    with pytest.raises(SemvizError, match="method search uses no weights"):
        Localizer(weights=path)
    read = weights.read_weights(path)
    other = replace(read, tensors={"seen.inlet.weight": np.zeros((2, 2), np.float32)})
    other.save(tmp_path / "other.safetensors")
    with pytest.raises(SemvizError, match="weights of another version of paper"):
        Localizer("paper", weights=tmp_path / "other.safetensors")
    monkeypatch.setattr(weights, "SHIPPED", tmp_path / "nowhere")
    with pytest.raises(SemvizError, match="no such weights"):
        Localizer("paper")
    assert not set(available_methods()) & set(MODELS)


def test_semviz_itself_offers_the_paper_s_methods() -> None:
    """Where this fails, install semviz again: entry points are read from its metadata."""
    offered = {point.name: point.load() for point in entry_points(group=localize.ENTRY_POINTS)}
    assert {name: offered.get(name) for name in MODELS} == dict.fromkeys(MODELS, method.load_chain)
    assert set(MODELS) < set(known_methods())


def test_any_package_can_bring_a_method(
    problem: LocalizationProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Gps:
        def __init__(self, *given: object) -> None:
            self.given = given

        def localize(self, work: Localization, *_: object) -> Localization:
            return replace(work, reason=f"made with {self.given}")

    monkeypatch.setattr(
        "semviz_core.localization.localizer.entry_points", lambda group: [ours, other]
    )
    monkeypatch.setattr(EntryPoint, "load", lambda self: Gps)
    ours = EntryPoint("gps", "others:Gps", localize.ENTRY_POINTS)
    other = EntryPoint("search", "others:Gps", localize.ENTRY_POINTS)
    localize._entry_points.cache_clear()
    try:
        assert known_methods() == ("search", "direct", "learned", "correspondences", "gps")
        answer = solve(Localizer("gps", seed=3), problem)
        assert answer.reason == f"made with {('gps', None, DEFAULT_CLASSES, 3)}"
        assert solve(Localizer("search"), problem).status == "ok"  # our own stays
        with pytest.raises(SemvizError, match=r"unknown method 'paper'; known are .*, gps"):
            Localizer("paper")
    finally:
        localize._entry_points.cache_clear()
