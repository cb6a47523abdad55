"""Edit the labels behind a run's map, and rebuild the map and the run on request.

The new run is stored beside the old one.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from semviz.inspector import messages
from semviz.inspector.context import Background, Panel
from semviz.inspector.element_card import Origins, mapped, provenance_of
from semviz.inspector.views_run import LabelEditsEvent, LabelPageEvent, MapSavedEvent, RebuildView
from semviz.runs.comparison import frame_change
from semviz.runs.diagnosis import frame_diagnosis, implicated_elements
from semviz.runs.frame_table import frame_table
from semviz.runs.images import project_elements
from semviz.runs.run import FrameRecord, Run
from semviz.web.protocol import RefusedError, handles
from semviz.what_if.solve import describe_sweep, free_path
from semviz.workspace.localization.rebuild import rebuild_run
from semviz.workspace.settings import login_name
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import AddElements, AnyEdit, DecideElements, Link, NewElement
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.rows import Observation, review_decision
from semviz_annotation.storage.store import ConflictError, EditBase, LogEnd, ReplacedLogError
from semviz_core.base.map_file import save_map
from semviz_core.common.errors import SemvizError

OFF_PX, OFF_TIMES = 8.0, 3.0
"""A mark is off if it is so far from its element, and so many times further than the median."""


class Rebuild(Background[Path]):
    """Rebuilds map and run. Its value is the file of the new run."""

    def __init__(self, run: Run, path: Path, workspace: Workspace) -> None:
        super().__init__()
        self._run = run
        self._path = path
        self._workspace = workspace
        self.summary = ""
        """The result in words; empty until it is complete."""

    def work(self) -> Path:
        path = free_path(self._path, "mended")
        rebuilt = rebuild_run(self._run, path, self._workspace, self._on_progress)
        frames = zip(self._run.frames, rebuilt.frames, strict=True)
        self.summary = describe_sweep([frame_change(before, after) for before, after in frames])
        return path

    def _on_progress(self, step: str, done: int, total: int) -> None:
        if self.is_stopped:
            raise SemvizError("Stopped; nothing was changed.")
        self.report(f"{step}: {done} of {total}")


class LabelEdits(NamedTuple):
    """Counts of the label edits that are newer than the map, and of those undoable here."""

    workspace: str
    """Empty if the labels are not found."""
    edits: int
    undoable: int
    seen: EditBase | None
    """What a page that is sent this has seen of the labels."""


class RunLabels:
    """The labels of one run's map, for all pages."""

    def __init__(self, run: Run, path: Path) -> None:
        """``path`` is the file of the run."""
        self._run = run
        self.origins = Origins(run, path)
        """The label elements behind the map's elements."""
        self._done: list[LogEnd] = []
        """The operations that were made here and not undone."""

    @property
    def workspace(self) -> Workspace:
        """The workspace with the labels. Raise SemvizError if they are not found."""
        if self.origins.workspace is None:
            workspace = self._run.info.workspace or "WORKSPACE"
            raise SemvizError(f"the labels were not found; open them: semviz annotate {workspace}")
        return self.origins.workspace

    def view(self) -> LabelEdits:
        """Count the label edits."""
        workspace, end = self.origins.workspace, self.origins.end
        if workspace is None or end is None:
            return LabelEdits("", 0, 0, None)
        edits = max(0, end.number - self._run.semantic_map.operation)
        return LabelEdits(workspace.name, edits, len(self._undoable), EditBase.at(end))

    def place(self, element_id: int, frame: int) -> tuple[str, int]:
        """Return the label element behind a map element, by name, and the frame number of the
        observation that is far off its place, or else of the one nearest to ``frame``. A track is
        given by its id."""
        if track := self.origins.track(element_id):
            nearest = min(track, key=lambda row: abs(row.frame_index - frame))
            return self._label_ids_of_map(element_id)[0], nearest.frame_index
        origins = self.origins.of(element_id)
        marks = [(origin.element, row) for origin in origins for row in origin.used]
        if not marks:
            raise SemvizError(self.origins.why_none(element_id))
        off_px = np.array([self._off_px(element_id, row) for _, row in marks])
        if off_px.max() > max(OFF_PX, OFF_TIMES * float(np.median(off_px))):
            element, row = marks[int(off_px.argmax())]
        else:
            element, row = min(
                marks, key=lambda mark: (abs(mark[1].frame_index - frame), mark[1].frame_index)
            )
        name = self.workspace.classes.element_name(element.class_id, element.number)
        return name, row.frame_index

    def _off_px(self, element_id: int, row: Observation) -> float:
        """Return the distance of a mark from the map element in its image; 0 if unknown."""
        position = frame_table(self._run).position_of(row.frame_index)
        pose = None if position is None else self._run.frames[position].frame.T_map_camera
        rig, element = self._run.info.rig, mapped(self._run, element_id)
        if pose is None or not row.anchor_known:
            return 0.0
        T_camera_map, camera = pose.inverse(), rig.left
        if row.side == "right":
            if rig.right is None or rig.T_right_left is None:
                return 0.0
            T_camera_map, camera = rig.T_right_left @ T_camera_map, rig.right
        projected = project_elements(element, T_camera_map, camera)
        if not projected.shown[0]:
            return 0.0
        return float(np.linalg.norm(projected.anchor_px[0] - np.array(row.anchor_px)))

    def merge(self, element_ids: tuple[int, ...], base: EditBase | None = None) -> None:
        """Link the labels of map elements as one landmark.

        As for every edit here, ``base`` is what the page had shown; see ``LabelStore.apply``.
        """
        self._apply(Link(self._label_ids(element_ids)), base)

    def exclude(self, element_id: int, base: EditBase | None = None) -> None:
        """Exclude the labels of a map element from maps; a track of detections is rejected."""
        if track := self.origins.track(element_id):
            self._reject(element_id, track, base)
            return
        ids = self._label_ids((element_id,))
        self._apply(DecideElements(tuple(review_decision(id, "leave out") for id in ids)), base)

    def _reject(self, element_id: int, track: tuple[Proposal, ...], base: EditBase | None) -> None:
        """Add a track of detections as an element that is left out of maps."""
        from semviz.annotator.tracks.detection_tracks import free_detections, mark_of

        track_id, labels = self._label_ids_of_map(element_id)[0], self.workspace.read_labels()
        rows = tuple(
            mark_of(row).at(row.frame_index, row.side, row.id)
            for row in free_detections(track, labels)
        )
        element = NewElement(track_id, track[0].class_id, rows)
        self._apply(AddElements((element,), left_out=True), base)

    def _label_ids_of_map(self, element_id: int) -> tuple[str, ...]:
        """Return the UUIDs that the map gives for an element, of labels or of tracks."""
        provenance = provenance_of(self._run.semantic_map, element_id)
        return () if provenance is None else provenance.label_ids

    def undo(self, base: EditBase | None = None) -> None:
        """Undo the last edit that was made here."""
        undoable = self._undoable
        if not undoable:
            raise SemvizError("nothing was changed here; 'semviz annotate' can undo other edits")
        with self.workspace.open_labels() as store:
            store.undo(login_name(), number=undoable[-1].number, base=base)
        self._done.remove(undoable[-1])

    @property
    def _undoable(self) -> list[LogEnd]:
        """The edits made here that are still in the log: a restored backup may hold others."""
        return [end for end in self._done if self.origins.holds(end)]

    def _label_ids(self, element_ids: tuple[int, ...]) -> tuple[str, ...]:
        """Return the UUIDs of the label elements behind map elements."""
        label_ids = []
        for id_ in element_ids:
            origins = self.origins.of(id_)
            if not origins:
                raise SemvizError(self.origins.why_none(id_))
            label_ids += [origin.element.id for origin in origins]
        return tuple(label_ids)

    def _apply(self, edit: AnyEdit, base: EditBase | None) -> None:
        with self.workspace.open_labels() as store:
            done = store.apply(edit, login_name(), base=base)
        self._done.append(LogEnd(done.number, done.hash))


