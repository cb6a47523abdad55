"""The 3D scene of one opened page, drawn in the background; the latest state wins."""

import threading
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Protocol

import numpy as np

from semviz.annotator import messages
from semviz.annotator.scene_view import AnnotatorScene, Shown
from semviz.annotator.services import PageServices
from semviz.annotator.views import label_element_name
from semviz.web import protocol
from semviz.web.shapes import Theme
from semviz.web.viser_servers import ViserServers
from semviz_annotation.mapping.backdrop import Backdrop


class SceneServices(PageServices, Protocol):
    """Those for 3D scenes."""

    @property
    def scenes(self) -> ViserServers: ...

    @property
    def scene_thread(self) -> Executor:
        """One thread that draws all 3D scenes, so that no edit waits for one."""
        ...


class PageScene:
    """Draws labels, tracks and cameras for one page, once it has been asked for."""

    def __init__(
        self,
        page_id: str,
        send: Callable[[messages.AnnotatorEvent], None],
        shared: SceneServices,
    ) -> None:
        self._id = page_id
        self._send = send
        self._shared = shared
        self._frame = 0
        self.selected: str | None = None
        self.reviewed: frozenset[str] = frozenset()
        """Elements of the decision or finding on screen."""
        self.theme: Theme = "dark"
        self.backdrop: Backdrop | None = None
        """None while it is hidden."""
        self._scene: AnnotatorScene | None = None
        self._closed = False
        self._queued = threading.Event()

    def announce(self) -> None:
        """Tell a page that has reconnected that there is a scene."""
        if self._scene is not None:
            self._send(protocol.SceneEvent())

    def redraw(self, frame: int) -> None:
        """Draw the scene soon, with the cameras of a frame."""
        self._frame = frame
        if not self._queued.is_set():
            self._queued.set()
            self._shared.scene_thread.submit(self._draw)

    def drop(self) -> None:
        """Draw the scene from nothing: its trajectory is that of other poses."""
        self._shared.scene_thread.submit(self._drop)

    def close(self) -> None:
        self._shared.scene_thread.submit(self._close)

    def _drop(self) -> None:
        self._scene = None
        self._shared.scenes.close(self._id)

    def _close(self) -> None:
        self._closed = True
        self._shared.scenes.close(self._id)

    def _draw(self) -> None:
        if self._closed:  # the page closed while another's edit was sent to all
            return
        self._queued.clear()
        with self._shared.lock:
            shown = self._shown()
        if self._scene is None:
            self._scene = self._new()
            self._send(protocol.SceneEvent())
        self._scene.show(shown)
        self._scene.set_theme(self.theme)
        self._scene.show_backdrop(self.backdrop, self.backdrop is not None)

    def _shown(self) -> Shown:
        session = self._shared.session
        labels = session.labels
        ids = [self.selected or "", *sorted(self.reviewed)]
        marked = [labels.elements[id_] for id_ in ids if id_ in labels.elements]
        tracks = session.scene.open_tracks(ids)
        names = [label_element_name(element, session.classes) for element in marked]
        names += [track.name for _, track in tracks]
        return Shown(
            elements=session.scene.elements(),
            T_map_camera=session.frames[self._frame].T_map_camera,
            tracks=session.scene.tracks(),
            marked=frozenset(element.number for element in marked),
            marked_tracks=frozenset(place for place, _ in tracks),
            name=names[0] if names else "",
        )

    def _new(self) -> AnnotatorScene:
        session = self._shared.session
        poses = [frame.T_map_camera for frame in session.frames.values()]
        centers = [pose.translation for pose in poses if pose is not None]
        return AnnotatorScene(
            self._shared.scenes.scene(self._id),
            np.array(centers).reshape(-1, 3),
            session.rig.left,
            session.classes,
            self._clicked,
        )

    def _clicked(self, kind: str, number: int) -> None:
        session = self._shared.session
        if kind == "track":
            track = session.scene.track_at(number)
            self._send(messages.ElementClickedEvent(element=track.id, is_track=True))
            return
        for element in session.labels.elements.values():
            if element.number == number:
                self._send(messages.ElementClickedEvent(element=element.id, is_track=False))
