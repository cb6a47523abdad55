"""What was decided for a run's map, what looks odd in it, and the answers that people give."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from semviz.author import login_name
from semviz.inspector.selection.origins import workspace_of
from semviz.inspector.topic import Topic, Verbs
from semviz.recording.run import Run
from semviz.reviewing import Json, entry_json, entry_key
from semviz.web.sessions import Message
from semviz_annotation.labels import Labels
from semviz_annotation.mapping.quality.linting.finding import Finding
from semviz_annotation.mapping.review import edit_of
from semviz_annotation.storing.store import LabelStore
from semviz_core.arrays import ByteImage
from semviz_core.camera import Rig
from semviz_core.errors import SemvizError
from semviz_core.frame import Frame
from semviz_core.semantic_map import Decision, MapFrame
from semviz_core.sources.source import Side


class Decisions:
    """Decisions and findings of one run's map. Labels are read anew each time: others write too."""

    def __init__(self, run: Run, path: Path) -> None:
        """``path`` is where the run was read from."""
        self._run = run
        self._map = run.semantic_map
        self._workspace = workspace_of(run, path)
        self._answered: dict[str, int] = {}
        """Number of the operation that answered a decision here, by its key."""

    def view(self, with_findings: bool) -> Json:
        """All decisions, where they can be answered and, which takes longer, all findings."""
        labels = self._labels()
        entries: list[Decision | Finding] = list(self._map.decisions)
        entries += self._findings if with_findings else ()
        shown = [entry_json(one, self._map, labels) for one in entries]
        for one in shown:
            one["undo"] = one["key"] in self._answered
        return {"entries": shown, "note": self._note() if self._map.decisions else ""}

    def answer(self, key: str, name: str) -> None:
        """Stores what a person says to a decision; SemvizError where that is not possible."""
        decision = self._entry(key)
        if not isinstance(decision, Decision):
            raise SemvizError("a finding has no answers; correct its labels in 'semviz annotate'")
        with self._open_labels() as store:
            edit = edit_of(decision, name, store.labels)
            self._answered[key] = store.apply(edit, login_name()).number

    def undo(self, key: str) -> None:
        """Takes the answer back that was given here."""
        if key not in self._answered:
            raise SemvizError("this decision was not answered here; 'semviz annotate' can undo it")
        with self._open_labels() as store:
            store.undo(login_name(), number=self._answered[key])
        del self._answered[key]

    def place(self, key: str) -> tuple[int | None, int | None]:
        """Position in the run of the frame that shows an entry best, and its map element.

        That is the frame which a finding names, or else the middle one of those in which the
        element is seen, or near.
        """
        entry = self._entry(key)
        elements = entry_json(entry, self._map, Labels())["elements"]
        map_id = next((one["map_id"] for one in elements if one["map_id"] is not None), None)
        named = entry.frame_index if isinstance(entry, Finding) else None
        frames = list(enumerate(self._run.frames))
        told = [at for at, one in frames if one.frame.index == named]
        seen = [at for at, one in frames if np.any(one.element_id == map_id)]
        near = [at for at, one in frames if np.any(one.localization.submap.id == map_id)]
        there = told or seen or near
        return (there[len(there) // 2] if there else None), map_id

    @cached_property
    def _findings(self) -> tuple[Finding, ...]:
        """The worst first."""
        from semviz_annotation.mapping.quality.lint import lint

        frames = tuple(one.frame for one in self._run.frames)
        posed = {one.index for one in frames if one.T_map_camera is not None}
        labels = self._labels()
        drive = _Drive(self._run.info.rig, frames, self._map.frame)
        return lint(self._map, labels if posed.issuperset(labels.frames) else Labels(), drive)

    def _entry(self, key: str) -> Decision | Finding:
        entries: list[Decision | Finding] = [*self._map.decisions, *self._findings]
        for one in entries:
            if entry_key(one) == key:
                return one
        raise SemvizError("the map of this run has no such decision; reload the page")

    def _labels(self) -> Labels:
        return Labels() if self._workspace is None else self._workspace.read_labels()

    def _open_labels(self) -> LabelStore:
        if self._workspace is None:
            raise SemvizError(self._note())
        return LabelStore.open(self._workspace.labels_path, self._workspace.classes)

    def _note(self) -> str:
        """Where answers go."""
        if self._workspace is not None:
            return f"Answers are saved in {self._workspace.name}; 'semviz map build' follows them."
        where = self._run.info.workspace or "WORKSPACE"
        return f"The labels are not at hand: answer in 'semviz annotate {where}'."


class DecisionTopic(Topic):
    """Shows the decisions of the open run's map and takes answers."""

    def verbs(self) -> Verbs:
        return {
            "decisions": self._tell,
            "see": self._see,
            "answer": self._answer,
            "undo": self._undo,
        }

    def _tell(self, message: Message) -> None:
        decisions = self.desk.kept(Decisions)
        self.desk.say("decisions", decisions.view(message.get("findings") is True))

    def _see(self, message: Message) -> None:
        """Selects the map element of a decision, in a frame that shows it."""
        desk = self.desk
        position, element = desk.kept(Decisions).place(str(message.get("key")))
        if position is not None:
            desk.state = desk.state.at(position, desk.run)
        desk.state = desk.state.selecting(None, element, desk.run)
        desk.tell_frame()
        desk.draw_frame()

    def _answer(self, message: Message) -> None:
        decisions = self.desk.kept(Decisions)
        decisions.answer(str(message.get("key")), str(message.get("name")))
        self._tell(message)

    def _undo(self, message: Message) -> None:
        self.desk.kept(Decisions).undo(str(message.get("key")))
        self._tell(message)


@dataclass(frozen=True, eq=False)
class _Drive:
    """The frames of a run, as a source whose images nobody needs."""

    rig: Rig
    frames: tuple[Frame, ...]
    map_frame: MapFrame

    def image(self, index: int, side: Side) -> ByteImage:
        raise SemvizError(f"a run has no {side} image of frame {index} to read")
