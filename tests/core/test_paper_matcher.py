"""The paper's matcher and those it is compared with: what they see, and that they learn."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.weights import NetworkWeights
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.research.paper.matcher import MODELS, Matcher, graph_features, split_lines
from semviz_core.research.paper.matcher_torch import GraphMatcher, GraphNetwork
from semviz_core.research.paper.training import PaperTask
from semviz_core.research.training.batch import Batch, Progress
from semviz_core.research.training.simulated_samples import PAPER_DISTRIBUTION

START = Progress(0, 100)
torch.set_num_threads(1)  # samples are small: more threads would wait for each other


@cache
def sample(number: int) -> Sample:
    return PAPER_DISTRIBUTION.sample(number)


def batch_for(name: str, numbers: range) -> Batch:
    task = PaperTask(name, PAPER_DISTRIBUTION)
    return task.collate([task._of(sample(number)) for number in numbers])


@pytest.mark.parametrize("name", MODELS)
def test_padding_changes_no_probability(name: str) -> None:
    torch.manual_seed(0)
    network = GraphMatcher(MODELS[name], 4)
    with torch.no_grad():
        found = network(batch_for(name, range(3)))
        for row in range(3):
            alone = network(batch_for(name, range(row, row + 1)))
            _, m, n = alone.probability.shape
            padded = found.probability[row]
            torch.testing.assert_close(padded[:m, :n], alone.probability[0], atol=1e-4, rtol=1e-3)
            assert not padded[m:].any()
            assert not padded[:, n:].any()


@pytest.mark.parametrize(("name", "hears"), [("paper", True), ("paper-no-semantics", False)])
def test_only_models_with_semantics_hear_of_classes(name: str, hears: bool) -> None:
    torch.manual_seed(0)
    network = GraphMatcher(MODELS[name], 4)
    batch = batch_for(name, range(4))
    other = replace(batch, mapped_class=3 - batch.mapped_class)
    assert bool((network.cost(batch) != network.cost(other)).any()) == hears


@pytest.mark.parametrize(("name", "hears"), [("paper", True), ("bpnpnet-semantic", False)])
def test_only_models_with_lines_hear_of_directions(name: str, hears: bool) -> None:
    torch.manual_seed(0)
    network = GraphMatcher(MODELS[name], 4)
    batch = batch_for("paper", range(4))
    other = replace(batch, bottom_m=batch.bottom_m + torch.tensor([1.0, 0.0, 0.0]))
    assert bool((network.cost(batch) != network.cost(other)).any()) == hears


def test_split_lines_see_known_bottoms_as_points_that_belong_together() -> None:
    whole = sample(3)
    split = split_lines(whole)
    m, n = len(whole.ray), len(whole.point_m)
    bottoms = np.flatnonzero(whole.seen_known[:, 1])
    assert len(split.ray) == m + len(bottoms)
    assert np.array_equal(split.ray[m:], whole.bottom_ray[bottoms])
    assert np.array_equal(split.ray, split.bottom_ray)
    assert not split.seen_known[:, 1].any()
    assert whole.truth is not None
    assert split.truth is not None
    for i, j in np.argwhere(split.truth.pairs):
        x = split.truth.rotation @ split.point_m[j] + split.truth.translation
        off = np.degrees(np.arccos(split.ray[i] @ x / np.linalg.norm(x)))
        assert off < 15.0, (i, j)  # hidden bottoms are off by half a pole
        assert (i < m) == (j < n)
    assert np.array_equal(split.truth.pairs[:m, :n], whole.truth.pairs)


@pytest.mark.parametrize("name", MODELS)
def test_numpy_and_torch_say_the_same(name: str) -> None:
    torch.manual_seed(0)
    task = PaperTask(name, PAPER_DISTRIBUTION)
    tensors = {name: value.numpy() for name, value in task.network.state_dict().items()}
    matcher = Matcher(task.model, NetworkWeights(name, task.options, tensors), DEFAULT_CLASSES)
    split = task._of(sample(2))
    found, soft = task.network(task.collate([split])), matcher.of_sample(split)
    assert np.array_equal(soft.possible, task.network.possible(task.collate([split]))[0])
    assert np.abs(soft.cost - found.cost[0].detach().numpy()).max() < 1e-3
    mass = soft.probability * min(soft.cost.shape)
    assert np.abs(mass - found.probability[0].detach().numpy() * min(soft.cost.shape)).max() < 1e-2


@pytest.mark.parametrize("n", [1, 3, 5, 40])
def test_numpy_takes_any_number_of_elements(n: int) -> None:
    torch.manual_seed(0)
    network = GraphNetwork(7, 4)
    tensors = {f"seen.{name}": value.numpy() for name, value in network.state_dict().items()}
    elements = torch.randn(1, n, 7)
    expected = network(elements, torch.ones(1, n, dtype=torch.bool))[0].detach().numpy()
    features = graph_features(tensors, "seen", elements[0].numpy(), 4)
    assert np.abs(features - expected).max() < 1e-3


@pytest.mark.parametrize("name", ["paper", "bpnpnet"])
def test_a_matcher_learns_a_few_frames(name: str) -> None:
    torch.manual_seed(0)
    task = PaperTask(name, PAPER_DISTRIBUTION)
    batch = batch_for(name, range(4))
    adam = torch.optim.Adam(task.network.parameters(), task.learning_rate(START))
    before = float(task.losses(batch, START)["loss"].detach())
    for _ in range(8):
        adam.zero_grad()
        task.losses(batch, START)["loss"].backward()
        adam.step()
    with torch.no_grad():
        after = task.figures(batch)
    assert float(after["correspondence"]) < before - 0.2
    assert float(after["top1"]) <= float(after["top5"]) <= 1.0


def test_the_pose_counts_after_three_fifths_of_a_training() -> None:
    torch.manual_seed(0)
    task = PaperTask("paper", PAPER_DISTRIBUTION)
    batch = batch_for("paper", range(4))
    assert set(task.losses(batch, Progress(59, 100))) == {"loss"}
    losses = task.losses(batch, Progress(60, 100))
    pose, correspondence = losses["pose"] * losses["ok"], losses["correspondence"]
    assert float(losses["loss"].detach()) == pytest.approx(float((pose + correspondence).detach()))
    losses["loss"].backward()
    assert all(parameter.grad.isfinite().all() for parameter in task.network.parameters())
