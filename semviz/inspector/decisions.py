"""Show the decisions and lint findings of a run's map, and store review decisions.

Labels are read again each time, because other processes may write them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from semviz.inspector import messages, views_run
from semviz.inspector.context import Panel
from semviz.inspector.element_card import workspace_of
from semviz.inspector.label_repair import unseen
from semviz.runs.run import Run
from semviz.web.protocol import RefusedError, handles
from semviz.workspace.maps.map_review import EntryView, entry_key, entry_view
from semviz.workspace.settings import login_name
from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.decisions import edit_of
from semviz_annotation.mapping.quality.lint_context import Finding
from semviz_annotation.storage.store import (
    ConflictError,
    EditBase,
    LabelStore,
    LogEnd,
    ReplacedLogError,
)
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame, Side
from semviz_core.base.semantic_map import Decision, MapFrame
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError


class Decisions:
    """Decisions and findings of one run's map."""

    def __init__(self, run: Run, path: Path) -> None:
        """``path`` is the file of the run."""
        self._run = run
        self._map = run.semantic_map
        self._workspace = workspace_of(run, path)
        self._answered: dict[str, LogEnd] = {}
        """The operation that answered a decision here, by the decision's key."""

    def view(self, with_findings: bool) -> views_run.DecisionsEvent:
        """Return all decisions and, on request, all findings (slower)."""
        labels, seen = self._labels_and_base()
        entries: list[Decision | Finding] = list(self._map.decisions)
        entries += self._findings if with_findings else ()
        views = (entry_view(entry, self._map, labels) for entry in entries)
        return views_run.DecisionsEvent(
            entries=tuple(_decision_view(view, view.key in self._answered) for view in views),
            note=self._note() if self._map.decisions else "",
            seen=seen,
        )

    def answer(self, key: str, name: str, base: EditBase | None = None) -> None:
        """Store the answer ``name`` to a decision; ``base`` is what the page had shown.

        Raise SemvizError if that is impossible.
        """
        decision = self._entry(key)
        if not isinstance(decision, Decision):
            raise SemvizError("a finding has no answers; correct its labels in 'semviz annotate'")
        with self._open_labels() as store:
            edit = edit_of(decision, name, store.labels)
            answered = store.apply(edit, login_name(), base=base)
        self._answered[key] = LogEnd(answered.number, answered.hash)

    def undo(self, key: str, base: EditBase | None = None) -> None:
        """Undo an answer that was given here."""
        answered = self._answered.get(key)
        if answered is None:
            raise SemvizError("this decision was not answered here; 'semviz annotate' can undo it")
        with self._open_labels() as store:
            if not store.holds(answered):
                raise ReplacedLogError
            store.undo(login_name(), number=answered.number, base=base)
        del self._answered[key]

    def place(self, key: str) -> tuple[int | None, int | None]:
        """Return the position of the frame that shows an entry best, and the id of its element.

        That is the frame that a finding names, or else the middle one of those that detect the
        element, or have it in the submap.
        """
        entry = self._entry(key)
        elements = entry_view(entry, self._map, Labels()).elements
        map_id = next((element.map_id for element in elements if element.map_id is not None), None)
        named = entry.frame_index if isinstance(entry, Finding) else None
        frames = list(enumerate(self._run.frames))
        positions = (
            [position for position, record in frames if record.frame.index == named]
            or [position for position, record in frames if np.any(record.element_id == map_id)]
            or [
                position
                for position, record in frames
                if np.any(record.localization.submap.id == map_id)
            ]
        )
        return (positions[len(positions) // 2] if positions else None), map_id

    @cached_property
    def _findings(self) -> tuple[Finding, ...]:
        """Findings of lint, worst first."""
        from semviz_annotation.mapping.quality.lint import lint

        frames = tuple(frame.frame for frame in self._run.frames)
        posed = {frame.index for frame in frames if frame.T_map_camera is not None}
        labels = self._labels()
        dataset = _RunDataset(self._run.info.rig, frames, self._map.frame)
        return lint(self._map, labels if posed.issuperset(labels.frames) else Labels(), dataset)

    def _entry(self, key: str) -> Decision | Finding:
        entries: list[Decision | Finding] = [*self._map.decisions, *self._findings]
        for entry in entries:
            if entry_key(entry) == key:
                return entry
        text = "the map of this run has no such decision; reload the page"
        raise RefusedError("not_found", text)

    def _labels(self) -> Labels:
        return Labels() if self._workspace is None else self._workspace.read_labels()

    def _labels_and_base(self) -> tuple[Labels, EditBase]:
        """Return the labels, and the base of an edit by who has seen them."""
        if self._workspace is None or not self._workspace.labels_path.exists():
            return self._labels(), EditBase(0)
        with self._open_labels() as store:
            labels, end = store.labels_and_end
            answered = self._answered.items()  # a restored backup may hold other operations
            self._answered = {key: made for key, made in answered if store.holds(made)}
            return labels, EditBase.at(end)

    def _open_labels(self) -> LabelStore:
        if self._workspace is None:
            raise SemvizError(self._note())
        return LabelStore.open(self._workspace.labels_path)

    def _note(self) -> str:
        """Return where answers are saved, as a sentence."""
        if self._workspace is not None:
            return f"Answers are saved in {self._workspace.name}. 'semviz map build' applies them."
        workspace = self._run.info.workspace or "WORKSPACE"
        return f"The labels were not found. Answer in 'semviz annotate {workspace}'."


class DecisionPanel(Panel):
    """Sends the decisions of the open run's map, and stores answers."""

    @handles(messages.GetDecisionsRequest)
    def _get(self, request: messages.GetDecisionsRequest) -> None:
        self._send(request.findings)

    @handles(messages.GoToDecisionRequest)
    def _go_to(self, request: messages.GoToDecisionRequest) -> None:
        context = self.context
        position, element = context.cached(Decisions).place(request.key)
        if position is not None:
            context.state = context.state.at(position, context.run)
        context.state = context.state.with_selection(None, element, context.run)
        context.send_frame()
        context.draw_frame()

    @handles(messages.AnswerDecisionRequest)
    def _answer(self, request: messages.AnswerDecisionRequest) -> None:
        decisions = self.context.cached(Decisions)
        self._edit(lambda: decisions.answer(request.key, request.name, request.base))

    @handles(messages.UndoAnswerRequest)
    def _undo(self, request: messages.UndoAnswerRequest) -> None:
        decisions = self.context.cached(Decisions)
        self._edit(lambda: decisions.undo(request.key, request.base))

    def _edit(self, edit: Callable[[], None]) -> None:
        try:
            edit()
        except (ConflictError, ReplacedLogError) as error:
            raise unseen(error) from None
        finally:
            self._send(with_findings=True)  # after a refusal: the page has seen the labels of now

    def _send(self, with_findings: bool) -> None:
        self.context.send(self.context.cached(Decisions).view(with_findings))


def _decision_view(entry: EntryView, is_answered: bool) -> views_run.DecisionView:
    elements = (
        views_run.DecidedElement(
            name=element.name, class_id=element.class_id, map_id=element.map_id
        )
        for element in entry.elements
    )
    return views_run.DecisionView(
        key=entry.key,
        kind=entry.kind,
        by=entry.by,
        severity=entry.severity,
        reason=entry.reason,
        evidence=tuple(
            views_run.EvidenceLine(name=item.name, value=item.value) for item in entry.evidence
        ),
        elements=tuple(elements),
        answers=tuple(
            views_run.AnswerOption(name=answer.name, title=answer.title) for answer in entry.answers
        ),
        undo=is_answered,
    )


@dataclass(frozen=True, eq=False)
class _RunDataset:
    """The frames of a run as a dataset for lint, which reads no images."""

    rig: Rig
    frames: tuple[Frame, ...]
    map_frame: MapFrame

    def image(self, index: int, side: Side) -> ByteImage:
        raise SemvizError(f"frame {index} of a run has no {side} image to read")
