"""The detector's figures: errors that are planted come out as exactly those numbers."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_core.base.classes import DEFAULT_CLASSES, POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.elements import Elements2D, joined
from semviz_core.metrics.detection import (
    FALSE_POSITIVE,
    IGNORED,
    ImageGroundTruth,
    match_confused_classes,
    match_detections,
)
from semviz_core.metrics.detection_summary import ImageEvaluation, detection_figures, threshold_at
from semviz_core.simulation.detector import street_truth
from semviz_core.simulation.street import Street

FRAMES = 30


def scene(seed: int = 0) -> Elements2D:
    """Six poles of 100 px, a little tilted, and two signs of each class, all far apart."""
    rng = np.random.default_rng(seed)
    u = 60.0 + 90.0 * np.arange(12) + rng.uniform(-5.0, 5.0, 12)
    v = rng.uniform(40.0, 200.0, 12)
    anchor = np.stack([u, v], axis=1)
    end = anchor + np.array([3.0, 100.0])
    end[6:] = np.nan
    kinds = [POLE] * 6 + [TRIANGULAR, RECTANGULAR, ROUNDED] * 2
    return Elements2D.from_ends(anchor, end, kinds)


def judged(found: Elements2D, true: Elements2D, seconds: float = 0.1) -> ImageEvaluation:
    return ImageEvaluation(found, ImageGroundTruth.of(true), seconds)


def moved(elements: Elements2D, offset_px) -> Elements2D:
    return replace(
        elements, anchor_px=elements.anchor_px + offset_px, end_px=elements.end_px + offset_px
    )


def scored(elements: Elements2D, score) -> Elements2D:
    return replace(elements, score=np.broadcast_to(score, len(elements)))


def figures(images, threshold: float | None = 0.0):
    return detection_figures(images, DEFAULT_CLASSES, threshold)


def test_a_perfect_detector_is_perfect() -> None:
    told = figures([judged(scene(seed), scene(seed)) for seed in range(FRAMES)], None)
    assert told.false_a_frame == 0.0
    assert told.threshold == 0.0
    for class_ in told.classes.values():
        assert class_.recall.share == class_.precision.share == 1.0
        assert class_.accuracy.lateral_rmse_px == pytest.approx(0.0, abs=1e-12)
    diagonal = np.diag([180, 60, 60, 60, 0])
    np.testing.assert_array_equal(told.confusion, diagonal)


def test_every_third_missed_and_two_invented() -> None:
    """Recall 2/3; of each frame's two inventions one is a pole, one a rounded sign."""
    invented = Elements2D.from_ends(
        [[30.0, 340.0], [1200.0, 340.0]], [[30.0, 370.0], [np.nan, np.nan]], [POLE, ROUNDED]
    )
    images = [
        judged(joined(true[np.arange(12) % 3 != 0], invented), true)
        for true in map(scene, range(FRAMES))
    ]
    told = figures(images)
    pole, triangular = told.classes["pole"], told.classes["triangular sign"]
    assert (pole.recall.count, pole.recall.of) == (4 * FRAMES, 6 * FRAMES)
    assert triangular.recall.share == 0.0  # both stand at multiples of three
    assert told.classes["rounded sign"].recall.share == 1.0
    assert pole.precision.share == pytest.approx(4 / 5)
    assert told.classes["rounded sign"].precision.share == pytest.approx(2 / 3)
    assert triangular.precision.share is None
    assert told.false_a_frame == 2.0
    assert pole.false_a_frame == 1.0
    assert told.confusion[-1] == (FRAMES, 0, 0, FRAMES, 0)
    assert [row[-1] for row in told.confusion] == [2 * FRAMES, 2 * FRAMES, 0, 0, 0]


