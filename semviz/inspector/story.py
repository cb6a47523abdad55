"""Send the story of the open run: what is right, what explains the rest, and where it happens.

It is told at once from the diagnoses of single frames, and again when the run is diagnosed, in a
background thread.
"""

import numpy as np

from semviz.inspector.context import PageContext, Panel
from semviz.inspector.elements import RunAnalysis
from semviz.inspector.messages import GetStoryRequest
from semviz.inspector.views import number
from semviz.inspector.views_run import StoryCause, StoryEvent, StoryPart, StoryView
from semviz.runs.frame_table import frame_table
from semviz.runs.run import Run
from semviz.runs.story import (
    Cause,
    RoutePart,
    RunStory,
    counts_by_status,
    frames_text,
    kinds_text,
    stretches,
)
from semviz.web.protocol import handles
from semviz_core.diagnosis.fault import RunFault

LONG_RUN = 200
"""Frames; pages of longer runs open with their story, which comes before the 3D view is drawn."""
EXAMPLES = 3
"""Frames that are offered for a cause."""
MOST_HARMLESS = 5
"""Harmless faults that are listed; *Elements* lists all."""


class StoryPanel(Panel):
    """Sends the story of the open run on request."""

    def __init__(self, context: PageContext) -> None:
        super().__init__(context)
        self._sent: RunStory | None = None
        self._wanted = ""
        """Name of the run whose story the page wants."""

    def on_opened(self) -> None:
        self._sent = None
        if self.context.state.run == self._wanted:  # opened again
            self._start()
        elif len(self.context.run.frames) > LONG_RUN:
            self._send()

    @handles(GetStoryRequest)
    def _get(self, _: GetStoryRequest) -> None:
        self._wanted = self.context.state.run
        self._start()

    def _start(self) -> None:
        run, analysis = self.context.run, self.context.cached(RunAnalysis)
        analysis.start(lambda: self._on_progress(run, analysis))

    def _on_progress(self, run: Run, analysis: RunAnalysis) -> None:
        """Called in the background thread; the page may show another run by then."""
        with self.context.lock:
            if self.context.run is not run:
                return
            if analysis.met_damage:
                self.context.open_checked()
            else:
                self._send()

    def _send(self) -> None:
        """Send the story unless it is the one sent last, and the progress of the diagnosis."""
        analysis = self.context.cached(RunAnalysis)
        progress = "" if analysis.value is not None else analysis.progress
        story, diagnosed = analysis.story, len(analysis.positions)
        found = None if story is self._sent else story_view(story)
        self._sent = story
        self.context.send(StoryEvent(progress=progress, diagnosed=diagnosed, found=found))


def story_view(story: RunStory) -> StoryView:
    """Return a story as the page gets it."""
    table, counts = frame_table(story.run), counts_by_status(story.run)
    known_m = table.distance_m[np.isfinite(table.distance_m)]
    return StoryView(
        headline=story.headline,
        detail=story.detail,
        length_m=round(story.length_m, 1),
        seconds=round(float(table.time_s[-1] - table.time_s[0]), 1),
        median_m=number(np.median(known_m)) if len(known_m) else None,
        ok=counts["ok"],
        ambiguous=counts["ambiguous"],
        cannot=counts["cannot"],
        overconfident=int(table.is_overconfident.sum()) if len(known_m) else None,
        causes=tuple(_cause_view(story, cause) for cause in story.causes),
        harmless=tuple(_harmless_view(story, fault) for fault in story.harmless[:MOST_HARMLESS]),
        route=tuple(_part_view(part) for part in story.route),
    )


def _harmless_view(story: RunStory, fault: RunFault) -> StoryCause:
    kinds = kinds_text(fault)
    return _cause_view(story, Cause(kinds, fault.sentence, fault.frames, is_of_run=True))


def _cause_view(story: RunStory, cause: Cause) -> StoryCause:
    groups = sorted(stretches(cause.frames), key=lambda group: group[0] - group[1])[:EXAMPLES]
    return StoryCause(
        kind=cause.kind,
        sentence=cause.sentence,
        where=frames_text(story.run, cause.frames),
        is_of_run=cause.is_of_run,
        frames=cause.frames,
        examples=tuple(sorted((first + last) // 2 for first, last in groups)),
        parts=story.parts_of(cause),
    )


def _part_view(part: RoutePart) -> StoryPart:
    shown = part.wrong or part.frames
    return StoryPart(
        points=tuple((round(x, 1), round(y, 1)) for x, y in part.points_m.tolist()),
        frames=len(part.frames),
        wrong=len(part.wrong),
        position=shown[len(shown) // 2],
    )
