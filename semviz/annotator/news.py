"""What has happened to the labels since the pages were last told."""

from collections import deque

from semviz.annotator import views
from semviz.annotator.facts import Facts
from semviz.annotator.views import Json
from semviz_annotation.labels import Labels
from semviz_annotation.storing.store import LabelStore
from semviz_core.classes import ClassSet

HISTORY = 100
"""So many operations the page lists at first."""


class News:
    """Follows the log of one store, whoever writes it. One thread at a time."""

    def __init__(self, store: LabelStore, classes: ClassSet, facts: Facts) -> None:
        self._store = store
        self._classes = classes
        self._facts = facts
        self._touched: set[int] = set()
        """Frames that were changed and that the pages have not been told of."""
        self._start_at(store.last_operation)

    def _start_at(self, operation: int) -> None:
        self._history: deque[Json] = deque(maxlen=HISTORY)
        """Newest first."""
        self.operation = max(0, operation - HISTORY)
        """The last one in the history."""
        self._announced = operation

    @property
    def waits(self) -> bool:
        """Whether there is something that the pages have not been told of."""
        return self._store.last_operation != self._announced

    def history(self, labels: Labels) -> list[Json]:
        """The last operations up to ``labels``, newest first."""
        if self._store.last_operation < self.operation:  # an older backup was put back
            self._start_at(self._store.last_operation)
            self._touched.update(self._facts.forget_all())
        for one in self._store.operations(after=self.operation):
            self._history.appendleft(views.operation_json(one, labels, self._classes))
            self._touched.update(views.frames_touched(one))
            self._facts.forget(one, labels)
            self.operation = one.number
        return list(self._history)

    def told(self) -> set[int]:
        """The frames that changed since the last call; all pages are told of them now."""
        touched, self._touched = self._touched, set()
        self._announced = self.operation
        return touched
