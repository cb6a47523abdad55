"""Any edit, mostly of elements that exist; often one that must be refused."""

from collections.abc import Iterable

import numpy as np

from semviz_annotation.labels.edits import (
    AddMany,
    AddObservation,
    DecideElements,
    DeleteElement,
    DeleteMany,
    DeleteObservation,
    Dismiss,
    Edit,
    Link,
    MoveObservation,
    ReviewFrame,
    RevokeDecision,
    SetAttribute,
    SetClass,
    SetClassOfMany,
    SetKnown,
    SetKnownOfMany,
    SwapEnds,
    Unlink,
)
from semviz_annotation.labels.labels import Dismissal, Labels, new_id, proposal_id
from semviz_annotation.labels.rows import different_elements, review_decision


def pole(frame: int = 0, side: str = "left") -> AddObservation:
    return AddObservation(new_id(), new_id(), frame, side, (1.0, 2.0), (3.0, 40.0), class_id=0)


def random_edit(labels: Labels, rng: np.random.Generator) -> Edit:
    def some(ids: Iterable[str]) -> str:
        known = sorted(ids)
        return known[rng.integers(len(known))] if known else new_id()

    a, b, c = (some(labels.elements) for _ in range(3))
    row, other_row = some(labels.observations), some(labels.observations)
    frame, side = int(rng.integers(3)), ("left", "right")[rng.integers(2)]
    point, other = (tuple(map(float, rng.uniform(0, 300, 2))) for _ in range(2))
    class_id = int(rng.integers(4))
    end = other if class_id == 0 else None
    new = AddObservation(new_id(), new_id(), frame, side, point, end, class_id=class_id)
    more = AddObservation(new_id(), new.element_id, frame + 3, side, point, end)
    why = ("rejected", "occluded", "absent")[rng.integers(3)]
    down = Dismissal(proposal_id(a, frame, side), frame, side, why, a)
    choices: list[Edit] = [
        *[new] * 3,  # of empty labels most other edits are refused
        AddMany((new, more)),
        AddObservation(new_id(), a, frame, side, point, other),
        AddObservation(new_id(), a, frame, side, point),
        MoveObservation(row, point),
        MoveObservation(row, point),
        SetKnown(row, bool(rng.integers(2)), bool(rng.integers(2))),
        SwapEnds(row),
        DeleteObservation(row),
        DeleteMany((row, other_row)),
        SetKnownOfMany((row, other_row), bool(rng.integers(2))),
        DeleteElement(a),
        SetAttribute(a, "material", ("steel", "wood", None)[rng.integers(3)]),
        Link((a, b)),
        Link((a, b, c)),
        Unlink((row,), new_id()),
        Unlink((row, other_row), new_id()),
        SetClass(a, class_id),
        SetClassOfMany((a, b), class_id),
        ReviewFrame(frame, ("unseen", "in work", "reviewed", "reviewed, empty")[rng.integers(4)]),
        Dismiss((down,)),
        Dismiss((down, Dismissal(new_id(), frame, side, why, None))),
        DecideElements((different_elements(a, b),)),
        DecideElements(
            (review_decision(c, ("keep", "leave out")[rng.integers(2)]), different_elements(b, c))
        ),
        RevokeDecision(some(labels.review_decisions)),
    ]
    return choices[rng.integers(len(choices))]
