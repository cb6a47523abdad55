"""Read older operations, named states and former frames, and follow the log for updates.

The log may be written by any process. One thread at a time.
"""

from collections import deque
from collections.abc import Container

from semviz.annotator import operation_texts, views
from semviz.annotator.drawing.draft import LabelledFrameView
from semviz.annotator.frame_quality import FrameQuality
from semviz.annotator.panes import Panes
from semviz.annotator.views import OperationView, TeamSummary
from semviz.web.protocol import Part, RefusedError
from semviz.workspace.poses.pose_choices import PoseChoices
from semviz_annotation.labels.labels import Labels, Review
from semviz_annotation.storage.operations import NO_HASH, LogEnd
from semviz_annotation.storage.store import LabelStore, Operation

PAGE_SIZE = 100
"""Number of older operations in one answer."""


class PastFrame(Part):
    """A frame as it was after operation number ``operation``; ``done`` describes it, None for 0."""

    operation: int
    done: OperationView | None
    frame: LabelledFrameView


class HistoryView:
    """Read access to the history of one label store. One thread at a time."""

    def __init__(self, store: LabelStore, panes: Panes, frames: Container[object]) -> None:
        self._store = store
        self._panes = panes
        self._frames = frames
        self._last_read = Labels()
        """The state read last: people step through its frames."""

    def operations(self, before: int) -> list[OperationView]:
        """Return up to ``PAGE_SIZE`` operations before number ``before``, newest first."""
        return self._views(self._store.operations(before=before, limit=PAGE_SIZE))

    def named_states(self) -> list[OperationView]:
        """Return the operations that named a state, newest first; their text is the name."""
        named = self._store.named()
        names = {operation.number: operation.text for operation in named}
        return [view.model_copy(update={"text": names[view.number]}) for view in self._views(named)]

    def frame(self, operation: int, frame_index: int, second: int | None = None) -> PastFrame:
        """Return the labels of a frame after an operation, and that operation (None for 0).

        Raise RefusedError if there is no such operation or frame.
        """
        if frame_index not in self._frames:
            raise RefusedError("not_found", f"frame {frame_index} is not in this sequence")
        self._panes.show(frame_index, second)
        labels = self._labels_at(operation)
        panes = self._panes.of(frame_index)
        done = self._store.operations(after=operation - 1, limit=1) if operation else ()
        frame = LabelledFrameView(
            index=frame_index,
            operation=operation,
            hash="",
            panes=views.pane_views(self._panes, frame_index),
            at_that_time=self._panes.at_that_time(frame_index),
            elements=views.element_views(labels, panes, self._store.labels.classes),
            proposals=[],
            nearby=[],
            is_searching=False,
        )
        return PastFrame(operation=operation, done=next(iter(self._views(done)), None), frame=frame)

    def can_undo(self, author: str, choices: PoseChoices) -> bool:
        """Return whether there is a step of the author's to undo, of labels or of poses."""
        return self._store.undoable(author) is not None or self.undoes_poses(choices, author)

    def can_redo(self, author: str) -> bool:
        """Return whether there is an undone edit of the author's."""
        return self._store.redoable(author) is not None

    def undoes_poses(self, choices: PoseChoices, author: str) -> bool:
        """Return whether the author's last step that can be undone is a choice of poses."""
        last = choices.present[-1:]
        if not last or last[0].author != author:
            return False
        number = self._store.undoable(author)
        edits = () if number is None else self._store.operations(after=number - 1, limit=1)
        return not edits or edits[0].time <= last[0].time

    def _labels_at(self, number: int) -> Labels:
        if self._last_read.operation != number:
            self._last_read = self._store.labels_at(number)
        return self._last_read

    def _views(self, operations: tuple[Operation, ...]) -> list[OperationView]:
        labels = self._store.labels
        return [
            operation_texts.operation_view(operation, labels) for operation in reversed(operations)
        ]


HISTORY = 100
"""Number of operations that the page lists at first."""


class UpdateFeed:
    """Follows the log of one store, whichever process writes it. One thread at a time."""

    def __init__(self, store: LabelStore, quality: FrameQuality) -> None:
        self._store = store
        self._quality = quality
        self._changed: set[int] = set()
        """Changed frames that have not been sent to the pages."""
        self._start()

    def _start(self) -> None:
        last = self._store.end
        self.team = team_summary(self._store)
        self._history: deque[OperationView] = deque(maxlen=HISTORY)
        """Newest first."""
        before = self._store.operations(before=last.number - HISTORY + 1, limit=1)
        self.end = LogEnd(before[0].number, before[0].hash) if before else LogEnd(0, NO_HASH)
        """The last operation in the history."""
        self._sent = last

    @property
    def has_updates(self) -> bool:
        """Whether there are operations that have not been sent to the pages."""
        return self._store.end != self._sent

    def history(self, labels: Labels) -> list[OperationView]:
        """Return the last operations, newest first, described with the names of ``labels``."""
        if not self._store.holds(self.end):  # a backup was restored
            self._start()
            self._changed.update(self._quality.forget_all())
        for operation in self._store.operations(after=self.end.number):
            self._history.appendleft(operation_texts.operation_view(operation, labels))
            self._changed.update(operation_texts.frames_touched(operation))
            self._changed.update(operation_texts.frames_of_decisions(operation, labels))
            self._quality.forget(operation, labels)
            if _is_of_the_team(operation):
                self.team = team_summary(self._store)
            self.end = LogEnd(operation.number, operation.hash)
        return list(self._history)

    def take_changed_frames(self) -> set[int]:
        """Return the frames that changed since the last call, to be sent to all pages."""
        changed, self._changed = self._changed, set()
        self._sent = self.end
        return changed


def team_summary(store: LabelStore) -> TeamSummary:
    """Return which frames were sent back, and who has which."""
    team, labels = store.team(), store.labels
    return TeamSummary(
        sent_back=[
            frame
            for frame, writer in sorted(team.reviews.items())
            if writer.kind == "send back" and labels.review(frame) == "in work"
        ],
        assigned={
            name: [(part.first, part.last) for part in of] for name, of in team.assigned.items()
        },
    )


def _is_of_the_team(operation: Operation) -> bool:
    """Return whether an operation assigns frames, or changes what was reviewed or sent back."""
    rows = (change.after or change.before for change in operation.changes)
    return operation.kind == "assign" or any(isinstance(row, Review) for row in rows)
