"""One frame solved again with changes, and what is worth trying first in it."""

from dataclasses import dataclass

from semviz.inspector.background import Background
from semviz.inspector.what_if.views import Json, result_view, side_view
from semviz.recording.run import FrameRecord, Run
from semviz.trying.advice import most_telling
from semviz.trying.again import again, as_asked
from semviz.trying.change import Change
from semviz.verdicts import explained


@dataclass(frozen=True, eq=False)
class Answer:
    """A frame with changes, and what the page shows of it."""

    record: FrameRecord
    view: Json


class Attempt(Background[Answer]):
    """One frame with changes."""

    def __init__(self, run: Run, position: int, changes: tuple[Change, ...]) -> None:
        super().__init__()
        self._run = run
        self._position = position
        self._changes = changes

    def work(self) -> Answer:
        found = again(self._run, self._run.frames[self._position], self._changes)
        return Answer(found, result_view(self._run, self._position, found, self._changes))

    def view(self) -> Json | None:
        """What came of it, or why nothing did; None until it is over."""
        if self.value is not None:
            return self.value.view
        return {"position": self._position, "failure": self.doing} if self.is_over else None


@dataclass(frozen=True)
class Advised:
    """What is worth trying first, if anything is, and what the page shows of it."""

    change: Change | None
    view: Json


class Advice(Background[Advised]):
    """For one frame."""

    def __init__(self, run: Run, position: int) -> None:
        super().__init__()
        self._run = run
        self._position = position

    def is_of(self, run: Run, position: int) -> bool:
        return self._run is run and self._position == position

    def work(self) -> Advised:
        run, record = self._run, self._run.frames[self._position]
        best = most_telling(run, record, explained(run, record))
        view: Json = {"position": self._position, "text": ""}
        if best is not None:
            view["text"] = best.words(run.semantic_map)
            view["before"] = side_view(as_asked(run, record))
            view["after"] = side_view(again(run, record, (best,)))
        return Advised(best, view)
