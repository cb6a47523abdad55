"""Answer the view "Map over time": its changes, decisions on them, and the changed map."""

import json
import os
from typing import NamedTuple

from aiohttp import web

from semviz.inspector.context import Panel, RunLibrary
from semviz.inspector.element_card import workspaces_near
from semviz.inspector.map_over_time import over_time_requests
from semviz.inspector.map_over_time.over_time import (
    OverTime,
    PassSearch,
    over_time_event,
    search_of,
    search_of_run,
    shots_of,
)
from semviz.inspector.map_over_time.views_over_time import (
    ChangeAnswer,
    ChangeAnswersEvent,
    ChangedMapEvent,
)
from semviz.inspector.views_run import LabelPageEvent
from semviz.web.protocol import RefusedError, handles
from semviz.workspace.maps.map_decisions import (
    Answer,
    ChangeDecisions,
    DecisionConflictError,
    LabelPlace,
    decide_in,
    decisions_path,
    read_decisions,
)
from semviz.workspace.outputs import PARQUET, check_outputs
from semviz.workspace.settings import login_name
from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping.passes.changed_map import changed_map
from semviz_annotation.mapping.passes.changes import Change
from semviz_annotation.mapping.quality.diff import diff_maps
from semviz_core.base.map_file import save_map
from semviz_core.common.errors import SemvizError


def changes_route(library: RunLibrary) -> web.AbstractRouteDef:
    """Serve what ``semviz map changes --json`` prints at ``/map-changes.json?run=NAME``."""

    async def respond(request: web.Request) -> web.Response:
        try:
            search = search_of_run(library, request.query.get("run", ""))
        except SemvizError:
            raise web.HTTPNotFound(text="no such run\n") from None
        if search.value is None:
            raise web.HTTPNotFound(text="the passes are not searched for changes yet\n")
        path = None if search.workspace is None else decisions_path(search.workspace)
        decisions = ChangeDecisions() if path is None else read_decisions(path)
        file = json.dumps(decisions.as_dict(search.value.changes), indent=1)
        headers = {"Content-Disposition": 'attachment; filename="map-changes.json"'}
        return web.Response(text=file, content_type="application/json", headers=headers)

    return web.get("/map-changes.json", respond)


class Former(NamedTuple):
    """What a decision on a change replaced."""

    name: str
    answer: Answer
    label: LabelPlace | None


