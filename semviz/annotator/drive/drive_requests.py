"""Handle the requests of a page about its drive: the view "Your drive", and its poses.

Poses are compared, shown frame by frame, and chosen; choices are undone and redone.
"""

from collections.abc import Callable
from typing import Protocol

from semviz.annotator import messages
from semviz.annotator.drive import pose_views
from semviz.annotator.drive.drive_view import (
    DriveEvent,
    DriveFrameEvent,
    DrivePair,
    ShowDriveFrameRequest,
    ShowDriveRequest,
    drive_pair,
    drive_view,
)
from semviz.annotator.drive.pose_views import PoseWork, pose_marks
from semviz.annotator.messages import PageEdit
from semviz.annotator.services import PageServices, SearchServices
from semviz.annotator.session import LabelSession
from semviz.reports.pose_check import choice_text
from semviz.web import protocol
from semviz.web.protocol import RefusedError
from semviz.workspace.poses.pose_review import choose_poses, step_choices
from semviz_core.common.errors import SemvizError


class DriveRequests:
    """The requests of one opened page about its drive."""

    def __init__(
        self, send: Callable[[messages.AnnotatorEvent], None], shared: SearchServices
    ) -> None:
        self._send = send
        self._shared = shared
        self._wanted: int | None = None

    @protocol.handles(ShowDriveRequest)
    def _show_drive(self, request: ShowDriveRequest) -> None:
        session = self._shared.session
        with self._shared.lock:
            try:
                view = drive_view(session.workspace, session.source)
            except SemvizError as error:
                raise RefusedError("invalid", str(error)) from None
        self._send(DriveEvent(reply_to=request.id, drive=view))

    @protocol.handles(ShowDriveFrameRequest)
    def _show_drive_frame(self, request: ShowDriveFrameRequest) -> None:
        """Match the images in the background; the latest request wins."""
        if request.frame not in self._shared.session.frames:
            raise RefusedError("not_found", f"frame {request.frame} is not in this sequence")
        self._wanted = request.frame
        self._shared.search_thread.submit(self._match, request.frame)

    def _match(self, index: int) -> None:
        if index != self._wanted:
            return
        try:
            pair = drive_pair(self._shared.session.source, index)
        except SemvizError as error:
            pair = DrivePair(frame=index, second=index, matches=[], edges=([], []), note=str(error))
        self._send(DriveFrameEvent(pair=pair))


class PoseServices(PageServices, Protocol):
    """Those for the poses."""

    @property
    def pose_work(self) -> PoseWork: ...

    def use_chosen_poses(self) -> None:
        """Open the session again with the poses that are chosen now, and tell all pages."""
        ...


class PoseUndo:
    """Undo and redo of choices of poses, in one order with the edits of labels."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        """What was said about a request: one that is sent twice is applied once."""
        self._undone_last = False

    def step(
        self, edit: PageEdit, request_id: str, session: LabelSession, author: str
    ) -> str | None:
        """Undo or redo the author's choice of poses, if that is next; return what to say about it.

        None: ``edit`` is another edit, or the next step is one of labels.
        """
        is_step = isinstance(edit, messages.UndoEdit | messages.RedoEdit)
        if not is_step or (isinstance(edit, messages.UndoEdit) and edit.request is not None):
            self._undone_last = False
            return None
        if request_id in self._texts:
            return self._texts[request_id]
        is_undo = isinstance(edit, messages.UndoEdit)
        choices = session.choices
        if is_undo and not session.history.undoes_poses(choices, author):
            self._undone_last = False
            return None
        if not is_undo and (choices.standing == len(choices.operations) or not self._undone_last):
            return None
        operation = step_choices(session.workspace, -1 if is_undo else 1)
        self._undone_last = is_undo
        text = f"{'Undone' if is_undo else 'Done again'}: {choice_text(operation)}."
        self._texts[request_id] = text
        return text


class PoseRequests:
    """Those of one opened page."""

    def __init__(
        self,
        send: Callable[[messages.AnnotatorEvent], None],
        shared: PoseServices,
        author: str,
    ) -> None:
        self._send = send
        self._author = author
        self._shared = shared

    def send_progress(self) -> None:
        """Send how far the comparison is, with its result if there is one."""
        work = self._shared.pose_work
        now = work.progress
        self._send(
            pose_views.PosesEvent(
                state=now.state,
                done=now.done,
                total=now.total,
                seconds=now.seconds,
                failure=now.failure,
                poses=None if now.state == "working" and work.view is None else work.view,
            )
        )

    @protocol.handles(pose_views.ShowPosesRequest)
    def _show_poses(self, request: pose_views.ShowPosesRequest) -> None:
        self._shared.pose_work.start()
        self.send_progress()

    @protocol.handles(pose_views.ShowPoseFrameRequest)
    def _show_pose_frame(self, request: pose_views.ShowPoseFrameRequest) -> None:
        review = self._shared.pose_work.review
        if review is None or request.stretch >= len(review.stretches):
            raise RefusedError("not_found", "the poses have not been compared yet")
        marks = pose_marks(review.stretches[request.stretch], request.frame)
        self._send(
            pose_views.PoseFrameEvent(
                reply_to=request.id, frame=request.frame, stretch=request.stretch, marks=marks
            )
        )

    @protocol.handles(pose_views.ChoosePosesRequest)
    def _choose_poses(self, request: pose_views.ChoosePosesRequest) -> None:
        review = self._shared.pose_work.review
        if review is None:
            raise RefusedError("not_found", "the poses have not been compared yet")
        stretch = request.first, request.last, request.subject
        try:
            chosen = choose_poses(review, request.choice, stretch, self._author, request.id)
        except SemvizError as error:
            raise RefusedError("invalid", str(error)) from None
        text = choice_text(chosen)
        text = f"{text[0].upper()}{text[1:]}. Undo: Ctrl Z."
        self._send(pose_views.PosesChosenEvent(reply_to=request.id, text=text))
        self._shared.use_chosen_poses()
