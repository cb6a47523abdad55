"""Looking back: older operations, named states, and a frame as it was after any operation."""

from collections.abc import Container

from semviz.annotator import views
from semviz.annotator.panes import Panes
from semviz.annotator.views import Json
from semviz_annotation.labels import Labels
from semviz_annotation.storing.store import LabelStore, Operation
from semviz_core.classes import ClassSet
from semviz_core.errors import SemvizError

PAGE = 100
"""So many older operations are given at once."""


class Past:
    """The past of one label store, for reading. One thread at a time."""

    def __init__(
        self, store: LabelStore, panes: Panes, frames: Container[object], classes: ClassSet
    ) -> None:
        self._store = store
        self._panes = panes
        self._frames = frames
        self._classes = classes
        self._last = Labels()
        """The state that was looked at last: people go through its frames."""

    def operations(self, before: object) -> Json:
        """Operations before number ``before``, newest first; named states where it is None.

        Raises SemvizError where ``before`` is no number.
        """
        if before is None:
            named = self._store.named()
            names = [{"text": one.text} for one in reversed(named)]
            rows = [row | name for row, name in zip(self._json(named), names, strict=True)]
            return {"operations": [], "named": rows}
        found = self._store.operations(before=operation_number(before), limit=PAGE)
        return {"operations": self._json(found)}

    def frame(self, operation: object, frame_index: object) -> Json:
        """What was labelled in a frame after an operation, and that operation (None for 0).

        Raises SemvizError where there is no such operation or frame.
        """
        number = operation_number(operation)
        if not isinstance(frame_index, int) or frame_index not in self._frames:
            raise SemvizError(f"frame {frame_index} is not in this sequence")
        labels = self._labels_at(number)
        panes = self._panes.of(frame_index)
        done = self._json(self._store.operations(after=number - 1, limit=1)) if number else []
        return {
            "operation": number,
            "done": done[0] if done else None,
            "frame": {
                "index": frame_index,
                "panes": views.panes_json(panes),
                "elements": views.elements_json(labels, panes, self._classes),
                "offers": [],
                "nearby": [],
                "looking": False,
            },
        }

    def _labels_at(self, number: int) -> Labels:
        if self._last.operation != number:
            self._last = self._store.labels_at(number)
        return self._last

    def _json(self, operations: tuple[Operation, ...]) -> list[Json]:
        labels = self._store.labels
        return [views.operation_json(one, labels, self._classes) for one in reversed(operations)]


def operation_number(number: object) -> int:
    """Raises SemvizError where it is none."""
    if not isinstance(number, int) or isinstance(number, bool) or number < 0:
        raise SemvizError("no number of an operation; reload the page")
    return number
