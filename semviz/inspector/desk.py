"""What one opened page has before it: a state, a run, a 3D scene, and the line to the page."""

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from semviz.inspector import views
from semviz.inspector.mending.labelling import LabellingTools
from semviz.inspector.scene.scene_view import SceneView
from semviz.inspector.session import State
from semviz.inspector.shelf import Shelf
from semviz.inspector.topic import Topic
from semviz.recording.run import Run
from semviz.web.scenes import Scenes
from semviz.web.sessions import Send
from semviz_core.errors import SemvizError

Made = TypeVar("Made")


class Desk:
    """Holds it for the topics, and tells page and topics of every change."""

    def __init__(
        self, session_id: str, shelf: Shelf, tools: LabellingTools, scenes: Scenes, send: Send
    ) -> None:
        self.shelf = shelf
        self.tools = tools
        self.state = State()
        self.topics: Sequence[Topic] = ()
        self.lock = threading.RLock()
        """Held in every verb and hook; threads of a topic's own take it to touch anything here."""
        self._session_id = session_id
        self._scenes = scenes
        self._send = send
        self._run: Run | None = None
        self._scene: SceneView | None = None

    @property
    def is_open(self) -> bool:
        """Whether a run is open."""
        return self._run is not None

    @property
    def run(self) -> Run:
        """The open run. Raises SemvizError where there is none."""
        if self._run is None:
            raise SemvizError("no run is open; choose one at the top left")
        return self._run

    @property
    def has_scene(self) -> bool:
        """Whether anything was drawn in 3D."""
        return self._scene is not None

    @property
    def scene(self) -> SceneView:
        """The 3D pane, made when first drawn: viser takes a second to import."""
        if self._scene is None:
            self._scene = SceneView(
                self._scenes.scene(self._session_id), self._clicked, self.shelf.path
            )
            self.say("scene", True)
        return self._scene

    def kept(self, make: Callable[[Run, Path], Made]) -> Made:
        """What ``make`` makes of the open run, once for all pages."""
        return self.shelf.kept(self.state.run, make)

    def open(self, name: str, frame: int | None) -> None:
        """Show another run, at the frame numbered ``frame`` or at its first."""
        run = self.shelf.run(name)
        self.state = self.state.opened(name, run, frame)
        self._run = run
        self.tell_run()
        self.draw_run()
        for topic in self.topics:
            topic.on_run()

    def select(self, observed: int | None, element: int | None) -> None:
        """Select an observed row, a map element, a pair, or nothing."""
        self.state = self.state.selecting(observed, element, self.run)
        self.tell_state()
        self.scene.select(self.run, self.state)

    def draw_run(self) -> None:
        """Map and frame in 3D, all anew."""
        self.scene.show_run(self.run, self.state)
        self._drawn()

    def draw_frame(self) -> None:
        """The frame in 3D."""
        self.scene.show_frame(self.run, self.state)
        self._drawn()

    def say(self, kind: str, value: Any) -> None:
        """Send the page ``{"type": kind, kind: value}``; its panels get it as ``showKind``."""
        self._send({"type": kind, kind: value})

    def tell_run(self) -> None:
        """Run and frame."""
        self.say("run", views.run_view(self.state.run, self.run))
        self.tell_frame()

    def tell_frame(self) -> None:
        """Frame and state."""
        frame = views.frame_view(self.run, self.state.position)
        self._send({"type": "frame", "frame": frame, "state": views.state_view(self.state)})
        for topic in self.topics:
            topic.on_frame()

    def tell_state(self) -> None:
        """Selection, and how things are looked at."""
        self.say("state", views.state_view(self.state))
        for topic in self.topics:
            topic.on_state()

    def close(self) -> None:
        self._scenes.close(self._session_id)

    def _drawn(self) -> None:
        for topic in self.topics:
            topic.on_drawn()

    def _clicked(self, kind: str, number: int) -> None:
        """Called in a thread of viser's, for an element's id or a frame's position."""
        with self.lock:
            if kind == "frame":
                self.state = self.state.at(number, self.run)
                self.tell_frame()
                self.draw_frame()
            else:
                self.select(None, number)
