"""The training of the pair matcher: the laws of its network in torch, and what it learns."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.localization.correspondences.candidate_pairs import BIN_RAD, Sample
from semviz_core.localization.correspondences.network import (
    LEAST_ODDS,
    pair_log_odds,
    tensor_shapes,
)
from semviz_core.research.evaluation.problems import (
    HARD_SETS,
    Difficulty,
    LocalizationProblem,
    make_problem,
)
from semviz_core.research.pair_matcher.network import ConsensusNetwork, Prepared
from semviz_core.research.pair_matcher.training import MatcherTask, log_probabilities, true_rank
from semviz_core.research.training.batch import Batch, Progress
from semviz_core.research.training.simulated_samples import LEARNED_DISTRIBUTION, transform_sample


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def network() -> ConsensusNetwork:
    torch.manual_seed(3)
    return ConsensusNetwork(len(DEFAULT_CLASSES)).eval()


def problems(number: int, level: Difficulty | None = None) -> list[LocalizationProblem]:
    made = (make_problem(seed, level) for seed in range(100))
    return [sample for sample in made if sample.is_valid and len(sample.pairs) > 2][:number]


def seen_as(problem: LocalizationProblem) -> Sample:
    sample = Sample.of(problem.observed, problem.submap, problem.camera, problem.prior)
    return sample.with_truth(problem.T_camera_map, problem.pairs)


def log_odds(network: ConsensusNetwork, *samples: Sample) -> torch.Tensor:
    with torch.no_grad():
        found: torch.Tensor = network(Prepared.of(samples))
    return found


def shuffled(sample: Sample, seen: np.ndarray, mapped: np.ndarray) -> Sample:
    of_seen = ("ray", "bottom_ray", "sigma_rad", "score", "seen_class", "seen_known")
    of_mapped = ("point_m", "bottom_m", "mapped_class", "mapped_known")
    values = {name: getattr(sample, name)[seen] for name in of_seen}
    values |= {name: getattr(sample, name)[mapped] for name in of_mapped}
    return replace(sample, **values, truth=None)


# --- laws of the network ---


def test_numpy_says_the_same_as_torch(network: ConsensusNetwork) -> None:
    """Inference is another implementation of the learned part; the geometry is one."""
    samples = [LEARNED_DISTRIBUTION.sample(number) for number in range(6)]
    prepared = Prepared.of(samples)
    with torch.no_grad():
        together = network(prepared).numpy()
    weights = {name: value.numpy() for name, value in network.state_dict().items()}
    assert {name: value.shape for name, value in weights.items()} == tensor_shapes(4)
    for row, (sample, frame) in enumerate(zip(samples, prepared.frames, strict=True)):
        m, n = len(sample.ray), len(sample.point_m)
        alone = pair_log_odds(weights, frame, sample.seen_class, n)
        assert np.allclose(together[row, :m, :n], alone, atol=2e-3)
        assert (alone > LEAST_ODDS).any()


def test_padding_changes_nothing(network: ConsensusNetwork) -> None:
    samples = [LEARNED_DISTRIBUTION.sample(number) for number in range(6)]
    together = log_odds(network, *samples)
    for row, sample in enumerate(samples):
        m, n = len(sample.ray), len(sample.point_m)
        alone = log_odds(network, sample)[0]
        assert torch.allclose(together[row, :m, :n], alone, atol=2e-3)
        assert (together[row, m:] == LEAST_ODDS).all()


def same(tensor: torch.Tensor, other: torch.Tensor, nats: float = 0.03) -> bool:
    """But for poses that rounding puts beyond a gate, or into another square."""
    off = (tensor - other).abs()
    return bool((off < nats).float().mean() > 0.9) and float(off.mean()) < nats


def test_order_does_not_matter(network: ConsensusNetwork) -> None:
    rng = np.random.default_rng(1)
    before, after = [], []
    for number in range(8):
        sample = LEARNED_DISTRIBUTION.sample(number)
        seen, mapped = rng.permutation(len(sample.ray)), rng.permutation(len(sample.point_m))
        before.append(log_odds(network, sample)[0][seen][:, mapped].flatten())
        after.append(log_odds(network, shuffled(sample, seen, mapped))[0].flatten())
    assert same(torch.cat(before), torch.cat(after))
    assert not same(torch.cat(before), torch.cat(after).flip(0))


@pytest.mark.parametrize("level", ["noise 3 px", "heading 15 deg"])
def test_turning_the_map_by_whole_bins_changes_little(
    network: ConsensusNetwork, level: str
) -> None:
    given, turned, without = [], [], []
    for problem in problems(8, HARD_SETS[level]):
        sample = seen_as(problem)
        other = transform_sample(sample, 7 * BIN_RAD, [0.0, 0.0])
        given.append(log_odds(network, sample).flatten())
        turned.append(log_odds(network, other).flatten())
        lost = replace(other, prior=sample.prior, road=sample.road)
        without.append(log_odds(network, lost).flatten())
    assert same(torch.cat(given), torch.cat(turned), 0.2)
    assert not same(torch.cat(given), torch.cat(without), 0.2)


def test_scores_of_detections_are_not_looked_at(network: ConsensusNetwork) -> None:
    sample = LEARNED_DISTRIBUTION.sample(0)
    doubtful = replace(sample, score=np.zeros_like(sample.score))
    assert torch.equal(log_odds(network, sample), log_odds(network, doubtful))


# --- training ---


def test_a_short_training_learns() -> None:
    torch.manual_seed(0)
    task = MatcherTask("matcher", LEARNED_DISTRIBUTION)
    items = [task.make(number) for number in range(32)]
    batches = [task.collate(items[row : row + 8]) for row in range(0, 32, 8)]
    optimizer = torch.optim.Adam(task.network.parameters(), 3e-3)
    losses = []
    for step in range(40):
        loss = task.losses(batches[step % 4], Progress(8 * step, 320))["loss"]
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        losses.append(float(loss.detach()))
    assert np.mean(losses[-4:]) < 0.85 * np.mean(losses[:4])
    parts = dict(task.network.named_parameters())
    assert all(part.grad is not None and part.grad.isfinite().all() for part in parts.values())


def test_ranks_count_what_is_likelier() -> None:
    likely = torch.log(torch.tensor([[[0.5, 0.3, 0.1, 0.1], [0.1, 0.2, 0.6, 0.1], [0.0] * 4]]))
    pairs = torch.tensor([[[False, True, False], [True, False, True]]])
    assert true_rank(likely, pairs).tolist() == [[1, 0]]


def test_figures_of_a_perfect_matcher(network: ConsensusNetwork) -> None:
    sample = LEARNED_DISTRIBUTION.sample(5)
    batch = Batch.of([sample])
    assert batch.truth is not None
    odds = torch.where(batch.truth.pairs, 15.0, LEAST_ODDS)
    log_probability = log_probabilities(odds, batch)
    assert (true_rank(log_probability, batch.truth.pairs) == 0).all()
