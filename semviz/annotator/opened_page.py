"""One opened page: what it asks for, what it is told, and its 3D scene."""

import json
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from typing import Protocol

import numpy as np
from pydantic import TypeAdapter, ValidationError

from semviz.annotator.hand import Look
from semviz.annotator.scene_view import SceneView, Shown
from semviz.annotator.session import LabelSession
from semviz.annotator.views import Json, element_name, observation_json
from semviz.web.colors import Theme
from semviz.web.scenes import Scenes
from semviz.web.sessions import Message, Send
from semviz_annotation.edits import first_fault
from semviz_annotation.storing.operations import ConflictError
from semviz_core.errors import SemvizError

_LOOK: TypeAdapter[Look] = TypeAdapter(Look)


class Shared(Protocol):
    """What all opened pages of a workspace share."""

    @property
    def session(self) -> LabelSession: ...

    @property
    def lock(self) -> threading.RLock:
        """Held around every use of ``session``."""
        ...

    @property
    def scenes(self) -> Scenes: ...

    @property
    def painter(self) -> Executor:
        """One thread that draws all 3D scenes, so that no edit waits for one."""
        ...

    @property
    def observer(self) -> Executor:
        """One thread that looks at the images for all pages."""
        ...

    @property
    def pages(self) -> Iterable["OpenedPage"]: ...

    def forget(self, page: "OpenedPage") -> None: ...


