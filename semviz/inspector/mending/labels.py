"""From error to label: the labels behind a run's map opened and mended, and the run made again."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from semviz.author import login_name
from semviz.inspector.mending.rebuild import Rebuild
from semviz.inspector.selection.origins import Origins
from semviz.inspector.topic import Topic, Verbs, whole
from semviz.recording.run import FrameRecord, Run
from semviz.verdicts import blamed_elements, explained
from semviz.web.sessions import Message
from semviz.workspace import Workspace
from semviz_annotation.edits import Edit, Judge, Link
from semviz_annotation.rows import judged
from semviz_core.errors import SemvizError
from semviz_core.map_file import save_map

Json = dict[str, Any]


class Mending:
    """The labels of one run's map, for all pages."""

    def __init__(self, run: Run, path: Path) -> None:
        """``path`` is where the run was read from."""
        self._run = run
        self.origins = Origins(run, path)
        """What its elements were made of."""
        self._done: list[int] = []
        """Numbers of the operations that were done here and stand."""

    @property
    def workspace(self) -> Workspace:
        """SemvizError where the labels are not at hand."""
        if self.origins.workspace is None:
            where = self._run.info.workspace or "WORKSPACE"
            raise SemvizError(f"the labels are not at hand; open them: semviz annotate {where}")
        return self.origins.workspace

    def view(self) -> Json:
        """How many edits of the labels the run's map does not know, and what can be undone here."""
        workspace = self.origins.workspace
        if workspace is None:
            return {"workspace": "", "edits": 0, "undoable": 0}
        edits = max(0, self.origins.operation - self._run.semantic_map.operation)
        return {"workspace": workspace.name, "edits": edits, "undoable": len(self._done)}

    def place(self, element_id: int, frame: int) -> tuple[str, int]:
        """Name of a label element that a map element was made of, and number of the frame next to
        ``frame`` that shows it."""
        shown = [
            (abs(row.frame_index - frame), row.frame_index, origin.element.number, origin.element)
            for origin in self.origins.of(element_id)
            for row in origin.used
        ]
        if not shown:
            raise SemvizError(self.origins.why_none(element_id))
        _, index, number, element = min(shown, key=lambda one: one[:3])
        return self.workspace.classes.element_name(element.class_id, number), index

    def merge(self, element_ids: tuple[int, ...]) -> None:
        """Says that map elements are one thing."""
        self._apply(Link(self._made_of(element_ids)))

    def leave_out(self, element_id: int) -> None:
        """Says that a map element does not belong in a map."""
        self._apply(Judge(tuple(judged(one, "leave out") for one in self._made_of((element_id,)))))

    def undo(self) -> None:
        """Takes the last edit back that was made here."""
        if not self._done:
            raise SemvizError("nothing was changed here; 'semviz annotate' can undo other edits")
        with self.workspace.open_labels() as store:
            store.undo(login_name(), number=self._done[-1])
        self._done.pop()

    def _made_of(self, element_ids: tuple[int, ...]) -> tuple[str, ...]:
        """UUIDs of the label elements that map elements were made of."""
        found = []
        for one in element_ids:
            origins = self.origins.of(one)
            if not origins:
                raise SemvizError(self.origins.why_none(one))
            found += [origin.element.id for origin in origins]
        return tuple(found)

    def _apply(self, edit: Edit) -> None:
        with self.workspace.open_labels() as store:
            self._done.append(store.apply(edit, login_name()).number)


class MendTopic(Topic):
    """Opens labels, takes edits of them, and has the run made again; nothing of it unasked."""

    _rebuild: Rebuild | None = None

    def verbs(self) -> Verbs:
        return {
            "mending": lambda _: self._tell(),
            "label": self._label,
            "merge": self._merge,
            "leave out": self._leave_out,
            "take back": lambda _: self._edit(self._mending.undo),
            "rebuild": lambda _: self._start(),
            "stop rebuild": lambda _: self._stop(),
            "keep map": lambda _: self._keep_map(),
        }

    def on_run(self) -> None:
        self._tell()

    @property
    def _mending(self) -> Mending:
        return self.desk.kept(Mending)

    @property
    def _record(self) -> FrameRecord:
        return self.desk.run.frames[self.desk.state.position]

    def _label(self, message: Message) -> None:
        """Where the label is to be seen: of ``element``, or else of the one that is blamed."""
        desk, element = self.desk, whole(message, "element")
        blamed = blamed_elements(desk.run, self._record)
        if element is None and not blamed:
            raise SemvizError("select an element first: its label is opened")
        element = blamed[0] if element is None else element
        index = self._record.frame.index
        workspace = self._mending.workspace
        name, frame = self._mending.place(element, index)
        tool = desk.tools.open(workspace)
        desk.say("label", f"annotate/{tool}/?frame={frame}&element={name}")

    def _merge(self, _: Message) -> None:
        """The elements of which the frame's verdict says that they are one thing."""
        fault = explained(self.desk.run, self._record).fault
        if fault.kind != "twice in the map":
            raise SemvizError("this frame's verdict names no elements that are one thing")
        self._edit(lambda: self._mending.merge(fault.elements))

    def _leave_out(self, message: Message) -> None:
        element = whole(message, "element")
        if element is None:
            raise SemvizError("select the element that does not belong in the map")
        self._edit(lambda: self._mending.leave_out(element))

    def _edit(self, edit: Callable[[], None]) -> None:
        edit()
        self._tell()

    def _start(self) -> None:
        desk = self.desk
        path = desk.shelf.path(desk.state.run)
        rebuild = self._rebuild = Rebuild(desk.run, path, self._mending.workspace)
        rebuild.ask(lambda: self._got_on(rebuild))

    def _stop(self) -> None:
        if self._rebuild is not None:
            self._rebuild.stop()

    def _got_on(self, rebuild: Rebuild) -> None:
        """Called in its thread; another one may have been begun."""
        with self.desk.lock:
            if rebuild is self._rebuild:
                if rebuild.value is not None:
                    self.desk.shelf.offer(rebuild.value)
                    self.desk.say("runs", list(self.desk.shelf.names))
                self._tell()

    def _keep_map(self) -> None:
        """The new run's map becomes the workspace's."""
        if self._rebuild is None or self._rebuild.value is None:
            raise SemvizError("there is no new map; build it first")
        shelf = self.desk.shelf
        made = shelf.run(shelf.offer(self._rebuild.value))
        path = self._mending.workspace.map_path(made.info.map_name)
        save_map(made.semantic_map, path)
        self.desk.say("mapKept", f"{path} is now this map.")

    def _tell(self) -> None:
        self.desk.say("mending", {**self._mending.view(), "rebuild": self._rebuild_view()})

    def _rebuild_view(self) -> Json | None:
        rebuild = self._rebuild
        if rebuild is None:
            return None
        made = rebuild.value
        return {
            "isOver": rebuild.is_over,
            "doing": rebuild.said if made is not None else rebuild.doing,
            "run": None if made is None else self.desk.shelf.offer(made),
        }
