"""The verifier: the same for numpy and torch, whatever the order and the padding; its diagnoses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from problem_frames import frames

from semviz.research.training_run import make_training_task
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.localization import Localization
from semviz_core.base.weights import NetworkWeights, shipped_weights
from semviz_core.common.errors import SemvizError
from semviz_core.localization.heading_votes import WIDE
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.mode_verifier import (
    MAPPED_FEATURES,
    MODE_FEATURES,
    MOST_MODES,
    SEEN_FEATURES,
    TASK,
    ModeVerifier,
)
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.refinement import FIXING_PAIRS
from semviz_core.localization.search import Modes, search
from semviz_core.localization.status import SURE_PROBABILITY
from semviz_core.localization.upright import assumed_upright
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import (
    DETECTOR,
    HARD_SETS,
    Difficulty,
    LocalizationProblem,
)
from semviz_core.research.training.batch import Progress
from semviz_core.research.training.simulated_samples import HARD_DISTRIBUTION
from semviz_core.research.training.verifier import collate, label_modes, right_modes

HARD = replace(HARD_SETS["all together"], noise="paper")
NAMES = [class_.name for class_ in DEFAULT_CLASSES]


@pytest.fixture(scope="module")
def network() -> torch.nn.Module:
    """With weights that make all inputs count."""
    task = make_training_task(TASK)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in task.network.parameters():
            parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator))
    return task.network


@pytest.fixture(scope="module")
def verifier(network: torch.nn.Module) -> ModeVerifier:
    tensors = {name: parameter.detach().numpy() for name, parameter in network.named_parameters()}
    return ModeVerifier(tensors, DEFAULT_CLASSES)


def wide(problem: LocalizationProblem) -> Modes:
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    return search(scene, assumed_upright(problem.prior), WIDE)


def probability(verifier: ModeVerifier, problem: LocalizationProblem, modes: Modes) -> np.ndarray:
    prior = assumed_upright(problem.prior)
    return verifier.probability(problem.observed, problem.submap, problem.camera, prior, modes)


def test_torch_and_numpy_say_the_same_and_padding_says_nothing(
    network: torch.nn.Module, verifier: ModeVerifier
) -> None:
    problems = frames(4, HARD)
    items = [label_modes(problem, DEFAULT_CLASSES) for problem in problems]
    batch = collate(items)
    with torch.no_grad():
        found = network(
            batch.mode, batch.weight, batch.mapped, batch.near, batch.seen, batch.is_seen
        )
    assert found.exp().std() > 1e-2
    for row, problem in enumerate(problems):
        modes = wide(problem)
        alone = probability(verifier, problem, modes)[:MOST_MODES]
        together = found[row].exp().numpy()
        np.testing.assert_allclose(together[: len(alone)], alone, atol=1e-5)
        assert together[len(alone) : -1].max(initial=0.0) == 0.0
        assert together[-1] == pytest.approx(1.0 - alone.sum(), abs=1e-5)


def test_the_order_of_elements_does_not_matter(verifier: ModeVerifier) -> None:
    rng = np.random.default_rng(0)
    for problem in frames(3, HARD):
        modes = wide(problem)
        seen, mapped = (
            rng.permutation(len(elements)) for elements in (problem.observed, problem.submap)
        )
        place = np.append(np.argsort(mapped), -1)  # of a mapped row among the shuffled ones
        other = replace(
            modes, match=place[modes.match[:, seen]], gain=modes.gain[:, seen][..., mapped]
        )
        shuffled = replace(problem, observed=problem.observed[seen], submap=problem.submap[mapped])
        np.testing.assert_allclose(
            probability(verifier, shuffled, other), probability(verifier, problem, modes), atol=1e-5
        )


def test_without_modes_nothing_is_right(verifier: ModeVerifier) -> None:
    problem = frames(1, HARD)[0]
    modes = wide(problem)
    none = Modes(
        0, 0, modes.rotation[:0], modes.translation[:0], modes.score[:0], modes.match[:0],
        modes.gain[:0],
    )  # fmt: skip
    assert probability(verifier, problem, none).shape == (0,)
    assert verifier.verified(
        problem.observed, problem.submap, problem.camera, problem.prior, none
    )[0] is none  # fmt: skip


def test_the_likeliest_comes_first_and_the_others_stay_in_order(verifier: ModeVerifier) -> None:
    problem = frames(1, HARD)[0]
    modes = wide(problem)
    given = problem.observed, problem.submap, problem.camera, assumed_upright(problem.prior)
    before = verifier.probability(*given, modes)
    chosen, after = verifier.verified(*given, modes)
    first = int(before.argmax())
    order = [first, *np.delete(np.arange(len(before)), first)]
    np.testing.assert_array_equal(after, before[order])
    np.testing.assert_array_equal(chosen.score, modes.score[order])
    np.testing.assert_array_equal(chosen.match, modes.match[order])


def test_right_modes_are_those_at_the_truth() -> None:
    problem = frames(1, Difficulty())[0]
    true = problem.T_camera_map
    aside = [true.translation + np.array(value) for value in ([0.5, 0.0, 0.0], [0.0, 0.0, 1.5])]
    rotation = np.stack([true.rotation] * 2)
    modes = replace(wide(problem), rotation=rotation, translation=np.stack(aside))
    assert right_modes(modes, problem).tolist() == [True, False]


def test_it_learns_from_frames_that_are_made_once() -> None:
    task = make_training_task(TASK)
    assert task.make(5) is task.make(5)
    assert task.source is HARD_DISTRIBUTION
    batch = task.collate([task.make(number) for number in range(6)])
    optimizer = torch.optim.Adam(task.network.parameters(), 3e-3)
    losses = []
    for _ in range(30):
        loss = task.losses(batch, Progress(0, 1))["loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.5 * losses[0]
    figures = task.figures(batch)
    assert figures["any"] >= figures["chosen"]


def answers(method: str, problems: list[LocalizationProblem]) -> list[Localization]:
    localizer = Localizer(method, detector=DETECTOR)
    return [localizer.localize(p.observed, p.submap, p.camera, p.prior) for p in problems]


needs_weights = pytest.mark.skipif(
    not shipped_weights(TASK).is_file(), reason="the verifier's weights do not come with this copy"
)


@needs_weights
def test_learned_finds_more_than_search_and_is_not_sure_of_more_wrong_ones() -> None:
    problems = list(frames(200, HARD))
    found, wrong = {}, {}
    for method in ("search", "learned"):
        errors = []
        for problem, answer in zip(problems, answers(method, problems), strict=True):
            pose = answer.T_camera_map
            off = np.inf if pose is None else pose_error(pose, problem.T_camera_map)[0]
            errors.append((off, answer.status))
        found[method] = sum(off < 1.0 for off, _ in errors)
        wrong[method] = sum(off > 1.0 and status == "ok" for off, status in errors)
    assert found["learned"] > found["search"]
    assert wrong["learned"] <= wrong["search"]


@needs_weights
def test_few_pairs_are_an_answer_where_they_are_likely_right_and_never_a_sure_one() -> None:
    """Two pairs, or fewer than half of what is seen, which search takes for no answer."""
    problems = list(frames(120, HARD_SETS["4 elements"], least=1))
    right, few = [], 0
    both = zip(problems, answers("learned", problems), answers("search", problems), strict=True)
    for problem, learned, rules in both:
        if learned.T_camera_map is None or rules.T_camera_map is not None:
            continue
        assert learned.status == "ambiguous"
        assert learned.covariance is not None
        right.append(pose_error(learned.T_camera_map, problem.T_camera_map)[0] < 1.0)
        few += learned.refinement is not None and len(learned.refinement.pairs) == FIXING_PAIRS
    assert len(right) >= 5
    assert few > 0
    assert np.mean(right) > 0.4


@needs_weights
def test_of_two_places_alike_none_is_sure() -> None:
    """What is mapped is there twice, as far on either side of the fix."""
    problem = frames(1, Difficulty(false_detections=0.0, moved=0.0, missing=0.0))[0]
    shift = np.array([24.0, 0.0, 0.0])
    submap = problem.submap
    twice = replace(
        submap, id=submap.id + 100_000, anchor_m=submap.anchor_m + shift, end_m=submap.end_m + shift
    )
    both = np.concatenate
    values = {
        name: both([getattr(submap, name), getattr(twice, name)])
        for name in submap.__dataclass_fields__
    }
    prior = replace(
        problem.prior, horizontal_sigma_m=12.0, road_m=None,
        position_m=problem.T_camera_map.inverse().translation * [1.0, 1.0, 0.0]
        + problem.prior.position_m * [0.0, 0.0, 1.0] + 0.5 * shift,
    )  # fmt: skip
    planted = replace(problem, submap=type(submap)(**values), prior=prior)
    answer = answers("learned", [planted])[0]
    assert answer.status == "ambiguous"
    assert "right with" in answer.reason
    alone = answers("learned", [problem])[0]
    assert alone.status == "ok"
    assert float(alone.reason.split("; ")[1].split(" %")[0].rstrip("% sure.")) >= (
        100.0 * SURE_PROBABILITY
    )


@needs_weights
def test_the_same_again() -> None:
    problems = list(frames(2, HARD))
    for answer, other in zip(
        answers("learned", problems), answers("learned", problems), strict=True
    ):
        assert answer.reason == other.reason
        if answer.T_camera_map is not None and other.T_camera_map is not None:
            np.testing.assert_array_equal(
                answer.T_camera_map.translation, other.T_camera_map.translation
            )


def test_weights_that_are_missing_or_for_something_else_are_told(
    tmp_path: Path, verifier: ModeVerifier
) -> None:
    with pytest.raises(SemvizError, match="no such weights"):
        Localizer("learned", weights=tmp_path / "none.safetensors")
    path = tmp_path / "verifier.safetensors"
    NetworkWeights(TASK, {"classes": NAMES}, dict(verifier.weights)).save(path)
    Localizer("learned", weights=path)
    with pytest.raises(SemvizError, match="trained for the classes"):
        Localizer("learned", weights=path, classes=ClassSet(tuple(DEFAULT_CLASSES)[:2]))
    fewer = {name: weight for name, weight in verifier.weights.items() if name != "none.bias"}
    NetworkWeights(TASK, {"classes": NAMES}, fewer).save(path)
    with pytest.raises(SemvizError, match="another version"):
        Localizer("learned", weights=path)
    NetworkWeights("matcher", {"classes": NAMES}, fewer).save(path)
    with pytest.raises(SemvizError, match="weights of matcher"):
        Localizer("learned", weights=path)
    with pytest.raises(SemvizError, match="uses no weights"):
        Localizer("search", weights=path)


def test_evidence_has_the_columns_that_it_says() -> None:
    evidence = label_modes(frames(1, HARD)[0], DEFAULT_CLASSES).features
    assert evidence.mode.shape[1] == MODE_FEATURES
    assert evidence.mapped.shape[2] == MAPPED_FEATURES + len(NAMES)
    assert evidence.seen.shape[2] == SEEN_FEATURES + len(NAMES)
    for elements in (evidence.mode, evidence.weight, evidence.mapped, evidence.near, evidence.seen):
        assert np.isfinite(elements).all()
