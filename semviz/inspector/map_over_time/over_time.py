"""The view "Map over time": search all runs for changes of the open run's map, in a thread."""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from semviz.inspector.context import Background, PageContext, RunLibrary
from semviz.inspector.element_card import workspaces_near
from semviz.inspector.map_over_time.change_texts import (
    change_facts,
    change_sentence,
    change_title,
    near_rows,
)
from semviz.inspector.map_over_time.views_over_time import (
    LeftOutRun,
    OverTimeChange,
    OverTimeEvent,
    OverTimeView,
    PassRow,
    PassShot,
    PassView,
    StandingElement,
)
from semviz.inspector.views import Pixel
from semviz.runs.run import Run
from semviz.workspace.maps.passes import check_drive, date_of, in_time, pass_of
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.passes.changes import Change, MapChanges, find_changes
from semviz_annotation.mapping.passes.evidence import Pass
from semviz_core.base.semantic_map import SemanticMap, footprint_m
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError


class Shots(NamedTuple):
    """Frames that show a change best: position in a pass, and whether it detects the element."""

    before: tuple[Pass, int, bool] | None
    after: tuple[Pass, int, bool] | None


class OverTime(NamedTuple):
    """What the passes say, and the passes in the order of its columns."""

    changes: MapChanges
    passes: tuple[Pass, ...]


class PassSearch(Background[OverTime]):
    """Searches all runs of the library for changes of one map."""

    def __init__(self, library: RunLibrary, semantic_map: SemanticMap, workspace: Workspace | None):
        super().__init__()
        self._library = library
        self._map = semantic_map
        self.workspace = workspace
        """The one that holds the map; None if it is not found."""
        self.left_out: list[LeftOutRun] = []

    def work(self) -> OverTime:
        passes = in_time(self._passes())
        labels = Labels(triangle_center=self._map.triangle_center)
        if self.workspace is not None:
            labels = self.workspace.read_labels()
        sure = tuple(one for one in passes if one.sure)
        found = find_changes(sure, self._map, labels, self._on_progress)
        self.report("")
        return OverTime(found, sure)

    def _passes(self) -> list[Pass]:
        passes: list[Pass] = []
        drives: dict[bytes, str] = {}
        names = self._library.names
        for name in self.watch(names, "reading runs", len(names)):
            try:
                one = pass_of(name, self._library.run(name), self._map.frame)
                if not one.sure:
                    raise SemvizError(f"{name}: no frame has the status ok")
                check_drive(one, drives)
                passes.append(one)
            except SemvizError as error:
                reason = str(error).removeprefix(f"{name}: ")
                self.left_out.append(LeftOutRun(run=name, reason=reason))
        return passes

    def _on_progress(self, step: str, done: int, total: int) -> None:
        self.report(f"{step}: pass {done + 1} of {total}")


def search_of(context: PageContext) -> PassSearch:
    """Return the search for changes of the open run's map, one for all pages."""
    return search_of_run(context.library, context.state.run)


def search_of_run(library: RunLibrary, name: str) -> PassSearch:
    """Return the search for changes of the map of a run."""
    run = library.run(name)
    make = partial(_new_search, library, run, library.path(name))
    return library.of_map(run.semantic_map.digest, make)


def _new_search(library: RunLibrary, run: Run, path: Path) -> PassSearch:
    near = workspaces_near(run, path)
    workspace = next((one for one in near if run.info.map_name in one.maps()), None)
    return PassSearch(library, run.semantic_map, workspace)


def over_time_event(search: PassSearch, map_name: str) -> OverTimeEvent:
    """Return what is found, or how far the search is."""
    found = search.value
    return OverTimeEvent(
        progress=search.progress,
        is_over=search.is_over,
        left_out=tuple(search.left_out),
        found=None if found is None else _view(found, map_name),
    )


