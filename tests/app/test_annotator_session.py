"""What labelling does, without a browser: pairing, ghosts, undo, and what the page is told."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from annotating import SIDES
from hypothesis import example, given, settings
from hypothesis import strategies as st

from semviz.annotator import looker
from semviz.annotator.fit import misfit_px
from semviz.annotator.pairing import CONSISTENT_PX
from semviz.annotator.session import Drawing, LabelSession, Look
from semviz.workspace import Workspace
from semviz_annotation.assist.snap import snap
from semviz_annotation.labels import Observation, new_id
from semviz_annotation.proposals import Proposal, Proposals, save_proposals
from semviz_annotation.storing.backup import backup_labels, restore_labels
from semviz_annotation.view import rig_view
from semviz_core.classes import POLE, ROUNDED, TRIANGULAR
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose
from semviz_core.sources.source import Side

PEAK, BOTTOM = np.array([[3.0, -1.2, 14.0]]), np.array([[3.0, 1.6, 14.0]])
"""A pole in the coordinates of frame 0's left camera."""


@pytest.fixture
def session(tmp_path: Path) -> Iterator[LabelSession]:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 6))
    session = LabelSession(workspace, "tester")
    yield session
    session.close()


@pytest.fixture(scope="module")
def shared_session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LabelSession]:
    """For many examples; each leaves it without elements."""
    folder = tmp_path_factory.mktemp("shared")
    session = LabelSession(Workspace.create_street(folder / "street", 7, range(0, 6)), "tester")
    yield session
    session.close()


def pixel(session: LabelSession, point: np.ndarray, frame: int, side: str) -> tuple[float, float]:
    """Where a point of frame 0's left camera is in any image."""
    rig = session.rig
    first, now = (session.frames[index].T_map_camera for index in (0, frame))
    assert first is not None
    assert now is not None
    assert rig.T_right_left is not None
    T_camera_left = Pose.identity() if side == "left" else rig.T_right_left
    u, v = rig.left.project((T_camera_left @ now.inverse() @ first).apply(point))[0]
    return float(u), float(v)


def pole(
    session: LabelSession,
    frame: int,
    side: str,
    selected: str | None = None,
    shift_px: tuple[float, float] = (0.0, 0.0),
    **more: Any,
) -> dict[str, Any]:
    def place(point: np.ndarray) -> list[float]:
        u, v = pixel(session, point, frame, side)
        return [u + shift_px[0], v + shift_px[1]]

    return {
        "kind": "draw",
        "observation_id": new_id(),
        "element_id": new_id(),
        "frame_index": frame,
        "side": side,
        "class_id": POLE,
        "anchor_px": place(PEAK),
        "end_px": place(BOTTOM),
        "anchor_known": True,
        "end_known": True,
        "selected_id": selected,
    } | more


def sign(frame: int, side: str, middle: tuple[float, float], **more: Any) -> dict[str, Any]:
    return {
        "kind": "draw",
        "observation_id": new_id(),
        "element_id": new_id(),
        "frame_index": frame,
        "side": side,
        "class_id": ROUNDED,
        "anchor_px": list(middle),
        "end_px": None,
        "anchor_known": True,
        "end_known": False,
        "selected_id": None,
    } | more


def draw(session: LabelSession, edit: dict[str, Any]) -> str:
    done = session.do(new_id(), edit)
    assert done.element_id is not None
    return done.element_id


