"""Small runs through the simulated street, and ways to spoil them, for tests of what reads runs."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from semviz.runs.run import FrameRecord, Run, RunInfo, assumed_detector
from semviz.runs.writer import RunWriter
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localization.localizer import Localizer
from semviz_core.research.evaluation.roads import move_element
from semviz_core.simulation.street import Street

FRAMES = (10, 12, 14, 16, 18, 20)
Spoil = Callable[[FrameRecord], FrameRecord]


@lru_cache
def small_run() -> Run:
    """What is labelled in a few frames, localized in the true map; all ok, and without images."""
    street = Street(7)
    info = RunInfo("first", "", "search", 0, "0", "2026-01-01T00:00:00", street.rig, "street")
    return _localized(info, street, street.truth_map)


@lru_cache
def run_with_a_moved_pole() -> tuple[Run, int]:
    """The same in a map where the pole that most frames see stands elsewhere, and its id.

    Four others are seen in each frame: with more, the pole would spoil no pose.
    """
    street = Street(7)
    poles = street.truth_map.elements.id[street.truth_map.elements.is_line]
    seen = np.concatenate([frame.element_id for frame in small_run().frames])
    pole = int(np.bincount(seen[np.isin(seen, poles)]).argmax())
    info = replace(small_run().info, name="moved", map_name="moved")
    moved = move_element(street.truth_map, pole, (1.5, 0.8, 0.0))
    return _localized(info, street, moved, pole), pole


def _localized(
    info: RunInfo, street: Street, semantic_map: SemanticMap, pole: int | None = None
) -> Run:
    frames = tuple(_record(info, street, index, semantic_map, pole) for index in FRAMES)
    return Run(info, semantic_map, frames)


def _record(
    info: RunInfo, street: Street, index: int, semantic_map: SemanticMap, pole: int | None
) -> FrameRecord:
    frame = street.frames[index]
    observed, ids = street.labels(index, "left")
    if pole is not None:
        rows = np.sort([*np.flatnonzero(ids == pole), *np.flatnonzero(ids != pole)[:4]])
        observed, ids = observed[rows], ids[rows]
    assert frame.T_map_camera is not None
    prior = simulate_prior(frame.T_map_camera, PriorOptions((1.0, 2.0)), (0, index))
    submap = semantic_map.crop(prior.position_m, 50.0)
    localizer = Localizer(detector=assumed_detector(info))
    return FrameRecord(frame, localizer.localize(observed, submap, street.rig.left, prior), ids)


def spoiled(run: Run, by_frame: dict[int, Spoil]) -> Run:
    """The run with some frames changed, by number."""
    frames = (by_frame.get(frame.frame.index, lambda same: same)(frame) for frame in run.frames)
    return replace(run, frames=tuple(frames))


def off_by(metres: float) -> Spoil:
    """The answer is so far from the true pose, straight ahead."""

    def spoil(record: FrameRecord) -> FrameRecord:
        assert record.frame.T_map_camera is not None
        ahead = Pose(np.eye(3), np.array([0.0, 0.0, metres]))
        wrong = (record.frame.T_map_camera @ ahead).inverse()
        return replace(record, localization=replace(record.localization, T_camera_map=wrong))

    return spoil


def ambiguous(record: FrameRecord) -> FrameRecord:
    return replace(record, localization=replace(record.localization, status="ambiguous"))


def unanswered(record: FrameRecord) -> FrameRecord:
    failed = replace(
        record.localization,
        status="cannot",
        reason="Nothing fits.",
        T_camera_map=None,
        covariance=None,
        refinement=None,
        alternatives=(),
    )
    return replace(record, localization=failed)


def without_truth(run: Run) -> Run:
    frames = (replace(frame, frame=replace(frame.frame, T_map_camera=None)) for frame in run.frames)
    return replace(run, frames=tuple(frames))


def saved(run: Run, path: Path) -> Path:
    """The run as a file; cut off before its end where it is not complete."""
    writer = RunWriter(path, run.info, run.semantic_map)
    try:
        with writer:
            for frame in run.frames:
                writer.write(frame)
            if not run.complete:
                raise KeyboardInterrupt
    except KeyboardInterrupt:
        pass
    return path
