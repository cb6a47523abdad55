"""What-if: a frame solved again with something changed, on this page alone until it is saved."""

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from semviz.inspector.topic import Topic, Verbs, whole
from semviz.inspector.what_if.offers import offers
from semviz.inspector.what_if.sweep import Sweep
from semviz.inspector.what_if.views import Json, result_view, side_view
from semviz.recording.run import FrameRecord, Run
from semviz.trying.advice import most_telling
from semviz.trying.again import again, as_asked
from semviz.trying.change import Change
from semviz.trying.changes import as_text, from_json, in_words, to_json
from semviz.verdicts import explained
from semviz.web.sessions import Message
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz.inspector.desk import Desk

NOTHING_TO_TRY = "Nothing stands out to be tried in this frame. Select something, or choose below."


class WhatIf(Topic):
    """Changes that are being tried, and those that are kept; both hold for every frame shown.

    Frames are solved in a thread; an answer that comes after the page has moved on is dropped.
    """

    def __init__(self, desk: "Desk") -> None:
        super().__init__(desk)
        self._trying: tuple[Change, ...] = ()
        self._kept: tuple[Change, ...] = ()
        self._result: Json | None = None
        self._found: FrameRecord | None = None
        self._sweep: Sweep | None = None

    def verbs(self) -> Verbs:
        return {
            "offers": lambda _: self.desk.say("offers", offers(self.desk.run, self.desk.state)),
            "advise": lambda _: self._advise(self._tell_advice),
            "try": self._try,
            "try best": lambda _: self._advise(self._try_best),
            "keep": lambda _: self._change((), tuple(dict.fromkeys(self._changes))),
            "drop": lambda _: self._change((), self._kept),
            "forget": self._forget,
            "try all": lambda _: self._try_all(),
            "stop": lambda _: self._stop(),
            "save": lambda _: self._save(),
        }

    def on_run(self) -> None:
        self._change((), ())

    def on_frame(self) -> None:
        if self._changes:
            self._solve()

    def on_drawn(self) -> None:
        self._draw()

    @property
    def _changes(self) -> tuple[Change, ...]:
        return (*self._kept, *self._trying)

    def _try(self, message: Message) -> None:
        self._change((from_json(message.get("change")),), self._kept)

    def _forget(self, message: Message) -> None:
        number = whole(message, "number")
        self._change(self._trying, tuple(one for at, one in enumerate(self._kept) if at != number))

    def _change(self, trying: tuple[Change, ...], kept: tuple[Change, ...]) -> None:
        """Other changes than before."""
        if kept != self._kept:
            self._stop()
            self._sweep = None
        self._trying, self._kept = trying, kept
        self._solve()

    def _solve(self) -> None:
        """The frame shown with all changes; without any, there is nothing to show."""
        self._result = self._found = None
        self._draw()
        self._tell()
        changes, run, position = self._changes, self.desk.run, self.desk.state.position
        if not changes:
            return

        def work() -> None:
            found: FrameRecord | None = None
            try:
                found = again(run, run.frames[position], changes)
                result = result_view(run, position, found, changes)
            except SemvizError as error:
                result = {"position": position, "failure": str(error)}
            with self.desk.lock:
                if self._is_at(run, position) and self._changes == changes:
                    self._result, self._found = result, found
                    self._tell()
                    self._draw()

        threading.Thread(target=work, name="what-if", daemon=True).start()

    def _advise(self, then: Callable[[Change | None], None]) -> None:
        """Has ``then`` called, under the lock, with what is worth trying first in this frame."""
        run, position = self.desk.run, self.desk.state.position

        def work() -> None:
            record = run.frames[position]
            best = most_telling(run, record, explained(run, record))
            with self.desk.lock:
                if self._is_at(run, position):
                    then(best)

        threading.Thread(target=work, name="advice", daemon=True).start()

    def _try_best(self, best: Change | None) -> None:
        if best is not None:
            self._change((best,), self._kept)
        self.desk.say("bestTried", "" if best is not None else NOTHING_TO_TRY)

    def _tell_advice(self, best: Change | None) -> None:
        run, position = self.desk.run, self.desk.state.position
        advice: Json = {"position": position, "text": ""}
        if best is not None:
            record = run.frames[position]
            advice["text"] = best.words(run.semantic_map)
            advice["before"] = side_view(as_asked(run, record))
            advice["after"] = side_view(again(run, record, (best,)))
        self.desk.say("advice", advice)

    def _try_all(self) -> None:
        """The kept changes on all frames in which they matter."""
        self._stop()
        self._sweep = Sweep(self.desk.run, self._kept, self._swept)
        self._sweep.start()

    def _swept(self, sweep: Sweep) -> None:
        """Called in the sweep's thread, as it gets on."""
        with self.desk.lock:
            if self._sweep is sweep:
                self._tell()

    def _stop(self) -> None:
        if self._sweep is not None:
            self._sweep.stop()

    def _save(self) -> None:
        if self._sweep is None:
            raise SemvizError("try the changes on all frames first; then they can be saved")
        self._sweep.save(self.desk.shelf.path(self.desk.state.run))

    def _is_at(self, run: Run, position: int) -> bool:
        return self.desk.is_open and self.desk.run is run and self.desk.state.position == position

    def _draw(self) -> None:
        """The answer's camera in 3D, or none."""
        if self.desk.has_scene:
            found = None if self._found is None else self._found.localization
            self.desk.scene.show_tried(found, self.desk.state)

    def _tell(self) -> None:
        semantic_map = self.desk.run.semantic_map
        view = {
            "trying": in_words(self._trying, semantic_map),
            "kept": [
                {"text": one.words(semantic_map), "change": to_json(one)} for one in self._kept
            ],
            "file": as_text(self._kept),
            "isSolving": bool(self._changes) and self._result is None,
            "result": self._result,
            "sweep": None if self._sweep is None else self._sweep.view(),
        }
        self.desk.say("whatIf", view)
