"""What is said of each element over a run: a planted one stands out, and frames are its own."""

from dataclasses import replace
from functools import lru_cache
from itertools import count

import numpy as np
import pytest
from support.planted_faults import WHOLE, Given, shifted
from support.planted_runs import FRAMES, STEP, PlantedRun, plant_in_run

from semviz_core.base.elements import Elements3D
from semviz_core.base.localization import Localization
from semviz_core.diagnosis.element_statistics import (
    DiagnosedFrame,
    ElementRecord,
    element_records,
)
from semviz_core.diagnosis.fault import FaultKind, GroundTruth
from semviz_core.research.evaluation.problems import (
    DETECTOR,
    default_road,
    make_problem,
    mapped_elements,
)


@lru_cache
def planted_run(fault: FaultKind) -> PlantedRun:
    found = (plant_in_run(fault, seed, default_road()) for seed in count())
    return next(filter(None, found))


def records_of(run: PlantedRun) -> tuple[ElementRecord, ...]:
    frames = [DiagnosedFrame(*frame) for frame in run.frames]
    return element_records(frames, run.semantic_map, DETECTOR)


def test_a_moved_element_comes_first_and_fits_in_no_frame() -> None:
    run = planted_run("moved in the map")
    worst, *others = records_of(run)
    assert (worst.id,) == run.elements
    assert worst.outlier_share == 1.0
    assert worst.median_px > 5.0
    assert all(other.outlier_share < 0.5 for other in others if len(other.seen) > 2)


def test_where_nothing_is_wrong_next_to_nothing_is_an_outlier() -> None:
    records = records_of(planted_run("healthy"))
    assert sum(len(record.outlier) for record in records) <= 0.02 * sum(
        len(record.seen) for record in records
    )


def test_frames_are_those_that_see_the_element_and_rest_on_it() -> None:
    run = planted_run("healthy")
    for record in records_of(run):
        ids = [truth.element_id for _, truth in run.frames]
        assert record.seen == [k for k, id in enumerate(ids) if id is not None and record.id in id]
        assert record.used == [
            k for k, (found, _) in enumerate(run.frames) if record.id in used(found)
        ]
        assert set(record.outlier) <= set(record.seen)
        assert len(record.residual_px) == len(record.seen)


def used(localization: Localization) -> list[int]:
    if localization.refinement is None or localization.T_camera_map is None:
        return []
    return localization.submap.id[
        localization.refinement.pairs[localization.refinement.inlier, 1]
    ].tolist()


def test_an_element_that_pulls_answers_costs_and_one_that_holds_them_helps() -> None:
    """Moved by 0.4 m it is still taken, and the error is larger with it than without."""
    frames, elements, element = a_drive()
    pulled = shifted(elements, element, np.array([0.25, 0.3, 0.0]))
    given = [replace(frame, elements=pulled) for frame in frames]
    localized = [
        DiagnosedFrame(pose.localized(), GroundTruth(pose.T_camera_map, pose.ids)) for pose in given
    ]
    records = element_records(localized, given[0].semantic_map, DETECTOR)
    costs = {record.id: record.mean_cost_m for record in records if record.cost_m}
    assert max(costs, key=lambda id: costs[id]) == element
    assert costs[element] > 0.05


def a_drive() -> tuple[list[Given], Elements3D, int]:
    road = default_road()
    elements = mapped_elements(road, 3, WHOLE)
    frames = [
        Given.of(make_problem(3, WHOLE, road, 30 + k * STEP, driving=True), elements)
        for k in range(FRAMES)
    ]
    seen = np.concatenate([frame.ids[frame.ids >= 0] for frame in frames])
    ids, times = np.unique(seen, return_counts=True)
    return frames, elements, int(ids[np.argmax(times)])


def test_without_the_true_poses_nothing_is_said_of_costs() -> None:
    run = planted_run("healthy")
    records = element_records(
        [DiagnosedFrame(frame, None) for frame, _ in run.frames], run.semantic_map, DETECTOR
    )
    assert records
    assert not any(record.cost_m for record in records)


def test_progress_is_told() -> None:
    told = []
    run = planted_run("healthy")

    def watch(cases, what, total):  # type: ignore[no-untyped-def]
        told.append((what, total))
        return cases

    frames = [DiagnosedFrame(*frame) for frame in run.frames]
    element_records(frames, run.semantic_map, DETECTOR, watch)
    assert told == [("checking elements", len(run.frames))]


def test_of_no_frames_there_is_nothing_to_say() -> None:
    assert element_records([], planted_run("healthy").semantic_map) == ()
    empty = ElementRecord(1)
    assert np.isnan([empty.outlier_share, empty.median_px, empty.mean_cost_m]).all()
    assert pytest.approx(0.5) == replace(empty, seen=[1, 2], outlier=[2]).outlier_share
