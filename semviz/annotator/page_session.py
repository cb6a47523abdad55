"""Handle the requests of one opened page, and send it updates and its 3D scene."""

import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from semviz.annotator import messages
from semviz.annotator.drawing.association import SamePlaceError
from semviz.annotator.drawing.draft import LabelledFrameView
from semviz.annotator.drive.drive_requests import (
    DriveRequests,
    PoseRequests,
    PoseServices,
    PoseUndo,
)
from semviz.annotator.drive.pose_views import ChoosePosesRequest
from semviz.annotator.filmstrip.filmstrip_requests import FilmstripRequests
from semviz.annotator.page_scene import PageScene, SceneServices
from semviz.annotator.panes import SecondImage
from semviz.annotator.services import SearchServices
from semviz.annotator.session import LabelSession
from semviz.annotator.session_results import SavedEdit
from semviz.annotator.team.blind_views import OpenShareRequest
from semviz.annotator.team.people_view import PeopleEvent, PersonView
from semviz.annotator.team.team_requests import REVIEWING, TeamRequests, TeamServices, needs_review
from semviz.annotator.tracks.track_requests import TrackRequests
from semviz.annotator.tracks.track_rows import TrackFrame, TrackRow
from semviz.annotator.views import FrameSummary, LabelsView, label_element_name
from semviz.web import protocol
from semviz.web.protocol import RefusedError
from semviz.workspace.maps.backdrop import find_backdrop
from semviz_annotation.storage.label_file import Health, LabelFileError
from semviz_annotation.storage.operations import ConflictError, ReplacedLogError


class AnnotatorServices(PoseServices, SearchServices, TeamServices, SceneServices, Protocol):
    """All services of the annotator."""

    @property
    def pose_steps(self) -> PoseUndo: ...

    @property
    def pages(self) -> Iterable["AnnotatorPage"]: ...

    @property
    def updates_queued(self) -> threading.Event:
        """Set when a page has updates to send."""
        ...

    def people_changed(self) -> None:
        """Tell all pages soon who is where."""
        ...

    def forget(self, page: "AnnotatorPage") -> None: ...


CHANGING = (
    messages.ApplyEditRequest,
    messages.BuildMapRequest,
    messages.StopMapBuildRequest,
    ChoosePosesRequest,
    OpenShareRequest,
    *REVIEWING,
)
"""Requests that need more than the right to look."""


