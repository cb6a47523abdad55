"""Detections of two images are paired if one landmark explains both, on epipolar lines only."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from semviz_annotation.assist.stereo_matching import stereo_pairs
from semviz_annotation.labels.labels import new_id
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.views import PosedView, rig_view
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.pose import Pose

CAMERA = Camera(1241, 376, np.array([[718.0, 0.0, 607.0], [0.0, 718.0, 185.0], [0.0, 0.0, 1.0]]))
SIGMA_PX = 1.0
Landmark = tuple[int, np.ndarray, tuple[bool, bool], tuple[bool, bool]]
"""Class, peak and bottom in space, and which ends each image shows."""
SIGNS = st.sampled_from([TRIANGULAR, RECTANGULAR, ROUNDED])


def views(turn_rad: float) -> tuple[PosedView, PosedView]:
    """Rectified or not: the right camera is turned about its optical axis."""
    T = Pose.from_rotvec([0.0, 0.0, turn_rad], [-0.54, 0.0, 0.0])
    rig = Rig(CAMERA, CAMERA, T)
    return rig_view(rig, "left"), rig_view(rig, "right")


def proposal(class_id: int, ends: np.ndarray, known: tuple[bool, bool]) -> Proposal:
    anchor, end = ((float(u), float(v)) for u, v in ends)
    is_line = class_id == POLE
    return Proposal(
        new_id(), 0, "left", class_id, anchor, end if is_line else None, known[0], known[1],
        0.9, SIGMA_PX, SIGMA_PX,
    )  # fmt: skip


def shown(
    landmarks: list[Landmark], here: PosedView, there: PosedView
) -> tuple[list[Proposal], list[Proposal]]:
    """In both images."""
    lefts = [proposal(kind, here.project(ends), known) for kind, ends, known, _ in landmarks]
    rights = [proposal(kind, there.project(ends), known) for kind, ends, _, known in landmarks]
    return lefts, rights


@st.composite
def landmarks(draw: st.DrawFn) -> Landmark:
    class_id = draw(st.one_of(st.just(POLE), SIGNS))
    depth = draw(st.floats(4.0, 40.0))
    x, y = draw(st.floats(-0.7, 0.7)) * depth, draw(st.floats(-3.0, 0.5))
    peak = np.array([x, y, depth])
    known = st.tuples(st.booleans(), st.booleans())
    return class_id, np.stack([peak, peak + np.array([0.0, 2.5, 0.0])]), draw(known), draw(known)


@given(landmarks(), st.sampled_from([0.0, 0.05]))
def test_what_one_landmark_shows_in_both_images_is_a_pair(
    landmark: Landmark, turn_rad: float
) -> None:
    here, there = views(turn_rad)
    assert stereo_pairs(here, there, *shown([landmark], here, there)) == [(0, 0)]


@given(st.lists(landmarks(), min_size=2, max_size=6), st.sampled_from([0.0, 0.05]))
def test_all_are_paired_but_those_that_could_be_another_too(
    standing: list[Landmark], turn_rad: float
) -> None:
    here, there = views(turn_rad)
    lefts, rights = shown(standing, here, there)
    pairs = stereo_pairs(here, there, lefts, rights)
    could_be = {
        (n, m)
        for n, left in enumerate(lefts)
        for m, right in enumerate(rights)
        if stereo_pairs(here, there, [left], [right])
    }
    rivals = [sum(n in pair for pair in could_be if pair != (n, n)) for n in range(len(standing))]
    assert {(n, n) for n, count in enumerate(rivals) if not count} <= set(pairs) <= could_be
    assert len({n for n, _ in pairs}) == len({m for _, m in pairs}) == len(pairs)


@given(
    landmarks(), st.floats(15.0, 200.0), st.sampled_from([-1.0, 1.0]), st.sampled_from([0.0, 0.05])
)
def test_nothing_is_paired_across_epipolar_lines(
    landmark: Landmark,
    off_px: float,
    sign: float,
    turn_rad: float,
) -> None:
    class_id, ends, _, _ = landmark
    here, there = views(turn_rad)
    moved = there.project(ends) + sign * off_px * np.array([-np.sin(turn_rad), np.cos(turn_rad)])
    left = proposal(class_id, here.project(ends), (True, True))
    assert stereo_pairs(here, there, [left], [proposal(class_id, moved, (True, True))]) == []


@given(landmarks())
def test_neither_another_class_nor_what_would_be_behind_the_camera(
    landmark: Landmark,
) -> None:
    class_id, ends, known, _ = landmark
    here, there = views(0.0)
    (left,), (right,) = shown([landmark], here, there)
    if class_id != POLE:
        other = TRIANGULAR if class_id == ROUNDED else ROUNDED
        assert stereo_pairs(here, there, [left], [replace(right, class_id=other)]) == []
    beyond = np.array([[60.0, 0.0], [60.0, 0.0]])
    swapped = proposal(class_id, here.project(ends) + beyond, known)
    assert stereo_pairs(here, there, [left], [swapped]) == []


def test_two_that_would_do_are_left_to_the_images() -> None:
    here, there = views(0.0)
    lone = np.array([[2.0, -1.0, 12.0], [2.0, 1.5, 12.0]])
    left = proposal(ROUNDED, here.project(lone), (True, False))
    right = proposal(ROUNDED, there.project(lone), (True, False))
    u, v = right.anchor_px
    beside = replace(right, id=new_id(), anchor_px=(u - 8.0, v + 1.0))
    assert stereo_pairs(here, there, [left], [right, beside]) == []
    assert stereo_pairs(here, there, [left], [right]) == [(0, 0)]