def test_shifts_and_turns_are_the_errors() -> None:
    true = scene()
    u, v = 1.5, -2.0
    signs = figures([judged(moved(true[6:], (u, v)), true[6:])]).classes["rounded sign"].accuracy
    assert signs.rmse_px == pytest.approx(2.5)
    assert (signs.lateral_me_px, signs.longitudinal_me_px) == pytest.approx((u, v))
    assert (signs.lateral_sde_px, signs.longitudinal_sde_px) == pytest.approx((0.0, 0.0))
    poles = true[:6]
    turn = np.deg2rad(1.5)
    axis = poles.end_px - poles.anchor_px
    turned = axis @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    accuracy = figures([judged(replace(poles, end_px=poles.anchor_px + turned), poles)])
    pole = accuracy.classes["pole"].accuracy
    assert (pole.angular_me_deg, pole.angular_rmse_deg) == pytest.approx((1.5, 1.5))
    assert pole.angular_sde_deg == pytest.approx(0.0, abs=1e-9)
    aside = figures([judged(moved(poles, (u, 0.0)), poles)]).classes["pole"].accuracy
    across = u * axis[0, 1] / np.linalg.norm(axis[0])  # they are all tilted alike
    assert (aside.lateral_me_px, aside.lateral_rmse_px) == pytest.approx((across, across))
    assert aside.angular_me_deg == pytest.approx(0.0, abs=1e-9)


def test_a_wrong_class_is_a_miss_a_false_one_and_confused() -> None:
    true = scene()
    swap = {TRIANGULAR: ROUNDED, RECTANGULAR: RECTANGULAR, ROUNDED: TRIANGULAR, POLE: POLE}
    found = replace(
        true, class_id=np.array([swap[class_id] for class_id in true.class_id.tolist()])
    )
    told = figures([judged(found, true)])
    for name in ("triangular sign", "rounded sign"):
        assert told.classes[name].recall.count == 0
        assert told.classes[name].precision.count == 0
    assert told.false_a_frame == 4.0
    assert told.confusion[TRIANGULAR] == (0, 0, 0, 2, 0)
    assert told.confusion[ROUNDED] == (0, 2, 0, 0, 0)
    assert told.confusion[RECTANGULAR] == (0, 0, 2, 0, 0)


@pytest.mark.parametrize("lie", [1.0, 0.5, 3.0])
def test_sigma_is_held_against_the_errors(lie: float) -> None:
    """Errors of 0.5 px, said to be ``lie`` times that."""
    rng = np.random.default_rng(1)
    images = []
    for true in map(scene, range(100)):
        noise = np.clip(rng.normal(0.0, 0.5, (12, 2)), -2.0, 2.0)
        found = moved(true, noise)
        images.append(judged(replace(found, sigma_px=np.full((12, 2), 0.5 * lie)), true))
    for bins in figures(images).sigma.values():
        (answer,) = bins
        assert answer.sigma_px == pytest.approx(0.5 * lie)
        assert answer.error_px == pytest.approx(0.5, rel=0.06)
        assert answer.ratio == pytest.approx(1.0 / lie, rel=0.06)


def test_flags_of_ends() -> None:
    """Of six bottoms two are hidden; the detector believes all but one of the others known."""
    poles = scene()[:6]
    true = replace(poles, end_known=np.array([False, False, True, True, True, True]))
    said = np.array([True, False, True, True, True, False])
    found = replace(moved(poles, 0.0), end_known=said)
    axis = poles.end_px - poles.anchor_px
    along = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    found = replace(found, end_px=found.end_px + 3.0 * along)
    bottoms = figures([judged(found, true)]).classes["pole"].bottoms
    assert bottoms is not None
    assert (bottoms.seen.count, bottoms.seen.of) == (3, 4)
    assert (bottoms.hidden.count, bottoms.hidden.of) == (1, 2)
    assert bottoms.along_rmse_px == pytest.approx(3.0)


