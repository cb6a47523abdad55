"""The learned matcher: its geometry, the laws of its network, its training and its answers."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from semviz_core.base.classes import DEFAULT_CLASSES, POLE, RECTANGULAR
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.base.weights import NetworkWeights
from semviz_core.common.errors import SemvizError
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.upright import gravity
from semviz_core.research.evaluation.problems import (
    CAMERA,
    HARD_SETS,
    Difficulty,
    LocalizationProblem,
    make_problem,
)
from semviz_core.research.pair_matcher.candidates import BIN_RAD, candidate_pairs, level_view
from semviz_core.research.pair_matcher.couples import Prepared
from semviz_core.research.pair_matcher.inference import PairMatcher, load_pair_matcher
from semviz_core.research.pair_matcher.network import LEAST_ODDS, ConsensusNetwork, Poses, fitted
from semviz_core.research.pair_matcher.training import MatcherTask, log_probabilities, true_rank
from semviz_core.research.training.batch import Batch
from semviz_core.research.training.samples import Sample
from semviz_core.research.training.simulated_samples import LEARNED_DISTRIBUTION, transform_sample
from semviz_core.research.training.task import Progress

PRECISE = Difficulty(
    sigma_px=0.01, hidden_bottoms=0.0, false_detections=0.0, missing=0.0, duplicated=0.0, moved=0.0,
    map_view_sigma_m=0.0, map_sigma_m=0.0, map_turn_rad=0.0,
)  # fmt: skip


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
        found: torch.Tensor = network(Prepared.of(Batch.of(samples))).log_odds
    return found


def shuffled(sample: Sample, seen: np.ndarray, mapped: np.ndarray) -> Sample:
    of_seen = ("ray", "bottom_ray", "sigma_rad", "score", "seen_class", "seen_known")
    of_mapped = ("point_m", "bottom_m", "mapped_class", "mapped_known")
    values = {name: getattr(sample, name)[seen] for name in of_seen}
    values |= {name: getattr(sample, name)[mapped] for name in of_mapped}
    return replace(sample, **values, truth=None)


# --- geometry ---


def test_gravity_is_that_of_the_search() -> None:
    for problem in problems(5):
        scene = PoseProblem.of(problem.camera, problem.observed, problem.submap)
        up, _ = gravity(scene, PriorRecord.of(problem.prior))
        batch = Batch.of([seen_as(problem)])
        level = level_view(batch)
        rays = problem.camera.bearing(problem.observed.anchor_px)
        along = rays @ up
        slope = along / np.sqrt(1.0 - along**2)
        assert np.allclose(level.slope[0, :, 0].numpy(), slope, atol=2e-3)


@pytest.mark.parametrize("level", [PRECISE, replace(PRECISE, gps_distance_m=(25.0, 30.0))])
def test_true_pairs_are_candidates_at_about_their_distance(level: Difficulty) -> None:
    of, off = 0, []
    for problem in problems(15, level):
        batch = Batch.of([seen_as(problem)])
        pairs = candidate_pairs(batch)
        assert batch.truth is not None
        true = batch.truth.pairs[0][pairs.seen, pairs.mapped]
        center = problem.T_camera_map.inverse().translation - problem.prior.position_m
        distance = (pairs.place_m - complex(center[0], center[1])).abs()
        turn = torch.sgn(torch.tensor(complex(*problem.T_camera_map.rotation[2, :2])))
        told = pairs.distance_m(turn, torch.arange(len(true)))
        off.append(((told - distance) / pairs.sigma_m)[true].numpy())
        of += len(problem.pairs)
    sigmas = np.abs(np.concatenate(off))
    assert len(sigmas) > 0.8 * of  # bridges put some of the roads at another height
    assert np.median(sigmas) < 1.0


def test_poses_near_the_truth_are_fitted_to_it() -> None:
    rng = np.random.default_rng(0)
    before, after = [], []
    for problem in problems(25, PRECISE):
        prepared = Prepared.of(Batch.of([seen_as(problem)]))
        center = problem.T_camera_map.inverse().translation - problem.prior.position_m
        true = torch.tensor([complex(center[0], center[1])], dtype=torch.complex64)
        turn = torch.sgn(torch.tensor([complex(*problem.T_camera_map.rotation[2, :2])]))
        start = true + complex(*rng.normal(0.0, 0.5, 2))
        poses = Poses(torch.zeros(1, dtype=torch.int64), start, turn.to(torch.complex64))
        before.append(float((start - true).abs()))
        after.append(float((fitted(poses, prepared.pairs, 1).camera_m - true).abs()))
    assert np.median(after) < 0.5 * np.median(before)


def test_couples_of_true_pairs_know_the_camera() -> None:
    off = []
    for problem in problems(15, PRECISE):
        batch = Batch.of([seen_as(problem)])
        prepared = Prepared.of(batch)
        assert batch.truth is not None
        true = batch.truth.pairs[0][prepared.pairs.seen, prepared.pairs.mapped]
        both = true[prepared.couples.first] & true[prepared.couples.second]
        center = problem.T_camera_map.inverse().translation - problem.prior.position_m
        off.append((prepared.couples.camera_m[both] - complex(center[0], center[1])).abs().numpy())
    assert np.median(np.concatenate(off)) < 1.5


# --- laws of the network ---


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


def symmetric_scene() -> tuple[Elements2D, Elements3D, Pose]:
    """A camera amid elements that are symmetric about it; those ahead are observed."""
    place = np.array([[12.0, 4.0], [18.0, -5.0], [25.0, 2.0], [15.0, -9.0]])
    place = np.concatenate([place, -place])
    height = np.tile([3.0, 2.6, 5.0, 2.4], 2)
    class_id = np.tile([POLE, RECTANGULAR, POLE, RECTANGULAR], 2)
    top = np.column_stack([place, height])
    bottom = np.where((class_id == POLE)[:, None], np.column_stack([place, 0.0 * height]), np.nan)
    submap = Elements3D.from_ends(np.arange(8), top, bottom, class_id)
    rotation = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    T_camera_map = Pose(rotation, rotation @ [0.0, 0.0, -1.65])
    tops, bottoms = (CAMERA.project(T_camera_map.apply(point[:4])) for point in (top, bottom))
    return Elements2D.from_ends(tops, bottoms, class_id[:4]), submap, T_camera_map


def test_a_compass_tells_the_two_halves_of_a_symmetric_scene_apart(
    network: ConsensusNetwork,
) -> None:
    observed, submap, _ = symmetric_scene()
    prior = Prior(np.array([0.0, 0.0, 1.65]), up_camera=np.array([0.0, -1.0, 0.0]))
    matcher = PairMatcher(network, DEFAULT_CLASSES)
    unknown = matcher.match(observed, submap, CAMERA, prior).log_odds
    ahead, behind = np.arange(4), np.arange(4, 8)
    assert np.allclose(unknown[ahead, ahead], unknown[ahead, behind], atol=0.02)
    told = matcher.match(observed, submap, CAMERA, replace(prior, heading_rad=0.0)).log_odds
    assert (told[ahead, ahead] > told[ahead, behind] + 0.5).all()
    wrong = replace(prior, heading_rad=np.pi)
    told = matcher.match(observed, submap, CAMERA, wrong).log_odds
    assert (told[ahead, ahead] < told[ahead, behind] - 0.5).all()


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


# --- answers ---


def test_answers_are_repeatable_and_each_element_is_one(network: ConsensusNetwork) -> None:
    problem = problems(1)[0]
    matcher = PairMatcher(network, DEFAULT_CLASSES)
    asked = problem.observed, problem.submap, problem.camera, problem.prior
    match, other = matcher.match(*asked), matcher.match(*asked)
    for field in fields(match):
        assert np.array_equal(getattr(match, field.name), getattr(other, field.name))
    assert np.allclose(match.probability[:-1].sum(axis=1), 1.0, atol=1e-5)
    assert np.allclose(match.probability[:, :-1].sum(axis=0), 1.0, atol=1e-5)
    same = problem.observed.class_id[:, None] == problem.submap.class_id
    assert np.array_equal(match.log_odds > -np.inf, same)
    assert (np.diff(match.share) <= 0.0).all()
    assert match.share.sum() <= 1.0 + 1e-5


def test_nothing_that_may_be_a_pair_is_an_answer_too(network: ConsensusNetwork) -> None:
    observed, submap, _ = symmetric_scene()
    prior = Prior(np.array([500.0, 0.0, 1.65]))
    matcher = PairMatcher(network, DEFAULT_CLASSES)
    found = matcher.match(observed, submap, CAMERA, prior)
    assert (found.log_odds <= LEAST_ODDS).all()
    assert len(found.pose) == 0
    of_two_classes = matcher.match(observed[:1], submap[[1]], CAMERA, prior)
    assert (of_two_classes.log_odds == -np.inf).all()


def test_weights_go_to_a_file_and_back(network: ConsensusNetwork, tmp_path: Path) -> None:
    task = MatcherTask("matcher", LEARNED_DISTRIBUTION)
    tensors = {name: value.half().float().numpy() for name, value in network.state_dict().items()}
    NetworkWeights("matcher", task.options, tensors).save(tmp_path / "a.safetensors")
    again = load_pair_matcher(tmp_path / "a.safetensors", DEFAULT_CLASSES)
    for name, value in again.network.state_dict().items():
        assert np.array_equal(value.numpy(), tensors[name])
    NetworkWeights("paper", task.options, tensors).save(tmp_path / "b.safetensors")
    with pytest.raises(SemvizError, match="weights of paper; give those of matcher"):
        load_pair_matcher(tmp_path / "b.safetensors", DEFAULT_CLASSES)


def test_the_shipped_weights_match() -> None:
    matcher = load_pair_matcher(None, DEFAULT_CLASSES)
    first, near, of = 0, 0, 0
    for problem in problems(15):
        asked = problem.observed, problem.submap, problem.camera, problem.prior
        found = matcher.match(*asked)
        likely = found.probability[problem.pairs[:, 0], :-1].argmax(axis=1)
        first += int((likely == problem.pairs[:, 1]).sum())
        of += len(problem.pairs)
        center = problem.T_camera_map.inverse().translation
        near += bool((np.linalg.norm(found.pose[:12, :3] - center, axis=1) < 2.5).any())
    assert first > 0.8 * of
    assert near >= 13
