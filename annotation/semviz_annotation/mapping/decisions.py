"""The decisions of map building, and the answers that a person can give to each.

A decision has the same id in every build, whatever its evidence. An answer is an ordinary edit of
labels, so it is saved, undone and exported like any other. The algorithm's own choice comes first.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Literal

import numpy as np

from semviz_annotation.labels.edits import DecideElements, DeleteMany, Edit, Link, Unlink
from semviz_annotation.labels.labels import Labels, Observation
from semviz_annotation.labels.rows import (
    ReviewDecision,
    derived_id,
    different_elements,
    review_decision,
    row_elements,
)
from semviz_annotation.mapping.association.candidates import ground_positions
from semviz_annotation.mapping.association.tracks import Tracks
from semviz_annotation.mapping.placement.reprojection import residuals
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.semantic_map import Decision, DecisionKind
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError

_ORDER: tuple[DecisionKind, ...] = ("merge", "apart", "split", "leave out")


def decisions_of(tracks: Tracks) -> tuple[Decision, ...]:
    """Return all decisions, sorted by kind and number."""
    log = _DecisionLog(tracks)
    decisions = [*log.merges(), *log.kept_apart(), *log.splits(), *log.outliers(), *log.left_out()]
    return tuple(
        sorted(
            decisions,
            key=lambda decision: (_ORDER.index(decision.kind), decision.numbers, decision.reason),
        )
    )


@dataclass(frozen=True, eq=False)
class _DecisionLog:
    tracks: Tracks

    def decision(
        self,
        kind: DecisionKind,
        elements: Sequence[int],
        reason: str,
        evidence: Mapping[str, float] | None = None,
        observations: IntArray | None = None,
        by: Literal["machine", "human"] = "machine",
    ) -> Decision:
        """Return a decision about label elements (rows), or about observations (rows) of one."""
        gathered = self.tracks.gathered
        about = [] if observations is None else observations.tolist()
        return Decision(
            kind=kind,
            label_ids=tuple(gathered.elements[row].id for row in elements),
            numbers=tuple(gathered.elements[row].number for row in elements),
            by=by,
            reason=reason,
            evidence={name: float(value) for name, value in (evidence or {}).items()},
            observation_ids=tuple(gathered.label_rows[row].id for row in about),
        )

    def merges(self) -> Iterator[Decision]:
        """Yield the label elements that are one landmark."""
        tracks, nodes = self.tracks, self.tracks.nodes
        order = np.argsort(tracks.landmark, kind="stable")
        order = order[nodes.part[order] == 0]
        landmarks, first, count = np.unique(
            tracks.landmark[order], return_index=True, return_counts=True
        )
        for landmark, start, several in zip(landmarks, first, count, strict=True):
            if several > 1 and self._ok[landmark]:
                members = order[start : start + several]
                evidence = {
                    "distance_m": self._distance_m(members, int(landmark)),
                    "chi2_apart": tracks.alone.chi2[members].sum(),
                    "chi2_together": tracks.placed.chi2[landmark],
                    "freedom": tracks.placed.rows[landmark] - tracks.placed.parameters[landmark],
                    "frames": self._frames[landmark],
                }
                yield self.decision("merge", nodes.element[members], "they fit one place", evidence)

    def kept_apart(self) -> Iterator[Decision]:
        """Yield landmarks that fit one position but exclude each other, and those kept apart."""
        tracks = self.tracks
        reported: set[tuple[int, ...]] = set()
        for merge in tracks.apart:
            elements = tuple(tracks.nodes.element[list(merge.nodes)].tolist())
            landmarks = tracks.landmark[list(merge.nodes)]
            if elements[0] == elements[1] or not self._ok[landmarks].all():
                continue  # two parts of one element: that is a split
            evidence = {
                "distance_m": float(np.linalg.norm(np.subtract(*self._stand_m[landmarks]))),
                "chi2": merge.chi2,
                "freedom": merge.freedom,
            }
            reported.add(elements)
            yield self.decision("apart", elements, merge.reason.text, evidence, by=merge.reason.by)
        for pair in tracks.constraints.apart.tolist():
            if tuple(pair) not in reported:
                yield self.decision("apart", pair, "a person said so", by="human")

    def splits(self) -> Iterator[Decision]:
        """Yield the parts of label elements that are other landmarks."""
        tracks, nodes = self.tracks, self.tracks.nodes
        for node in np.flatnonzero((nodes.part > 0) & self._ok[tracks.landmark]).tolist():
            row, landmark = int(nodes.element[node]), int(tracks.landmark[node])
            about = np.flatnonzero(nodes.of_observation == node)
            main = tracks.landmark[nodes.main[row]]
            away = float(np.linalg.norm(self._stand_m[landmark] - self._stand_m[main]))
            where = "" if np.isnan(away) else f" {away:.1f} m away"
            same = [
                member
                for member in np.flatnonzero(tracks.landmark == landmark)
                if nodes.part[member] == 0
            ]
            who = ""
            if same:
                who = f", which is number {tracks.gathered.elements[nodes.element[same[0]]].number}"
            are = "is" if len(about) == 1 else "are"
            reason = f"{len(about)} of its labels {are} of another landmark{where}{who}"
            yield self.decision("split", [row], reason, {"distance_m": away}, about)

    def outliers(self) -> Iterator[Decision]:
        """Yield the unused observations of label elements that are in the map."""
        tracks, nodes = self.tracks, self.tracks.nodes
        used = np.zeros(len(tracks.gathered.label_rows), dtype=bool)
        used[tracks.observations.label_row] = True
        unused = np.flatnonzero(~used)
        elements, first = np.unique(
            tracks.gathered.observations.landmark[unused], return_index=True
        )
        for row, about in zip(elements.tolist(), np.split(unused, first[1:]), strict=False):
            node = nodes.main.get(row)
            if node is None or not self._ok[tracks.landmark[node]]:
                continue
            for unclear in (False, True):
                some = about[tracks.unclear[about] == unclear]
                if len(some):
                    off = self._errors_px(some, int(tracks.landmark[node])).max()
                    why = self._why_unused(some, unclear, off)
                    yield self.decision("leave out", [row], why, {"error_px": off}, some)

    def _why_unused(self, rows: IntArray, unclear: bool, off_px: float) -> str:
        single = len(rows) == 1
        many = "a label is" if single else f"{len(rows)} of its labels are"
        why = (
            "not clearly of this landmark"
            if unclear
            else f"{'' if single else 'up to '}{off_px:.1f} px off"
        )
        return f"{many} {self.tracks.unused or why}"

    def left_out(self) -> Iterator[Decision]:
        """Yield the label elements that are not in the map."""
        tracks = self.tracks
        for row in range(len(tracks.gathered.elements)):
            node = tracks.nodes.main.get(row)
            if tracks.constraints.left_out[row]:
                yield self.decision("leave out", [row], "a person said so", by="human")
            elif node is None:
                yield self.decision("leave out", [row], str(tracks.failure[row]))
            elif not self._ok[tracks.landmark[node]]:
                failure = str(tracks.placed.failure[tracks.landmark[node]])
                yield self.decision("leave out", [row], failure)

    @cached_property
    def _ok(self) -> BoolArray:
        """(n,) whether each landmark is in the map."""
        return self.tracks.placed.ok

    @cached_property
    def _frames(self) -> IntArray:
        """(n,) number of frames that see each landmark."""
        observations = self.tracks.observations
        frame = self.tracks.gathered.views.frame_index[observations.view]
        landmarks = np.unique(np.stack([observations.landmark, frame]), axis=1)[0]
        return np.bincount(landmarks, minlength=observations.count)

    @cached_property
    def _stand_m(self) -> FloatArray:
        """(n, 2) positions of landmarks on the ground plane; NaN without a position."""
        at_m, _, _ = ground_positions(self.tracks.placed)
        return at_m

    @cached_property
    def _stand_alone_m(self) -> FloatArray:
        """(m, 2) positions of single nodes on the ground plane; NaN without a position."""
        at_m, _, _ = ground_positions(self.tracks.alone)
        return at_m

    def _distance_m(self, nodes: IntArray, landmark: int) -> float:
        """Return the largest distance of a landmark from the single positions of its nodes."""
        placed = nodes[self.tracks.alone.ok[nodes]]
        away = np.linalg.norm(self._stand_alone_m[placed] - self._stand_m[landmark], axis=1)
        return float(away.max(initial=0.0))

    def _errors_px(self, rows: IntArray, landmark: int) -> FloatArray:
        """Return the errors (m,) of gathered observations (rows) from a landmark's position."""
        gathered, placed = self.tracks.gathered, self.tracks.placed
        observations = gathered.observations.taken(rows, np.zeros(len(rows), dtype=np.int64), 1)
        here = slice(landmark, landmark + 1)
        at = residuals(gathered.views, observations, placed.anchor_m[here], placed.end_m[here])
        return np.where(at.ahead, np.linalg.norm(at.pixels_off, axis=1), np.inf)


