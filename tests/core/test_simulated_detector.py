"""The simulated detector errs as often and as far as it says."""

import numpy as np
import pytest

from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.detector_model import NOISE, SIMULATED_DETECTOR, NoiseName
from semviz_core.common.arrays import FloatArray
from semviz_core.simulation.detector import RECALL, SimulatedDetector
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

SEEDS = range(20)


@pytest.fixture(scope="module")
def street() -> Street:
    return Street(5, StreetOptions(frames=160, spacing_m=3.0))


FRAMES = range(0, 160, 4)


def distances(street: Street, ids: np.ndarray, index: int) -> FloatArray:
    elements = street.truth_map.elements
    offset = elements.anchor_m[np.searchsorted(elements.id, ids)]
    offset = offset - street.view(index, "left").center_m
    return np.asarray(np.linalg.norm(offset[:, :2], axis=1))


def test_the_same_seed_detects_the_same(street: Street) -> None:
    row, same = (SimulatedDetector(street, "paper", 3).detect(4) for _ in range(2))
    other = SimulatedDetector(street, "paper", 4).detect(4)
    assert np.array_equal(row.observed.anchor_px, same.observed.anchor_px)
    assert np.array_equal(row.element_id, same.element_id)
    assert not np.array_equal(row.observed.anchor_px, other.observed.anchor_px)


def test_recall_is_that_of_its_class_and_falls_with_distance(street: Street) -> None:
    near_found, near_all = np.zeros(4), np.zeros(4)
    far_found = far_expected = 0.0
    for index in FRAMES:
        labels, ids = street.labels(index, "left")
        distance = distances(street, ids, index)
        for seed in SEEDS:
            found = np.isin(ids, SimulatedDetector(street, "low", seed).detect(index).element_id)
            assert not found[(distance < 3.0) | (distance > 40.0)].any()
            near = (distance > 3.0) & (distance < 20.0)
            np.add.at(near_found, labels.class_id[near], found[near])
            np.add.at(near_all, labels.class_id[near], 1)
            far = (distance > 37.0) & (distance < 40.0)
            far_found += found[far].sum()
            far_expected += sum(RECALL[class_id] for class_id in labels.class_id[far].tolist())
    for class_id in (POLE, TRIANGULAR, RECTANGULAR, ROUNDED):
        assert near_found[class_id] / near_all[class_id] == pytest.approx(
            RECALL[class_id], abs=0.05
        )
    assert far_found / far_expected == pytest.approx(0.63, abs=0.08)


@pytest.mark.parametrize("noise", ["paper", "low"])
def test_errors_are_as_large_as_sigma_says(street: Street, noise: NoiseName) -> None:
    signs, across, along, angles = [], [], [], []
    for index in FRAMES:
        labels, ids = street.labels(index, "left")
        rows = {int(element_id): row for row, element_id in enumerate(ids)}
        for seed in SEEDS:
            detection = SimulatedDetector(street, noise, seed).detect(index)
            for i in np.flatnonzero(detection.element_id >= 0):
                true, seen = labels[[rows[int(detection.element_id[i])]]], detection.observed[[i]]
                sigma = seen.sigma_px[0]
                error = (seen.anchor_px - true.anchor_px)[0]
                if not true.is_line[0]:
                    signs.extend(error / sigma)
                    continue
                axis = (true.end_px - true.anchor_px)[0]
                unit = axis / np.linalg.norm(axis)
                normal = np.array([-unit[1], unit[0]])
                across.append(error @ normal / sigma[0])
                if true.anchor_known[0]:
                    along.append(error @ unit / sigma[1])
                turned = (seen.end_px - seen.anchor_px)[0]
                angles.append(np.arctan2(turned @ normal, turned @ unit))
    for errors in (signs, across, along):
        assert len(errors) > 500
        assert np.mean(errors) == pytest.approx(0.0, abs=0.12)
        assert np.std(errors) == pytest.approx(1.0, abs=0.12)
    # an end that slides along its line adds no angle; sigma of the angle is the stated one
    assert np.std(angles) == pytest.approx(NOISE[noise].pole_angle_rad, rel=0.15)


def test_about_half_of_the_bottoms_are_hidden() -> None:
    known = []
    for seed in range(8):
        street = Street(seed)
        for index in range(0, 60, 6):
            detection = SimulatedDetector(street, "paper", seed).detect(index)
            true = (detection.element_id >= 0) & detection.observed.is_line
            known.extend(detection.observed.end_known[true])
    assert len(known) > 200
    assert np.mean(known) == pytest.approx(0.5, abs=0.1)


def test_false_detections_come_half_a_time_each_frame(street: Street) -> None:
    counts, poles = [], []
    for seed in range(60):
        detector = SimulatedDetector(street, "paper", seed)
        for index in range(0, 160, 16):
            detection = detector.detect(index)
            false = detection.element_id < 0
            counts.append(false.sum())
            poles.extend(detection.observed.class_id[false] == POLE)
    assert np.mean(counts) == pytest.approx(0.5, abs=0.1)
    assert np.var(counts) == pytest.approx(0.5, abs=0.12)
    assert np.mean(poles) == pytest.approx(0.7, abs=0.1)


def test_both_cameras_can_detect(street: Street) -> None:
    detector = SimulatedDetector(street, "low", 0)
    left, right = detector.detect(8, "left"), detector.detect(8, "right")
    assert not np.array_equal(left.element_id, right.element_id)


@pytest.fixture(scope="module")
def asked() -> tuple[FloatArray, FloatArray]:
    """Distances of all mapped elements in view, hidden ones too, and whether each was detected;
    on streets other than those the model was made on."""
    distance_m, found = [], []
    for seed in range(4, 8):
        street = Street(seed)
        elements, camera = street.truth_map.elements, street.rig.left
        detector = SimulatedDetector(street, "low", seed)
        for frame in street.frames[:60]:
            assert frame.T_map_camera is not None
            anchor_c = frame.T_map_camera.inverse().apply(elements.anchor_m)
            in_view = (anchor_c[:, 2] > 0.0) & camera.contains(camera.project(anchor_c))
            ids = elements.id[in_view]
            distance_m.append(distances(street, ids, frame.index))
            found.append(np.isin(ids, detector.detect(frame.index).element_id))
    return np.concatenate(distance_m), np.concatenate(found).astype(np.float64)


@pytest.mark.parametrize(
    ("nearest_m", "furthest_m", "share"),
    [
        (3.0, SIMULATED_DETECTOR.near_m, SIMULATED_DETECTOR.recall_near),
        (36.0, SIMULATED_DETECTOR.far_m, SIMULATED_DETECTOR.recall_far),
        (SIMULATED_DETECTOR.reach_m, 60.0, 0.0),
    ],
)
def test_its_model_knows_how_many_mapped_elements_it_finds(
    asked: tuple[FloatArray, FloatArray], nearest_m: float, furthest_m: float, share: float
) -> None:
    distance_m, found = asked
    there = (distance_m > nearest_m) & (distance_m < furthest_m)
    assert there.sum() > 300
    assert found[there].mean() == pytest.approx(share, abs=0.07)
