"""Solve the frame shown, or all affected frames, with changes.

A change is pending or kept. Both apply to every frame shown, on this page alone. A sweep solves
all frames with the kept changes and can be saved as a new run.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from semviz.inspector import messages
from semviz.inspector.context import Background, Panel
from semviz.inspector.what_if_options import (
    ChangedFrame,
    SuggestionEvent,
    SuggestionStatusEvent,
    SweepView,
    WhatIfEvent,
    WhatIfOptionsEvent,
    WhatIfResult,
    answer_view,
    result_view,
    what_if_options,
)
from semviz.runs.diagnosis import frame_diagnosis
from semviz.runs.run import FrameRecord, Run
from semviz.web.protocol import handles
from semviz.what_if import solve
from semviz.what_if.change import WhatIfChange
from semviz.what_if.solve import changes_text, describe_changes, from_json
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.inspector.context import PageContext


@dataclass(frozen=True, eq=False)
class WhatIfAnswer:
    """A frame solved with changes, and what the page shows of it."""

    record: FrameRecord
    view: WhatIfResult


class WhatIfJob(Background[WhatIfAnswer]):
    """Solves one frame with changes."""

    def __init__(self, run: Run, position: int, changes: tuple[WhatIfChange, ...]) -> None:
        super().__init__()
        self._run = run
        self._position = position
        self._changes = changes

    def work(self) -> WhatIfAnswer:
        run, position, changes = self._run, self._position, self._changes
        record = solve.solve_with_changes(run, run.frames[position], changes)
        return WhatIfAnswer(record, result_view(run, position, record, changes))

    @property
    def failure(self) -> str:
        """Why the frame could not be solved; empty if it was, or is still being solved."""
        return self.progress if self.is_over and self.value is None else ""


@dataclass(frozen=True)
class Suggestion:
    """The suggested change, if any, and what the page shows of it."""

    change: WhatIfChange | None
    view: SuggestionEvent | None


class SuggestionJob(Background[Suggestion]):
    """Finds the best suggestion for one frame."""

    def __init__(self, run: Run, position: int) -> None:
        super().__init__()
        self._run = run
        self._position = position

    def is_of(self, run: Run, position: int) -> bool:
        return self._run is run and self._position == position

    def work(self) -> Suggestion:
        run, record = self._run, self._run.frames[self._position]
        best = solve.best_suggestion(run, record, frame_diagnosis(run, record))
        if best is None:
            return Suggestion(None, None)
        view = SuggestionEvent(
            position=self._position,
            text=best.describe(run.semantic_map),
            before=answer_view(solve.localize_request(run, record)),
            after=answer_view(solve.solve_with_changes(run, record, (best,))),
        )
        return Suggestion(best, view)


class Sweep(Background[tuple[solve.SweepResult, ...]]):
    """Solves all frames that changes affect. If stopped, it keeps the frames solved so far."""

    def __init__(self, run: Run, changes: tuple[WhatIfChange, ...]) -> None:
        super().__init__()
        self.run = run
        self.changes = changes

    def work(self) -> tuple[solve.SweepResult, ...]:
        self.report("finding the affected frames")
        records = solve.affected_frames(self.run, self.changes)
        watched = self.watch(records, "solved", len(records))
        return tuple(solve.sweep(self.run, record, self.changes) for record in watched)

    @property
    def is_complete(self) -> bool:
        """Whether all frames were solved."""
        return self.value is not None and not self.is_stopped

    def view(self) -> SweepView:
        """Return the progress of the sweep, or its result."""
        if self.value is None:
            return SweepView(is_over=self.is_over, can_save=False, text=self.progress, changed=())
        frames = [result.change for result in self.value]
        stopped = "" if self.is_complete else "Stopped. "
        changed = (
            ChangedFrame(index=frame.index, change=frame.change)
            for frame in frames
            if frame.change != "same"
        )
        return SweepView(
            is_over=True,
            can_save=self.is_complete and bool(frames),
            text=stopped + solve.describe_sweep(frames),
            changed=tuple(changed),
        )


class Save(Background[Path]):
    """Saves the frames of a sweep as a new run beside the run's file."""

    def __init__(self, sweep: Sweep, results: Sequence[solve.SweepResult], path: Path) -> None:
        super().__init__()
        self._sweep = sweep
        self._records = {result.change.index: result.record for result in results}
        self._path = path

    def work(self) -> Path:
        path = solve.free_path(self._path, "tried")
        solve.save(self._sweep.run, self._sweep.changes, self._records, path)
        return path

    @property
    def message(self) -> str:
        """Where the run was saved, or why it was not."""
        if not self.is_over:
            return "Saving."
        if self.value is None:
            return f"Not saved: {self.progress}"
        return f"Saved as {self.value}. Compare: semviz compare {self._path} {self.value}"


NO_SUGGESTION = "No suggestion for this frame. Select an element, or choose a change below."