def _view(over_time: OverTime, map_name: str) -> OverTimeView:
    found, passes = over_time
    semantic_map = found.semantic_map
    changed = {change.element_id for change in found.changes}
    place_m, elements = footprint_m(semantic_map.elements), semantic_map.elements
    return OverTimeView(
        map=map_name,
        elements=len(semantic_map),
        passes=tuple(
            PassView(run=one.name, date=date_of(one), frames=len(one.frames), sure=len(one.sure))
            for one in passes
        ),
        changes=tuple(_change_view(over_time, change) for change in found.changes),
        standing=tuple(
            StandingElement(
                name=semantic_map.name_of(id_),
                class_id=int(elements.class_id[row]),
                place=_pixel(place_m[row]),
            )
            for row, id_ in enumerate(elements.id.tolist())
            if id_ not in changed
        ),
        route=_route(semantic_map, passes[0]),
    )


def _route(semantic_map: SemanticMap, one: Pass) -> tuple[Pixel, ...]:
    if len(semantic_map.trajectory_m):
        return tuple(_pixel(point_m) for point_m in semantic_map.trajectory_m)
    poses = (one.localizations[position].T_camera_map for position in one.sure)
    return tuple(_pixel(pose.inverse().translation) for pose in poses if pose is not None)


def _change_view(over_time: OverTime, change: Change) -> OverTimeChange:
    found, shots = over_time.changes, shots_of(over_time, change)
    return OverTimeChange(
        name=change.name,
        class_id=int(found.whole.class_id[change.row]),
        seen=change.seen,
        chances=change.chances,
        probability=change.probability,
        kind=change.kind,
        element=change.element_id,
        since=found.passes.index(change.since) if change.since else None,
        existence=change.existence,
        place=_pixel(change.place_m),
        was=None if change.was_m is None else _pixel(change.was_m),
        title=change_title(change),
        story=change.story,
        sentence=change_sentence(found, change),
        facts=change_facts(found, change),
        near=tuple(_row_view(found, row) for row in near_rows(found, change)),
        before=_shot_view(found, change, shots.before, is_after=False),
        after=_shot_view(found, change, shots.after, is_after=True),
    )


def _row_view(found: MapChanges, row: int) -> PassRow:
    counts = found.evidence.counts
    return PassRow(
        name=found.semantic_map.name_of(int(found.whole.id[row])),
        class_id=int(found.whole.class_id[row]),
        seen=tuple(counts.seen[row].tolist()),
        chances=tuple(counts.chances[row].tolist()),
        probability=tuple(found.existence.probability[row].round(4).tolist()),
    )


def shots_of(over_time: OverTime, change: Change) -> Shots:
    """Return the frames that show a change best: the last ones before it, and the last of all."""
    (found, passes), row = over_time, change.row
    seen, missed = found.evidence.nearest_seen, found.evidence.nearest_missed
    since = found.passes.index(change.since) if change.since else len(passes)

    def last(positions: IntArray, is_seen: bool) -> tuple[Pass, int, bool] | None:
        known = np.flatnonzero(positions >= 0)
        if not len(known):
            return None
        return passes[known[-1]], int(positions[known[-1]]), is_seen

    if change.kind == "new":
        return Shots(last(missed[row, :since], False), last(seen[row], True))
    if change.kind == "moved":
        old = seen[found.row_in_map(change)]
        return Shots(last(old[:since], True), last(seen[row], True))
    unseen = np.where(seen[row] >= 0, -1, missed[row])
    return Shots(last(seen[row, :since], True), last(unseen, False))


def _shot_view(
    found: MapChanges, change: Change, shot: tuple[Pass, int, bool] | None, is_after: bool
) -> PassShot | None:
    if shot is None:
        return None
    one, position, is_seen = shot
    result = one.localizations[position]
    assert result.T_camera_map is not None
    was_here = change.kind == "moved" and not is_after
    element = found.whole[[found.row_in_map(change) if was_here else change.row]]
    points_m = [element.anchor_m[0]] + ([element.end_m[0]] if element.is_line[0] else [])
    ends = result.camera.project(result.T_camera_map.apply(np.array(points_m)))
    return PassShot(
        run=one.name,
        position=position,
        frame=one.frames[position].index,
        date=date_of(one),
        ends=tuple(_pixel(end) for end in ends if np.isfinite(end).all()),
        is_seen=is_seen,
    )


def _pixel(values: object) -> Pixel:
    x, y = np.asarray(values, np.float64)[:2].round(2).tolist()
    return x, y
