"""Lint rules about single elements and about elements near each other.

Single: leaning poles, odd lengths, elements off the ground or in the driven lane. Together:
signs without a post, class conflicts, duplicates.
"""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.quality.label_links import map_rows
from semviz_annotation.mapping.quality.lint_context import Finding, LintContext, Severity
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import Decision, footprint_covariance_m2, footprint_m
from semviz_core.common.arrays import FloatArray, IntArray

LEANING_DEG = (5.0, 15.0)
"""Warning, error. Posts are set to a degree or two; 5 is an accident, 15 a wrong click."""
VAGUE_DEG = 5.0
"""An axis with a larger sigma gives no error."""
SHORT_POLE_M = (1.0, 0.3)
"""Warning, error. Bollards are the shortest that people label, just under 1 m."""
TALL_POLE_M = (15.0, 40.0)
"""Warning, error. Street lamps end at 12 m; 40 m are the masts of a stadium."""
GROUND_M = 0.5
"""Kerbs, verges and the camera's pitch together."""
GROUND_SLOPE = 0.1
"""Slope of the ground away from the road: that of a steep street."""
HOVERING_M = 1.0
"""A bottom higher above the ground (and slope) was hidden, or is another pole's."""
HIGH_SIGN_M = 10.0
"""Signs over motorways hang at 5 to 7 m."""
LANE_M = 1.0
"""Half a car and a margin: nearer elements stand where the camera drove."""
CLEARANCE_M = 2.5
"""Elements that begin higher may hang over the lane."""
FAR_M = 200.0
"""Farther from the road, 1 px is the size of a sign: it was not mapped from there."""
SIGMAS = 2.0
"""A limit is exceeded if the uncertainty does not explain it."""


def leaning_pole(context: LintContext) -> Iterator[Finding]:
    """Find leaning poles; a pole with its peak below its bottom leans by more than 90 deg."""
    elements = context.semantic_map.elements
    lean, sigma = _lean_deg(elements)
    for row in np.flatnonzero(elements.is_line & (lean - SIGMAS * sigma > LEANING_DEG[0])).tolist():
        is_error = sigma[row] < VAGUE_DEG and lean[row] - SIGMAS * sigma[row] > LEANING_DEG[1]
        yield context.finding(
            "leaning pole",
            "error" if is_error else "warning",
            (row,),
            f"{context.name(row)} leans by {lean[row]:.1f} deg (+- {sigma[row]:.1f}): "
            "look at its ends in both images",
        )


def _lean_deg(elements: Elements3D) -> tuple[FloatArray, FloatArray]:
    """Return angles to the vertical (n,) and their standard deviations (deg); 0 for points."""
    axis = np.where(elements.is_line[:, None], elements.anchor_m - elements.end_m, [0.0, 0.0, 1.0])
    level = np.linalg.norm(axis[:, :2], axis=1)
    length = np.maximum(np.linalg.norm(axis, axis=1), 1e-9)
    aside = np.where(level[:, None] > 0.0, axis[:, :2] / np.maximum(level, 1e-12)[:, None], [1, 0])
    down = np.concatenate([axis[:, 2:] * aside, -level[:, None]], axis=1) / length[:, None]
    J = np.concatenate([down, -down], axis=1) / length[:, None]  # of the angle, by both ends
    variance = np.einsum("ni,nij,nj->n", J, elements.covariance_m2, J)
    lean = np.arctan2(level, axis[:, 2])
    return np.rad2deg(lean), np.rad2deg(np.sqrt(np.maximum(variance, 0.0)))


def odd_length(context: LintContext) -> Iterator[Finding]:
    """Find poles that are too short or too tall."""
    elements = context.semantic_map.elements
    length = np.linalg.norm(elements.anchor_m - elements.end_m, axis=1)  # NaN for points
    whole = elements.anchor_known & elements.end_known
    for row in np.flatnonzero(whole & (length < SHORT_POLE_M[0])).tolist():
        yield context.finding(
            "too short pole",
            "error" if length[row] < SHORT_POLE_M[1] else "warning",
            (row,),
            f"{context.name(row)} is {length[row]:.2f} m long: are both ends its own?",
        )
    for row in np.flatnonzero(length > TALL_POLE_M[0]).tolist():
        yield context.finding(
            "too tall pole",
            "error" if length[row] > TALL_POLE_M[1] else "warning",
            (row,),
            f"{context.name(row)} is {length[row]:.1f} m long: are both ends of one pole?",
        )