class OverTimePanel(Panel):
    """Sends the map over time and the decisions on its changes, and stores decisions."""

    _search: PassSearch | None = None
    _done: list[tuple[Former, ...]]
    """What the decisions that were made on this page replaced, oldest first."""

    def on_run(self) -> None:
        search = search_of(self.context)
        if search is not self._search:
            self._search, self._done = search, []

    @property
    def _found(self) -> OverTime:
        if self._search is None or self._search.value is None:
            raise RefusedError("busy", "the passes are still searched for changes; wait for them")
        return self._search.value

    @property
    def _workspace(self) -> Workspace:
        if self._search is None or self._search.workspace is None:
            raise SemvizError(self._note())
        return self._search.workspace

    @handles(over_time_requests.GetOverTimeRequest)
    def _get(self, _: over_time_requests.GetOverTimeRequest) -> None:
        search = search_of(self.context)
        search.start(lambda: self._on_progress(search))

    def _on_progress(self, search: PassSearch) -> None:
        """Called in the background thread; the page may show another map by then."""
        with self.context.lock:
            if search is self._search:
                self.context.send(over_time_event(search, self.context.run.info.map_name))
                if search.value is not None:
                    self._send_answers()

    @handles(over_time_requests.GoToChangeRequest)
    def _go_to(self, request: over_time_requests.GoToChangeRequest) -> None:
        context, change = self.context, self._change(request.name)
        shots = shots_of(self._found, change)
        shot = shots.after if request.is_after else shots.before
        if shot is None:
            raise RefusedError("not_found", f"no frame shows {change.name}")
        one, position, _ = shot
        if one.name != context.state.run:
            context.open(one.name, one.frames[position].index)
        context.state = context.state.at(position, context.run)
        element = change.element_id
        if element is not None and element not in context.run.semantic_map:
            element = None
        context.state = context.state.with_selection(None, element, context.run)
        context.send_frame()
        context.draw_frame()

    @handles(over_time_requests.DecideChangesRequest)
    def _decide(self, request: over_time_requests.DecideChangesRequest) -> None:
        decisions, digest = self._decisions(), self._found.changes.semantic_map.digest
        former = []
        for name in request.names:
            before = decisions.on(self._change(name), digest)
            former.append(
                Former(name, "open", None)
                if before is None
                else Former(name, before.answer, before.label)
            )
        places = {
            name: self._label_place(self._change(name)) if request.answer == "label" else None
            for name in request.names
        }
        answers = [Former(name, request.answer, places[name]) for name in request.names]
        self._store(tuple(answers), request.seen)
        self._done.append(tuple(former))
        self._send_answers()

    @handles(over_time_requests.UndoChangeAnswerRequest)
    def _undo(self, request: over_time_requests.UndoChangeAnswerRequest) -> None:
        if not self._done:
            raise SemvizError("nothing was decided on this page; choose another answer instead")
        self._store(self._done[-1], request.seen)
        self._done.pop()
        self._send_answers()

    def _store(self, answers: tuple[Former, ...], seen: int) -> None:
        try:
            decide_in(self._workspace, self._found.changes, answers, login_name(), seen)
        except DecisionConflictError as error:
            self._send_answers()  # the page has seen the decisions of now
            raise RefusedError("conflict", str(error)) from None

    @handles(over_time_requests.OpenAskedLabelRequest)
    def _open_label(self, request: over_time_requests.OpenAskedLabelRequest) -> None:
        change, digest = self._change(request.name), self._found.changes.semantic_map.digest
        decision = self._decisions().on(change, digest)
        if decision is None or decision.label is None:
            raise RefusedError("not_found", f"no label of {change.name} is asked for")
        workspace = Workspace.open(self._workspace.path / decision.label.workspace)
        annotator = self.context.annotators.open(workspace)
        named = {
            element.number
            for element in workspace.read_labels().elements.values()
            if element.class_id == int(self._found.changes.whole.class_id[change.row])
        }
        element = f"&element={change.name}" if change.element_id in named else ""
        address = f"annotate/{annotator}/?frame={decision.label.frame}{element}"
        self.context.send(LabelPageEvent(address=address))

    @handles(over_time_requests.WriteChangedMapRequest)
    def _write(self, request: over_time_requests.WriteChangedMapRequest) -> None:
        found, workspace = self._found.changes, self._workspace
        path = workspace.map_path(request.name)
        if path.exists():
            raise SemvizError(f"{path}: exists already; choose another name")
        check_outputs(path, PARQUET, can_force=False, purpose="map")
        made = self._decisions().made(found)
        if not made:
            raise SemvizError("no change is to be made; decide on some first")
        changed = changed_map(found, made)
        save_map(changed, path)
        following = f"semviz localize {workspace.path} --map {request.name}"
        text = f"{path}: {len(changed)} elements. Next: {following}"
        diff = diff_maps(found.semantic_map, changed).as_text()
        self.context.send(ChangedMapEvent(name=request.name, text=text, diff=diff))
        self._send_answers()

    def _change(self, name: str) -> Change:
        for change in self._found.changes.changes:
            if change.name == name:
                return change
        raise RefusedError("not_found", f"there is no change of {name}; reload the page")

    def _decisions(self) -> ChangeDecisions:
        if self._search is None or self._search.workspace is None:
            return ChangeDecisions()
        return read_decisions(decisions_path(self._search.workspace))

    def _label_place(self, change: Change) -> LabelPlace:
        """Return where a label of a change is asked for. Raise SemvizError if that is unknown."""
        shots = shots_of(self._found, change)
        shot = shots.after or shots.before
        if shot is None:
            raise SemvizError(f"no frame shows {change.name}, so none can be labelled")
        one, position, _ = shot
        library = self.context.library
        near = workspaces_near(library.run(one.name), library.path(one.name))
        workspace = next(near, None)
        if workspace is None:
            raise SemvizError(
                f"the workspace of {one.name} was not found, so its frames cannot be labelled here"
            )
        folder = os.path.relpath(workspace.path.resolve(), self._workspace.path.resolve())
        return LabelPlace(workspace=folder, run=one.name, frame=one.frames[position].index)

    def _send_answers(self) -> None:
        found, decisions = self._found.changes, self._decisions()
        answers = []
        for change in found.changes:
            decision = decisions.on(change, found.semantic_map.digest)
            if decision is not None:
                place = decision.label
                answers.append(
                    ChangeAnswer(
                        name=change.name,
                        answer=decision.answer,
                        author=decision.author,
                        time=decision.time,
                        label="" if place is None else f"frame {place.frame} of {place.run}",
                    )
                )
        workspace = None if self._search is None else self._search.workspace
        self.context.send(
            ChangeAnswersEvent(
                answers=tuple(answers),
                seen=len(decisions.decisions),
                can_undo=bool(self._done),
                can_decide=workspace is not None,
                note=self._note(),
                next_map="" if workspace is None else _free_name(workspace, self._map_name),
            )
        )

    @property
    def _map_name(self) -> str:
        return self.context.run.info.map_name

    def _note(self) -> str:
        """Return where decisions are kept, as a sentence."""
        workspace = None if self._search is None else self._search.workspace
        if workspace is not None:
            return f"Decisions are kept in {workspace.name}. Its maps and labels stay as they are."
        return (
            f"The workspace with the map {self._map_name} was not found, so nothing can be decided "
            "here; open the runs with 'semviz serve WORKSPACE'."
        )


def _free_name(workspace: Workspace, name: str) -> str:
    """Return ``main-2``, or the first number from there on that is no map yet."""
    known, number = set(workspace.maps()), 2
    while f"{name}-{number}" in known:
        number += 1
    return f"{name}-{number}"
