"""List a map's decisions and lint findings as both web tools show them.

The key of a decision or finding is the same in every build.
"""

from collections.abc import Iterable
from functools import lru_cache
from math import isfinite

import numpy as np

from semviz.web.protocol import Part
from semviz_annotation.labels.edits import Edit
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import derived_id
from semviz_annotation.mapping.decisions import decision_id, frame_to_see, review_options
from semviz_annotation.mapping.quality.lint_context import Finding
from semviz_core.base.semantic_map import Decision, SemanticMap


class FigureView(Part):
    """One piece of evidence: ``Distance``, ``0.43 m``."""

    name: str
    value: str


class EntryElement(Part):
    """An element that a decision or finding is about, from labels or map."""

    id: str | None
    """Id of the label element."""
    number: int
    name: str
    class_id: int | None
    map_id: int | None
    """Id of its map element."""
    frames: list[int]
    """Some frames with its labels."""


class AnswerView(Part):
    """A possible review decision, and its edit."""

    name: str
    title: str
    edit: Edit


class EntryView(Part):
    """A decision of the map, or a finding in it."""

    key: str
    kind: str
    by: str | None = None
    """Person or program that decided; None for a finding."""
    severity: str | None = None
    """Severity of a finding; None for a decision."""
    reason: str
    evidence: list[FigureView]
    elements: list[EntryElement]
    about: list[int]
    """Some frames whose labels it is based on."""
    answers: list[AnswerView]
    frame: int | None
    """Frame that shows it best."""


_UNITS = {"m": "m", "px": "px", "deg": "°", "s": "s"}
"""Suffix of a figure's name, and the unit to show."""
_SHOWN_FRAMES = 4
"""Number of frames listed per element, evenly spaced."""


def entry_key(entry: Decision | Finding) -> str:
    """Return the key, the same in every build, of a decision or finding."""
    if isinstance(entry, Decision):
        return decision_id(entry)
    return derived_id(repr((entry.rule, entry.element_ids, entry.frame_index)))


def entry_view(entry: Decision | Finding, semantic_map: SemanticMap, labels: Labels) -> EntryView:
    """Return the view of a decision or finding."""
    if isinstance(entry, Decision):
        return _decision_view(entry, semantic_map, labels)
    return _finding_view(entry, semantic_map, labels)


def _decision_view(decision: Decision, semantic_map: SemanticMap, labels: Labels) -> EntryView:
    """Return a decision with its evidence, elements and, if it is open, possible answers."""
    options = review_options(decision, labels, semantic_map.classes)
    elements = zip(decision.label_ids, decision.numbers, strict=True)
    return EntryView(
        key=entry_key(decision),
        kind=decision.kind,
        by=decision.by,
        reason=_sentence(decision.reason),
        evidence=[_figure(name, value) for name, value in decision.evidence.items()],
        elements=[_label_element(*element, semantic_map, labels) for element in elements],
        about=_frames(decision.observation_ids, labels),
        answers=[
            AnswerView(name=option.name, title=option.title, edit=option.edit) for option in options
        ],
        frame=frame_to_see(decision, labels),
    )


def _finding_view(finding: Finding, semantic_map: SemanticMap, labels: Labels) -> EntryView:
    """Return a finding with its elements."""
    rows = np.flatnonzero(np.isin(semantic_map.elements.id, finding.element_ids)).tolist()
    return EntryView(
        key=entry_key(finding),
        kind=finding.rule,
        severity=finding.severity,
        reason=_sentence(finding.message),
        evidence=[],
        elements=[_map_element(row, semantic_map, labels) for row in rows],
        about=[],
        answers=[],
        frame=finding.frame_index,
    )


def _label_element(
    label_id: str, number: int, semantic_map: SemanticMap, labels: Labels
) -> EntryElement:
    """Return a label element from the labels or, if it was deleted, from the map."""
    row = _row_of(label_id, semantic_map)
    element = labels.elements.get(label_id)
    class_id = None
    if element is not None:
        class_id = element.class_id
    elif row is not None:
        class_id = int(semantic_map.elements.class_id[row])
    classes = semantic_map.classes
    return EntryElement(
        id=label_id,
        number=number,
        name=str(number) if class_id is None else classes.element_name(class_id, number),
        class_id=class_id,
        map_id=None if row is None else int(semantic_map.elements.id[row]),
        frames=_frames((observation.id for observation in labels.of_element(label_id)), labels),
    )


def _map_element(row: int, semantic_map: SemanticMap, labels: Labels) -> EntryElement:
    """Return a map element, with the label element that gave it its name, if it still exists."""
    map_id, class_id = (
        int(column[row]) for column in (semantic_map.elements.id, semantic_map.elements.class_id)
    )
    label_ids = semantic_map.provenance[row].label_ids if semantic_map.provenance else ()
    label_id = next((id_ for id_ in label_ids if id_ in labels.elements), None)
    rows = () if label_id is None else labels.of_element(label_id)
    return EntryElement(
        id=label_id,
        number=map_id,
        name=semantic_map.classes.element_name(class_id, map_id),
        class_id=class_id,
        map_id=map_id,
        frames=_frames((observation.id for observation in rows), labels),
    )


def _row_of(label_id: str, semantic_map: SemanticMap) -> int | None:
    """Return the row of the map element built from a label element, or from a part of it."""
    return _rows_by_label(semantic_map).get(label_id)


@lru_cache(maxsize=2)
def _rows_by_label(semantic_map: SemanticMap) -> dict[str, int]:
    rows = list(enumerate(semantic_map.provenance))
    return {label_id: row for row, origin in reversed(rows) for label_id in origin.label_ids}


def _frames(observation_ids: Iterable[str], labels: Labels) -> list[int]:
    """Return up to ``_SHOWN_FRAMES`` frames of the observations, ascending and evenly spaced."""
    known = (labels.observations.get(id_) for id_ in observation_ids)
    frames = sorted({row.frame_index for row in known if row is not None})
    positions = np.linspace(0, len(frames) - 1, min(len(frames), _SHOWN_FRAMES)).round()
    return [frames[position] for position in positions.astype(int)]


def _figure(name: str, value: float) -> FigureView:
    """``distance_m`` 0.4321 as ``Distance`` 0.43 m."""
    words, _, unit = name.rpartition("_")
    if unit not in _UNITS:
        words, unit = name, ""
    number = f"{value:.0f}" if float(value).is_integer() else f"{value:.2f}"
    shown = f"{number} {_UNITS.get(unit, '')}".strip() if isfinite(value) else "unknown"
    return FigureView(name=_sentence(words.replace("_", " ")), value=shown)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