def off_the_ground(context: LintContext) -> Iterator[Finding]:
    """Find poles and signs that begin below the ground, or high above it."""
    if context.road is None or not len(context.semantic_map):
        return
    elements = context.semantic_map.elements
    height, distance = _above_ground_m(context)
    slack = GROUND_SLOPE * distance + SIGMAS * context.foot_sigma_m
    for row in np.flatnonzero(height < -(GROUND_M + slack)).tolist():
        yield context.finding(
            "below ground",
            "error",
            (row,),
            f"{context.name(row)} reaches {-height[row]:.1f} m below the ground, "
            f"{distance[row]:.0f} m from the road",
        )
    limit = np.where(elements.is_line, HOVERING_M, HIGH_SIGN_M) + slack
    bottom_seen = elements.end_known | ~elements.is_line
    for row in np.flatnonzero(bottom_seen & (height > limit)).tolist():
        yield context.finding(
            "hovering",
            "warning",
            (row,),
            f"{context.name(row)} begins {height[row]:.1f} m above the ground, "
            f"{distance[row]:.0f} m from the road: was its bottom hidden?",
        )


def _above_ground_m(context: LintContext) -> tuple[FloatArray, FloatArray]:
    """Return the height (n,) of each element's lowest point above the ground, and its distance to
    the road."""
    assert context.road is not None
    beside = context.road.beside(context.foot_m)
    bottoms = context.foot_m[context.semantic_map.elements.end_known]
    ground = beside.camera_m - context.road.camera_height_m(bottoms)
    return context.foot_m[:, 2] - ground, beside.distance_m


def where_the_car_drove(context: LintContext) -> Iterator[Finding]:
    """Find elements in the driven lane, or too far from the road to have been seen."""
    if context.road is None or not len(context.semantic_map):
        return
    height, distance = _above_ground_m(context)
    for row in np.flatnonzero((distance < LANE_M) & (height < CLEARANCE_M)).tolist():
        yield context.finding(
            "in the lane",
            "error",
            (row,),
            f"{context.name(row)} stands where the car drove, "
            f"{distance[row]:.1f} m from its middle",
        )
    for row in np.flatnonzero(distance > FAR_M).tolist():
        yield context.finding(
            "far from the road",
            "error",
            (row,),
            f"{context.name(row)} is {distance[row]:.0f} m from the road: other units or another "
            "frame, or rays that hardly meet?",
        )


POST_M = 0.6
"""Largest distance of a sign's centre from its post: half of a wide plate on two posts."""
SAME_PLACE_M = 0.3
"""Least distance between two signs or two poles, except for intended pairs."""
SAME_PLACE_MOST_M = 2.0
"""Elements farther apart are no duplicates, whatever their uncertainty."""
CHI2_99 = {2: 9.21, 3: 11.34}
"""Squared distance that two positions of one landmark exceed with 1 %, by dimension."""


def sign_without_post(context: LintContext) -> Iterator[Finding]:
    """Find signs without a pole next to them: on a wall, or with an unlabelled post."""
    from scipy.spatial import cKDTree

    elements = context.semantic_map.elements
    signs, poles = np.flatnonzero(~elements.is_line), np.flatnonzero(elements.is_line)
    if not len(signs) or not len(poles):
        return
    sigma = np.sqrt(np.trace(elements.covariance_m2[:, :2, :2], axis1=1, axis2=2))
    distance, _ = cKDTree(footprint_m(elements)[poles, :2]).query(elements.anchor_m[signs, :2])
    for row, nearest in zip(signs.tolist(), distance, strict=True):
        if nearest > POST_M + 2.0 * sigma[row]:
            yield context.finding(
                "sign without post",
                "hint",
                (row,),
                f"{context.name(row)} has no pole within {POST_M} m, the nearest is "
                f"{nearest:.1f} m away: is its post labelled?",
            )


