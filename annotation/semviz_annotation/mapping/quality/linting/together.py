"""Rules about elements near each other: posts and signs, conflicts, duplicates."""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.quality.labelled import map_rows
from semviz_annotation.mapping.quality.linting.case import Case
from semviz_annotation.mapping.quality.linting.finding import Finding, Severity
from semviz_annotation.mapping.quality.stand import stand_covariance_m2, stand_m
from semviz_core.arrays import IntArray
from semviz_core.semantic_map import Decision

POST_M = 0.6
"""From a sign's middle to its post: half of a wide plate on one of two posts."""
SAME_PLACE_M = 0.3
"""No two signs or poles stand nearer to each other than this, but in pairs that are meant so."""
SAME_PLACE_MOST_M = 2.0
"""However uncertain their places are, things further apart are no duplicates to speak of."""
CHI2_99 = {2: 9.21, 3: 11.34}
"""A squared distance that two places of one thing exceed once in a hundred times, by dimension."""


def sign_without_post(case: Case) -> Iterator[Finding]:
    """A sign with no pole beside it: on a wall, or its post was not labelled."""
    from scipy.spatial import cKDTree

    elements = case.semantic_map.elements
    signs, poles = np.flatnonzero(~elements.is_line), np.flatnonzero(elements.is_line)
    if not len(signs) or not len(poles):
        return
    sigma = np.sqrt(np.trace(elements.covariance_m2[:, :2, :2], axis1=1, axis2=2))
    distance, _ = cKDTree(stand_m(elements)[poles, :2]).query(elements.anchor_m[signs, :2])
    for row, nearest in zip(signs.tolist(), distance, strict=True):
        if nearest > POST_M + 2.0 * sigma[row]:
            yield case.finding(
                "sign without post",
                "hint",
                (row,),
                f"{case.name(row)} has no pole within {POST_M} m, the nearest is {nearest:.1f} m "
                "away: is its post labelled?",
            )


def class_conflict(case: Case) -> Iterator[Finding]:
    """Two signs of different classes at one place; or an element of another class than labelled."""
    elements, classes = case.semantic_map.elements, case.semantic_map.classes
    for pair in _near(case, np.where(elements.is_line, -1, 0)):
        one, two = pair.rows
        if elements.class_id[one] == elements.class_id[two] or _seen_together(case, pair):
            continue
        yield case.finding(
            "class conflict",
            "warning",
            pair.rows,
            f"{case.name(one)} and {case.name(two)} are {pair.distance_m:.2f} m apart and never "
            "seen in one image: are they one sign of two classes?",
        )
    for row, provenance in enumerate(case.semantic_map.provenance):
        for label_id in provenance.label_ids:
            label = case.labels.elements.get(label_id)
            if label is not None and label.class_id != elements.class_id[row]:
                now = case.semantic_map.classes.element_name(label.class_id, label.number)
                yield case.finding(
                    "class conflict",
                    "error",
                    (row,),
                    f"{case.name(row)} is a {classes[elements.class_id[row]].name} in the map, "
                    f"but labelled as {now}, a {classes[label.class_id].name}",
                )


def duplicate_nearby(case: Case) -> Iterator[Finding]:
    """Two elements of one class at places that may be one."""
    apart = _kept_apart(case)
    for pair in _near(case, case.semantic_map.elements.class_id):
        decision = apart.get(pair.rows)
        if decision is not None and decision.by == "human":
            continue
        together = _seen_together(case, pair)
        if together and pair.distance_m > SAME_PLACE_M:
            continue
        one, two = (case.name(row) for row in pair.rows)
        severity: Severity = "hint" if together or decision is not None else "warning"
        why = "never seen in one image: are they one thing?"
        if together:
            why = "yet seen in one image: is one of them labelled twice?"
        elif decision is not None:
            why = f"kept apart: {decision.reason}"
        yield case.finding(
            "duplicate nearby",
            severity,
            pair.rows,
            f"{one} and {two} are {pair.distance_m:.2f} m apart ({pair.sigmas:.1f} sigma), {why}",
        )


class _Pair(NamedTuple):
    """Two elements at one place, as far as can be told."""

    rows: tuple[int, int]
    distance_m: float
    sigmas: float
    """The distance in standard deviations of both places together."""


def _near(case: Case, group: IntArray) -> Iterator[_Pair]:
    """Pairs of one group (n,), by row; those of group -1 have none."""
    from scipy.spatial import cKDTree

    elements, is_line = case.semantic_map.elements, case.semantic_map.elements.is_line
    place, covariance = stand_m(elements), stand_covariance_m2(elements)
    for number in np.unique(group[group >= 0]):
        rows = np.flatnonzero(group == number)
        pairs = cKDTree(place[rows]).query_pairs(SAME_PLACE_MOST_M, output_type="ndarray")
        for i, j in rows[np.sort(pairs, axis=1)][np.lexsort(pairs.T[::-1])]:
            dimension = 2 if is_line[i] else 3
            offset = (place[i] - place[j])[:dimension]
            both = (covariance[i] + covariance[j])[:dimension, :dimension]
            squared = float(offset @ np.linalg.pinv(both) @ offset)
            distance = float(np.linalg.norm(offset))
            if distance < SAME_PLACE_M or squared < CHI2_99[dimension]:
                yield _Pair((int(i), int(j)), distance, float(np.sqrt(squared)))


def _seen_together(case: Case, pair: _Pair) -> bool:
    """Whether one image shows both."""
    one, two = (case.views_of(row) for row in pair.rows)
    return bool(np.isin(one, two).any())


def _kept_apart(case: Case) -> dict[tuple[int, int], Decision]:
    """What was decided about pairs of rows (ascending) when the map was built."""
    semantic_map = case.semantic_map
    row_of = map_rows(semantic_map).of_label
    apart: dict[tuple[int, int], Decision] = {}
    for one in semantic_map.decisions:
        if one.kind == "apart":
            rows = sorted({row_of[label] for label in one.label_ids if label in row_of})
            apart.update(dict.fromkeys(combinations(rows, 2), one))
    return apart
