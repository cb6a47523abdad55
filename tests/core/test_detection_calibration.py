"""Planted probabilities, sigmas and rates of a detector are recovered from its detections."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semviz_core.base.classes import POLE
from semviz_core.base.detector_model import (
    CalibratedRates,
    DetectorCalibration,
    DetectorModel,
    ScoreCurve,
    SigmaScale,
)
from semviz_core.base.elements import Elements2D, joined
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.detection import ImageGroundTruth
from semviz_core.metrics.detection_calibration import (
    CalibrationImage,
    FittedCalibration,
    best_threshold,
    fit_calibration,
    threshold_figures,
)

IMAGES, POLES, LENGTH_PX = 300, 10, 120.0
RECALL_NEAR, RECALL_FAR = 0.8, 0.3
FALSE_AN_IMAGE = 2.0
HIDDEN = 0.2
ACROSS, ALONG = 2.0, 0.5
"""Planted errors, in stated sigmas."""
SIGMA_PX = np.array([0.4, 3.0])


def probability(score: np.ndarray) -> np.ndarray:
    """The planted probability that a detection is right: monotone, and not the score."""
    return score**2


def planted_image(rng: np.random.Generator) -> CalibrationImage:
    """Poles 3 to 60 m away; recall falls from 20 to 45 m. A fifth of bottoms is hidden."""
    u = 100.0 * (1 + np.arange(POLES)) + rng.uniform(-10, 10, POLES)
    anchor, end = np.column_stack([u, np.full(POLES, 100.0)]), np.column_stack([u, 100.0 + 0 * u])
    end[:, 1] += LENGTH_PX
    distance = rng.uniform(3.0, 60.0, POLES)
    far = np.clip((distance - 20.0) / 25.0, 0.0, 1.0)
    found = rng.random(POLES) < RECALL_NEAR + far * (RECALL_FAR - RECALL_NEAR)
    kinds = np.full(POLES, POLE)
    truth = ImageGroundTruth.of(Elements2D.from_ends(anchor, end, kinds), distance, reach_m=120.0)
    seen = Elements2D.from_ends(anchor[found], end[found], kinds[found])
    error = rng.normal(0.0, SIGMA_PX * (ACROSS, ALONG), (len(seen), 2, 2))
    hidden = rng.random(len(seen)) < HIDDEN
    right: Elements2D = replace(
        seen,
        anchor_px=seen.anchor_px + error[:, 0],
        end_px=seen.end_px + error[:, 1] - np.column_stack([0 * hidden, 50.0 * hidden]),
        sigma_px=np.tile(SIGMA_PX, (len(seen), 1)),
        score=drawn(rng, len(seen), True),
    )
    count = rng.poisson(FALSE_AN_IMAGE)
    between = 150.0 + 100.0 * rng.permutation(POLES)[:count]  # between the poles
    invented = Elements2D.from_ends(
        np.column_stack([between, 0 * between + 100.0]),
        np.column_stack([between, 0 * between + 200.0]),
        [POLE] * len(between),
    )
    false = replace(invented, score=drawn(rng, len(between), False))
    return CalibrationImage.of(joined(right, false), truth, is_complete=True)


def drawn(rng: np.random.Generator, count: int, is_right: bool) -> np.ndarray:
    """Draw scores of right or of false detections, by rejection from uniform ones."""
    scores = rng.random(50 * count + 50)
    share = probability(scores)
    kept = scores[rng.random(len(scores)) < (share if is_right else 1.0 - share)]
    return kept[:count]


@pytest.fixture(scope="module")
def images() -> list[CalibrationImage]:
    rng = np.random.default_rng(5)
    return [planted_image(rng) for _ in range(IMAGES)]


@pytest.fixture(scope="module")
def fitted(images: list[CalibrationImage]) -> FittedCalibration:
    return fit_calibration(images)


def test_scores_become_probabilities(
    images: list[CalibrationImage], fitted: FittedCalibration
) -> None:
    """The curve is the share of right ones among detections of a score, and never falls."""
    curve = fitted.scores["pole"]
    scores = np.concatenate([image.detections.score for image in images])
    right = np.concatenate([image.matches >= 0 for image in images])
    for low in np.arange(0.0, 1.0, 0.2):
        rows = (scores >= low) & (scores < low + 0.2)
        assert curve(scores[rows]).mean() == pytest.approx(right[rows].mean(), abs=0.04)
    assert (np.diff(curve(np.linspace(0.0, 1.0, 101))) >= 0.0).all()
    assert np.abs(curve(scores) - scores).max() > 0.15  # raw scores were no probabilities


def test_sigmas_are_scaled_to_their_errors(fitted: FittedCalibration) -> None:
    scale = fitted.sigma_scale
    assert scale.pole_across == pytest.approx(ACROSS, rel=0.1)
    assert scale.pole_along == pytest.approx(ALONG, rel=0.1)
    assert scale.sign == 1.0  # none was seen


def test_a_kind_with_few_detections_has_the_curve_of_both(
    images: list[CalibrationImage], fitted: FittedCalibration
) -> None:
    """No sign was detected: its scores are compared with those of poles all the same."""
    assert fitted.scores["sign"] == fitted.scores["pole"]
    with pytest.raises(SemvizError, match="detections are known to be right or false, 20 are"):
        fit_calibration(images[:1])


def test_planted_rates_are_recovered(fitted: FittedCalibration) -> None:
    rates = fitted.figures[0].rates
    assert rates.least_score == 0.0
    assert rates.recall_near == pytest.approx(RECALL_NEAR, abs=0.05)
    assert rates.recall_far == pytest.approx(RECALL_FAR, abs=0.06)
    assert rates.false_detections == pytest.approx(FALSE_AN_IMAGE, abs=0.25)
    assert rates.hidden_bottoms == pytest.approx(HIDDEN, abs=0.04)


def test_higher_scores_leave_less(fitted: FittedCalibration) -> None:
    figures = fitted.figures
    for name in ("recall", "right", "false"):
        assert (np.diff([getattr(row, name) for row in figures]) <= 0.0).all()
    best = best_threshold(figures)
    assert best.surplus == max(row.surplus for row in figures)
    limited = best_threshold(figures, most_false=0.5)
    assert limited.false <= 0.5 < figures[figures.index(limited) - 1].false
    assert best_threshold(figures, most_false=1e-9) is figures[-1]  # as strict as it gets


def test_only_complete_images_say_what_is_false(images: list[CalibrationImage]) -> None:
    """Half of the images not reviewed: nothing in them is false, their elements still count."""
    rows = enumerate(images)
    half = [replace(image, is_complete=number % 2 == 0) for number, image in rows]
    strict = threshold_figures(images[::2])[0]
    mixed = threshold_figures(half)[0]
    assert mixed.false == strict.false
    assert mixed.recall != strict.recall
    with pytest.raises(SemvizError, match="0 detections are known to be right or false, 20 are"):
        fit_calibration([replace(image, is_complete=False) for image in images])


def calibration() -> DetectorCalibration:
    rates = [
        CalibratedRates(least_score=least, false_detections=false, recall_near=0.7,
                        recall_far=0.2, near_m=20.0, far_m=45.0, reach_m=1000.0, hidden_bottoms=0.1)
        for least, false in ((0.0, 5.0), (0.5, 1.25))
    ]  # fmt: skip
    return DetectorCalibration(
        detector="planted 12345678",
        model="12345678" * 8,
        measuring="edges",
        truth='3 images of "town"',
        least_score=0.5,
        scores={"pole": ScoreCurve(score=(0.2, 0.6), probability=(0.1, 0.9))},
        sigma_scale=SigmaScale(pole_across=2.0, pole_along=3.0, sign=4.0),
        rates=tuple(rates),
    )


def test_a_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "planted.calibration.toml"
    calibration().save(path)
    assert DetectorCalibration.load(path) == calibration()


def test_detections_are_calibrated_by_kind() -> None:
    """Scores of signs, without a curve, stay; each sigma has its own scale."""
    poles = Elements2D.from_ends([[10, 10], [20, 10]], [[10, 50], [20, 50]], [POLE, POLE])
    signs = Elements2D.from_ends([[40, 10]], [[np.nan, np.nan]], [1])
    seen = replace(joined(poles, signs), score=np.array([0.4, 0.95, 0.3]))
    told = calibration().calibrated(seen)
    np.testing.assert_allclose(told.score, [0.5, 0.9, 0.3])
    np.testing.assert_allclose(told.sigma_px, [[2.0, 3.0], [2.0, 3.0], [4.0, 4.0]])


@pytest.mark.parametrize(("least", "false"), [(0.0, 5.0), (0.49, 5.0), (0.5, 1.25), (1.0, 1.25)])
def test_rates_are_those_of_the_minimum_score(least: float, false: float) -> None:
    assert calibration().detector_model(least) == DetectorModel(
        false_detections=false, recall_near=0.7, recall_far=0.2, hidden_bottoms=0.1
    )


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("[0.1, 0.9]", "[0.9, 0.1]", "probability must not descend"),
        ("[0.2, 0.6]", "[0.2]", "same number of values"),
        ("recall_far = 0.2", "recall_far = 0.8", "recall_far <= recall_near"),
        ("least_score = 0.5\n", "least_score = 7\n", "less than or equal to 1"),
        ("format = 1", "format = 2", "format"),
        ("pole_along = 3.0", "pole_along = nan", "finite"),
        ("format = 1", "format = ", "planted.calibration.toml"),
    ],
)
def test_a_broken_file_is_refused_in_one_line(tmp_path: Path, old: str, new: str, why: str) -> None:
    path = tmp_path / "planted.calibration.toml"
    calibration().save(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(SemvizError, match=why) as refused:
        DetectorCalibration.load(path)
    assert "\n" not in str(refused.value)