@dataclass(frozen=True)
class ReviewOption:
    """One possible answer of a person to a decision."""

    name: str
    """``same``, ``two``, ``keep`` or ``leave out``; ``not 7``: number 7 is another landmark."""
    title: str
    """Short text for a button."""
    edit: Edit
    """The edit of the labels, which the next map build follows."""


def decision_id(decision: Decision) -> str:
    """Return the id of a decision, equal in every build whatever the evidence."""
    return derived_id(repr((decision.kind, decision.label_ids, decision.observation_ids)))


def is_open(decision: Decision, labels: Labels) -> bool:
    """Return whether a machine's decision is unanswered and its labels still exist.

    A decision without an alternative, given the labels, is not open.
    """
    element_ids = _existing_elements(decision, labels)
    if decision.by == "human" or not element_ids or settling_decisions(decision, labels):
        return False
    match decision.kind:
        case "merge":
            return len(element_ids) > 1
        case "apart":
            return len(element_ids) > 1 and not _seen_together(element_ids, labels)
        case "split":
            return (
                0
                < len(_existing_observations(decision, labels))
                < len(labels.of_element(element_ids[0]))
            )
        case "leave out":
            return bool(
                _existing_observations(decision, labels)
                if decision.observation_ids
                else element_ids
            )


def review_options(
    decision: Decision, labels: Labels, classes: ClassSet = DEFAULT_CLASSES
) -> tuple[ReviewOption, ...]:
    """Return the answers to an open decision, the machine's choice first; none if not open."""
    if not is_open(decision, labels):
        return ()
    match decision.kind:
        case "merge":
            return (_link_answer(decision, labels), *_separate_answers(decision, labels, classes))
        case "apart":
            return (*_separate_answers(decision, labels, classes), _link_answer(decision, labels))
        case "split":
            return (_unlink_answer(decision, labels), _keep_as_one_answer(decision, labels))
        case "leave out":
            return (_leave_out_answer(decision, labels), *_keep_answers(decision, labels))