def unseen(error: ConflictError | ReplacedLogError) -> RefusedError:
    """Return the refusal of an edit that was made without having seen others'."""
    if isinstance(error, ReplacedLogError):
        return RefusedError("replaced", f"{error}; look at them and repeat it")
    why = str(error).removesuffix("; keep yours or theirs")
    return RefusedError("conflict", f"{why}; nothing was changed: look at it and repeat")


class LabelRepairPanel(Panel):
    """Opens labels, edits them, and rebuilds the run, each on request."""

    _rebuild: Rebuild | None = None

    def on_run(self) -> None:
        self._send()

    @property
    def _labels(self) -> RunLabels:
        return self.context.cached(RunLabels)

    @property
    def _record(self) -> FrameRecord:
        return self.context.run.frames[self.context.state.position]

    @handles(messages.GetLabelEditsRequest)
    def _get(self, _: messages.GetLabelEditsRequest) -> None:
        self._send()

    @handles(messages.OpenLabelRequest)
    def _open_label(self, request: messages.OpenLabelRequest) -> None:
        context, element = self.context, request.element
        implicated = implicated_elements(context.run, self._record)
        if element is None and not implicated:
            raise SemvizError("no element is selected; select one to open its label")
        element = implicated[0] if element is None else element
        index = self._record.frame.index
        workspace = self._labels.workspace
        name, frame = self._labels.place(element, index)
        annotator = context.annotators.open(workspace)
        context.send(LabelPageEvent(address=f"annotate/{annotator}/?frame={frame}&element={name}"))

    @handles(messages.MergeDuplicatesRequest)
    def _merge(self, request: messages.MergeDuplicatesRequest) -> None:
        fault = frame_diagnosis(self.context.run, self._record).fault
        if fault.kind != "twice in the map":
            raise SemvizError("the diagnosis of this frame names no duplicates")
        self._edit(lambda: self._labels.merge(fault.elements, request.base))

    @handles(messages.ExcludeElementRequest)
    def _exclude(self, request: messages.ExcludeElementRequest) -> None:
        self._edit(lambda: self._labels.exclude(request.element, request.base))

    @handles(messages.UndoLabelEditRequest)
    def _undo(self, request: messages.UndoLabelEditRequest) -> None:
        self._edit(lambda: self._labels.undo(request.base))

    def _edit(self, edit: Callable[[], None]) -> None:
        try:
            edit()
        except (ConflictError, ReplacedLogError) as error:
            raise unseen(error) from None
        finally:
            self._send()  # after a refusal: the page has seen the labels of now

    @handles(messages.RebuildMapRequest)
    def _start(self, _: messages.RebuildMapRequest) -> None:
        context = self.context
        run, path = context.run, context.library.path(context.state.run)
        rebuild = self._rebuild = Rebuild(run, path, self._labels.workspace)
        rebuild.start(lambda: self._on_progress(rebuild))

    @handles(messages.StopRebuildRequest)
    def _stop(self, _: messages.StopRebuildRequest) -> None:
        if self._rebuild is not None:
            self._rebuild.stop()

    def _on_progress(self, rebuild: Rebuild) -> None:
        """Called in the background thread; another rebuild may have started by then."""
        with self.context.lock:
            if rebuild is self._rebuild:
                if rebuild.value is not None:
                    self.context.library.add(rebuild.value)
                    self.context.send_runs()
                self._send()

    @handles(messages.KeepMapRequest)
    def _keep_map(self, _: messages.KeepMapRequest) -> None:
        if self._rebuild is None or self._rebuild.value is None:
            raise SemvizError("there is no new map; build it first")
        library = self.context.library
        run = library.run(library.add(self._rebuild.value))
        path = self._labels.workspace.map_path(run.info.map_name)
        save_map(run.semantic_map, path)
        self.context.send(MapSavedEvent(text=f"Saved as {path}."))

    def _send(self) -> None:
        view = self._labels.view()
        self.context.send(LabelEditsEvent(**view._asdict(), rebuild=self._rebuild_view()))

    def _rebuild_view(self) -> RebuildView | None:
        rebuild = self._rebuild
        if rebuild is None:
            return None
        path = rebuild.value
        return RebuildView(
            is_over=rebuild.is_over,
            progress=rebuild.summary if path is not None else rebuild.progress,
            run=None if path is None else self.context.library.add(path),
        )
