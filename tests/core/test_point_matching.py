"""2D3D-MatchNet and DeepI2P between points: their solver, losses and networks."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.pose import Pose
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import (
    CAMERA,
    PAPER_20M,
    LocalizationProblem,
    make_problem,
)
from semviz_core.research.paper.matcher import split_lines
from semviz_core.research.point_matching.methods import (
    POINT_MODELS,
    PointMethod,
    TruePoints,
    pose_of_pairs,
)
from semviz_core.research.point_matching.networks import (
    level_bearings,
    make_network,
)
from semviz_core.research.point_matching.training import (
    PointTask,
    cell_loss,
    distance_loss,
    focal_loss,
    points_in_image,
)
from semviz_core.research.training.batch import Batch, Progress
from semviz_core.research.training.simulated_samples import (
    PAPER_20M_DISTRIBUTION,
    make_sample,
    sample_of,
)

torch.set_num_threads(1)  # samples are small: more threads would wait for each other


@pytest.fixture(scope="module")
def problems() -> list[LocalizationProblem]:
    """Frames of the paper's protocol, with at least six true pairs and 1 px of noise."""
    level = replace(PAPER_20M, noise="low")
    drawn = (make_problem(seed, level) for seed in range(200, 500))
    kept = [problem for problem in drawn if problem.is_valid and len(problem.pairs) >= 6]
    return kept[:6]


@pytest.fixture(scope="module")
def samples(problems: list[LocalizationProblem]) -> list[Sample]:
    rng = np.random.default_rng(0)
    return [split_lines(make_sample(problem, 3.0, rng)) for problem in problems]


def test_true_pairs_give_the_pose(problems: list[LocalizationProblem]) -> None:
    for problem in problems:
        result = TruePoints().solve(problem)
        assert result.T_camera_map is not None, result.reason
        rte_m, rre_deg = pose_error(result.T_camera_map, problem.T_camera_map)
        assert rte_m < 1.5
        assert rre_deg < 8.0


def exact_sample(T_camera_map: Pose, point_m: np.ndarray, sample: Sample) -> Sample:
    """Return a sample that sees all points where they are."""
    place = T_camera_map.apply(point_m)
    ray = place / np.linalg.norm(place, axis=1, keepdims=True)
    return replace(sample, ray=ray, point_m=point_m)


POINTS_M = np.array(
    [[3, 9, 0], [-4, 12, 3], [2, 15, 5], [-1, 20, 1], [6, 22, 2], [-7, 25, 4]], np.float64
)
AHEAD = Pose(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([0.2, 1.5, 0.3]))
"""Looks along y of the map, z up."""


@pytest.mark.parametrize(
    ("pose", "count", "said"),
    [
        (AHEAD, 6, ""),
        (AHEAD, 3, "3 points are matched, 4 needed"),
        (Pose(AHEAD.rotation, np.array([0.2, 1.5, 60.0])), 6, "far away"),
        (Pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ AHEAD, 6, "upside down"),
    ],
)
def test_a_pose_or_why_there_is_none(
    samples: list[Sample], pose: Pose, count: int, said: str
) -> None:
    sample = exact_sample(pose, POINTS_M, samples[0])
    pairs = np.tile(np.arange(count)[:, None], (1, 2))
    found = pose_of_pairs(sample, CAMERA, pairs)
    if isinstance(found, str):
        assert said
        assert said in found
    else:
        np.testing.assert_allclose(found.as_matrix(), pose.as_matrix(), atol=1e-5)


def test_wrong_pairs_give_no_pose(samples: list[Sample]) -> None:
    sample = exact_sample(AHEAD, POINTS_M, samples[0])
    wrong = np.column_stack([np.arange(6), [3, 5, 1, 0, 2, 4]])
    assert isinstance(pose_of_pairs(sample, CAMERA, wrong), str)


@pytest.mark.parametrize("name", POINT_MODELS)
def test_padding_changes_no_match(samples: list[Sample], name: str) -> None:
    torch.manual_seed(0)
    network = make_network(POINT_MODELS[name], 4).eval()
    with torch.no_grad():
        together = network.matches(Batch.of(samples)).numpy()
    for sample, matches in zip(samples, together, strict=True):
        m, n = len(sample.ray), len(sample.point_m)
        np.testing.assert_array_equal(np.argwhere(matches), network.pairs_of(sample))
        assert not matches[m:].any()
        assert not matches[:, n:].any()
        assert matches.sum(axis=1).max() <= 1