class OpenedPage:
    """A ``PageSession`` of the web tools' sessions."""

    def __init__(self, session_id: str, send: Send, shared: Shared) -> None:
        self._id = session_id
        self._send = send
        self._shared = shared
        self._session = shared.session
        self._frame = next(iter(self._session.frames))
        self._selected: str | None = None
        self._reviewed: frozenset[str] = frozenset()
        """Elements that the decision or finding on screen is about."""
        self._scene: SceneView | None = None
        self._theme: Theme = "dark"
        self._stale = threading.Event()
        self._curious = threading.Event()

    # -- as the web tools' sessions call it

    def connected(self) -> None:
        with self._shared.lock:  # or newer news could go first
            state = self._session.summary()
            self._send({"type": "hello"} | self._session.describe() | {"state": state})
        if self._scene is not None:
            self._send({"type": "scene"})
        self._redraw()

    def tell(self, kind: str, state: Json, more: Json | None = None) -> None:
        """Sends the session's news with the frame on screen; call with the lock held."""
        frame = self._session.frame(self._frame)
        self._send({"type": kind, "state": state, "frame": frame} | (more or {}))
        self._redraw()
        self._observe()

    def send_facts(self, frames: list[Json]) -> None:
        """Sends what is new in the list of frames."""
        self._send({"type": "facts", "frames": frames})

    def receive(self, message: Message) -> None:
        verbs: dict[object, Callable[[Message], None]] = {
            "go": self._go,
            "look": self._look,
            "edit": self._edit,
            "at": self._at,
            "history": self._history,
            "review": self._review,
            "build": self._build,
            "theme": self._set_theme,
        }
        if message.get("type") not in verbs:
            raise SemvizError("not a message of this page; reload it")
        verbs[message["type"]](message)

    def close(self) -> None:
        self._shared.forget(self)
        self._shared.painter.submit(self._shared.scenes.close, self._id)

    # -- what the page asks for

    def _go(self, message: Message) -> None:
        index = message.get("frame")
        if not isinstance(index, int):
            raise SemvizError("no frame number; reload the page")
        with self._shared.lock:
            frame = self._session.frame(index)
        self._frame = index
        self._send({"type": "frame", "frame": frame})
        self._session.images.prefetch(index)
        self._redraw()
        self._observe()

    def _look(self, message: Message) -> None:
        look = _look_of(message.get("look"))
        with self._shared.lock:
            answer = self._session.look(look)
        self._send({"type": "look", "look": answer})
        if self._selected != look.selected_id:
            self._selected = look.selected_id
            self._redraw()

    def _edit(self, message: Message) -> None:
        """Does an edit, says that it is saved, and tells the other pages what is new."""
        request, edit = message.get("request"), message.get("edit")
        if not isinstance(request, str) or not isinstance(edit, dict):
            raise SemvizError("an edit needs a request and what to do")
        with self._shared.lock:
            try:
                done = self._session.do(request, edit)
            except ConflictError as error:
                self._send({"type": "conflict", "request": request} | _conflict(error))
                return
            except SemvizError as error:
                # what the disk refused stays with the page; what makes no sense is dropped there
                kept = str(error).startswith("Not saved")
                refused = {"type": "refused", "request": request, "text": str(error), "kept": kept}
                self._send(refused)
                return
            self._send({"type": "on disk", "request": request, "operation": done.operation.number})
            if done.operation.kind in ("undo", "redo") and done.frame is not None:
                self._frame = done.frame
            state = self._session.news()
            answer = {
                "request": request,
                "element": done.element_id,
                "added": done.added,
                "note": done.note,
            }
            self.tell("saved", state, answer)
            for page in self._shared.pages:
                if page is not self:
                    page.tell("news", state)

    def _at(self, message: Message) -> None:
        """An earlier state of a frame, to look at."""
        with self._shared.lock:
            past = self._session.past.frame(message.get("operation"), message.get("frame"))
        self._send({"type": "past"} | past)

    def _history(self, message: Message) -> None:
        with self._shared.lock:
            operations = self._session.past.operations(message.get("before"))
        self._send({"type": "history"} | operations)

    def _review(self, message: Message) -> None:
        """Shows a decision of the last map, or a finding in it; without a ``list``, no more."""
        card: Json | None = None
        if message.get("list") is not None:
            with self._shared.lock:
                card = self._session.review(message)
        self._reviewed = frozenset(one["id"] for one in (card or {}).get("elements", ()))
        self._send({"type": "review", "card": card})
        self._redraw()

    def _build(self, message: Message) -> None:
        """Builds the map, or stops that; all pages are told that it has begun, and how it ends."""
        with self._shared.lock:
            if message.get("stop") is True:
                self._session.map_work.stop()
                return
            self._session.map_work.build()
            state = self._session.news()
            for page in self._shared.pages:
                page.tell("news", state)

    def _set_theme(self, message: Message) -> None:
        self._theme = "light" if message.get("theme") == "light" else "dark"
        self._redraw()

    # -- proposals

    def _observe(self) -> None:
        """Asks the images about what is proposed in this frame, soon."""
        if not self._curious.is_set():
            self._curious.set()
            self._shared.observer.submit(self._ask)

    def _ask(self) -> None:
        self._curious.clear()
        index = self._frame
        with self._shared.lock:
            questions = self._session.unanswered(index)
        for question in questions:
            if self._curious.is_set():
                return  # something has changed: it is asked for again
            self._session.looker.answer(question)
        if not questions:
            return
        with self._shared.lock:
            frame = self._session.frame(index)
        if self._frame == index:
            self._send({"type": "frame", "frame": frame})

    # -- the 3D scene

    def _redraw(self) -> None:
        """Draws the scene soon; the latest state wins."""
        if not self._stale.is_set():
            self._stale.set()
            self._shared.painter.submit(self._draw)

    def _draw(self) -> None:
        self._stale.clear()
        with self._shared.lock:
            shown = self._shown()
        if self._scene is None:
            self._scene = self._new_scene()
            self._send({"type": "scene"})
        self._scene.show(shown)
        self._scene.set_theme(self._theme)

    def _shown(self) -> Shown:
        labels = self._session.labels
        ids = [self._selected or "", *sorted(self._reviewed)]
        marked = [labels.elements[one] for one in ids if one in labels.elements]
        return Shown(
            elements=self._session.elements_3d(),
            T_map_camera=self._session.frames[self._frame].T_map_camera,
            marked=frozenset(one.number for one in marked),
            name=element_name(marked[0], self._session.classes) if marked else "",
        )

    def _new_scene(self) -> SceneView:
        poses = [frame.T_map_camera for frame in self._session.frames.values()]
        centers = [pose.translation for pose in poses if pose is not None]
        return SceneView(
            self._shared.scenes.scene(self._id),
            np.array(centers).reshape(-1, 3),
            self._session.rig.left,
            self._session.classes,
            self._clicked,
        )

    def _clicked(self, number: int) -> None:
        for element in self._session.labels.elements.values():
            if element.number == number:
                self._send({"type": "select", "element": element.id})


def _conflict(error: ConflictError) -> Json:
    """What others have made of the observation; null where they have deleted it."""
    row = error.current
    theirs = None if row is None else observation_json(row) | {"element": row.element_id}
    if theirs is not None:
        del theirs["id"]
    return {"text": str(error), "theirs": theirs}


def _look_of(data: object) -> Look:
    try:
        return _LOOK.validate_json(json.dumps(data))
    except ValidationError as error:
        raise SemvizError(f"not a look: {first_fault(error)}") from None
