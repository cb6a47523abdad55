"""Handle the requests of one opened page, and send it updates and its 3D scene."""

import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from typing import Protocol

import numpy as np

from semviz.annotator import messages
from semviz.annotator.association import SamePlaceError
from semviz.annotator.draft import LabelledFrameView
from semviz.annotator.drive_requests import DriveRequests, PoseRequests, PoseUndo
from semviz.annotator.panes import SecondImage
from semviz.annotator.pose_views import PoseWork
from semviz.annotator.scene_view import AnnotatorScene, Shown
from semviz.annotator.session import LabelSession
from semviz.annotator.session_results import SavedEdit
from semviz.annotator.track_requests import TrackRequests
from semviz.annotator.track_rows import TrackFrame, TrackRow
from semviz.annotator.views import FrameSummary, LabelsView, label_element_name
from semviz.web import protocol
from semviz.web.shapes import Theme
from semviz.web.viser_servers import ViserServers
from semviz.workspace.backdrop import find_backdrop
from semviz_annotation.mapping.backdrop import Backdrop
from semviz_annotation.storage.label_file import Health, LabelFileError
from semviz_annotation.storage.operations import ConflictError, ReplacedLogError


class AnnotatorServices(Protocol):
    """Services that all opened pages of a workspace share."""

    @property
    def session(self) -> LabelSession: ...

    @property
    def lock(self) -> threading.RLock:
        """Held around every use of ``session``."""
        ...

    @property
    def pose_work(self) -> PoseWork: ...

    @property
    def pose_steps(self) -> PoseUndo: ...

    def use_chosen_poses(self) -> None:
        """Open the session again with the poses that are chosen now, and tell all pages."""
        ...

    @property
    def scenes(self) -> ViserServers: ...

    @property
    def scene_thread(self) -> Executor:
        """One thread that draws all 3D scenes, so that no edit waits for one."""
        ...

    @property
    def search_thread(self) -> Executor:
        """One thread that searches the images for all pages."""
        ...

    @property
    def pages(self) -> Iterable["AnnotatorPage"]: ...

    def forget(self, page: "AnnotatorPage") -> None: ...