def test_left_then_right_become_one_element_in_its_true_place(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    second = draw(session, pole(session, 0, "right", selected=first))
    assert second == first
    place, T_map_camera = session.place(first), session.frames[0].T_map_camera
    assert place is not None
    assert T_map_camera is not None
    np.testing.assert_allclose(place.anchor_m, T_map_camera.apply(PEAK)[0], atol=1e-6)
    np.testing.assert_allclose(place.end_m, T_map_camera.apply(BOTTOM)[0], atol=1e-6)


def test_a_drawing_off_the_epipolar_line_starts_a_new_element_and_says_so(
    session: LabelSession,
) -> None:
    first = draw(session, pole(session, 0, "left"))
    done = session.do(new_id(), pole(session, 0, "right", first, shift_px=(0.0, 14.0)))
    assert done.element_id != first
    assert "px off P-01, so this is a new element" in done.note


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
    one = pole(session, 1, "left", first, shift_px=(aside_px, 0.0), **hidden)
    assert (draw(session, one) == first) == joins


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
        poses = [session.frames[one.frame_index].T_map_camera for one in rows]
        views = [
            rig_view(session.rig, one.side, None if pose is None else pose.inverse())
            for one, pose in zip(rows, poses, strict=True)
        ]
        assert (misfit_px(views, rows) <= CONSISTENT_PX) == (aside_px == 0.0)


def seen_as(drawn: dict[str, Any]) -> Observation:
    return Observation(
        "", "", drawn["frame_index"], drawn["side"], tuple(drawn["anchor_px"]),
        tuple(drawn["end_px"]), True, True,
    )  # fmt: skip


def test_a_bottom_that_ends_above_the_ground_is_hidden(tmp_path: Path) -> None:
    """Only where it is asked for, and never where it is seen; what is far away may not be told."""
    workspace = Workspace.create_street(tmp_path / "cars", 2, range(0, 8))
    session = LabelSession(workspace, "tester")
    street = workspace.street
    seen, ids = street.labels(0, "left")
    right = set(street.labels(0, "right")[1].tolist())
    marked, judged = {}, []
    for row in np.flatnonzero(seen.is_line & seen.anchor_known):
        if int(ids[row]) not in right or seen.end_px[row, 1] > street.rig.left.height - 3:
            continue
        ends = {"anchor_px": seen.anchor_px[row].tolist(), "end_px": seen.end_px[row].tolist()}
        edit = pole(session, 0, "left", snap=True, **ends)
        element = draw(session, edit | {"asks_bottom": True})
        for question in session.unanswered(0):
            session.looker.answer(question)
        (drawn,) = session.labels.of_element(element)
        marked[element] = edit
        judged.append((bool(seen.end_known[row]), drawn.end_known))
    assert sum(not truth for truth, _ in judged) >= 3
    assert all(said for truth, said in judged if truth)
    assert sum(not said for _, said in judged) >= 3
    hidden = next(one for one in marked if not session.labels.of_element(one)[0].end_known)
    session.do(new_id(), {"kind": "delete element", "element_id": hidden})
    new = {"observation_id": new_id(), "element_id": new_id()}
    session.do(new_id(), marked[hidden] | new)
    said = session.labels.observations[new["observation_id"]]
    assert said.end_known, "whoever says what is seen is believed"
    session.close()


def test_what_is_shown_and_then_saved_is_looked_for_once(
    session: LabelSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[object] = []

    def noted(shot: Any, mark: Any, element_class: Any) -> Any:
        looks.append(mark)
        return snap(shot, mark, element_class)

    monkeypatch.setattr(looker, "snap", noted)
    edit = pole(session, 0, "left", snap=True)
    anchor, end = tuple(edit["anchor_px"]), tuple(edit["end_px"])
    for _ in range(2):
        session.look(Look(0, drawing=Drawing("left", POLE, anchor, end, snap=True)))
    draw(session, edit)
    assert len(looks) == 1
    draw(session, pole(session, 0, "left", snap=True, shift_px=(60.0, 0.0)))
    draw(session, pole(session, 0, "right", snap=True, anchor_px=anchor, end_px=end))
    assert len(looks) == 3


def test_ghosts_lie_where_the_element_is_in_other_frames(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    (ghost,) = session.frame(2)["offers"]
    assert ghost["id"] == first
    for side in ("left", "right"):
        np.testing.assert_allclose(ghost[side]["anchor"], pixel(session, PEAK, 2, side), atol=1e-4)
        np.testing.assert_allclose(ghost[side]["end"], pixel(session, BOTTOM, 2, side), atol=1e-4)
    assert session.frame(0)["offers"] == []


@pytest.mark.parametrize(("shift", "joins"), [((4.0, -3.0), True), ((40.0, 0.0), False)])
def test_drawing_near_a_ghost_continues_its_element(
    session: LabelSession, shift: tuple[float, float], joins: bool
) -> None:
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    assert (draw(session, pole(session, 2, "left", shift_px=shift)) == first) is joins


def test_one_camera_and_two_frames_make_an_element(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    assert session.place(first) is None
    assert draw(session, pole(session, 5, "left", selected=first)) == first
    place, T_map_camera = session.place(first), session.frames[0].T_map_camera
    assert place is not None
    assert T_map_camera is not None
    np.testing.assert_allclose(place.anchor_m, T_map_camera.apply(PEAK)[0], atol=1e-4)


def test_the_same_request_is_done_once(session: LabelSession) -> None:
    request, edit = new_id(), pole(session, 0, "left")
    numbers = {session.do(request, edit).operation.number for _ in range(3)}
    assert numbers == {1}
    assert len(session.labels.observations) == 1


def test_undo_goes_to_the_frame_it_changes(session: LabelSession) -> None:
    draw(session, pole(session, 3, "left"))
    draw(session, pole(session, 0, "left"))
    assert session.do(new_id(), {"kind": "undo"}).frame == 0
    assert session.do(new_id(), {"kind": "undo"}).frame == 3
    assert session.labels.observations == {}
    assert session.do(new_id(), {"kind": "redo"}).frame == 3


def test_deleting_says_what_falls(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    left = session.labels.in_frame(0, "left")[0]
    note = session.do(new_id(), {"kind": "delete", "observation_id": left.id}).note
    assert note == "Deleted P-01 left. 1 view left. Ctrl Z brings it back."
    session.do(new_id(), {"kind": "undo"})
    note = session.do(new_id(), {"kind": "delete element", "element_id": first}).note
    assert note == "Deleted P-01 with 2 views in 1 frame. Ctrl Z brings all back."


def test_the_card_knows_depth_height_and_errors_before_anything_is_saved(
    session: LabelSession,
) -> None:
    first = draw(session, pole(session, 0, "left"))
    drawing = Drawing(
        side="right",
        class_id=POLE,
        anchor_px=pixel(session, PEAK, 0, "right"),
        end_px=pixel(session, BOTTOM, 0, "right"),
    )
    seen = session.look(Look(frame_index=0, selected_id=first, drawing=drawing))
    assert seen["joins"] == "P-01"
    card = seen["card"]
    assert card["depth_m"] == pytest.approx(14.0, abs=1e-6)
    assert card["height_m"] == pytest.approx(2.8, abs=1e-6)
    assert card["epipolar_px"] == pytest.approx(0.0, abs=1e-6)
    assert card["views"] == 2
    assert card["depth_sigma_m"] > 0.0
    assert len(session.labels.observations) == 1


def test_guides_run_through_the_partner(session: LabelSession) -> None:
    first = draw(session, pole(session, 0, "left"))
    guides = session.look(Look(frame_index=0, selected_id=first, side="left"))["guides"]
    assert guides["left"] == []
    for guide, point in zip(guides["right"], (PEAK, BOTTOM), strict=True):
        (near, far), partner = np.array(guide["plausible"]), pixel(session, point, 0, "right")
        along = (partner - near) @ (far - near) / ((far - near) @ (far - near))
        assert 0.0 < along < 1.0
        np.testing.assert_allclose(near + along * (far - near), partner, atol=1e-6)


def test_history_reads_like_what_was_done(session: LabelSession) -> None:
    draw(session, pole(session, 0, "left"))
    session.do(new_id(), {"kind": "review", "frame_index": 0, "state": "reviewed"})
    session.do(new_id(), {"kind": "undo"})
    summary = session.summary()
    texts = [entry["text"] for entry in summary["history"]]
    assert texts == ["Undo 2", "Frame 0 reviewed", "Draw P-01 left"]
    assert summary["operation"] == 3
    assert summary["frames"][0] == {"index": 0, "state": "in work", "elements": 1}


@pytest.mark.parametrize(
    ("edit", "reason"),
    [
        ({"kind": "paint"}, "not an edit"),
        (sign(0, "left", (5000.0, 10.0)), "outside the left image"),
        (sign(77, "left", (50.0, 10.0)), "frame 77 is not in this sequence"),
        (sign(0, "left", (50.0, 10.0)) | {"end_px": [1.0, 2.0]}, "has one point"),
        ({"kind": "delete", "observation_id": new_id()}, "no observation"),
    ],
)
def test_nonsense_is_refused_and_leaves_nothing(
    session: LabelSession, edit: dict[str, Any], reason: str
) -> None:
    with pytest.raises(SemvizError, match=reason):
        session.do(new_id(), edit)
    assert session.summary()["operation"] == 0


# -- far poles


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
    flags = [dict(zip(("anchor_known", "end_known"), one, strict=True)) for one in known]
    left = far_pole(session, 0, "left", depth_m, noise_px=noise[0], **flags[0])
    first = draw(session, left)
    right = far_pole(session, 0, "right", depth_m, first, noise[1] + OFFSET_PX, **flags[1])
    done = session.do(new_id(), right)
    assert done.element_id == first, done.note
    session.do(new_id(), {"kind": "delete element", "element_id": first})


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
    done = session.do(new_id(), far_pole(session, frames, "right", depth_m, first, shift))
    assert done.element_id != first
    assert "px off P-" in done.note
    for element_id in (first, done.element_id):
        session.do(new_id(), {"kind": "delete element", "element_id": element_id})


def test_a_wrong_disparity_does_not_pass_for_a_far_pole(session: LabelSession) -> None:
    """Rays that meet behind the cameras by more than noise are of two things."""
    first = draw(session, far_pole(session, 0, "left", 100.0))
    shift = np.array([30.0, 0.0])
    done = session.do(new_id(), far_pole(session, 0, "right", 100.0, first, shift))
    assert done.element_id != first
    disparity = session.rig.left.K[0, 0] * session.rig.baseline_m / 100.0
    assert done.note.startswith(f"{(30.0 - disparity) / 2.0:.1f} px off P-01")


def test_what_is_too_far_to_triangulate_is_offered_nearby_and_continued(
    session: LabelSession,
) -> None:
    first = draw(session, far_pole(session, 0, "left", 300.0))
    (nearby,) = session.frame(3)["nearby"]
    assert (nearby["id"], nearby["labelled_in"]) == (first, 0)
    assert session.frame(3)["offers"] == []  # one view tells no place
    draw(session, far_pole(session, 0, "right", 300.0, first))
    assert session.place(first) is None
    seen = session.frame(3)
    (offered,) = seen["offers"]
    assert (offered["id"], offered["sure"], offered["depth_m"]) == (first, False, None)
    for side in ("left", "right"):
        true = far_pole(session, 3, side, 300.0)
        np.testing.assert_allclose(offered[side]["anchor"], true["anchor_px"], atol=0.5)
        np.testing.assert_allclose(offered[side]["end"], true["end_px"], atol=0.5)
    assert draw(session, far_pole(session, 3, "left", 300.0, first)) == first
    assert session.frame(4)["nearby"][0]["labelled_in"] == 3
    draw(session, far_pole(session, 3, "right", 300.0, first))
    assert session.frame(3)["nearby"] == []


def test_what_is_expected_or_passed_or_labelled_long_ago_is_not_offered(tmp_path: Path) -> None:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 12))
    session = LabelSession(workspace, "tester")
    first = draw(session, pole(session, 0, "left"))
    draw(session, pole(session, 0, "right", first))
    once = draw(session, sign(0, "left", (700.0, 120.0)))
    offered = {frame: {one["id"] for one in session.frame(frame)["nearby"]} for frame in range(12)}
    expected = {frame: {one["id"] for one in session.frame(frame)["offers"]} for frame in range(12)}
    assert expected[1] == {first}
    assert all(first not in ids for ids in offered.values())
    assert [once in offered[frame] for frame in range(12)] == [False] + [True] * 5 + [False] * 6
    session.close()


def test_news_tell_what_another_process_did(session: LabelSession) -> None:
    session.news()
    assert not session.has_news()
    other = LabelSession(session.workspace, "somebody else")
    draw(other, pole(other, 4, "left"))
    other.close()
    assert session.has_news()
    news = session.news()
    assert news["frames"] == [{"index": 4, "state": "in work", "elements": 1}]
    assert news["operation"] == 1
    assert not session.has_news()


def test_labels_that_were_put_back_are_shown_and_labelled_on(
    session: LabelSession, tmp_path: Path
) -> None:
    draw(session, pole(session, 0, "left"))
    backup_labels(session.workspace.labels_path, tmp_path / "backup.db")
    for frame in (1, 2):
        draw(session, sign(frame, "left", (700.0, 120.0)))
    session.news()
    restore_labels(session.workspace.labels_path, tmp_path / "backup.db")
    assert session.has_news()
    news = session.news()
    assert (news["operation"], len(news["history"])) == (1, 1)
    assert {one["index"]: one["elements"] for one in news["frames"]} == dict.fromkeys(
        range(6), 0
    ) | {0: 1}
    draw(session, sign(3, "left", (700.0, 120.0)))
    assert session.news()["operation"] == 2


def test_what_a_detector_found_is_proposed_until_it_is_labelled(tmp_path: Path) -> None:
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 2))
    places = {"aside": (700.0, 120.0), "labelled": (300.0, 150.0)}
    found = [
        Proposal(new_id(), 0, "left", ROUNDED, place, None, True, False, 0.9, 1.0)
        for place in places.values()
    ]
    save_proposals(Proposals.of(found), workspace.proposals_path)
    session = LabelSession(workspace, "tester")
    draw(session, sign(0, "left", (303.0, 152.0)))  # by a person, about where the detector's is
    (offer,) = [one for one in session.frame(0)["offers"] if one["origin"] == "detector"]
    assert (offer["left"]["id"], offer["score"], offer["sure"]) == (found[0].id, None, False)
    assert session.frame(0)["looking"]
    for question in session.unanswered(0):
        session.looker.answer(question)
    assert not session.frame(0)["looking"]
    (offer,) = [one for one in session.frame(0)["offers"] if one["origin"] == "detector"]
    assert 0.0 < offer["score"] < 1.0
    mark = sign(0, "left", places["aside"], observation_id=found[0].id)
    session.do(new_id(), {"kind": "accept", "marks": [mark]})
    assert session.labels.observations[found[0].id].anchor_px == places["aside"]
    origins = {one["origin"] for one in session.frame(0)["offers"]}
    assert "detector" not in origins
    session.close()
