"""The rates of a detector measured on frames, with true poses and with estimates."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.localization import Localization
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.detector_rates import MeasuredDetector, measure_detector
from semviz_core.diagnosis.fault import GroundTruth
from semviz_core.localization.localizer import Localizer
from semviz_core.research.evaluation.problems import Difficulty, make_problem, mapped_elements
from semviz_core.research.evaluation.roads import simulated_road

ROAD, SEED, FRAMES = simulated_road(3), 5000, 40


@cache
def whole_map(level: Difficulty) -> SemanticMap:
    """The map of one seed's road: every frame of the seed observes it."""
    return SemanticMap(mapped_elements(ROAD, SEED, level), MapFrame("road"))


@cache
def localized(level: Difficulty, is_known: bool) -> list[tuple[Localization, GroundTruth | None]]:
    frames: list[tuple[Localization, GroundTruth | None]] = []
    for index in np.linspace(0, len(ROAD) - 1, 4 * FRAMES).astype(int).tolist():
        problem = make_problem(SEED, level, ROAD, index)
        if not problem.is_valid or len(frames) == FRAMES:
            continue
        request = problem.observed, problem.submap, problem.camera, problem.prior
        found = Localizer().localize(*request)
        truth = GroundTruth(problem.T_camera_map) if is_known else None
        frames.append((found, truth))
    return frames


@cache
def measured(level: Difficulty, is_known: bool = True) -> MeasuredDetector:
    return measure_detector(localized(level, is_known), whole_map(level))


def test_hidden_bottoms_are_measured_and_not_imagined() -> None:
    half, none = (measured(Difficulty(hidden_bottoms=share)).model for share in (0.5, 0.0))
    assert half.hidden_bottoms == pytest.approx(0.5, abs=0.12)
    assert none.hidden_bottoms < 0.05


def test_a_map_without_bottoms_leaves_the_assumed_share() -> None:
    level = Difficulty(hidden_bottoms=0.5)
    elements = replace(whole_map(level).elements, end_known=np.zeros(len(whole_map(level)), bool))
    found = measure_detector(localized(level, True), SemanticMap(elements, MapFrame("road")))
    assert found.model.hidden_bottoms == pytest.approx(DetectorModel().hidden_bottoms)


def test_false_detections_and_recall() -> None:
    plain, cluttered = (measured(Difficulty(clutter_share=share)) for share in (0.0, 1.0))
    assert 0.4 < plain.model.false_detections < 2.0  # some elements are not in the map
    assert cluttered.model.false_detections > 2.0 * plain.model.false_detections
    assert plain.model.recall_near == pytest.approx(0.72, abs=0.12)


def test_sigmas_are_scaled_to_the_errors() -> None:
    honest = measured(Difficulty(hidden_bottoms=0.5)).sigma_scale
    assert honest.pole_across == pytest.approx(1.0, abs=0.3)
    proud = measured(Difficulty(sigma_px=3.0, stated_sigma_px=1.0)).sigma_scale
    assert proud.pole_across == pytest.approx(3.0, abs=0.8)


def test_estimates_that_are_sure_replace_the_truth() -> None:
    known, own = (measured(Difficulty(hidden_bottoms=0.5), is_known) for is_known in (True, False))
    assert own.frames < known.frames
    assert own.model.hidden_bottoms == pytest.approx(known.model.hidden_bottoms, abs=0.15)
    assert own.sigma_scale.pole_across == pytest.approx(known.sigma_scale.pole_across, abs=0.5)


def test_rates_belong_to_minimum_scores() -> None:
    rates = measured(Difficulty(hidden_bottoms=0.5)).rates
    assert [row.least_score for row in rates[:2]] == [0.0, 0.1]
    false = [row.false_detections for row in rates]
    assert false == sorted(false, reverse=True)


def test_too_few_frames_are_refused() -> None:
    with pytest.raises(SemvizError, match="0 frames have a true pose"):
        measure_detector([], whole_map(Difficulty()))