class AnnotatorPage:
    """One opened page; a ``PageSession``."""

    def __init__(
        self,
        session_id: str,
        send: Callable[[messages.AnnotatorEvent], None],
        shared: AnnotatorServices,
    ) -> None:
        self._id = session_id
        self._send = send
        self._shared = shared
        self._poses = PoseRequests(send, shared)
        self._drive = DriveRequests(send, shared)
        self._tracks = TrackRequests(send, shared)
        self._frame = next(iter(self._session.frames))
        self._second: SecondImage | None = None
        """The wish for the second image."""
        self._selected: str | None = None
        self._reviewed: frozenset[str] = frozenset()
        """Elements of the decision or finding on screen."""
        self._scene: AnnotatorScene | None = None
        self._closed = False
        self._theme: Theme = "dark"
        self._backdrop: Backdrop | None = None
        self._shows_backdrop = False
        self._redraw_queued = threading.Event()
        self._search_queued = threading.Event()
        self._handle = HANDLERS.bound_to(self, self._poses, self._drive, self._tracks)

    @property
    def _session(self) -> LabelSession:
        """Another one after the poses were chosen anew."""
        return self._shared.session

    # -- called by the web tools' sessions and by the annotator

    def connected(self) -> None:
        with self._shared.lock:  # or a newer update could go first
            workspace, labels = self._session.describe(), self._session.summary()
            self._send(messages.WorkspaceEvent(workspace=workspace, labels=labels))
        self.send_health(self._session.health())
        self._poses.send_progress()
        if self._scene is not None:
            self._send(protocol.SceneEvent())
        self._redraw()

    def restart(self) -> None:
        """Send everything again, with other poses. The caller holds the lock."""
        self._shared.scene_thread.submit(self._drop_scene)
        self.connected()

    def send_poses(self) -> None:
        """Send how far the comparison of poses is."""
        self._poses.send_progress()

    def send_update(self, labels: LabelsView) -> None:
        """Send the session's updates with the frame on screen. The caller holds the lock."""
        self._send(messages.UpdateEvent(labels=labels, frame=self._shown_frame()))
        self._redraw()
        self._search_images()

    def send_health(self, health: Health) -> None:
        """Send what is known about the label file."""
        self._send(messages.LabelFileEvent(state=health.state, text=health.text))

    def send_frame_list(self, frames: list[FrameSummary]) -> None:
        """Send the changed entries of the list of frames."""
        self._send(messages.FrameListEvent(frames=frames))

    def send_tracks(self, rows: Sequence[TrackRow], frames: Sequence[TrackFrame] = ()) -> None:
        """Send rows and frames of the view "Tracks", if the page has asked for them."""
        self._tracks.send_rows(rows, frames)

    def receive(self, request: protocol.Request) -> None:
        self._handle(request)

    def close(self) -> None:
        self._shared.forget(self)
        self._shared.scene_thread.submit(self._close_scene)

    def _shown_frame(self) -> LabelledFrameView:
        return self._session.frame(self._frame, self._second)

    # -- requests

    @protocol.handles(messages.GoToFrameRequest)
    def _go_to_frame(self, request: messages.GoToFrameRequest) -> None:
        with self._shared.lock:
            frame = self._session.frame(request.frame, request.second)
            self._frame, self._second = request.frame, request.second
            self._send(messages.LabelledFrameEvent(reply_to=request.id, frame=frame))
        self._session.images.prefetch(request.frame)
        self._redraw()
        self._search_images()

    @protocol.handles(messages.PreviewDraftRequest)
    def _preview_draft(self, request: messages.PreviewDraftRequest) -> None:
        draft = request.draft
        with self._shared.lock:
            preview = self._session.preview(draft)
        self._send(messages.DraftPreviewEvent(reply_to=request.id, preview=preview))
        if self._selected != draft.selected_id:
            self._selected = draft.selected_id
            self._redraw()

    @protocol.handles(messages.ApplyEditRequest)
    def _apply_edit(self, request: messages.ApplyEditRequest) -> None:
        """Apply an edit, confirm that it is saved, and update the other pages."""
        with self._shared.lock:
            try:
                self._save_edit(request)
            except ConflictError as error:
                self._send(_conflict(error, request.id))
            except ReplacedLogError as error:
                self._send(
                    protocol.ErrorEvent(reply_to=request.id, code="replaced", text=str(error))
                )
            except SamePlaceError as error:
                self._send(same_place(error, request.id))
            except LabelFileError as error:  # the page keeps the edit, and sends it again
                self._send(
                    protocol.ErrorEvent(
                        reply_to=request.id, code="not_saved", text=str(error), retry=True
                    )
                )

    def _save_edit(self, request: messages.ApplyEditRequest) -> None:
        stepped = self._shared.pose_steps.step(request.edit, request.id, self._session)
        if stepped is not None:
            self._send_pose_step(request.id, stepped)
            return
        saved = self._session.apply(request.id, request.edit, request.base)
        number = saved.operation.number
        self._send(messages.SavedOperationEvent(reply_to=request.id, operation=number))
        if saved.operation.kind in ("undo", "redo") and saved.frame is not None:
            self._frame = saved.frame
        labels = self._session.updates()
        self._send_saved(request.id, saved, labels)
        rows = self._session.tracks.changed()
        for page in self._shared.pages:
            page.send_tracks(rows)
            if page is not self:
                page.send_update(labels)

    def _send_pose_step(self, request_id: str, text: str) -> None:
        """Confirm that a choice of poses was undone or redone, and use the poses of now."""
        number = self._session.labels.operation
        self._send(messages.SavedOperationEvent(reply_to=request_id, operation=number))
        self._send(
            messages.EditSavedEvent(
                reply_to=request_id,
                labels=self._session.updates(),
                frame=self._shown_frame(),
                element=None,
                added=0,
                note=text,
            )
        )
        self._shared.use_chosen_poses()

    def _send_saved(self, request_id: str, saved: SavedEdit, labels: LabelsView) -> None:
        event = messages.EditSavedEvent(
            reply_to=request_id,
            labels=labels,
            frame=self._shown_frame(),
            element=saved.element_id,
            added=saved.added,
            note=saved.note,
        )
        self._send(event)
        self._redraw()
        self._search_images()

    @protocol.handles(messages.ShowPastFrameRequest)
    def _show_past_frame(self, request: messages.ShowPastFrameRequest) -> None:
        with self._shared.lock:
            past = self._session.history.frame(request.operation, request.frame, request.second)
        self._send(messages.PastFrameEvent(reply_to=request.id, past=past))

    @protocol.handles(messages.ListOperationsRequest)
    def _list_operations(self, request: messages.ListOperationsRequest) -> None:
        with self._shared.lock:
            operations = self._session.history.operations(request.before)
        self._send(messages.OperationsEvent(reply_to=request.id, operations=operations))

    @protocol.handles(messages.ListNamedStatesRequest)
    def _list_named_states(self, request: messages.ListNamedStatesRequest) -> None:
        with self._shared.lock:
            states = self._session.history.named_states()
        self._send(messages.NamedStatesEvent(reply_to=request.id, states=states))

    @protocol.handles(messages.ShowReviewRequest)
    def _show_review(self, request: messages.ShowReviewRequest) -> None:
        """Show a decision of the last map, or a finding in it."""
        with self._shared.lock:
            review = self._session.review(request)
        elements = review.entry.elements if review.entry else ()
        self._reviewed = frozenset(element.id for element in elements if element.id is not None)
        self._send(messages.ReviewEvent(reply_to=request.id, review=review))
        self._redraw()

    @protocol.handles(messages.CloseReviewRequest)
    def _close_review(self, request: messages.CloseReviewRequest) -> None:
        self._reviewed = frozenset()
        self._send(messages.ReviewEvent(reply_to=request.id, review=None))
        self._redraw()

    @protocol.handles(messages.BuildMapRequest)
    def _build_map(self, request: messages.BuildMapRequest) -> None:
        """Build the map; all pages show its progress and its result."""
        with self._shared.lock:
            self._session.map_work.build()
            labels = self._session.updates()
            for page in self._shared.pages:
                page.send_update(labels)

    @protocol.handles(messages.StopMapBuildRequest)
    def _stop_map_build(self, request: messages.StopMapBuildRequest) -> None:
        with self._shared.lock:
            self._session.map_work.stop()

    @protocol.handles(protocol.SetThemeRequest)
    def _set_theme(self, request: protocol.SetThemeRequest) -> None:
        self._theme = request.theme
        self._redraw()

    @protocol.handles(protocol.SetBackdropRequest)
    def _set_backdrop(self, request: protocol.SetBackdropRequest) -> None:
        session = self._session
        frame, frames = session.source.map_frame, session.frames.values()
        found = find_backdrop(session.workspace, frame, session.rig, frames)
        self._backdrop, self._shows_backdrop = found.backdrop, request.shown
        available = found.backdrop is not None
        self._send(
            protocol.BackdropEvent(reply_to=request.id, available=available, note=found.note)
        )
        self._redraw()

    # -- proposals

    def _search_images(self) -> None:
        """Search the images for the proposals of this frame, in the background."""
        if not self._search_queued.is_set():
            self._search_queued.set()
            self._shared.search_thread.submit(self._search)

    def _search(self) -> None:
        self._search_queued.clear()
        index = self._frame
        with self._shared.lock:
            queries = self._session.pending_queries(index, self._second)
        for query in queries:
            if self._search_queued.is_set():
                return  # the frame or its labels changed: the next search takes over
            self._session.image_worker.search(query)
        if not queries:
            return
        with self._shared.lock:  # or a newer update could go first
            if self._frame == index:
                self._send(messages.LabelledFrameEvent(frame=self._shown_frame()))

    # -- the 3D scene

    def _redraw(self) -> None:
        """Draw the scene in the background; the latest state wins."""
        if not self._redraw_queued.is_set():
            self._redraw_queued.set()
            self._shared.scene_thread.submit(self._draw)

    def _drop_scene(self) -> None:
        """Draw the scene from nothing: its trajectory is that of other poses."""
        self._scene = None
        self._shared.scenes.close(self._id)

    def _close_scene(self) -> None:
        self._closed = True
        self._shared.scenes.close(self._id)

    def _draw(self) -> None:
        if self._closed:  # the page closed while another's edit was sent to all
            return
        self._redraw_queued.clear()
        with self._shared.lock:
            shown = self._shown()
        if self._scene is None:
            self._scene = self._new_scene()
            self._send(protocol.SceneEvent())
        self._scene.show(shown)
        self._scene.set_theme(self._theme)
        self._scene.show_backdrop(self._backdrop, self._shows_backdrop)

    def _shown(self) -> Shown:
        labels = self._session.labels
        ids = [self._selected or "", *sorted(self._reviewed)]
        marked = [labels.elements[id_] for id_ in ids if id_ in labels.elements]
        tracks = self._session.scene.open_tracks(ids)
        names = [label_element_name(element, self._session.classes) for element in marked]
        names += [track.name for _, track in tracks]
        return Shown(
            elements=self._session.scene.elements(),
            T_map_camera=self._session.frames[self._frame].T_map_camera,
            tracks=self._session.scene.tracks(),
            marked=frozenset(element.number for element in marked),
            marked_tracks=frozenset(place for place, _ in tracks),
            name=names[0] if names else "",
        )

    def _new_scene(self) -> AnnotatorScene:
        poses = [frame.T_map_camera for frame in self._session.frames.values()]
        centers = [pose.translation for pose in poses if pose is not None]
        return AnnotatorScene(
            self._shared.scenes.scene(self._id),
            np.array(centers).reshape(-1, 3),
            self._session.rig.left,
            self._session.classes,
            self._clicked,
        )

    def _clicked(self, kind: str, number: int) -> None:
        if kind == "track":
            track = self._session.scene.track_at(number)
            self._send(messages.ElementClickedEvent(element=track.id, is_track=True))
            return
        for element in self._session.labels.elements.values():
            if element.number == number:
                self._send(messages.ElementClickedEvent(element=element.id, is_track=False))


def _conflict(error: ConflictError, request_id: str) -> messages.ConflictEvent:
    """The refusal of an edit that would overwrite what others did."""
    return messages.ConflictEvent(
        reply_to=request_id,
        text=str(error),
        overwritten=list(error.overwritten),
        is_deleted=error.is_deleted,
    )


def same_place(error: SamePlaceError, request_id: str) -> messages.SamePlaceEvent:
    """Return the question whether a drawing and the label below it are the same element."""
    row = error.below.row
    return messages.SamePlaceEvent(
        reply_to=request_id,
        text=str(error),
        element_id=row.element_id,
        name=error.below.name,
        observation_id=row.id,
        anchor=error.drawn.anchor_px if error.drawn.anchor_known else None,
        end=error.drawn.end_px if error.drawn.end_known else None,
    )


HANDLERS = protocol.Handlers(
    messages.AnnotatorRequest, AnnotatorPage, PoseRequests, DriveRequests, TrackRequests
)
