"""Rules about each element by itself: whether anything can stand there like that."""

from collections.abc import Iterator

import numpy as np

from semviz_annotation.mapping.quality.linting.case import Case
from semviz_annotation.mapping.quality.linting.finding import Finding
from semviz_core.arrays import FloatArray
from semviz_core.elements import Elements3D

LEANING_DEG = (5.0, 15.0)
"""Warning, error. Posts are set to a degree or two; 5 is an accident, 15 a wrong click."""
VAGUE_DEG = 5.0
"""An axis that is known no better may lean or not: no error."""
SHORT_POLE_M = (1.0, 0.3)
"""Warning, error. Bollards are the shortest that people label, just under 1 m."""
TALL_POLE_M = (15.0, 40.0)
"""Warning, error. Street lamps end at 12 m; 40 m are the masts of a stadium."""
GROUND_M = 0.5
"""Kerbs, verges and the camera's pitch together."""
GROUND_SLOPE = 0.1
"""The ground rises or falls by so much away from where the car drove; a steep street's grade."""
HOVERING_M = 1.0
"""A bottom so far above the ground, with the slope, was hidden, or is another pole's."""
HIGH_SIGN_M = 10.0
"""Signs over motorways hang at 5 to 7 m."""
LANE_M = 1.0
"""Half a car, and a little: what stands nearer to the camera's way was driven over."""
CLEARANCE_M = 2.5
"""What begins higher above the ground may hang over the lane."""
FAR_M = 200.0
"""Further from the road, 1 px is the size of a sign: it was not mapped from there."""
SIGMAS = 2.0
"""A limit counts as passed where the uncertainty does not explain it."""


def leaning_pole(case: Case) -> Iterator[Finding]:
    """A pole out of plumb; with its peak below its bottom it leans by more than 90 deg."""
    elements = case.semantic_map.elements
    lean, sigma = _lean_deg(elements)
    for row in np.flatnonzero(elements.is_line & (lean - SIGMAS * sigma > LEANING_DEG[0])).tolist():
        sure = sigma[row] < VAGUE_DEG and lean[row] - SIGMAS * sigma[row] > LEANING_DEG[1]
        yield case.finding(
            "leaning pole",
            "error" if sure else "warning",
            (row,),
            f"{case.name(row)} leans by {lean[row]:.1f} deg (+- {sigma[row]:.1f}): "
            "look at its ends in both images",
        )


def _lean_deg(elements: Elements3D) -> tuple[FloatArray, FloatArray]:
    """(n,) angle to the vertical, and its standard deviation; 0 for points."""
    axis = np.where(elements.is_line[:, None], elements.anchor_m - elements.end_m, [0.0, 0.0, 1.0])
    level = np.linalg.norm(axis[:, :2], axis=1)
    length = np.maximum(np.linalg.norm(axis, axis=1), 1e-9)
    aside = np.where(level[:, None] > 0.0, axis[:, :2] / np.maximum(level, 1e-12)[:, None], [1, 0])
    down = np.concatenate([axis[:, 2:] * aside, -level[:, None]], axis=1) / length[:, None]
    J = np.concatenate([down, -down], axis=1) / length[:, None]  # of the angle, by both ends
    variance = np.einsum("ni,nij,nj->n", J, elements.covariance_m2, J)
    lean = np.arctan2(level, axis[:, 2])
    return np.rad2deg(lean), np.rad2deg(np.sqrt(np.maximum(variance, 0.0)))


def odd_length(case: Case) -> Iterator[Finding]:
    """A pole that is shorter or taller than poles are."""
    elements = case.semantic_map.elements
    length = np.linalg.norm(elements.anchor_m - elements.end_m, axis=1)  # NaN for points
    whole = elements.anchor_known & elements.end_known
    for row in np.flatnonzero(whole & (length < SHORT_POLE_M[0])).tolist():
        yield case.finding(
            "too short pole",
            "error" if length[row] < SHORT_POLE_M[1] else "warning",
            (row,),
            f"{case.name(row)} is {length[row]:.2f} m long: are both ends its own?",
        )
    for row in np.flatnonzero(length > TALL_POLE_M[0]).tolist():
        yield case.finding(
            "too tall pole",
            "error" if length[row] > TALL_POLE_M[1] else "warning",
            (row,),
            f"{case.name(row)} is {length[row]:.1f} m long: are both ends of one pole?",
        )


def off_the_ground(case: Case) -> Iterator[Finding]:
    """A pole or sign that begins below the ground, or high above it."""
    if case.road is None or not len(case.semantic_map):
        return
    elements = case.semantic_map.elements
    height, distance = _above_ground_m(case)
    slack = GROUND_SLOPE * distance + SIGMAS * case.foot_sigma_m
    for row in np.flatnonzero(height < -(GROUND_M + slack)).tolist():
        yield case.finding(
            "below ground",
            "error",
            (row,),
            f"{case.name(row)} reaches {-height[row]:.1f} m below the ground, "
            f"{distance[row]:.0f} m from the road",
        )
    limit = np.where(elements.is_line, HOVERING_M, HIGH_SIGN_M) + slack
    bottom_seen = elements.end_known | ~elements.is_line
    for row in np.flatnonzero(bottom_seen & (height > limit)).tolist():
        yield case.finding(
            "hovering",
            "warning",
            (row,),
            f"{case.name(row)} begins {height[row]:.1f} m above the ground, "
            f"{distance[row]:.0f} m from the road: was its bottom hidden?",
        )


def _above_ground_m(case: Case) -> tuple[FloatArray, FloatArray]:
    """(n,) height of each element's lowest point above the ground, and its way to the road."""
    assert case.road is not None
    beside = case.road.beside(case.foot_m)
    bottoms = case.foot_m[case.semantic_map.elements.end_known]
    ground = beside.camera_m - case.road.camera_height_m(bottoms)
    return case.foot_m[:, 2] - ground, beside.distance_m


def where_the_car_drove(case: Case) -> Iterator[Finding]:
    """An element in the driven lane, or so far from the road that nobody can have seen it."""
    if case.road is None or not len(case.semantic_map):
        return
    height, distance = _above_ground_m(case)
    for row in np.flatnonzero((distance < LANE_M) & (height < CLEARANCE_M)).tolist():
        yield case.finding(
            "in the lane",
            "error",
            (row,),
            f"{case.name(row)} stands where the car drove, {distance[row]:.1f} m from its middle",
        )
    for row in np.flatnonzero(distance > FAR_M).tolist():
        yield case.finding(
            "far from the road",
            "error",
            (row,),
            f"{case.name(row)} is {distance[row]:.0f} m from the road: other units or another "
            "frame, or rays that hardly meet?",
        )
