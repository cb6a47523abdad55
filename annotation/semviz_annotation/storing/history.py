"""What each author can undo and redo, and former states from the log."""

from collections.abc import Iterable, Iterator

from semviz_annotation.labels import Labels
from semviz_annotation.rows import Change, Key, Row, row_key
from semviz_annotation.storing.operations import Operation
from semviz_core.errors import SemvizError


class History:
    """Numbers of each author's edits that stand, and of those taken back; latest last.

    An author undoes the own edits only, as often as there are any; a new edit ends redoing. Naming
    a state is no edit.
    """

    def __init__(self) -> None:
        self._done: dict[str, dict[int, None]] = {}
        self._undone: dict[str, dict[int, None]] = {}

    def add(self, one: Operation) -> None:
        """Raises SemvizError where ``one`` takes back what does not stand, or the reverse."""
        self.add_numbers(one.number, one.author, one.kind, one.undoes, one.redoes)

    def add_numbers(
        self, number: int, author: str, kind: str, undoes: int | None, redoes: int | None
    ) -> None:
        """As ``add``, without having read the changes."""
        done = self._done.setdefault(author, {})
        undone = self._undone.setdefault(author, {})
        if undoes is not None:
            _move(undoes, done, undone)
        elif redoes is not None:
            _move(redoes, undone, done)
        elif kind != "name":
            done[number] = None
            undone.clear()

    def done(self, author: str) -> Iterator[int]:
        """The author's edits that stand, latest first."""
        return reversed(self._done.get(author, {}))

    def undone(self, author: str) -> Iterator[int]:
        """The author's edits that can be done once more, last undone first."""
        return reversed(self._undone.get(author, {}))

    def stands(self, author: str, number: int) -> bool:
        return number in self._done.get(author, {})


def _move(number: int, source: dict[int, None], target: dict[int, None]) -> None:
    if number not in source:
        raise SemvizError(f"operation {number} is not an edit of this author to undo or redo")
    del source[number]
    target[number] = None


def replayed(operations: Iterable[Operation], next_number: int) -> Labels:
    """The state that operations from the first on lead to."""
    rows: dict[Key, Row | None] = {}
    for change in _changes(operations):
        rows[change.key] = change.after
    return Labels.from_rows((row for row in rows.values() if row is not None), next_number)


def rewound(labels: Labels, operations: Iterable[Operation]) -> Labels:
    """The state before the operations, oldest first, that led to ``labels``."""
    rows: dict[Key, Row | None] = {}
    for change in _changes(operations):
        rows.setdefault(change.key, change.before)
    return labels.changed(
        Change(now, then) for key, then in rows.items() if (now := labels.row(key)) != then
    )


def difference(before: Labels, after: Labels) -> Iterator[Change]:
    """The changes that lead from one state to another."""
    for row in before.rows():
        then = after.row(row_key(row))
        if then != row:
            yield Change(row, then)
    for row in after.rows():
        if before.row(row_key(row)) is None:
            yield Change(None, row)


def _changes(operations: Iterable[Operation]) -> Iterator[Change]:
    return (change for one in operations for change in one.changes)
