"""What takes long: worked out once, in a thread of its own, while pages go on."""

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from typing import Generic, TypeVar

from semviz_core.errors import SemvizError

TOLD_EVERY = 20
"""Progress is told so many times in each pass."""
Tell = Callable[[], None]
Item = TypeVar("Item")
Value = TypeVar("Value")


class Background(ABC, Generic[Value]):
    """Works when first asked; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._told: list[Tell] = []
        self._stopped = threading.Event()
        self._started = False
        self.doing = "waiting to begin"
        """How far it has come, or why it failed."""
        self.value: Value | None = None
        """None until it is worked out."""
        self.is_over = False
        """Worked out, or failed."""

    @abstractmethod
    def work(self) -> Value:
        """Works it out; what it goes through may be handed to ``watch``. SemvizError says why it
        cannot be."""

    def ask(self, tell: Tell) -> None:
        """Have ``tell`` called now, as the work gets on, and when it is over."""
        with self._lock:
            if not self.is_over:
                self._told.append(tell)
            start, self._started = not self._started, True
        if start:
            threading.Thread(target=self._complete, daemon=True).start()
        tell()

    def stop(self) -> None:
        """Soon: ``watch`` passes nothing more through."""
        self._stopped.set()

    @property
    def is_stopped(self) -> bool:
        return self._stopped.is_set()

    def watch(self, items: Iterable[Item], what: str, total: int) -> Iterator[Item]:
        """Passes items through, and tells how many of them are done."""
        every = max(total // TOLD_EVERY, 1)
        for number, item in enumerate(items):
            if self.is_stopped:
                return
            if number % every == 0:
                first = "" if number else "; on a new machine, up to a minute of compiling first"
                self.tell_doing(f"{what}: {number} of {total}{first}")
            yield item

    def tell_doing(self, text: str) -> None:
        """Says how far it has come."""
        self.doing = text
        self._tell()

    def _complete(self) -> None:
        try:
            self.value = self.work()
        except SemvizError as error:
            self.doing = str(error)
        except Exception as error:  # a fault of ours must be seen, not leave the page waiting
            logging.getLogger(__name__).exception("work in the background failed")
            self.doing = f"Internal error: {type(error).__name__}: {error}. The terminal has more."
        with self._lock:
            self.is_over = True
        self._tell()
        with self._lock:
            self._told.clear()

    def _tell(self) -> None:
        with self._lock:
            told = tuple(self._told)
        for tell in told:
            tell()
