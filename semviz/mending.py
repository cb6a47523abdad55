"""From error to label and back: a run's map built again from its labels, and the run with it."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from semviz.drive import Drive
from semviz.localizability import options_of
from semviz.observing import Observe, detector_model, observations_of, observe_labels
from semviz.recording.run import FrameRecord, Run, RunInfo
from semviz.recording.writer import write_run
from semviz.workspace import Workspace
from semviz_annotation.mapping.build import rebuild_map
from semviz_core.arrays import IntArray
from semviz_core.elements import Elements2D
from semviz_core.frame import Frame, Prior
from semviz_core.localize import Localizer
from semviz_core.semantic_map import SemanticMap

OnProgress = Callable[[str, int, int], None]
"""What is done, how much of it, and of how much."""


def mend_run(
    run: Run, path: Path, workspace: Workspace, on_progress: OnProgress = lambda what, i, n: None
) -> Run:
    """A new run in ``path``: the map as it was built, from labels as they are now; the same frames.

    They are seen as before and known as before, unless it is the labels that are seen: then these
    too are read as they are now. ``on_progress`` may raise to stop it; nothing is left then.

    Raises SemvizError where the map was not built from labels, or cannot be any more.
    """
    labels = workspace.read_labels()
    semantic_map, _ = rebuild_map(run.semantic_map, labels, workspace.source, on_progress)
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


def _localized(run: Run, semantic_map: SemanticMap, workspace: Workspace) -> Iterable[FrameRecord]:
    """The run's frames in another map, with the images they had."""
    options = options_of(run.info.options)
    observations = observations_of(run.info.observations)
    recorded = {one.frame.index: one for one in run.frames}
    by_labels = observations == "labels"
    observe = observe_labels(workspace, semantic_map) if by_labels else _as_seen(recorded)
    detector = detector_model(observations)
    drive = Drive(
        workspace.source,
        semantic_map,
        tuple(one.frame for one in run.frames),
        observe,
        _as_known(recorded),
        Localizer(
            options.method, run.info.seed, semantic_map.classes, detector, options.weights_path
        ),
        options,
    )
    for one in drive:
        was = recorded[one.frame.index]
        yield replace(was, localization=one.localization, element_id=one.element_id)


def _as_seen(recorded: dict[int, FrameRecord]) -> Observe:
    def observe(frame: Frame) -> tuple[Elements2D, IntArray]:
        record = recorded[frame.index]
        return record.localization.observed, record.element_id

    return observe


def _as_known(recorded: dict[int, FrameRecord]) -> Callable[[Frame], Prior]:
    return lambda frame: recorded[frame.index].localization.prior
