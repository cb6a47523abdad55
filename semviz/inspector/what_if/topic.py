"""What-if: a frame solved again with something changed, on this page alone until it is saved."""

from functools import partial
from typing import TYPE_CHECKING

from semviz.inspector.topic import Topic, Verbs, whole
from semviz.inspector.what_if.attempt import Advice, Attempt
from semviz.inspector.what_if.offers import offers
from semviz.inspector.what_if.sweep import Save, Sweep
from semviz.trying.change import Change
from semviz.trying.changes import as_text, from_json, in_words, to_json
from semviz.web.sessions import Message
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz.inspector.desk import Desk

NOTHING_TO_TRY = "Nothing stands out to be tried in this frame. Select something, or choose below."


class WhatIf(Topic):
    """Changes that are being tried, and those that are kept; both hold for every frame shown.

    Answers come from threads of their own; one that comes after the page has moved on is dropped.
    """

    def __init__(self, desk: "Desk") -> None:
        super().__init__(desk)
        self._trying: tuple[Change, ...] = ()
        self._kept: tuple[Change, ...] = ()
        self._attempt: Attempt | None = None
        self._advice: Advice | None = None
        self._sweep: Sweep | None = None
        self._save: Save | None = None

    def verbs(self) -> Verbs:
        return {
            "offers": lambda _: self.desk.say("offers", offers(self.desk.run, self.desk.state)),
            "advise": lambda _: self._advise(),
            "try": self._try,
            "try best": lambda _: self._try_best(),
            "keep": lambda _: self._change((), tuple(dict.fromkeys(self._changes))),
            "drop": lambda _: self._change((), self._kept),
            "forget": self._forget,
            "try all": lambda _: self._try_all(),
            "stop": lambda _: self._stop(),
            "save": lambda _: self._save_run(),
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
            self._sweep = self._save = None
        self._trying, self._kept = trying, kept
        self._solve()

    def _solve(self) -> None:
        """The frame shown with all changes; without any, there is nothing to show."""
        changes, self._attempt = self._changes, None
        if changes:
            self._attempt = Attempt(self.desk.run, self.desk.state.position, changes)
            self._attempt.ask(partial(self._answered, self._attempt))
        else:
            self._show()

    def _answered(self, attempt: Attempt) -> None:
        with self.desk.lock:
            if attempt is self._attempt:
                self._show()

    def _advice_here(self) -> Advice:
        """On the frame shown."""
        run, position = self.desk.run, self.desk.state.position
        if self._advice is None or not self._advice.is_of(run, position):
            self._advice = Advice(run, position)
        return self._advice

    def _advise(self) -> None:
        advice = self._advice_here()
        advice.ask(partial(self._tell_advice, advice))

    def _tell_advice(self, advice: Advice) -> None:
        with self.desk.lock:
            if advice is self._advice and advice.value is not None:
                self.desk.say("advice", advice.value.view)

    def _try_best(self) -> None:
        advice = self._advice_here()
        advice.ask(partial(self._take_advice, advice))

    def _take_advice(self, advice: Advice) -> None:
        with self.desk.lock:
            if not advice.is_over or advice is not self._advice_here():
                return
            best = None if advice.value is None else advice.value.change
            if best is not None and self._trying != (best,):
                self._change((best,), self._kept)
            nothing = NOTHING_TO_TRY if advice.value is not None else advice.doing
            self.desk.say("bestTried", nothing if best is None else "")

    def _try_all(self) -> None:
        """The kept changes on all frames in which they matter."""
        self._stop()
        self._sweep, self._save = Sweep(self.desk.run, self._kept), None
        self._sweep.ask(self._got_on)

    def _stop(self) -> None:
        if self._sweep is not None:
            self._sweep.stop()

    def _save_run(self) -> None:
        """What was tried on all frames."""
        sweep = self._sweep
        if sweep is None or sweep.value is None or not sweep.is_whole:
            raise SemvizError("try the changes on all frames first; then they can be saved")
        self._save = Save(sweep, sweep.value, self.desk.shelf.path(self.desk.state.run))
        self._save.ask(self._got_on)

    def _got_on(self) -> None:
        """Called in the threads of the sweep and of saving it."""
        with self.desk.lock:
            self._tell()

    def _show(self) -> None:
        self._tell()
        self._draw()

    def _draw(self) -> None:
        """The answer's camera in 3D, or none."""
        if self.desk.has_scene:
            answer = None if self._attempt is None else self._attempt.value
            found = None if answer is None else answer.record.localization
            self.desk.scene.show_tried(found, self.desk.state)

    def _tell(self) -> None:
        semantic_map = self.desk.run.semantic_map
        result = None if self._attempt is None else self._attempt.view()
        view = {
            "trying": in_words(self._trying, semantic_map),
            "kept": [
                {"text": one.words(semantic_map), "change": to_json(one)} for one in self._kept
            ],
            "file": as_text(self._kept),
            "isSolving": bool(self._changes) and result is None,
            "result": result,
            "sweep": None if self._sweep is None else self._sweep.view(),
            "said": "" if self._save is None else self._save.said,
        }
        self.desk.say("whatIf", view)