def test_recall_by_distance() -> None:
    true = scene()
    distance = np.array([5.0, 15.0, 25.0, 35.0, 15.0, 50.0, *np.full(6, np.nan)])
    image = ImageEvaluation(true[[1, 2]], ImageGroundTruth.of(true, distance), 0.1)
    pole = figures([image]).classes["pole"]
    counts = [(share.count, share.of) for share in pole.recall_by_distance]
    assert counts == [(0, 1), (1, 2), (1, 1), (0, 1), (0, 0), (0, 0), (0, 0)]
    assert pole.recall.of == 5  # what is 50 m away does not count
    far = figures(
        [ImageEvaluation(true[[5]], ImageGroundTruth.of(true, distance, reach_m=60.0), 0.1)]
    )
    assert far.classes["pole"].recall_by_distance[4].share == 1.0


def test_what_does_not_count_makes_nothing_right_or_false() -> None:
    true = scene()
    distance = np.full(12, 20.0)
    distance[[0, 6]] = 41.0
    stump = Elements2D.from_ends([[1180.0, 100.0]], [[1180.0, 107.0]], [POLE])
    truth = ImageGroundTruth.of(joined(true, stump), np.append(distance, 20.0))
    wrong = replace(true[[6]], class_id=[ROUNDED])
    found = joined(joined(true, stump), joined(wrong, wrong))
    matches = match_detections(found, truth)
    assert matches[[0, 6, 12, 13, 14]].tolist() == [IGNORED] * 5
    told = figures([ImageEvaluation(found, truth, 0.1)])
    assert told.false_a_frame == 0.0
    assert told.classes["pole"].recall.of == 5
    assert np.sum(told.confusion) == 10


def test_what_counts_is_found_beside_what_does_not() -> None:
    sign = scene()[6:7]
    truth = ImageGroundTruth.of(joined(sign, moved(sign, (1.0, 0.0))), np.array([20.0, 50.0]))
    twice = joined(moved(sign, (1.0, 0.0)), sign)
    assert match_detections(twice, truth).tolist() == [0, IGNORED]


def test_the_better_one_takes_it_and_the_second_is_false() -> None:
    true = scene()[6:7]
    found = scored(joined(moved(true, (2.0, 0.0)), moved(true, (0.5, 0.0))), [0.9, 0.8])
    assert match_detections(found, ImageGroundTruth.of(true)).tolist() == [0, FALSE_POSITIVE]
    assert match_confused_classes(
        found, ImageGroundTruth.of(true), np.array([0, FALSE_POSITIVE])
    ).tolist() == [FALSE_POSITIVE, FALSE_POSITIVE]


@pytest.mark.parametrize(
    ("offset_px", "size_px", "near"),
    [(3.9, np.nan, True), (4.1, np.nan, False), (9.9, 40.0, True), (10.1, 40.0, False),
     (3.9, 5.0, True)],
)  # fmt: skip
def test_how_near_a_sign_must_be(offset_px: float, size_px: float, near: bool) -> None:
    true = scene()[6:7]
    truth = ImageGroundTruth.of(true, size_px=np.array([size_px]))
    assert (match_detections(moved(true, (0.0, offset_px)), truth)[0] == 0) == near


@pytest.mark.parametrize(
    ("anchor", "end", "near"),
    [
        ((100.0, 100.0), (100.0, 200.0), True),
        ((100.0, 165.0), (100.0, 200.0), True),
        ((100.0, 175.0), (100.0, 200.0), False),  # a quarter of it
        ((100.0, 0.0), (100.0, 450.0), False),  # far more than it
        ((103.9, 100.0), (103.9, 200.0), True),
        ((104.1, 100.0), (104.1, 200.0), False),
        ((97.0, 120.0), (103.0, 190.0), True),  # 4.9 deg
        ((96.9, 120.0), (103.2, 190.0), False),  # 5.1 deg
        ((100.0, 200.0), (100.0, 100.0), False),  # upside down
        ((100.0, 205.0), (100.0, 250.0), False),  # below it
    ],
)
def test_how_near_a_pole_must_be(anchor, end, near: bool) -> None:
    truth = ImageGroundTruth.of(Elements2D.from_ends([[100.0, 100.0]], [[100.0, 200.0]], [POLE]))
    found = Elements2D.from_ends([anchor], [end], [POLE])
    assert (match_detections(found, truth)[0] == 0) == near


