"""What was decided when a map was built, and what looks odd in it, as both web pages show it."""

from collections.abc import Iterable
from functools import lru_cache
from math import isfinite
from typing import Any

import numpy as np

from semviz_annotation.edits import edit_to_json
from semviz_annotation.labels import Labels
from semviz_annotation.mapping.quality.linting.finding import Finding
from semviz_annotation.mapping.review import answers, decision_id, frame_to_see
from semviz_annotation.rows import derived_id
from semviz_core.semantic_map import Decision, SemanticMap

Json = dict[str, Any]

_UNITS = {"m": "m", "px": "px", "deg": "°", "s": "s"}
"""The end of a figure's name, and how that unit is written."""
_SHOWN_FRAMES = 4
"""So many frames of an element are named, evenly among all."""


def entry_key(entry: Decision | Finding) -> str:
    """The same for the same decision or finding in every build."""
    if isinstance(entry, Decision):
        return decision_id(entry)
    return derived_id(repr((entry.rule, entry.element_ids, entry.frame_index)))


def entry_json(entry: Decision | Finding, semantic_map: SemanticMap, labels: Labels) -> Json:
    """What there is to see and to say of a decision or finding."""
    key: Json = {"key": entry_key(entry)}
    if isinstance(entry, Decision):
        return key | _decision_json(entry, semantic_map, labels)
    return key | _finding_json(entry, semantic_map, labels)


def _decision_json(decision: Decision, semantic_map: SemanticMap, labels: Labels) -> Json:
    """A decision with its evidence, its elements and, where it is open, what can be said to it."""
    said = answers(decision, labels, semantic_map.classes)
    elements = zip(decision.label_ids, decision.numbers, strict=True)
    return {
        "kind": decision.kind,
        "by": decision.by,
        "reason": _sentence(decision.reason),
        "evidence": [_figure(name, value) for name, value in decision.evidence.items()],
        "elements": [_element_json(*one, semantic_map, labels) for one in elements],
        "about": _frames(decision.observation_ids, labels),
        "answers": [
            {"name": one.name, "title": one.title, "edit": edit_to_json(one.edit)} for one in said
        ],
        "frame": frame_to_see(decision, labels),
    }


def _finding_json(finding: Finding, semantic_map: SemanticMap, labels: Labels) -> Json:
    """What a rule found, with its elements."""
    rows = np.flatnonzero(np.isin(semantic_map.elements.id, finding.element_ids)).tolist()
    return {
        "kind": finding.rule,
        "severity": finding.severity,
        "reason": _sentence(finding.message),
        "evidence": [],
        "elements": [_mapped_json(row, semantic_map, labels) for row in rows],
        "about": [],
        "answers": [],
        "frame": finding.frame_index,
    }


def _element_json(label_id: str, number: int, semantic_map: SemanticMap, labels: Labels) -> Json:
    """A label element: as the labels know it or, where it is gone, as the map does."""
    row = _row_of(label_id, semantic_map)
    element = labels.elements.get(label_id)
    class_id = None
    if element is not None:
        class_id = element.class_id
    elif row is not None:
        class_id = int(semantic_map.elements.class_id[row])
    classes = semantic_map.classes
    return {
        "id": label_id,
        "number": number,
        "name": str(number) if class_id is None else classes.element_name(class_id, number),
        "class": class_id,
        "map_id": None if row is None else int(semantic_map.elements.id[row]),
        "frames": _frames((one.id for one in labels.of_element(label_id)), labels),
    }


def _mapped_json(row: int, semantic_map: SemanticMap, labels: Labels) -> Json:
    """An element of the map, with the label element that it is called after, if there is one."""
    map_id, class_id = (
        int(column[row]) for column in (semantic_map.elements.id, semantic_map.elements.class_id)
    )
    label_ids = semantic_map.provenance[row].label_ids if semantic_map.provenance else ()
    label_id = next((one for one in label_ids if one in labels.elements), None)
    rows = () if label_id is None else labels.of_element(label_id)
    return {
        "id": label_id,
        "number": map_id,
        "name": semantic_map.classes.element_name(class_id, map_id),
        "class": class_id,
        "map_id": map_id,
        "frames": _frames((one.id for one in rows), labels),
    }


def _row_of(label_id: str, semantic_map: SemanticMap) -> int | None:
    """The map element that a label element became, or became part of."""
    return _rows_by_label(semantic_map).get(label_id)


@lru_cache(maxsize=2)
def _rows_by_label(semantic_map: SemanticMap) -> dict[str, int]:
    rows = list(enumerate(semantic_map.provenance))
    return {label_id: row for row, one in reversed(rows) for label_id in one.label_ids}


def _frames(observation_ids: Iterable[str], labels: Labels) -> list[int]:
    """Some of the frames of observations, ascending."""
    known = (labels.observations.get(one) for one in observation_ids)
    frames = sorted({row.frame_index for row in known if row is not None})
    places = np.linspace(0, len(frames) - 1, min(len(frames), _SHOWN_FRAMES)).round().astype(int)
    return [frames[place] for place in places]


def _figure(name: str, value: float) -> Json:
    """``distance_m`` 0.4321 as ``Distance`` 0.43 m."""
    words, _, unit = name.rpartition("_")
    if unit not in _UNITS:
        words, unit = name, ""
    number = f"{value:.0f}" if float(value).is_integer() else f"{value:.2f}"
    shown = f"{number} {_UNITS.get(unit, '')}".strip() if isfinite(value) else "unknown"
    return {"name": _sentence(words.replace("_", " ")), "value": shown}


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
