"""What map building decided, for people to judge: what is still open, and what each answer does.

An answer is an ordinary edit of labels, so it is saved, undone and exported like any other.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

from semviz_annotation.edits import DeleteMany, Edit, Judge, Link, Unlink
from semviz_annotation.labels import Labels, Observation
from semviz_annotation.rows import Judgement, apart, derived_id, elements_of, judged
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import Decision


@dataclass(frozen=True)
class Answer:
    """What a person can say to a decision."""

    name: str
    """``same``, ``two``, ``keep`` or ``leave out``; ``not 7``: number 7 is another thing."""
    title: str
    """In a few words, as on a button."""
    edit: Edit
    """What it does to the labels; the next map that is built follows them."""


def decision_id(decision: Decision) -> str:
    """The same for the same decision of every build, whatever its evidence."""
    return derived_id(repr((decision.kind, decision.label_ids, decision.observation_ids)))


def is_open(decision: Decision, labels: Labels) -> bool:
    """Whether it is a machine's, nobody has answered it, and its labels still exist.

    What a person could only agree with, as the labels leave no choice, is not open.
    """
    there = _there(decision, labels)
    if decision.by == "human" or not there or settling(decision, labels):
        return False
    match decision.kind:
        case "merge":
            return len(there) > 1
        case "apart":
            return len(there) > 1 and not _seen_together(there, labels)
        case "split":
            return 0 < len(_about(decision, labels)) < len(labels.of_element(there[0]))
        case "leave out":
            return bool(_about(decision, labels) if decision.observation_ids else there)


def answers(
    decision: Decision, labels: Labels, classes: ClassSet = DEFAULT_CLASSES
) -> tuple[Answer, ...]:
    """What can be said to an open decision, the machine's own opinion first; none to others."""
    if not is_open(decision, labels):
        return ()
    match decision.kind:
        case "merge":
            return (_same(decision, labels), *_different(decision, labels, classes))
        case "apart":
            return (*_different(decision, labels, classes), _same(decision, labels))
        case "split":
            return (_two(decision, labels), _one(decision, labels))
        case "leave out":
            return (_left_out(decision, labels), *_kept(decision, labels))


def edit_of(decision: Decision, name: str, labels: Labels) -> Edit:
    """What an answer does; SemvizError where it cannot be given, or not any more."""
    for one in answers(decision, labels):
        if one.name == name:
            return one.edit
    raise SemvizError(f"'{name}' is no answer to this decision now; it may be answered already")


def settling(decision: Decision, labels: Labels) -> tuple[Judgement, ...]:
    """The judgements that settle a decision, to be taken back where people change their mind."""
    there = _there(decision, labels)
    rows = {row.id: row for one in there for row in labels.judgements_of(one)}
    between = decision.kind in ("merge", "apart")
    return tuple(
        row
        for _, row in sorted(rows.items())
        if (row.verdict == "apart") == between and set(elements_of(row)) <= set(there)
    )


def frame_to_see(decision: Decision, labels: Labels) -> int | None:
    """The frame that is nearest to where each part of a decision is labelled; None for no labels.

    Parts are the label elements or, of one element, the observations that it is about and the rest.
    """
    parts = [frames for rows in _parts(decision, labels) if (frames := _frames(rows))]
    candidates = sorted({frame for frames in parts for frame in frames})
    if not candidates:
        return None
    return min(candidates, key=lambda here: sum(_gap(here, frames) for frames in parts))


def _there(decision: Decision, labels: Labels) -> tuple[str, ...]:
    """Its label elements that still exist."""
    return tuple(one for one in decision.label_ids if one in labels.elements)


def _about(decision: Decision, labels: Labels) -> tuple[Observation, ...]:
    """Its observations that still exist and are of its elements."""
    there = _there(decision, labels)
    rows = (labels.observations.get(one) for one in decision.observation_ids)
    return tuple(row for row in rows if row is not None and row.element_id in there)


def _seen_together(element_ids: Sequence[str], labels: Labels) -> bool:
    """Whether one image shows two of them: then they are two."""
    images = [(row.frame_index, row.side) for one in element_ids for row in labels.of_element(one)]
    return len(set(images)) < len(images)


def _same(decision: Decision, labels: Labels) -> Answer:
    return Answer("same", "One thing", Link(_there(decision, labels)))


def _different(decision: Decision, labels: Labels, classes: ClassSet) -> Iterable[Answer]:
    """All of them are, or, of three and more, one of them is another thing."""
    there = _there(decision, labels)
    every = tuple(apart(*pair) for pair in combinations(there, 2))
    yield Answer("two", "Two things" if len(there) == 2 else "All different", Judge(every))
    for one in there if len(there) > 2 else ():
        element = labels.element(one)
        name = classes.element_name(element.class_id, element.number)
        others = tuple(apart(one, other) for other in there if other != one)
        yield Answer(f"not {element.number}", f"Only {name} is another", Judge(others))


def _two(decision: Decision, labels: Labels) -> Answer:
    about = tuple(row.id for row in _about(decision, labels))
    new_id = derived_id(f"split off {decision_id(decision)} {labels.next_number}")
    return Answer("two", "Two things", Unlink(about, new_id))


def _one(decision: Decision, labels: Labels) -> Answer:
    return Answer("keep", "One thing", _judge(decision, labels, "keep"))


def _left_out(decision: Decision, labels: Labels) -> Answer:
    about = _about(decision, labels)
    if about:
        title = "Delete this label" if len(about) == 1 else f"Delete these {len(about)} labels"
        return Answer("leave out", title, DeleteMany(tuple(row.id for row in about)))
    return Answer("leave out", "Leave out for good", _judge(decision, labels, "leave out"))


def _kept(decision: Decision, labels: Labels) -> Iterable[Answer]:
    """Not where nothing can be kept: what is labelled once has no place."""
    if all(len(labels.of_element(one)) > 1 for one in _there(decision, labels)):
        yield Answer("keep", "Keep", _judge(decision, labels, "keep"))


def _judge(decision: Decision, labels: Labels, verdict: Literal["keep", "leave out"]) -> Judge:
    return Judge(tuple(judged(one, verdict) for one in _there(decision, labels)))


def _parts(decision: Decision, labels: Labels) -> list[tuple[Observation, ...]]:
    there = _there(decision, labels)
    about = _about(decision, labels)
    if not about:
        return [labels.of_element(one) for one in there]
    rest = tuple(row for one in there for row in labels.of_element(one) if row not in about)
    return [about, rest]


def _frames(rows: Iterable[Observation]) -> tuple[int, ...]:
    return tuple(sorted({row.frame_index for row in rows}))


def _gap(here: int, frames: Sequence[int]) -> int:
    return min(abs(here - frame) for frame in frames)
