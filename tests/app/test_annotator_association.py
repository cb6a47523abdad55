"""Association of drawings: with the element in the other image, a mapped one, or a new one."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from annotator_page import SIDES
from drawn_marks import BOTTOM, PEAK, do, draw, pixel, pole, sign
from hypothesis import example, given, settings
from hypothesis import strategies as st
from streets import street_workspace

from semviz.annotator.drawing.association import CONSISTENT_PX, SamePlaceError
from semviz.annotator.drawing.draft import DraftState, ElementDraft
from semviz.annotator.element_positions import reprojection_error_px
from semviz.annotator.messages import UndoEdit
from semviz.annotator.page_session import same_place
from semviz.annotator.session import LabelSession
from semviz_annotation.labels.edits import Dismiss
from semviz_annotation.labels.labels import Dismissal, Observation, new_id, proposal_id
from semviz_annotation.labels.views import rig_view
from semviz_core.base.classes import POLE, TRIANGULAR
from semviz_core.base.frame import Side


@pytest.fixture
def session(tmp_path: Path) -> Iterator[LabelSession]:
    workspace = street_workspace(tmp_path / "street", 7, 6)
    session = LabelSession(workspace, "tester")
    yield session
    session.close()


@pytest.fixture(scope="module")
def shared_session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LabelSession]:
    """For many examples; each leaves it without elements."""
    folder = tmp_path_factory.mktemp("shared")
    session = LabelSession(street_workspace(folder / "street", 7, 6), "tester")
    yield session
    session.close()


def test_left_then_right_become_one_element_in_its_true_place(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    second = draw(session, pole(session, 0, "right", selected=first))
    assert second == first
    place, T_map_camera = session.position(first), session.frames[0].T_map_camera
    assert place is not None
    assert T_map_camera is not None
    np.testing.assert_allclose(place.anchor_m, T_map_camera.apply(PEAK)[0], atol=1e-6)
    np.testing.assert_allclose(place.end_m, T_map_camera.apply(BOTTOM)[0], atol=1e-6)


def test_a_drawing_that_is_sent_twice_is_not_asked_about(session: LabelSession) -> None:
    """The answer to the first may be lost with the connection."""
    edit, request = pole(session, 0, "left", asks_same=True), new_id()
    first = do(session, edit, request)
    again = do(session, edit, request)
    assert again.element_id == first.element_id
    assert len(session.labels.observations) == 1


def test_a_hidden_end_of_a_drawing_does_not_replace_the_known_one(session: LabelSession) -> None:
    draw(session, pole(session, 0, "left"))
    u, v = pixel(session, BOTTOM, 0, "left")
    short = pole(session, 0, "left", asks_same=True, end_px=[u, v - 30.0], end_known=False)
    with pytest.raises(SamePlaceError) as asked:
        do(session, short)
    question = same_place(asked.value, "request")
    assert question.anchor is not None
    assert question.end is None


def test_a_drawing_off_the_epipolar_line_starts_a_new_element_and_says_so(
    session: LabelSession,
) -> None:
    first = draw(session, pole(session, 0, "left"))
    done = do(session, pole(session, 0, "right", first, shift_px=(0.0, 14.0)))
    assert done.element_id != first
    assert "px off P-01, so this is a new element" in done.note


@pytest.mark.parametrize(
    ("off_px", "is_chosen", "joins"),
    [(8.6, False, True), (14.0, False, False), (14.0, True, True), (-80.0, True, False)],
)
def test_what_a_person_selected_counts_more_than_poses_unless_it_is_far(
    session: LabelSession, off_px: float, is_chosen: bool, joins: bool
) -> None:
    """A pose that is turned by 0.7 deg moves a drawing by 8.6 px."""
    first = draw(session, pole(session, 0, "left"))
    right = pole(session, 0, "right", first, (0.0, off_px), is_chosen=is_chosen)
    done = do(session, right)
    assert (done.element_id == first) is joins
    assert ("kept as P-01" in done.note) is joins
    assert ("so this is a new element" in done.note) is not joins


def test_a_chosen_element_counts_more_than_another_that_is_expected_there(
    session: LabelSession,
) -> None:
    first, second = (
        do(session, pole(session, 0, "left", shift_px=(aside, 0.0), asks_same=False)).element_id
        for aside in (0.0, 20.0)
    )
    for element, aside in ((first, 0.0), (second, 20.0)):
        draw(session, pole(session, 0, "right", element, (aside, 0.0), is_chosen=True))
    drawn = pole(session, 1, "left", first, (20.0, 0.0))
    assert draw(session, drawn) == second, "a selection that only stayed gives way"
    session.apply(new_id(), UndoEdit(kind="undo"))
    again = pole(session, 1, "left", first, (20.0, 0.0), is_chosen=True)
    assert draw(session, again) == first


def test_a_rejected_proposal_that_is_drawn_by_hand_stays_its_element(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    rejected = Dismissal(proposal_id(first, 2, "left"), 2, "left", "rejected", first)
    session.apply(new_id(), Dismiss((rejected,)))
    here = pole(session, 2, "left", first, (25.0, 0.0), is_chosen=True)
    assert draw(session, here) == first
    assert session.labels.dismissed_in(2) == ()


@pytest.mark.parametrize(("off_px", "why", "joins"), [
    (6.0, "rejected", True), (30.0, "rejected", False), (6.0, "absent", False),
])  # fmt: skip
def test_of_several_rejected_proposals_each_is_continued_by_a_drawing_near_it(
    session: LabelSession, off_px: float, why: Any, joins: bool
) -> None:
    """Whatever is selected: only one of them can be."""
    far = (60.0, 0.0)
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    other = draw(session, pole(session, 0, "left", shift_px=far))
    draw(session, pole(session, 0, "right", other, far))
    rejected = [
        Dismissal(proposal_id(element, 2, side), 2, side, why, element)
        for element in (first, other)
        for side in SIDES
    ]
    session.apply(new_id(), Dismiss(tuple(rejected)))
    done = do(session, pole(session, 2, "left", other, (off_px, 0.0)))
    assert (done.element_id == first) is joins
    assert ("Continues P-01, which was rejected here" in done.note) is joins
    left = {(row.element_id, row.side) for row in session.labels.dismissed_in(2)}
    assert ((first, "right") in left) is not joins, "it may be proposed in the other image anew"
    assert {(other, "left"), (other, "right")} <= left


def test_a_drawing_on_a_label_is_asked_about(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    twice = pole(session, 0, "left", shift_px=(1.2, 0.0), asks_same=True)
    with pytest.raises(SamePlaceError, match=r"Lies on P-01, 1.2 px away") as asked:
        do(session, twice)
    assert asked.value.below.row.element_id == first
    assert session.labels.operation == 1
    preview = session.preview(
        DraftState(
            frame_index=0,
            drawing=ElementDraft("left", POLE, tuple(twice["anchor_px"]), tuple(twice["end_px"])),
        )
    )
    assert preview.warning == "Lies on P-01, 1.2 px away"
    assert draw(session, twice | {"asks_same": False}) != first
    beside = pole(session, 0, "left", shift_px=(9.0, 0.0), asks_same=True)
    assert draw(session, beside) != first
    sign_below = sign(0, "left", (700.0, 120.0), asks_same=True)
    draw(session, sign_below)
    other_class = sign(0, "left", (701.0, 121.0), asks_same=True, class_id=TRIANGULAR)
    with pytest.raises(SamePlaceError, match="Lies on O-"):
        do(session, other_class)


def test_another_class_never_pairs(session: LabelSession) -> None:
    first = draw(session, sign(0, "left", (700.0, 120.0)))
    right = sign(0, "right", (680.0, 120.0), selected_id=first, class_id=TRIANGULAR)
    assert draw(session, right) != first


def test_a_hidden_bottom_does_not_hinder_pairing(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    u, v = pixel(session, BOTTOM, 0, "right")
    short = pole(session, 0, "right", first, end_px=[u, v - 20.0], end_known=False)
    assert draw(session, short) == first


@pytest.mark.parametrize(("aside_px", "joins"), [(0.5, True), (20.0, False)])
def test_a_pole_without_ends_joins_the_selected_one_only_on_its_line(
    session: LabelSession, aside_px: float, joins: bool
) -> None:
    """Its ends say nothing; the selected one's are known in both images of another frame."""
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    hidden = {"anchor_known": False, "end_known": False}
    first_pole = pole(session, 1, "left", first, shift_px=(aside_px, 0.0), **hidden)
    assert (draw(session, first_pole) == first) == joins


