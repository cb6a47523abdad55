"""What can be tried with what is selected, in words, each with the change that it is.

An offer is a button; or a choice of one value of the change; or fields for its numbers.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from semviz.inspector.session import State
from semviz.inspector.what_if.views import Json
from semviz.recording.run import Run
from semviz.trying.asked import Asked
from semviz.trying.change import Change, element_name
from semviz.trying.changes import to_json
from semviz.trying.map_changes import AddElement, DropElement, ElementClass
from semviz.trying.pair_changes import ForbidPair, ForcePair, ForceTruePairs
from semviz.trying.prior_changes import CropRadius, MovePrior, PriorAtTruth, PriorSigma
from semviz.trying.seen_changes import (
    DetectionClass,
    DropDetection,
    IgnoreClasses,
    LeastScore,
    NoiseFactor,
)
from semviz.trying.solver_changes import StartAtTruth, UseMethod
from semviz_core.classes import ClassSet
from semviz_core.localize import methods_at_hand
from semviz_core.solving import matched


def offers(run: Run, state: State) -> list[Json]:
    """Groups of offers: what is selected first, then what needs no selection."""
    record = run.frames[state.position]
    asked = Asked.of(run, record)
    groups = [
        *_of_element(run, asked, state.selection.element),
        *_of_detection(run, asked, state.selection.observed, state.selection.element),
        ("Known beforehand", list(_beforehand(asked))),
        ("Seen", list(_of_all_seen(asked))),
        ("Solver", list(_solver(asked))),
    ]
    return [{"title": title, "offers": offered} for title, offered in groups if offered]


def _of_element(run: Run, asked: Asked, element: int | None) -> Iterator[tuple[str, list[Json]]]:
    elements = asked.semantic_map.elements
    rows = np.flatnonzero(elements.id == element)
    if element is None or not len(rows):
        return
    drop, add = DropElement(element), AddElement(element)
    named = ElementClass(element, int(elements.class_id[rows[0]]))
    offered = [_button("Not in the map", drop)] if drop.concerns(asked) else []
    if add.concerns(asked):
        offered.append(_button("Add to the submap", add))
    if drop.concerns(asked):
        offered.extend(_class_choice(run.semantic_map.classes, named))
    yield element_name(run.semantic_map, element), offered


def _of_detection(
    run: Run, asked: Asked, row: int | None, element: int | None
) -> Iterator[tuple[str, list[Json]]]:
    """By itself; with the selected element; with the true one, where that is another."""
    if row is None:
        return
    frame, semantic_map = asked.record.frame.index, run.semantic_map
    offered = [_button("Not seen", DropDetection(frame, row))]
    if element is not None and element in asked.submap.id:
        name = element_name(semantic_map, element)
        offered.append(_button(f"Surely {name}", ForcePair(frame, row, element)))
        offered.append(_button(f"Not {name}", ForbidPair(frame, row, element)))
    true = int(asked.element_id[row])
    if true != element and true in asked.submap.id:
        text = f"Surely {element_name(semantic_map, true)}, as it truly is"
        offered.append(_button(text, ForcePair(frame, row, true)))
    named = DetectionClass(frame, row, int(asked.observed.class_id[row]))
    yield f"Detection #{row}", [*offered, *_class_choice(semantic_map.classes, named)]


def _beforehand(asked: Asked) -> Iterator[Json]:
    prior, radius_m = asked.prior, asked.radius_m
    if asked.truth is not None:
        yield _button("Prior at the true place", PriorAtTruth())
    if asked.about is not None:
        yield _fields("Prior moved", MovePrior(0.0, 0.0), ("ahead_m", "ahead"), ("left_m", "left"))
    yield _fields("Prior ±", PriorSigma(round(prior.horizontal_sigma_m, 1)), ("sigma_m", ""))
    yield _fields("Submap within", CropRadius(round(radius_m, 1)), ("radius_m", ""))


def _of_all_seen(asked: Asked) -> Iterator[Json]:
    if ForceTruePairs().concerns(asked):
        yield _button("True pairs", ForceTruePairs())
    yield _button("Without classes", IgnoreClasses())
    yield _fields("Noise times", NoiseFactor(2.0), ("factor", ""))
    if np.ptp(asked.observed.score) > 0.0:
        middle = round(float(np.median(asked.observed.score)), 2)
        yield _fields("Score at least", LeastScore(middle), ("score", ""))


def _solver(asked: Asked) -> Iterator[Json]:
    if asked.truth is not None:
        yield _button("From the true pose", StartAtTruth())
    own = () if asked.record.localization.match is None else matched.METHODS
    options = [{"value": one, "text": one} for one in (*methods_at_hand(), *own)]
    choice = {"name": "method", "options": options}
    yield {"text": "Method", "change": to_json(UseMethod(asked.method)), "choice": choice}


def _button(text: str, change: Change) -> Json:
    return {"text": text, "change": to_json(change)}


def _class_choice(classes: ClassSet, change: ElementClass | DetectionClass) -> Iterator[Json]:
    """Another class of the same kind, if there is one: a pole cannot be a sign."""
    kind = classes[change.class_id].kind
    options = [{"value": one.id, "text": one.name} for one in classes if one.kind == kind]
    if len(options) > 1:
        choice = {"name": "class_id", "options": options}
        yield {"text": "Class", "change": to_json(change), "choice": choice}


def _fields(text: str, change: Change, *named: tuple[str, str]) -> Json:
    """Fields by the change's own names; what ends in ``_m`` is in metres."""
    told: dict[str, Any] = to_json(change)
    fields = [
        {"name": name, "label": label, "value": told[name], "unit": "m" * name.endswith("_m")}
        for name, label in named
    ]
    return {"text": text, "change": told, "fields": fields}
