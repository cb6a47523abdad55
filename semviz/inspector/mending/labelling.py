"""The labelling tool within the inspector: for each workspace whose labels somebody opens."""

import threading
from contextlib import ExitStack
from urllib.parse import urlsplit

from semviz.web.door import Door
from semviz.workspace import Workspace


class LabellingTools:
    """Each behind a door of its own that only this machine reaches; our own door is the way there.

    Thread-safe.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open = ExitStack()
        self._addresses: dict[str, str] = {}
        """``host:port`` by the workspace's folder."""

    def open(self, workspace: Workspace) -> str:
        """The tool's name: its page is at ``/annotate/NAME/``. Started at the first asking.

        Raises SemvizError where the labels cannot be opened.
        """
        from semviz.annotator.server import Annotator

        folder = str(workspace.path.resolve())
        with self._lock:
            if folder not in self._addresses:
                tool = Annotator(workspace)
                self._open.callback(tool.close)
                url = self._open.enter_context(Door(tool).running())
                self._addresses[folder] = urlsplit(url).netloc
            return str(list(self._addresses).index(folder) + 1)

    def address(self, name: str) -> str | None:
        """``host:port`` of the tool called ``name``; None where there is none."""
        addresses = dict(enumerate(self._addresses.values(), start=1))
        return addresses.get(int(name)) if name.isdecimal() else None

    def close(self) -> None:
        with self._lock:
            self._open.close()
            self._addresses.clear()
