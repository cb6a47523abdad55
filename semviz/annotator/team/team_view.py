"""Who has what, how far everybody is, and which frames wait for a reviewer."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from semviz.annotator.frame_quality import FrameQuality
from semviz.annotator.views import NoteView, label_element_name, note_view
from semviz.web.protocol import Part, Request
from semviz.workspace.people import Person
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import REVIEWED
from semviz_annotation.storage.operations import Writer
from semviz_annotation.storage.store import LabelStore
from semviz_annotation.storage.teamwork import AssignedFrames
from semviz_core.common.errors import SemvizError

QueueState: TypeAlias = Literal["waiting", "sent back", "accepted", "in work"]
STANDS_OUT_PX = 3.0
FEW_ELEMENTS = 4
PACE_HOURS = 8
"""The pace of a person counts the frames reviewed in so many hours."""
MOST_DAYS = 1000
"""Nothing is foretold for later than in so many days."""
FORECAST_DAYS = 7
"""The forecast takes the pace of those of the last days on which frames were reviewed."""


class TeamPerson(Part):
    """One person's share of the work."""

    name: str
    ranges: list[tuple[int, int]]
    """Assigned frames, first and last."""
    assigned: int
    """Number of frames in these ranges."""
    reviewed: int
    """How many of them are reviewed; without ranges, how many this person reviewed last."""
    pace: int
    """Frames that this person marked as reviewed in the last eight hours."""
    edits: int
    last: str
    """Time of the last edit, UTC; empty for none."""
    done_on: str
    """Day on which the rest of the assigned frames will be reviewed, at this person's pace; empty
    if nothing is left, or nothing tells."""


class ElementNote(NoteView):
    """A note with its element."""

    element: str
    name: str


class QueueEntry(Part):
    """A frame that is reviewed, was sent back, or has comments while it is in work."""

    frame: int
    state: QueueState
    person: str
    """Who marked it as reviewed, accepted it, sent it back, or commented last."""
    elements: int
    stands_out: str
    """What a reviewer should look at; empty for nothing."""
    notes: list[ElementNote]
    time: str


class TeamView(Part):
    """The work of all."""

    people: list[TeamPerson]
    queue: list[QueueEntry]
    """By frame."""
    reviewed: int
    """Frames of all."""
    done_on: str
    """Day on which all frames will be reviewed at the pace of all; as for a person."""


class ShowTeamRequest(Request):
    """Request who has what, and the queue."""

    type: Literal["show_team"] = "show_team"


AssignedFrame: TypeAlias = Annotated[int, Field(ge=0, lt=10**9)]
"""As many digits as the text of an assignment may have in the log."""


class AssignFramesRequest(Request):
    """Assign a range of frames to a person; without one, take all of them away."""

    type: Literal["assign_frames"] = "assign_frames"
    person: str
    frames: tuple[AssignedFrame, AssignedFrame] | None


def done_on(left: int, times: Iterable[str], now: datetime) -> str:
    """Return the day (ISO 8601) on which ``left`` frames will be reviewed.

    ``times`` (UTC, ISO 8601) are when others were. The pace is that of the days of the last week
    on which some were. Empty if none is left, or there were no such days.
    """
    since = (now - timedelta(days=FORECAST_DAYS)).isoformat()
    recent = [time[:10] for time in times if time > since]
    if not left or not recent:
        return ""
    days = math.ceil(left * len(set(recent)) / len(recent))
    return (now + timedelta(days=days)).date().isoformat() if days < MOST_DAYS else ""