class WhatIfPanel(Panel):
    """The pending change and the kept ones. A result is dropped if the page has moved on."""

    def __init__(self, context: "PageContext") -> None:
        super().__init__(context)
        self._pending: tuple[WhatIfChange, ...] = ()
        self._kept: tuple[WhatIfChange, ...] = ()
        self._job: WhatIfJob | None = None
        self._suggestion: SuggestionJob | None = None
        self._sweep: Sweep | None = None
        self._save: Save | None = None

    def on_run(self) -> None:
        self._set_changes((), ())

    def on_frame(self) -> None:
        if self._changes:
            self._solve()

    def on_drawn(self) -> None:
        self._draw()

    @property
    def _changes(self) -> tuple[WhatIfChange, ...]:
        return (*self._kept, *self._pending)

    @handles(messages.GetWhatIfOptionsRequest)
    def _send_options(self, _: messages.GetWhatIfOptionsRequest) -> None:
        self.context.send(
            WhatIfOptionsEvent(groups=what_if_options(self.context.run, self.context.state))
        )

    @handles(messages.SolveWhatIfRequest)
    def _solve_change(self, request: messages.SolveWhatIfRequest) -> None:
        self._set_changes((from_json(request.change),), self._kept)

    @handles(messages.KeepWhatIfRequest)
    def _keep(self, _: messages.KeepWhatIfRequest) -> None:
        self._set_changes((), tuple(dict.fromkeys(self._changes)))

    @handles(messages.DropWhatIfRequest)
    def _drop(self, _: messages.DropWhatIfRequest) -> None:
        self._set_changes((), self._kept)

    @handles(messages.ForgetWhatIfRequest)
    def _forget(self, request: messages.ForgetWhatIfRequest) -> None:
        kept = (change for index, change in enumerate(self._kept) if index != request.number)
        self._set_changes(self._pending, tuple(kept))

    def _set_changes(
        self, pending: tuple[WhatIfChange, ...], kept: tuple[WhatIfChange, ...]
    ) -> None:
        """Replace pending and kept changes, and solve the frame."""
        if kept != self._kept:
            self._stop()
            self._sweep = self._save = None
        self._pending, self._kept = pending, kept
        self._solve()

    def _solve(self) -> None:
        """Solve the frame shown with all changes, if there are any."""
        changes, self._job = self._changes, None
        if changes:
            self._job = WhatIfJob(self.context.run, self.context.state.position, changes)
            self._job.start(partial(self._on_solved, self._job))
        else:
            self._show()

    def _on_solved(self, job: WhatIfJob) -> None:
        with self.context.lock:
            if job is self._job:
                self._show()

    def _suggestion_job(self) -> SuggestionJob:
        """Return the suggestion job of the frame shown."""
        run, position = self.context.run, self.context.state.position
        if self._suggestion is None or not self._suggestion.is_of(run, position):
            self._suggestion = SuggestionJob(run, position)
        return self._suggestion

    @handles(messages.SuggestWhatIfRequest)
    def _suggest(self, _: messages.SuggestWhatIfRequest) -> None:
        job = self._suggestion_job()
        job.start(partial(self._send_suggestion, job))

    def _send_suggestion(self, job: SuggestionJob) -> None:
        with self.context.lock:
            if job is self._suggestion and job.value and job.value.view:
                self.context.send(job.value.view)

    @handles(messages.SolveSuggestionRequest)
    def _solve_suggestion(self, _: messages.SolveSuggestionRequest) -> None:
        job = self._suggestion_job()
        job.start(partial(self._solve_suggested, job))

    def _solve_suggested(self, job: SuggestionJob) -> None:
        with self.context.lock:
            if not job.is_over or job is not self._suggestion_job():
                return
            best = None if job.value is None else job.value.change
            if best is not None and self._pending != (best,):
                self._set_changes((best,), self._kept)
            reason = NO_SUGGESTION if job.value is not None else job.progress
            self.context.send(SuggestionStatusEvent(text=reason if best is None else ""))

    @handles(messages.SweepWhatIfRequest)
    def _start_sweep(self, _: messages.SweepWhatIfRequest) -> None:
        self._stop()
        self._sweep, self._save = Sweep(self.context.run, self._kept), None
        self._sweep.start(self._on_progress)

    @handles(messages.StopSweepRequest)
    def _stop_sweep(self, _: messages.StopSweepRequest) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._sweep is not None:
            self._sweep.stop()

    @handles(messages.SaveSweepRequest)
    def _save_run(self, _: messages.SaveSweepRequest) -> None:
        sweep = self._sweep
        if sweep is None or sweep.value is None or not sweep.is_complete:
            raise SemvizError("solve all frames with the kept changes first; then save them")
        self._save = Save(sweep, sweep.value, self.context.library.path(self.context.state.run))
        self._save.start(self._on_progress)

    def _on_progress(self) -> None:
        """Called in the background threads of the sweep and of saving."""
        with self.context.lock:
            self._send()

    def _show(self) -> None:
        self._send()
        self._draw()

    def _draw(self) -> None:
        """Draw the camera of the what-if result in 3D, or remove it."""
        if self.context.has_scene:
            answer = None if self._job is None else self._job.value
            localization = None if answer is None else answer.record.localization
            self.context.scene.show_what_if(localization, self.context.state)

    def _send(self) -> None:
        semantic_map, job = self.context.run.semantic_map, self._job
        answer = None if job is None else job.value
        event = WhatIfEvent(
            change=describe_changes(self._pending, semantic_map),
            kept=tuple(change.describe(semantic_map) for change in self._kept),
            file=changes_text(self._kept),
            solving=job is not None and answer is None and not job.failure,
            failure="" if job is None else job.failure,
            result=None if answer is None else answer.view,
            sweep=None if self._sweep is None else self._sweep.view(),
            saved="" if self._save is None else self._save.message,
        )
        self.context.send(event)