def edit_of(decision: Decision, name: str, labels: Labels) -> Edit:
    """Return the edit of an answer. Raise SemvizError if the answer is not possible (any more)."""
    for option in review_options(decision, labels):
        if option.name == name:
            return option.edit
    raise SemvizError(f"'{name}' is no answer to this decision; it may be answered already")


def settling_decisions(decision: Decision, labels: Labels) -> tuple[ReviewDecision, ...]:
    """Return the review decisions that answer a decision; revoke them to reopen it."""
    element_ids = _existing_elements(decision, labels)
    rows = {row.id: row for element_id in element_ids for row in labels.decisions_of(element_id)}
    between = decision.kind in ("merge", "apart")
    return tuple(
        row
        for _, row in sorted(rows.items())
        if (row.verdict == "apart") == between and set(row_elements(row)) <= set(element_ids)
    )


def frame_to_see(decision: Decision, labels: Labels) -> int | None:
    """Return the frame closest to the labels of each part of a decision; None without labels.

    Parts are the label elements or, of one element, the observations in question and the others.
    """
    parts = [frames for rows in _parts(decision, labels) if (frames := _frames(rows))]
    candidates = sorted({frame for frames in parts for frame in frames})
    if not candidates:
        return None
    return min(candidates, key=lambda candidate: sum(_gap(candidate, frames) for frames in parts))


