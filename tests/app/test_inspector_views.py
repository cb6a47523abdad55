"""What the inspector says about a run: state, words, numbers; no browser."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz.inspector.context import RunLibrary
from semviz.inspector.scene.scene_cameras import merge_labels
from semviz.inspector.server import HANDLERS
from semviz.inspector.state import State
from semviz.inspector.views import frame_view, run_view
from semviz.runs.diagnosis import DiagnosisCard, detection_errors, diagnosis_card
from semviz.runs.images import offsets, project_elements
from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz.web.protocol import MalformedRequestError, RefusedError
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Frame, Prior
from semviz_core.base.localization import Alternative, Localization, Match, Refinement, Search
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.errors import SemvizError

K = np.array([[700.0, 0.0, 620.0], [0.0, 700.0, 188.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(1241, 376, K)
LEVEL = Pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.0, 0.0, 1.65]))
NOWHERE = [np.nan] * 3
ELEMENTS = Elements3D.from_ends(
    [4, 7, 9, 12],
    [[20, 4, 6], [15, -4, 2.5], [25, -5, 7], [12, 3, 2.2]],
    [[20, 4, 0], NOWHERE, [25, -5, 0], NOWHERE],
    [0, 2, 0, 1],
)
MAP = SemanticMap(ELEMENTS, MapFrame("street-0"))


def seen_from(pose: Pose) -> Elements2D:
    projected = project_elements(ELEMENTS, pose.inverse(), CAMERA)
    return Elements2D.from_ends(projected.anchor_px, projected.end_px, ELEMENTS.class_id)


def localized(pose: Pose | None = LEVEL, status: str = "ok", reason: str = "Fine.") -> Localization:
    diagonal = np.column_stack([np.arange(4), np.arange(4)])
    probability = np.zeros((5, 5))
    probability[:4, :4] = np.eye(4)
    return Localization(
        method="search",
        camera=CAMERA,
        prior=Prior(np.array([3.0, 4.0, 1.65])),
        observed=seen_from(LEVEL),
        submap=ELEMENTS,
        status=status,  # type: ignore[arg-type]
        reason=reason,
        T_camera_map=None if pose is None else pose.inverse(),
        covariance=None if pose is None else np.eye(6) * 1e-4,
        match=Match(np.zeros((4, 4)), probability, diagonal),
        search=Search(100, (LEVEL.inverse(),), np.array([20.0])),
        refinement=Refinement(
            diagonal,
            np.array([[0.5, np.nan], [1.0, 1.0], [4.0, 0.1], [9.0, 0.0]]),
            np.array([0.1, 0.2, 3.0, 80.0]),
            np.array([True, True, True, False]),
            np.array([5.0, 1.0]),
        ),
        alternatives=(Alternative(LEVEL.inverse(), 18.5),),
        time_ms={"match": 1.0, "search": 5.0},
    )


def run_of(*localizations: Localization, truth: Pose | None = LEVEL) -> Run:
    info = RunInfo("first", "", "search", 0, "0", "2026-01-01T00:00:00", Rig(CAMERA), "street")
    frames = tuple(
        FrameRecord(
            Frame(10 + k, 0.1 * k, truth),
            localization,
            np.array([4, 7, 99, -1])[: len(localization.observed)],
        )
        for k, localization in enumerate(localizations)
    )
    return Run(info, MAP, frames)


def test_frame_is_plain_json_with_null_for_nan() -> None:
    again = json.loads(frame_view(run_of(localized()), 0).model_dump_json())
    assert again["observed"][1]["end"] is None
    assert again["pairs"][0]["residual_px"] == 0.5
    assert [detection["truth"] for detection in again["observed"]] == [0, 1, None, None]


def test_frame_without_any_stage_is_drawable() -> None:
    bare = replace(
        localized(None, "cannot", "3 elements seen, 4 needed."),
        match=None, search=None, refinement=None, alternatives=(), time_ms={},
    )  # fmt: skip
    view = json.loads(frame_view(run_of(bare, truth=None), 0).model_dump_json())
    assert (view["matrix"], view["pairs"], view["error_m"]) == (None, [], None)
    assert all(mapped["estimate"] is None and mapped["truth"] is None for mapped in view["mapped"])
    assert view["card"]["title"] == "Search miss"


def test_matrix_orders_rows_and_columns_into_class_blocks() -> None:
    matrix = frame_view(run_of(localized()), 0).matrix
    assert matrix is not None
    for order in (list(matrix.rows), list(matrix.columns)):
        assert sorted(order) == [0, 1, 2, 3]
        assert (np.diff(ELEMENTS.class_id[order]) >= 0).all()


def card_of(run: Run, record: FrameRecord) -> DiagnosisCard:
    return diagnosis_card(run, record, detection_errors(run, record))


def diagnoses(run: Run) -> list[str]:
    """What the page lists, by frame."""
    columns = run_view("first", run).frames
    return [columns.texts[row] for row in columns.diagnosis]


def test_sure_and_wrong_is_marked_and_named() -> None:
    far = Pose(LEVEL.rotation, LEVEL.translation + np.array([0.0, 3.2, 0.0]))
    run = run_of(localized(), localized(far), localized(far, "ambiguous", "Two poses fit."))
    columns = run_view("first", run).frames
    assert columns.overconfident == (1,)
    assert diagnoses(run) == ["healthy", "refinement diverged", "refinement diverged"]
    assert columns.error_m[1] == pytest.approx(3.2)
    card = card_of(run, run.frames[1])
    assert card.title == "Refinement diverged"
    assert "3.2 m" in card.sentence


def test_a_moved_element_is_named_at_the_true_pose() -> None:
    asides = np.where(ELEMENTS.id == 4, 2.0, 0.0)[:, None] * [0.0, 1.0, 0.0]
    faulty = replace(ELEMENTS, anchor_m=ELEMENTS.anchor_m + asides, end_m=ELEMENTS.end_m + asides)
    run = run_of(localized(), replace(localized(), submap=faulty))
    healthy, moved = (dict(card_of(run, frame).rows) for frame in run.frames)
    assert "Outliers, true pose" not in healthy
    name, size, unit = moved["Outliers, true pose"].split()
    assert (name, unit) == ("P-04", "px")
    assert float(size) == pytest.approx(700 * 2.0 / 20, rel=0.05)
    blind = dict(card_of(run, replace(run.frames[1], frame=Frame(0, 0.0, None))).rows)
    assert blind["Outliers"] == "T-12 9 px"


def failed(seen: int = 4, **changes: Any) -> Localization:
    bare = replace(localized(None, "cannot"), refinement=None, alternatives=(), **changes)
    return replace(bare, observed=bare.observed[np.arange(seen)])


def test_failures_are_named_by_the_first_broken_link() -> None:
    far = Prior(np.array([50.0, 0.0, 1.65]))
    nothing = ELEMENTS[np.arange(0)]
    run = run_of(
        failed(3, search=None, prior=far),
        failed(search=None, submap=nothing, prior=far),
        failed(search=None, submap=nothing),
        failed(search=Search(100, (), np.zeros(0))),
        failed(),
    )
    known = tuple(
        replace(frame, element_id=ELEMENTS.id[: len(frame.element_id)]) for frame in run.frames
    )
    assert diagnoses(replace(run, frames=known)) == [
        "missed detection", "wrong position prior", "not in the submap", "search miss",
        "ambiguous geometry",
    ]  # fmt: skip


def test_poses_that_nearly_coincide_share_a_label() -> None:
    places = {
        "/estimate": [0.0, 0, 0],
        "/truth": [5.0, 0, 0],
        "/B": [5.2, 0.3, 0],
        "/C": [9.0, 0, 0],
    }
    labels = merge_labels({name: np.array(place) for name, place in places.items()})
    assert labels == {"/estimate": "estimate", "/truth": "truth + B", "/C": "C"}


def test_median_is_over_frames_with_an_answer_and_a_truth() -> None:
    near = Pose(LEVEL.rotation, LEVEL.translation + np.array([0.0, 0.5, 0.0]))
    view = run_view("first", run_of(localized(), localized(near), localized(None, "cannot", "No.")))
    assert view.median_m == pytest.approx(0.25)
    assert view.ok_share == pytest.approx(2 / 3)
    assert run_view("first", run_of(localized(), truth=None)).median_m is None


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-0.1, 0.1))
def test_residual_vectors_end_on_the_projected_element(x: float, y: float, turn: float) -> None:
    other = Pose.from_rotvec([0, 0, turn], [x, y, 0.0]) @ LEVEL
    observed, seen = seen_from(LEVEL), project_elements(ELEMENTS, other.inverse(), CAMERA)
    start, vector = offsets(observed, seen, np.column_stack([np.arange(4), np.arange(4)]))
    reached = start + vector
    for row, is_line in enumerate(observed.is_line):
        if is_line:
            along = seen.end_px[row] - seen.anchor_px[row]
            across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
            assert abs((reached[row] - seen.anchor_px[row]) @ across) < 1e-6
            assert abs(vector[row] @ along) < 1e-6 * np.linalg.norm(along)
        else:
            assert np.allclose(reached[row], seen.anchor_px[row])


def test_poles_are_cut_at_the_camera_and_elements_behind_it_are_not_shown() -> None:
    # looking down, so that the foot of a near pole is ahead and its peak behind
    down = Pose(np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]).T, np.array([0.0, 0.0, 3.0]))
    pole = Elements3D.from_ends(
        [1, 2], [[0.4, 0, 9], [0.4, 0, 9]], [[0.4, 0, 0], [0.4, 0, 8]], [0, 0]
    )
    projected = project_elements(pole, down.inverse(), CAMERA)
    assert projected.shown.tolist() == [True, False]
    assert np.isfinite(projected.anchor_px[0]).all()


def test_state_moves_within_the_run() -> None:
    run = run_of(localized(), localized(), localized())
    state = State().opened("first", run, 11)
    assert state.position == 1
    assert State().opened("first", run, 99).position == 0
    assert state.at(-5, run).position == 0
    assert state.at(99, run).position == 2


def test_selecting_one_of_a_pair_selects_the_pair() -> None:
    run = run_of(localized())
    state = State().opened("first", run, None)
    assert (
        state.with_selection(1, None, run).selection == state.with_selection(None, 7, run).selection
    )
    assert state.with_selection(1, 12, run).selection.element == 12
    cleared = state.with_selection(1, None, run).with_selection(None, None, run).selection
    assert (cleared.observed, cleared.element) == (None, None)
    with pytest.raises(RefusedError, match="detection 4 does not exist") as refused:
        state.with_selection(4, None, run)
    assert refused.value.code == "not_found"


def test_selected_element_stays_selected_in_the_next_frame() -> None:
    run = run_of(localized(), localized())
    state = State().opened("first", run, None).with_selection(1, None, run).at(1, run)
    assert (state.selection.observed, state.selection.element) == (1, 7)


def test_wrong_wishes_are_refused_in_words() -> None:
    with pytest.raises(MalformedRequestError, match=r"set_view\.view"):
        HANDLERS.decode('{"type": "set_view", "id": "1", "view": "sideways"}')
    with pytest.raises(SemvizError, match="has no frames"):
        State().opened("first", run_of(), None)


def test_runs_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    paths = [tmp_path / "a" / "runs" / "x.rrd", tmp_path / "b" / "runs" / "x.rrd"]
    assert RunLibrary(paths).names == ("a/runs/x", "b/runs/x")
    assert RunLibrary(paths[:1]).names == ("x",)
    with pytest.raises(SemvizError, match="no run 'y'"):
        RunLibrary(paths).run("y")
    with pytest.raises(SemvizError, match="no run to show"):
        RunLibrary([])
