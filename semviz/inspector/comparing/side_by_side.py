"""The open run against another one: what changed, and each frame as the other run has it."""

from functools import partial

from semviz.inspector.background import Background
from semviz.inspector.comparing.comparison_view import Side, SideBySide
from semviz.inspector.shelf import Shelf
from semviz.inspector.topic import Topic, Verbs
from semviz.recording.run import Run
from semviz.web.sessions import Message
from semviz_core.errors import SemvizError


class Comparing(Background[SideBySide]):
    """Reads the base, which takes seconds, and compares."""

    def __init__(self, shelf: Shelf, base: str, other: str, run: Run) -> None:
        """``run`` is the one called ``other``."""
        super().__init__()
        self._shelf, self._base = shelf, base
        self._other = Side(other, run, shelf.path(other))

    def is_of(self, base: str, run: Run) -> bool:
        """Whether it compares a run with the one called ``base``."""
        return self._base == base and self._other.run is run

    def work(self) -> SideBySide:
        run = self._shelf.run(self._base)
        return SideBySide(Side(self._base, run, self._shelf.path(self._base)), self._other)


class CompareTopic(Topic):
    """Of the base's frames it tells only while both runs are shown."""

    _comparing: Comparing | None = None
    """The last one, which may be of runs that are shown no more."""

    def verbs(self) -> Verbs:
        return {"compare": self._compare, "gates": self._gates}

    def on_run(self) -> None:
        self._show()

    def on_frame(self) -> None:
        self._tell_frame()

    def on_drawn(self) -> None:
        self._draw()

    def on_state(self) -> None:
        if self.desk.has_scene:  # through the camera nothing of the base is shown
            self._draw()

    def _compare(self, message: Message) -> None:
        """With the run ``base``, side by side if ``comparing``; with none where that is empty."""
        desk, base = self.desk, str(message.get("base") or "")
        if base == desk.state.run:
            raise SemvizError(f"{base} is the run that is open; compare it with another one")
        is_other = base != desk.state.base
        desk.state = desk.state.against(base, bool(message.get("comparing")))
        desk.tell_state()
        if is_other:
            self._show()
        else:
            self._tell_frame()
        desk.draw_frame()

    def _gates(self, message: Message) -> None:
        """``texts``: what is to be told of each."""
        texts, shown = message.get("texts"), self._current()
        if shown is not None and isinstance(texts, list):
            self.desk.say("gates", [shown.gate(str(text)) for text in texts])

    def _current(self) -> SideBySide | None:
        """The comparison of the two runs that are chosen now, if it is made."""
        return (
            self._comparing.value if self._comparing and self._is_wanted(self._comparing) else None
        )

    def _is_wanted(self, comparing: Comparing) -> bool:
        return comparing.is_of(self.desk.state.base, self.desk.run)

    def _show(self) -> None:
        """The comparison; made first where it is not."""
        desk, comparing = self.desk, self._comparing
        if not desk.state.base:
            return
        if comparing is None or not self._is_wanted(comparing):
            comparing = Comparing(desk.shelf, desk.state.base, desk.state.run, desk.run)
            self._comparing = comparing
        comparing.ask(partial(self._got_on, comparing))

    def _got_on(self, comparing: Comparing) -> None:
        """Called in its thread; other runs may have been chosen by then."""
        desk = self.desk
        with desk.lock:
            if not comparing.is_over or not self._is_wanted(comparing):
                return
            if comparing.value is None:
                desk.state = desk.state.against("", False)
                desk.tell_state()
                desk.say("refusedComparison", comparing.doing)
                return
            desk.say("comparison", comparing.value.view())
            self._tell_frame()
            self._draw()

    def _tell_frame(self) -> None:
        """The frame as the base has it."""
        shown = self._current()
        if shown is not None and self.desk.state.comparing:
            self.desk.say("baseFrame", shown.base_frame(self._index))

    def _draw(self) -> None:
        """The same in 3D, or taken away from there."""
        shown, state = self._current(), self.desk.state
        base = shown.base_in_3d(self._index) if shown is not None and state.comparing else None
        self.desk.scene.show_base(base, state)

    @property
    def _index(self) -> int:
        """Number of the frame that is shown."""
        return self.desk.run.frames[self.desk.state.position].frame.index
