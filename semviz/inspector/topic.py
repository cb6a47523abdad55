"""A part of the inspector's page, with verbs of its own."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from semviz.web.sessions import Message

if TYPE_CHECKING:
    from semviz.inspector.desk import Desk

Verbs = Mapping[str, Callable[[Message], None]]


class Topic:
    """What one part of the page can be asked for, and what it does when other parts change things.

    All methods are called under the desk's lock.
    """

    def __init__(self, desk: "Desk") -> None:
        self.desk = desk

    def verbs(self) -> Verbs:
        """What the page asks for by ``{"verb": NAME, ...}``."""
        return {}

    def on_run(self) -> None:
        """Another run is open."""

    def on_theme(self) -> None:
        """Dark or light is another; the map in 3D is drawn anew."""

    def on_frame(self) -> None:
        """The page shows another frame."""

    def on_state(self) -> None:
        """The selection, or how things are looked at, is another."""

    def on_drawn(self) -> None:
        """The 3D pane shows another frame, or the same one anew."""


def whole(message: Message, name: str) -> int | None:
    """The whole number of that name in a message, if there is one."""
    value = message.get(name)
    return value if isinstance(value, int) and not isinstance(value, bool) else None