def _existing_elements(decision: Decision, labels: Labels) -> tuple[str, ...]:
    """Return the label elements of a decision that still exist."""
    return tuple(id_ for id_ in decision.label_ids if id_ in labels.elements)


def _existing_observations(decision: Decision, labels: Labels) -> tuple[Observation, ...]:
    """Return the observations of a decision that still exist and belong to its elements."""
    element_ids = _existing_elements(decision, labels)
    rows = (labels.observations.get(id_) for id_ in decision.observation_ids)
    return tuple(row for row in rows if row is not None and row.element_id in element_ids)


def _seen_together(element_ids: Sequence[str], labels: Labels) -> bool:
    """Return whether one image shows two of the elements, so that they differ."""
    images = [(row.frame_index, row.side) for id_ in element_ids for row in labels.of_element(id_)]
    return len(set(images)) < len(images)


def _link_answer(decision: Decision, labels: Labels) -> ReviewOption:
    return ReviewOption("same", "Same landmark", Link(_existing_elements(decision, labels)))


def _separate_answers(
    decision: Decision, labels: Labels, classes: ClassSet
) -> Iterable[ReviewOption]:
    """Yield the answer that all differ and, for three or more, that a single one differs."""
    element_ids = _existing_elements(decision, labels)
    all_pairs = tuple(different_elements(*pair) for pair in combinations(element_ids, 2))
    yield ReviewOption(
        "two",
        "Different landmarks" if len(element_ids) == 2 else "All different",
        DecideElements(all_pairs),
    )
    for element_id in element_ids if len(element_ids) > 2 else ():
        element = labels.element(element_id)
        name = classes.element_name(element.class_id, element.number)
        pairs = tuple(
            different_elements(element_id, other_id)
            for other_id in element_ids
            if other_id != element_id
        )
        yield ReviewOption(f"not {element.number}", f"Exclude {name}", DecideElements(pairs))


def _unlink_answer(decision: Decision, labels: Labels) -> ReviewOption:
    about = tuple(row.id for row in _existing_observations(decision, labels))
    new_id = derived_id(f"split off {decision_id(decision)} {labels.next_number}")
    return ReviewOption("two", "Different landmarks", Unlink(about, new_id))


def _keep_as_one_answer(decision: Decision, labels: Labels) -> ReviewOption:
    return ReviewOption("keep", "Same landmark", _decide(decision, labels, "keep"))


def _leave_out_answer(decision: Decision, labels: Labels) -> ReviewOption:
    about = _existing_observations(decision, labels)
    if about:
        title = "Delete this label" if len(about) == 1 else f"Delete these {len(about)} labels"
        return ReviewOption("leave out", title, DeleteMany(tuple(row.id for row in about)))
    return ReviewOption("leave out", "Leave out for good", _decide(decision, labels, "leave out"))


def _keep_answers(decision: Decision, labels: Labels) -> Iterable[ReviewOption]:
    """Yield the answer to keep elements, unless one is labelled only once: it has no position."""
    if all(
        len(labels.of_element(element_id)) > 1
        for element_id in _existing_elements(decision, labels)
    ):
        yield ReviewOption("keep", "Keep", _decide(decision, labels, "keep"))


def _decide(
    decision: Decision, labels: Labels, verdict: Literal["keep", "leave out"]
) -> DecideElements:
    return DecideElements(
        tuple(
            review_decision(element_id, verdict)
            for element_id in _existing_elements(decision, labels)
        )
    )


def _parts(decision: Decision, labels: Labels) -> list[tuple[Observation, ...]]:
    element_ids = _existing_elements(decision, labels)
    about = _existing_observations(decision, labels)
    if not about:
        return [labels.of_element(element_id) for element_id in element_ids]
    rest = tuple(
        row
        for element_id in element_ids
        for row in labels.of_element(element_id)
        if row not in about
    )
    return [about, rest]


def _frames(rows: Iterable[Observation]) -> tuple[int, ...]:
    return tuple(sorted({row.frame_index for row in rows}))


def _gap(frame_index: int, frames: Sequence[int]) -> int:
    return min(abs(frame_index - frame) for frame in frames)
