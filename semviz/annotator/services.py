"""The services that all opened pages of a workspace share, as far as several kinds of requests need
them. Each kind adds its own.
"""

import threading
from concurrent.futures import Executor
from typing import Protocol

from semviz.annotator.session import LabelSession


class PageServices(Protocol):
    """What every kind of request needs."""

    @property
    def session(self) -> LabelSession:
        """Another one after the poses were chosen anew."""
        ...

    @property
    def lock(self) -> threading.RLock:
        """Held around every use of ``session``."""
        ...


class SearchServices(PageServices, Protocol):
    """Those for searches of images."""

    @property
    def search_thread(self) -> Executor:
        """One thread that searches the images for all pages."""
        ...