@pytest.mark.parametrize("frames", [3, 5])
def test_however_many_frames_show_a_pole_another_beside_it_does_not_fit_it(
    session: LabelSession, frames: int
) -> None:
    """Many that agree must not hide that the last one does not."""
    shown: list[tuple[int, Side]] = [(frame, side) for frame in range(frames) for side in SIDES]
    for aside_px in (0.0, 8.0):
        shifts = [0.0] * len(shown) + [aside_px]
        rows = [
            seen_as(pole(session, frame, side, shift_px=(shift, 0.0)))
            for (frame, side), shift in zip([*shown, (frames, "left")], shifts, strict=True)
        ]
        poses = [session.frames[row.frame_index].T_map_camera for row in rows]
        views = [
            rig_view(session.rig, row.side, None if pose is None else pose.inverse())
            for row, pose in zip(rows, poses, strict=True)
        ]
        assert (reprojection_error_px(views, rows) <= CONSISTENT_PX) == (aside_px == 0.0)


def seen_as(drawn: dict[str, Any]) -> Observation:
    return Observation(
        "", "", drawn["frame_index"], drawn["side"], tuple(drawn["anchor_px"]),
        tuple(drawn["end_px"]), True, True,
    )  # fmt: skip


@pytest.mark.parametrize(("shift", "joins"), [((4.0, -3.0), True), ((40.0, 0.0), False)])
def test_drawing_near_a_proposal_continues_its_element(
    session: LabelSession, shift: tuple[float, float], joins: bool
) -> None:
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    assert (draw(session, pole(session, 2, "left", shift_px=shift)) == first) is joins