@given(st.integers(0, 10_000), st.floats(0.0, 1.0))
def test_a_threshold_changes_no_match_above_it(seed: int, threshold: float) -> None:
    """Crowded images, with any detections, at any threshold."""
    rng = np.random.default_rng(seed)
    true, found = (_crowd(rng, count) for count in (8, 20))
    truth = ImageGroundTruth.of(true, rng.uniform(0.0, 50.0, 8), rng.uniform(5.0, 60.0, 8))
    found = scored(found, rng.uniform(0.0, 1.0, 20))
    whole = match_detections(found, truth)
    kept = found.score >= threshold
    np.testing.assert_array_equal(match_detections(found[kept], truth), whole[kept])
    right = whole[whole >= 0]
    assert len(set(right.tolist())) == len(right)
    assert truth.counts[right].all()


def _crowd(rng: np.random.Generator, count: int) -> Elements2D:
    anchor = rng.uniform(0.0, 30.0, (count, 2))
    kind = rng.integers(0, 4, count)
    end = anchor + np.array([0.0, 40.0]) + rng.normal(0.0, 2.0, (count, 2))
    end[kind != POLE] = np.nan
    return Elements2D.from_ends(anchor, end, kind)


def test_the_threshold_for_a_rate_of_false_ones() -> None:
    """In ten frames three false ones score 0.2, 0.4 and 0.6; two may pass at 0.2 a frame."""
    nothing = Elements2D.from_ends([[30.0, 340.0]], [[30.0, 370.0]], [POLE])
    images = []
    for number, true in enumerate(map(scene, range(10))):
        found = scored(true, np.linspace(0.05, 1.0, 12))
        if number < 3:
            found = joined(found, scored(nothing, 0.2 * (number + 1)))
        images.append(judged(found, true))
    threshold = threshold_at(images, 0.2)
    assert threshold == pytest.approx(min(score for score in found.score if score > 0.2))
    told = figures(images, None)
    assert told.threshold == threshold
    assert told.false_a_frame == pytest.approx(0.2)
    assert threshold_at(images, 0.3) == 0.0
    assert threshold_at(images, 0.0) > 0.6
    recall = [point.recall["pole"] for point in told.curve]
    assert recall == sorted(recall)
    assert told.curve[-1].recall["pole"] == 1.0
    assert told.curve[0].recall["pole"] == 0.0  # poles score least


def test_times() -> None:
    images = [judged(scene(), scene(), seconds) for seconds in (0.1, 0.2, 0.9)]
    told = figures(images)
    assert told.time_ms_median == pytest.approx(200.0)
    assert told.time_ms_p95 == pytest.approx(830.0)


def test_an_image_with_nothing_in_it() -> None:
    nothing = Elements2D.from_ends([], [], [])
    told = figures([judged(nothing, nothing), judged(scene(), nothing)], None)
    assert all(class_.recall.share is None for class_ in told.classes.values())
    assert told.false_a_frame == 0.0
    assert figures([judged(nothing, scene())]).classes["pole"].recall.share == 0.0


def test_a_street_tells_what_counts() -> None:
    """Labels 3 to 40 m away count; all else that can be seen does not."""
    street = Street(30_000)
    truth = street_truth(street, 12, "right")
    labelled, _ = street.labels(12, "right")
    n = len(labelled)
    assert n < len(truth.elements)
    in_range = (truth.distance_m >= 3.0) & (truth.distance_m <= 40.0)
    np.testing.assert_array_equal(truth.counts[:n], in_range[:n])
    assert not truth.counts[n:].any()
    assert 5 < truth.counts.sum() < n
    matches = match_detections(labelled, truth)
    np.testing.assert_array_equal(matches, np.where(in_range[:n], np.arange(n), IGNORED))
    assert np.isfinite(truth.size_px).all()