@pytest.mark.parametrize("name", POINT_MODELS)
def test_matches_are_of_known_points_and_one_class_where_it_counts(
    samples: list[Sample], name: str
) -> None:
    torch.manual_seed(1)
    network = make_network(POINT_MODELS[name], 4).eval()
    sample = samples[0]
    known = sample.seen_known.copy()
    known[0, 0] = False
    i, j = network.pairs_of(replace(sample, seen_known=known)).T
    assert 0 not in i
    if POINT_MODELS[name].semantics:
        assert (sample.seen_class[i] == sample.mapped_class[j]).all()


@pytest.mark.parametrize("name", POINT_MODELS)
def test_a_frame_without_elements_has_no_match(samples: list[Sample], name: str) -> None:
    network = make_network(POINT_MODELS[name], 4).eval()
    seen = ("ray", "bottom_ray", "sigma_rad", "score", "seen_class", "seen_known")
    blind = replace(samples[0], **{part: getattr(samples[0], part)[:0] for part in seen})
    pairs = network.pairs_of(blind)
    assert pairs.shape == (0, 2)
    assert "0 points are matched" in str(pose_of_pairs(blind, CAMERA, pairs))


def test_bearings_are_level(samples: list[Sample]) -> None:
    level = level_bearings(Batch.of(samples)).numpy()
    for sample, bearing in zip(samples, level, strict=True):
        up = sample.prior[:3]
        np.testing.assert_allclose(bearing[: len(sample.ray), 2], sample.ray @ up, atol=1e-5)
        ahead = sample.ray[:, 2] > 0.9
        assert (bearing[: len(sample.ray)][ahead, 1] > 0.8).all()


def test_points_in_the_image_are_those_that_it_shows(
    samples: list[Sample], problems: list[LocalizationProblem]
) -> None:
    inside = points_in_image(Batch.of(samples)).numpy()
    for sample, row in zip(samples, inside, strict=True):
        assert sample.truth is not None
        place = sample.point_m @ sample.truth.rotation.T + sample.truth.translation
        pixel = CAMERA.project(place)
        size = np.array([CAMERA.width - 1, CAMERA.height - 1])
        shown = ((pixel >= 0) & (pixel <= size)).all(axis=1) & (place[:, 2] > 0.1)
        np.testing.assert_array_equal(row[: len(shown)], shown)
        assert not row[len(shown) :].any()


def test_losses_are_least_for_the_truth() -> None:
    sure, unsure, wrong = 20.0, 0.0, -20.0
    mapped, true_inside = torch.ones((1, 2), dtype=torch.bool), torch.tensor([[True, False]])

    def focal(by: float) -> float:
        return float(focal_loss(torch.tensor([[[-by, by], [by, -by]]]), true_inside, mapped))

    assert focal(sure) < 1e-6 < focal(unsure) < focal(wrong)
    assert focal(unsure) == pytest.approx(0.5 * 0.25 * np.log(2.0))
    cell, true_cell = torch.zeros((1, 2, 3)), torch.tensor([[1, 2]])
    assert float(cell_loss(cell, true_cell, true_inside)) == pytest.approx(np.log(3.0))
    cell[0, 0, 1] = sure  # the other point is outside and does not count
    assert float(cell_loss(cell, true_cell, true_inside)) < 1e-6


def test_the_loss_of_distances_compares_with_a_false_pair_that_is_possible() -> None:
    distance = torch.tensor([[[0.1, 1.5, 9.0]]])
    pairs = torch.tensor([[[True, False, False]]])
    possible = torch.tensor([[[True, True, False]]])
    drawn = torch.Generator().manual_seed(3)
    expected = np.log1p(np.exp(5.0 * (0.1 - 1.5)))
    assert float(distance_loss(distance, possible, pairs, drawn)) == pytest.approx(expected, 1e-5)
    alone = torch.tensor([[[True, False, False]]])
    assert float(distance_loss(distance, alone, pairs, drawn)) == 0.0


@pytest.mark.parametrize(("name", "steps"), [("matchnet", 80), ("deepi2p", 200)])
def test_a_network_learns_two_frames_by_heart_and_finds_their_pose(
    problems: list[LocalizationProblem], name: str, steps: int
) -> None:
    torch.manual_seed(0)
    task = PointTask(name, PAPER_20M_DISTRIBUTION)
    batch = task.collate([split_lines(sample_of(problem)) for problem in problems[:2]])
    before = float(task.figures(batch)["recall"])
    optimizer = torch.optim.Adam(task.network.parameters(), 1e-3)
    for step in range(steps):
        optimizer.zero_grad()
        task.losses(batch, Progress(step, steps))["loss"].backward()
        optimizer.step()
    after = float(task.figures(batch)["recall"])
    method = PointMethod(name, task.network, DEFAULT_CLASSES)
    assert all(method.solve(problem).T_camera_map is not None for problem in problems[:2])
    assert before < 0.4 < 0.6 < after
