"""Rebuild a run's map from its present labels, and localize the run in it again.

The map is built with the recorded options; frames, observations and priors stay the same. If the
run observed labels, the present ones are read. A stopped rebuild leaves nothing behind.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from semviz.runs.run import FrameRecord, Run, RunInfo, assumed_detector, observations_of
from semviz.runs.writer import write_run
from semviz.workspace.drive.rig_views import OdometrySource
from semviz.workspace.localization import localize
from semviz.workspace.localization.localizability import options_of
from semviz.workspace.localization.simulated_measurements import simulated_odometry
from semviz.workspace.observations import Observe, observe_labels, read_detections
from semviz.workspace.poses.pose_review import pose_errors, with_used_poses
from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping.build import rebuild_map, uses_detections
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Frame
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnProgress, unwatched
from semviz_core.diagnosis.fault import UNKNOWN_ID
from semviz_core.localization.localizer import Localizer


def rebuild_run(
    run: Run, path: Path, workspace: Workspace, on_progress: OnProgress = unwatched
) -> Run:
    """Write a new run to ``path``, with the map built again from the present labels.

    Observations and priors are those of ``run``, but observed labels are read again.
    ``on_progress`` may raise to stop it; nothing is left then.

    Raise SemvizError if the map was not built from labels or detections, or cannot be built any
    more, or if the run is of several cameras: it holds what one of them saw.
    """
    if options_of(run.info.options).rig:
        raise SemvizError(
            "the run has one pose from several cameras; build the map with 'semviz map build', "
            "then run 'semviz localize --rig' again"
        )
    labels = workspace.read_labels()
    detected = uses_detections(run.semantic_map)
    semantic_map, _ = rebuild_map(
        run.semantic_map,
        labels,
        workspace.source,
        on_progress,
        read_detections(workspace, ()) if detected else None,
        pose_errors(workspace),
    )
    semantic_map = with_used_poses(semantic_map, workspace)
    info = _info(run, path, workspace)
    frames: list[FrameRecord] = []

    def records() -> Iterator[FrameRecord]:
        for done, record in enumerate(_localized(run, semantic_map, workspace)):
            on_progress("localizing", done, len(run.frames))
            frames.append(record)
            yield record

    try:
        write_run(records(), path, info, semantic_map)
    finally:
        with suppress(OSError):
            path.with_name(f"{path.stem}.partial.rrd").unlink()
    return Run(info, semantic_map, tuple(frames))


def _info(run: Run, path: Path, workspace: Workspace) -> RunInfo:
    return replace(
        run.info,
        name=path.stem,
        workspace=run.info.workspace or str(workspace.path),
        version=version("semviz"),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def _new_ids(old: SemanticMap, new: SemanticMap) -> dict[int, int]:
    """Return the ids of elements of ``new`` by those of ``old`` that share most of their
    observations with them; ``UNKNOWN_ID`` for those that are gone.

    Ids of labelled elements stay. Tracks of detections are numbered along the drive, so each that
    is new or gone shifts the others.
    """
    if not uses_detections(old):
        return {}
    new_id = {
        observation_id: int(element_id)
        for element_id, source in zip(new.elements.id, new.provenance, strict=True)
        for observation_id in source.observation_ids
    }
    result = {}
    for element_id, source in zip(old.elements.id, old.provenance, strict=True):
        ids = Counter(new_id[id_] for id_ in source.observation_ids if id_ in new_id)
        result[int(element_id)] = ids.most_common(1)[0][0] if ids else UNKNOWN_ID
    return result


def _localized(run: Run, semantic_map: SemanticMap, workspace: Workspace) -> Iterable[FrameRecord]:
    """Localize the run's frames in another map; images are those of the run."""
    options = options_of(run.info.options)
    observations = observations_of(run.info.observations)
    recorded = {frame.frame.index: frame for frame in run.frames}
    from_labels = observations == "labels"
    new_id = _new_ids(run.semantic_map, semantic_map)
    observe = (
        observe_labels(workspace, semantic_map) if from_labels else _recorded(recorded, new_id)
    )
    localization = localize.SequenceLocalization(
        workspace.source,
        semantic_map,
        tuple(frame.frame for frame in run.frames),
        observe,
        lambda frame: recorded[frame.index].localization.prior,
        _odometry_of(recorded, options),
        Localizer(
            options.method,
            run.info.seed,
            semantic_map.classes,
            assumed_detector(run.info),
            options.weights_path,
        ),
        options,
    )
    for record in localization:
        old = recorded[record.frame.index]
        yield replace(old, localization=record.localization, element_id=record.element_id)


def _odometry_of(
    recorded: dict[int, FrameRecord], options: localize.LocalizeOptions
) -> OdometrySource:
    """Return the odometry of a run: what was measured, else simulated again."""
    if options.has_measurements:
        return lambda before, now: recorded[now.index].odometry
    return simulated_odometry(options.seed)


def _recorded(recorded: dict[int, FrameRecord], new_id: dict[int, int]) -> Observe:
    """Observe what was recorded; elements have new ids (by their old ones)."""

    def observe(frame: Frame) -> tuple[Elements2D, IntArray]:
        record = recorded[frame.index]
        ids = [new_id.get(old_id, old_id) for old_id in record.element_id.tolist()]
        return record.localization.observed, np.array(ids, dtype=np.int64)

    return observe