def class_conflict(context: LintContext) -> Iterator[Finding]:
    """Find signs of different classes at one position, and elements whose label has another
    class."""
    elements, classes = context.semantic_map.elements, context.semantic_map.classes
    for pair in _near(context, np.where(elements.is_line, -1, 0)):
        first, two = pair.rows
        if elements.class_id[first] == elements.class_id[two] or _seen_together(context, pair):
            continue
        yield context.finding(
            "class conflict",
            "warning",
            pair.rows,
            f"{context.name(first)} and {context.name(two)} are {pair.distance_m:.2f} m apart and "
            "never seen in one image: are they one sign of two classes?",
        )
    for row, provenance in enumerate(context.semantic_map.provenance):
        for label_id in provenance.label_ids:
            label = context.labels.elements.get(label_id)
            if label is not None and label.class_id != elements.class_id[row]:
                now = context.semantic_map.classes.element_name(label.class_id, label.number)
                yield context.finding(
                    "class conflict",
                    "error",
                    (row,),
                    f"{context.name(row)} is a {classes[elements.class_id[row]].name} in the map, "
                    f"but labelled as {now}, a {classes[label.class_id].name}",
                )


def duplicate_nearby(context: LintContext) -> Iterator[Finding]:
    """Find pairs of one class that may be one landmark."""
    apart = _kept_apart(context)
    for pair in _near(context, context.semantic_map.elements.class_id):
        decision = apart.get(pair.rows)
        if decision is not None and decision.by == "human":
            continue
        together = _seen_together(context, pair)
        if together and pair.distance_m > SAME_PLACE_M:
            continue
        first_name, two = (context.name(row) for row in pair.rows)
        severity: Severity = "hint" if together or decision is not None else "warning"
        why = "never seen in one image: are they one landmark?"
        if together:
            why = "yet seen in one image: is one of them labelled twice?"
        elif decision is not None:
            why = f"kept apart: {decision.reason}"
        yield context.finding(
            "duplicate nearby",
            severity,
            pair.rows,
            f"{first_name} and {two} are {pair.distance_m:.2f} m apart "
            f"({pair.sigmas:.1f} sigma), {why}",
        )


class _Pair(NamedTuple):
    """Two elements that may be at one position."""

    rows: tuple[int, int]
    distance_m: float
    sigmas: float
    """The distance in standard deviations of both positions."""


def _near(context: LintContext, group: IntArray) -> Iterator[_Pair]:
    """Yield close pairs of one group (n,), by row; group -1 has none."""
    from scipy.spatial import cKDTree

    elements, is_line = context.semantic_map.elements, context.semantic_map.elements.is_line
    place, covariance = footprint_m(elements), footprint_covariance_m2(elements)
    for number in np.unique(group[group >= 0]):
        rows = np.flatnonzero(group == number)
        pairs = cKDTree(place[rows]).query_pairs(SAME_PLACE_MOST_M, output_type="ndarray")
        for i, j in rows[np.sort(pairs, axis=1)][np.lexsort(pairs.T[::-1])]:
            dimension = 2 if is_line[i] else 3
            offset = (place[i] - place[j])[:dimension]
            covariance_sum = (covariance[i] + covariance[j])[:dimension, :dimension]
            squared = float(offset @ np.linalg.pinv(covariance_sum) @ offset)
            distance = float(np.linalg.norm(offset))
            if distance < SAME_PLACE_M or squared < CHI2_99[dimension]:
                yield _Pair((int(i), int(j)), distance, float(np.sqrt(squared)))


def _seen_together(context: LintContext, pair: _Pair) -> bool:
    """Return whether one image shows both."""
    first_views, two = (context.views_of(row) for row in pair.rows)
    return bool(np.isin(first_views, two).any())


def _kept_apart(context: LintContext) -> dict[tuple[int, int], Decision]:
    """Return the decisions of the map build that kept pairs of rows (ascending) apart."""
    semantic_map = context.semantic_map
    row_of = map_rows(semantic_map).of_label
    apart: dict[tuple[int, int], Decision] = {}
    for decision in semantic_map.decisions:
        if decision.kind == "apart":
            rows = sorted({row_of[label] for label in decision.label_ids if label in row_of})
            apart.update(dict.fromkeys(combinations(rows, 2), decision))
    return apart