@dataclass(frozen=True, eq=False)
class TeamWork:
    """Reads the work of all from the labels and their log. One thread at a time."""

    store: LabelStore
    quality: FrameQuality
    order: tuple[int, ...]
    """Indices of frames."""

    def view(self, people: Mapping[str, Person], owner: str) -> TeamView:
        """Return the work of who was invited, of the owner, and of all who labelled."""
        labels = self.store.labels
        writers, tallies, assigned, _ = self.store.team()
        names = sorted({*people, owner, *tallies, *assigned})
        now = datetime.now(UTC)
        recent = (now - timedelta(hours=PACE_HOURS)).isoformat()
        reviewed = {i for i in self.order if labels.review(i) in REVIEWED}
        team = []
        for name in names:
            own = [frame for frame, writer in writers.items() if writer.author == name]
            ranges = assigned.get(name, [])
            frames = {i for i in self.order if any(r.first <= i <= r.last for r in ranges)}
            done = [i for i in (frames or own) if i in reviewed]
            pace = [i for i in own if writers[i].kind == "review" and writers[i].time > recent]
            tally = tallies.get(name)
            team.append(
                TeamPerson(
                    name=name,
                    ranges=[(part.first, part.last) for part in ranges],
                    assigned=len(frames),
                    reviewed=len(done),
                    pace=len(pace),
                    edits=tally.edits if tally else 0,
                    last=tally.last if tally else "",
                    done_on=done_on(
                        len(frames - reviewed), (writers[i].time for i in own if i in reviewed), now
                    ),
                )
            )
        noted = {note.frame_index for note in labels.notes.values()}
        queue = [
            entry
            for index in self.order
            if (index in writers or index in noted)
            and (entry := self._entry(index, writers.get(index), labels))
        ]
        times = (writers[i].time for i in reviewed if i in writers)
        rest = done_on(len(self.order) - len(reviewed), times, now)
        return TeamView(people=team, queue=queue, reviewed=len(reviewed), done_on=rest)

    def checked(self, frames: tuple[int, int] | None) -> AssignedFrames | None:
        """Return a range of frames. Raise SemvizError if the sequence has none of them."""
        if frames is None:
            return None
        first, last = frames
        if not any(first <= index <= last for index in self.order):
            raise SemvizError(f"there are no frames {first} to {last}")
        return AssignedFrames(first, last)

    def _entry(self, index: int, writer: Writer | None, labels: Labels) -> QueueEntry | None:
        """Return where a frame stands; None if it is in work, without comments."""
        elements = {row.element_id for row in labels.in_frame(index)}
        notes = [
            ElementNote(
                **note_view(note).model_dump(),
                element=element_id,
                name=label_element_name(labels.elements[element_id], labels.classes),
            )
            for element_id in sorted(elements)
            for note in labels.notes_of(element_id)
            if note.frame_index == index
        ]
        state = _state(index, writer, labels)
        if state != "in work" and writer is not None:
            person, time = writer.author, writer.time
        elif notes:
            last = max(notes, key=lambda note: note.time)
            person, time = last.author, last.time
        else:
            return None
        return QueueEntry(
            frame=index,
            state=state,
            person=person,
            elements=len(elements),
            stands_out=self._stands_out(index, labels, len(elements), notes),
            notes=notes,
            time=time,
        )

    def _stands_out(
        self, index: int, labels: Labels, elements: int, notes: Iterable[ElementNote]
    ) -> str:
        for note in notes:
            if note.unsure:
                return f"{note.name} unsure"
        facts = self.quality.of(index)
        worst = None if facts is None else labels.elements.get(facts.worst_id or "")
        if facts is not None and worst is not None and facts.worst_px > STANDS_OUT_PX:
            return f"{label_element_name(worst, labels.classes)}: residual {facts.worst_px:.1f} px"
        if labels.review(index) == "reviewed, empty":
            return "reviewed, empty"
        return f"under {FEW_ELEMENTS} elements" if elements < FEW_ELEMENTS else ""


def _state(index: int, writer: Writer | None, labels: Labels) -> QueueState:
    if labels.review(index) in REVIEWED:
        is_accepted = writer is not None and writer.kind in ("accept frame", "merge frame")
        return "accepted" if is_accepted else "waiting"
    return "sent back" if writer is not None and writer.kind == "send back" else "in work"
