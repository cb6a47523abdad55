"""Going through runs and frames, selecting, and looking from elsewhere."""

from semviz.inspector.topic import Topic, Verbs, whole
from semviz.web.sessions import Message
from semviz_core.errors import SemvizError


class Navigation(Topic):
    """The verbs that every page needs."""

    def verbs(self) -> Verbs:
        return {
            "open": self._open,
            "go": self._go,
            "draw": self._draw,
            "select": self._select,
            "look": self._look,
            "theme": self._theme,
            "alternatives": self._alternatives,
        }

    def _open(self, message: Message) -> None:
        desk = self.desk
        desk.state = desk.state.themed(str(message.get("theme")))
        desk.open(str(message.get("run") or desk.shelf.names[0]), whole(message, "frame"))

    def _go(self, message: Message) -> None:
        position = whole(message, "position")
        if position is None:
            raise SemvizError("going to a frame needs its position")
        self.desk.state = self.desk.state.at(position, self.desk.run)
        self.desk.tell_frame()

    def _draw(self, _: Message) -> None:
        """Asked for once the page shows the frame, and not for frames that it rushes through."""
        self.desk.draw_frame()

    def _select(self, message: Message) -> None:
        self.desk.select(whole(message, "observed"), whole(message, "element"))

    def _look(self, message: Message) -> None:
        desk = self.desk
        desk.state = desk.state.looking(str(message.get("view")))
        desk.tell_state()
        desk.scene.look(desk.run, desk.state)

    def _theme(self, message: Message) -> None:
        desk = self.desk
        desk.state = desk.state.themed(str(message.get("theme")))
        if desk.is_open:
            desk.draw_run()
            for topic in desk.topics:
                topic.on_theme()

    def _alternatives(self, message: Message) -> None:
        desk = self.desk
        desk.state = desk.state.showing_alternatives(bool(message.get("shown")))
        desk.tell_state()
        desk.draw_frame()