class AnnotatorPage:
    """One opened page; a ``PageSession``."""

    def __init__(
        self,
        session_id: str,
        send: Callable[[messages.AnnotatorEvent], None],
        shared: AnnotatorServices,
        person: str = "",
    ) -> None:
        """``person`` is the guest whose page it is; empty for who started the server."""
        self._id = session_id
        self.person = person
        self._send = send
        self._shared = shared
        self._waiting: LabelsView | None = None
        """Updates that are still to be sent."""
        self._poses = PoseRequests(send, shared, self.author)
        self._drive = DriveRequests(send, shared)
        self._tracks = TrackRequests(send, shared)
        self._filmstrip = FilmstripRequests(send, shared)
        self._team = TeamRequests(send, shared, self.author, person)
        self._frame = next(iter(self._session.frames))
        self._second: SecondImage | None = None
        """The wish for the second image."""
        self._scene = PageScene(session_id, send, shared)
        self._search_queued = threading.Event()
        self._is_searching = False
        """Whether the page was told last that its frame is still searched."""
        self._handle = HANDLERS.bound_to(
            self, self._poses, self._drive, self._tracks, self._filmstrip, self._team
        )

    @property
    def _session(self) -> LabelSession:
        """Another one after the poses were chosen anew."""
        return self._shared.session

    @property
    def author(self) -> str:
        """Whose edits those of this page are."""
        return self.person or self._session.author

    @property
    def frame(self) -> int:
        """The frame on screen."""
        return self._frame

    @property
    def selected_name(self) -> str:
        """Name of the selected element; empty for none."""
        labels = self._session.labels
        element = labels.elements.get(self._scene.selected or "")
        return "" if element is None else label_element_name(element, labels.classes)

    # -- called by the web tools' sessions and by the annotator

    def connected(self) -> None:
        with self._shared.lock:  # or a newer update could go first
            self._waiting = None
            role = self._shared.role_of(self.person) or "look"
            workspace = self._session.describe(self.author, role)
            labels = self._own(self._session.summary())
            self._send(messages.WorkspaceEvent(workspace=workspace, labels=labels))
        self._shared.people_changed()
        self.send_health(self._session.health())
        self._poses.send_progress()
        self._scene.announce()
        self._redraw()

    def restart(self) -> None:
        """Send everything again, with other poses. The caller holds the lock."""
        self._scene.drop()
        self.connected()

    def send_poses(self) -> None:
        """Send how far the comparison of poses is."""
        self._poses.send_progress()

    def queue_update(self, labels: LabelsView) -> None:
        """Send the session's updates soon, together with later ones. The caller holds the lock."""
        self._waiting = self._with_waiting(labels)
        self._shared.updates_queued.set()

    def send_update(self) -> None:
        """Send what waits, with the frame on screen. The caller holds the lock."""
        labels, self._waiting = self._waiting, None
        if labels is None:
            return
        is_near = self._session.is_near(self._frame, [frame.index for frame in labels.frames])
        frame = self._shown_frame() if is_near else None
        self._send(messages.UpdateEvent(labels=self._own(labels), frame=frame))
        if is_near:
            self._redraw()
            self._search_images()

    def _with_waiting(self, labels: LabelsView) -> LabelsView:
        """Return updates together with those that wait, which are older."""
        if self._waiting is None:
            return labels
        return _with_frames(labels, self._waiting.frames, labels.frames)

    def _own(self, labels: LabelsView) -> LabelsView:
        """Return a view as this page shows it: one undoes one's own edits."""
        history, choices = self._session.history, self._session.choices
        own = {"can_undo": history.can_undo(self.author, choices)}
        return labels.model_copy(update=own | {"can_redo": history.can_redo(self.author)})

    def send_people(self, people: list[PersonView]) -> None:
        """Send who may label here, and where they are."""
        self._send(PeopleEvent(people=people))

    def send_health(self, health: Health) -> None:
        """Send what is known about the label file."""
        self._send(messages.LabelFileEvent(state=health.state, text=health.text))

    def send_frame_list(self, frames: list[FrameSummary]) -> None:
        """Send the changed entries of the list of frames. The caller holds the lock."""
        if self._waiting is not None:  # its frames are older, and would follow
            self._waiting = _with_frames(self._waiting, self._waiting.frames, frames)
        self._send(messages.FrameListEvent(frames=frames))

    def send_tracks(self, rows: Sequence[TrackRow], frames: Sequence[TrackFrame] = ()) -> None:
        """Send rows and frames of the view "Tracks", if the page has asked for them."""
        self._tracks.send_rows(rows, frames)

    def receive(self, request: protocol.Request) -> None:
        role = self._shared.role_of(self.person)
        if role is None:
            raise RefusedError("not_saved", f"{self.person}'s access was ended; ask to be invited")
        if role == "look" and isinstance(request, CHANGING):
            raise RefusedError("invalid", "you may look at these labels, and not change them")
        if role != "review" and needs_review(request):
            raise RefusedError("invalid", "only who reviews may do this")
        self._handle(request)

    def close(self) -> None:
        self._shared.forget(self)
        self._shared.people_changed()
        self._scene.close()

    def _shown_frame(self) -> LabelledFrameView:
        return self._frame_view(self._frame, self._second)

    def _frame_view(self, index: int, second: SecondImage | None) -> LabelledFrameView:
        frame = self._session.frame(index, second)
        self._is_searching = frame.is_searching
        return frame

    def _redraw(self) -> None:
        """Draw the scene in the background; the latest state wins."""
        self._scene.redraw(self._frame)

    # -- requests

    @protocol.handles(messages.GoToFrameRequest)
    def _go_to_frame(self, request: messages.GoToFrameRequest) -> None:
        with self._shared.lock:
            frame = self._frame_view(request.frame, request.second)
            self._frame, self._second = request.frame, request.second
            self._shared.people_changed()
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
        if self._scene.selected != draft.selected_id:
            self._scene.selected = draft.selected_id
            self._redraw()

    @protocol.handles(messages.ApplyEditRequest)
    def _apply_edit(self, request: messages.ApplyEditRequest) -> None:
        """Apply an edit, confirm that it is saved, and update the other pages."""
        with self._shared.lock:
            queries = self._session.queries_of(request.edit)
        for query in queries:  # without the lock: other pages go on
            self._session.image_worker.search(query)
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
        steps = self._shared.pose_steps
        stepped = steps.step(request.edit, request.id, self._session, self.author)
        if stepped is not None:
            self._send_pose_step(request.id, stepped)
            return
        saved = self._session.apply(request.id, request.edit, request.base, self.author)
        number = saved.operation.number
        self._send(messages.SavedOperationEvent(reply_to=request.id, operation=number))
        if saved.operation.kind in ("undo", "redo") and saved.frame is not None:
            self._frame = saved.frame
        labels = self._session.updates()
        mine, self._waiting = self._own(self._with_waiting(labels)), None
        self._send_saved(request.id, saved, mine)
        rows = self._session.tracks.changed()
        for page in self._shared.pages:
            page.send_tracks(rows)
            if page is not self:
                page.queue_update(labels)

    def _send_pose_step(self, request_id: str, text: str) -> None:
        """Confirm that a choice of poses was undone or redone, and use the poses of now."""
        number = self._session.labels.operation
        self._send(messages.SavedOperationEvent(reply_to=request_id, operation=number))
        self._send(
            messages.EditSavedEvent(
                reply_to=request_id,
                labels=self._own(self._session.updates()),
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
        self._scene.reviewed = frozenset(
            element.id for element in elements if element.id is not None
        )
        self._send(messages.ReviewEvent(reply_to=request.id, review=review))
        self._redraw()

    @protocol.handles(messages.CloseReviewRequest)
    def _close_review(self, request: messages.CloseReviewRequest) -> None:
        self._scene.reviewed = frozenset()
        self._send(messages.ReviewEvent(reply_to=request.id, review=None))
        self._redraw()

    @protocol.handles(messages.BuildMapRequest)
    def _build_map(self, request: messages.BuildMapRequest) -> None:
        """Build the map; all pages show its progress and its result."""
        with self._shared.lock:
            self._session.map_work.build()
            labels = self._session.updates()
            for page in self._shared.pages:
                page.queue_update(labels)

    @protocol.handles(messages.StopMapBuildRequest)
    def _stop_map_build(self, request: messages.StopMapBuildRequest) -> None:
        with self._shared.lock:
            self._session.map_work.stop()

    @protocol.handles(protocol.SetThemeRequest)
    def _set_theme(self, request: protocol.SetThemeRequest) -> None:
        self._scene.theme = request.theme
        self._redraw()

    @protocol.handles(protocol.SetBackdropRequest)
    def _set_backdrop(self, request: protocol.SetBackdropRequest) -> None:
        session = self._session
        frame, frames = session.source.map_frame, session.frames.values()
        found = find_backdrop(session.workspace, frame, session.rig, frames)
        self._scene.backdrop = found.backdrop if request.shown else None
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
        with self._shared.lock:  # or a newer update could go first
            if self._frame == index and self._is_searching:
                self._send(messages.LabelledFrameEvent(frame=self._shown_frame()))


def _with_frames(
    labels: LabelsView, older: Sequence[FrameSummary], newer: Sequence[FrameSummary]
) -> LabelsView:
    """Return a view with both frames, a newer one in place of an older."""
    frames = {frame.index: frame for frame in [*older, *newer]}
    return labels.model_copy(update={"frames": list(frames.values())})


def _conflict(error: ConflictError, request_id: str) -> messages.ConflictEvent:
    """The refusal of an edit that would overwrite what others did."""
    return messages.ConflictEvent(
        reply_to=request_id,
        text=str(error),
        overwritten=list(error.overwritten),
        is_deleted=error.is_deleted,
        operation=error.last.number,
        author=error.last.author,
        time=error.last.time,
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
    messages.AnnotatorRequest,
    AnnotatorPage,
    PoseRequests,
    DriveRequests,
    TrackRequests,
    FilmstripRequests,
    TeamRequests,
)
