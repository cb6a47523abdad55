"""The open run against another one: what changed, and each frame as the other run has it."""

import threading

from semviz.inspector.comparison_view import Side, SideBySide
from semviz.inspector.shelf import Shelf
from semviz.inspector.topic import Topic, Verbs
from semviz.web.sessions import Message
from semviz_core.errors import SemvizError


class CompareTopic(Topic):
    """Compares in a thread of its own; of the base's frames tells only while both are shown."""

    _shown: SideBySide | None = None
    """The last comparison, which may be of runs that are shown no more."""

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
        desk.state = desk.state.against(base, bool(message.get("comparing")))
        desk.tell_state()
        self._show()
        desk.draw_frame()

    def _gates(self, message: Message) -> None:
        """``texts``: what is to be told of each."""
        texts, shown = message.get("texts"), self._current()
        if shown is not None and isinstance(texts, list):
            self.desk.say("gates", [shown.gate(str(text)) for text in texts])

    def _current(self) -> SideBySide | None:
        """The comparison of the two runs that are chosen now, if it is made."""
        state, shown = self.desk.state, self._shown
        wanted = state.base, state.run
        return shown if shown and (shown.base.name, shown.other.name) == wanted else None

    def _show(self) -> None:
        """The comparison; made first where it is not."""
        if not self.desk.state.base:
            return
        if self._current() is None:
            threading.Thread(target=self._work, name="compare", daemon=True).start()
        else:
            self._tell_frame()

    def _work(self) -> None:
        """In a thread of its own: reading a run takes seconds."""
        desk = self.desk
        with desk.lock:
            base, other = desk.state.base, desk.state.run
        try:
            made = SideBySide(*(_side(desk.shelf, name) for name in (base, other)))
            refused = ""
        except SemvizError as error:
            made, refused = None, str(error)
        with desk.lock:
            if (base, other) != (desk.state.base, desk.state.run):
                return  # others were chosen meanwhile
            if made is None:
                desk.state = desk.state.against("", False)
                desk.tell_state()
                desk.say("refusedComparison", refused)
                return
            self._shown = made
            desk.say("comparison", made.view())
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


def _side(shelf: Shelf, name: str) -> Side:
    return Side(name, shelf.run(name), shelf.path(name))