def test_one_camera_and_two_frames_make_an_element(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    assert session.position(first) is None
    assert draw(session, pole(session, 5, "left", selected=first)) == first
    place, T_map_camera = session.position(first), session.frames[0].T_map_camera
    assert place is not None
    assert T_map_camera is not None
    np.testing.assert_allclose(place.anchor_m, T_map_camera.apply(PEAK)[0], atol=1e-4)


def far_pole(
    session: LabelSession,
    frame: int,
    side: str,
    depth_m: float,
    selected: str | None = None,
    noise_px: np.ndarray | None = None,
    **more: Any,
) -> dict[str, Any]:
    """A pole of 2 m a little left of the first camera's axis, with ``noise_px`` (2, 2) added."""
    top, bottom = np.array([[-1.0, -0.8, depth_m]]), np.array([[-1.0, 1.2, depth_m]])
    exact = np.array([pixel(session, point, frame, side) for point in (top, bottom)])
    noisy = exact + (0.0 if noise_px is None else noise_px)
    return pole(session, frame, side, selected, **more) | {
        "anchor_px": noisy[0].tolist(),
        "end_px": noisy[1].tolist(),
    }


OFFSET_PX = np.array([0.45, 0.0])
"""What KITTI's rectification leaves in its right images."""
KNOWN = st.sampled_from([(True, True), (False, True), (True, False)])


@given(
    depth_m=st.floats(5.0, 500.0),
    seed=st.integers(0, 2**32 - 1),
    known=st.tuples(KNOWN, KNOWN),
)
@settings(max_examples=60, deadline=None)
@example(depth_m=500.0, seed=2, known=((True, True), (True, True)))
@example(depth_m=500.0, seed=2, known=((False, True), (True, False)))
def test_left_and_right_of_one_pole_pair_however_far(
    shared_session: LabelSession,
    depth_m: float,
    seed: int,
    known: tuple[tuple[bool, bool], tuple[bool, bool]],
) -> None:
    session = shared_session
    noise = np.random.default_rng(seed).uniform(-0.5, 0.5, (2, 2, 2))
    flags = [dict(zip(("anchor_known", "end_known"), flags_of, strict=True)) for flags_of in known]
    left = far_pole(session, 0, "left", depth_m, noise_px=noise[0], **flags[0])
    first = draw(session, left)
    right = far_pole(session, 0, "right", depth_m, first, noise[1] + OFFSET_PX, **flags[1])
    done = do(session, right)
    assert done.element_id == first, done.note
    do(session, {"kind": "delete element", "element_id": first})


@given(
    depth_m=st.floats(10.0, 500.0),
    off=st.sampled_from([20.0, -20.0]),
    frames=st.integers(0, 2),
)
@settings(max_examples=30, deadline=None)
def test_twenty_pixels_off_the_line_never_pair(
    shared_session: LabelSession, depth_m: float, off: float, frames: int
) -> None:
    """Neither with one view nor with an element seen in ``frames`` whole pairs before."""
    session, first = shared_session, None
    for frame in range(frames):
        for side in ("left", "right"):
            first = draw(session, far_pole(session, frame, side, depth_m, first))
    first = draw(session, far_pole(session, frames, "left", depth_m, first))
    shift = np.array([0.0, off])
    done = do(session, far_pole(session, frames, "right", depth_m, first, shift))
    assert done.element_id != first
    assert "px off P-" in done.note
    for element_id in (first, done.element_id):
        do(session, {"kind": "delete element", "element_id": element_id})


def test_a_wrong_disparity_does_not_pass_for_a_far_pole(session: LabelSession) -> None:
    """Rays that meet behind the cameras by more than noise are of two elements."""
    first = draw(session, far_pole(session, 0, "left", 100.0))
    shift = np.array([30.0, 0.0])
    done = do(session, far_pole(session, 0, "right", 100.0, first, shift))
    assert done.element_id != first
    disparity = session.rig.left.K[0, 0] * session.rig.baseline_m / 100.0
    assert done.note.startswith(f"{30.0 - disparity:.1f} px off P-01")


def test_an_element_too_far_to_triangulate_is_listed_as_nearby_and_continued(
    session: LabelSession,
) -> None:
    first = draw(session, far_pole(session, 0, "left", 300.0))
    (nearby,) = session.frame(3).nearby
    assert (nearby.id, nearby.labelled_in) == (first, 0)
    assert session.frame(3).proposals == []  # one view tells no place
    draw(session, far_pole(session, 0, "right", 300.0, first))
    assert session.position(first) is None
    seen = session.frame(3)
    (proposed,) = seen.proposals
    assert (proposed.id, proposed.is_confident, proposed.depth_m) == (first, False, None)
    for side in ("left", "right"):
        true = far_pole(session, 3, side, 300.0)
        np.testing.assert_allclose(proposed.marks[side].anchor, true["anchor_px"], atol=0.5)
        np.testing.assert_allclose(proposed.marks[side].end, true["end_px"], atol=0.5)
    assert draw(session, far_pole(session, 3, "left", 300.0, first)) == first
    assert session.frame(4).nearby[0].labelled_in == 3
    draw(session, far_pole(session, 3, "right", 300.0, first))
    assert session.frame(3).nearby == []
