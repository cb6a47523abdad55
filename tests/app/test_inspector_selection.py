"""What is told of a selection: candidates, residuals, sigmas, its part in the run, its labels."""

import shutil
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from duplicated_pole import TWICE, element_id, merge, planted_map, street
from inspector_page import open_flat, open_page, wait_for
from small_runs import off_by, saved, small_run, spoiled, unanswered, without_truth

from semviz.inspector.context import EmbeddedAnnotators, RunLibrary
from semviz.inspector.element_card import Origins, element_card, origins_view
from semviz.inspector.messages import (
    GetOriginsRequest,
    GoToPositionRequest,
    OpenRunRequest,
    SelectRequest,
    SetViewRequest,
)
from semviz.inspector.selection import (
    SelectionPanel,
    candidates_of_column,
    candidates_of_row,
    selection_card,
)
from semviz.inspector.server import Inspector, InspectorSession
from semviz.inspector.state import Selection, State
from semviz.inspector.views_frame import SelectionCard, SelectionEvent
from semviz.runs.run import FrameRecord, Run
from semviz.web.gateway import Gateway
from semviz.web.protocol import Event, Request
from semviz.web.viser_servers import ViserServers
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import DeleteMany, MoveObservation
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Page

Json = dict[str, Any]


def told(run: Run, observed: int | None, element: int | None, position: int = 0) -> Json:
    """As the page gets it, without what belongs to it being selected too."""
    card = selection_card(run, State(position=position, selection=Selection(observed, element)))
    assert card is not None
    return card.model_dump(mode="json")


def pairs(record: FrameRecord) -> list[tuple[int, int]]:
    """Observed rows and elements' ids of the answer."""
    fine = record.localization.refinement
    assert fine is not None
    return [(int(i), int(record.localization.submap.id[j])) for i, j in fine.pairs]


def with_ids(record: FrameRecord, changed: dict[int, int]) -> FrameRecord:
    ids = record.element_id.copy()
    for row, value in changed.items():
        ids[row] = value
    return replace(record, element_id=ids)


# -- in the frame


def test_the_residual_at_the_estimate_is_the_solvers_own() -> None:
    run = small_run()
    for position, record in enumerate(run.frames):
        fine = record.localization.refinement
        assert fine is not None
        for row, (observed, element) in enumerate(pairs(record)):
            at_estimate, _ = told(run, observed, element, position)["residuals"]
            size = np.sqrt(np.nansum(fine.residual_px[row] ** 2))
            assert at_estimate["px"] == pytest.approx(size, abs=1e-6)
            assert at_estimate["chi2"] == pytest.approx(fine.chi2[row], rel=1e-6, abs=1e-9)
            assert at_estimate["fits"] == fine.inlier[row]


def test_an_estimate_that_is_off_shows_there_and_not_at_the_truth() -> None:
    run = small_run()
    wrong = spoiled(run, {run.frames[0].frame.index: off_by(2.0)})
    for observed, element in pairs(run.frames[0]):
        before, after = (told(value, observed, element)["residuals"] for value in (run, wrong))
        assert after[0]["chi2"] > before[0]["chi2"]
        assert after[1] == before[1]
        assert after[1]["fits"]


def test_without_a_pose_the_reason_stands_in_its_place() -> None:
    run = without_truth(spoiled(small_run(), {small_run().frames[0].frame.index: unanswered}))
    observed, element = pairs(small_run().frames[0])[0]
    reasons = [residual["reason"] for residual in told(run, observed, element)["residuals"]]
    assert reasons == ["no pose", "unknown"]
    assert told(run, observed, element)["summary"] == ["This frame has no pairs.", ""]
    kinds = run.semantic_map.elements.class_id
    other = int(run.semantic_map.elements.id[kinds != kinds[0]][0])
    line = int(np.flatnonzero(run.frames[1].localization.observed.class_id == kinds[0])[0])
    assert told(run, line, other, 1)["residuals"][0]["reason"] == "classes differ"


def test_candidates_are_the_matrix_in_order_and_always_hold_the_true_one() -> None:
    run = small_run()
    for record in run.frames:
        result = record.localization
        assert result.match is not None
        ids = [*result.submap.id.tolist(), None]
        for row in range(len(result.observed)):
            listed = candidates_of_row(run, record, row)
            values = result.match.probability[row]
            for cell in listed:
                column = ids.index(cell.element)
                assert cell.probability == values[column]
                assert cell.rank == 1 + np.sum(values > values[column])
            assert [cell.rank for cell in listed] == sorted(cell.rank for cell in listed)
            true = [cell.element for cell in listed if cell.is_true]
            assert true == [id_ for id_ in ids if id_ == record.element_id[row]]
    assert candidates_of_column(run.frames[0], -5) == ()


def test_an_unlikely_true_pair_is_listed_behind_the_likely_ones() -> None:
    record = small_run().frames[0]
    first, second = pairs(record)[:2]
    swapped = with_ids(record, {first[0]: second[1], second[0]: first[1]})
    *_, last = candidates_of_row(small_run(), swapped, first[0])
    assert (last.element, last.is_true) == (second[1], True)
    assert last.rank > 1


def test_words_for_pairs_false_detections_and_what_is_elsewhere() -> None:
    run = small_run()
    record = run.frames[0]
    (observed, element), (other, _) = pairs(record)[:2]
    assert told(run, observed, element)["summary"] == [
        "Matched, an inlier.",
        "Correct by ground truth.",
    ]
    assert told(run, other, element)["summary"][0] == "Not a pair of the estimate."
    false = replace(run, frames=(with_ids(record, {observed: -1}), *run.frames[1:]))
    assert told(false, observed, None)["summary"][1] == (
        f"Ground truth: #{observed} is a false positive."
    )
    assert told(false, observed, None)["residuals"] == []
    assert told(false, None, element)["summary"][1] == "Ground truth: not detected."
    far = int(run.semantic_map.elements.id[-1])
    assert far not in record.localization.submap.id
    assert told(run, None, far)["summary"][0].startswith("Outside this frame's submap, ")
    assert told(run, None, far)["of_row"] == []
    elsewhere = replace(run, frames=(with_ids(record, {observed: far}), *run.frames[1:]))
    assert "outside the submap" in told(elsewhere, observed, None)["summary"][1]
    assert told(without_truth(run), observed, element)["summary"][1] == ""


def test_only_what_is_in_the_map_can_be_selected() -> None:
    run = small_run()
    with pytest.raises(SemvizError, match="has no element 12345"):
        State().with_selection(None, 12345, run)
    assert selection_card(run, State()) is None
    observed, element = pairs(run.frames[0])[0]
    assert State().with_selection(observed, None, run).selection == Selection(observed, element)
    assert State().with_selection(None, element, run).selection == Selection(observed, element)


# -- of the element


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 30.0, 200.0])
def test_sigmas_are_across_and_along_the_line_of_sight(heading_deg: float) -> None:
    """A covariance that is long along the line of sight is so from there, and no other way."""
    heading = np.deg2rad(heading_deg)
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    covariance = np.zeros((1, 6, 6))
    covariance[0, :2, :2] = turn @ np.diag([0.5**2, 0.1**2]) @ turn.T  # along, across
    covariance[0, 2, 2] = 0.2**2
    run = small_run()
    record = run.frames[0]
    assert record.localization.T_camera_map is not None
    eye = record.localization.T_camera_map.inverse().translation
    elements = run.semantic_map.elements
    sign = elements[np.flatnonzero(~elements.is_line)[:1]]
    anchor = eye + np.array([20.0 * np.cos(heading), 20.0 * np.sin(heading), 3.0])
    sigmas = replace(sign, anchor_m=anchor[None], covariance_m2=covariance)
    mapped = replace(run, semantic_map=replace(run.semantic_map, elements=sigmas))
    (place,) = element_card(mapped, record, int(sign.id[0])).place
    assert place.sigma_m == pytest.approx([0.1, 0.5, 0.2])
    assert place.distance_m == pytest.approx(np.hypot(20.0, 3.0))


def test_an_end_that_nobody_saw_is_called_so() -> None:
    run = small_run()
    poles = run.semantic_map.elements
    unseen = replace(poles, end_known=np.zeros(len(poles), dtype=bool))
    hidden = replace(run, semantic_map=replace(run.semantic_map, elements=unseen))
    _, element = next(
        pair for pair in pairs(run.frames[0]) if poles.is_line[poles.id == pair[1]][0]
    )
    assert [end["known"] for end in told(run, None, element)["mapped"]["place"]] == [True, True]
    assert [end["known"] for end in told(hidden, None, element)["mapped"]["place"]] == [True, False]


def test_its_part_in_the_run_counts_frames() -> None:
    run = small_run()
    observed, element = pairs(run.frames[0])[0]
    counted = dict(told(run, None, element)["mapped"]["in_run"])
    fits = sum(element in [id for _, id in pairs(frame)] for frame in run.frames)
    frames = len(run.frames)
    assert counted["Matched, inlier"] == f"{fits}, {fits} of {frames} frames"
    seen = sum(element in record.element_id for record in run.frames)
    assert counted["Detected, matched correctly"] == f"{seen}, {fits} of {frames} frames"
    worse = replace(run, frames=(with_ids(run.frames[0], {observed: -1}), *run.frames[1:]))
    counted = dict(told(worse, None, element)["mapped"]["in_run"])
    assert counted["Detected, matched correctly"] == f"{seen - 1}, {fits - 1} of {frames} frames"


# -- its labels


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with a run whose only map element was made of two label elements."""
    workspace = street(tmp_path_factory.mktemp("labelled") / "street")
    labels = workspace.read_labels()
    saved(_run_in(planted_map(workspace, labels, [merge()])), workspace.run_path("search"))
    return workspace.path


def _run_in(semantic_map: Any) -> Run:
    """In which nothing of the map was given to the solver."""
    run = small_run()
    frames = []
    for frame in run.frames:
        nothing = replace(
            frame.localization,
            submap=semantic_map.elements[[]],
            match=None,
            refinement=None,
            alternatives=(),
        )
        frames.append(FrameRecord(frame.frame, nothing, np.full(len(frame.element_id), -1)))
    return replace(run, semantic_map=semantic_map, frames=tuple(frames))


@pytest.fixture
def workspace(labelled: Path, tmp_path: Path) -> Workspace:
    shutil.copytree(labelled, tmp_path / "street")
    return Workspace.open(tmp_path / "street")


def origins_of(path: Path) -> tuple[Run, Origins]:
    from semviz.runs.reader import load_run

    run = load_run(path)
    return run, Origins(run, path)


def test_labels_are_counted_by_frame_and_side_and_who_drew_last_is_named(
    workspace: Workspace,
) -> None:
    run, origins = origins_of(workspace.run_path("search"))
    view = origins_view(run, origins, 1)
    first, second = view.entries
    assert view.reason == ""
    assert [first.name, second.name] == ["P-01", "P-02"]
    assert (second.left, second.right) == (len(TWICE), len(TWICE))
    assert second.frames == tuple((index, "LR") for index in TWICE)
    assert second.writer is not None
    assert (second.writer.author, second.writer.origin) == ("planter", "human")
    assert not second.is_newer
    assert [decision["names"] for decision in told(run, None, 1)["mapped"]["decisions"]] == [
        ["P-01", "P-02"]
    ]
    assert (
        "labels. Errors of their poses are not included." in told(run, None, 1)["mapped"]["meaning"]
    )


def test_what_others_draw_meanwhile_shows_and_counts_as_newer_than_the_map(
    workspace: Workspace,
) -> None:
    run, origins = origins_of(workspace.run_path("search"))
    assert len(origins.of(1)) == 2
    row = workspace.read_labels().of_element(element_id(2))[0]
    with workspace.open_labels() as store:
        moved = (row.anchor_px[0] + 0.5, row.anchor_px[1])
        store.apply(MoveObservation(row.id, moved), "anna")
    first, second = origins_view(run, origins, 1).entries
    assert second.writer is not None
    assert (second.writer.author, second.is_newer) == ("anna", True)
    assert not first.is_newer
    with workspace.open_labels() as store:
        rows = store.labels.of_element(element_id(1)) + store.labels.of_element(element_id(2))
        store.apply(DeleteMany(tuple(row.id for row in rows)), "anna")
    view = origins_view(run, origins, 1)
    assert (view.entries, view.reason) == (
        (),
        "Its labels were deleted after this map was built.",
    )


def test_without_the_labels_it_says_why(workspace: Workspace, tmp_path: Path) -> None:
    alone = tmp_path / "elsewhere" / "run.rrd"
    alone.parent.mkdir()
    shutil.copy(workspace.run_path("search"), alone)
    view = origins_view(*origins_of(alone), 1)
    assert view.entries == ()
    assert "The labels were not found" in view.reason
    other = Workspace.create_street(tmp_path / "other", 7, range(2))
    shutil.copy(alone, other.run_path("search"))
    assert origins_view(*origins_of(other.run_path("search")), 1).entries == ()
    plain = small_run()
    view = origins_view(plain, Origins(plain, alone), int(plain.semantic_map.elements.id[0]))
    assert view.reason == "The map does not name the labels that it was built from."


def test_labels_of_what_is_no_longer_selected_are_not_told(workspace: Workspace) -> None:
    run, origins = origins_of(workspace.run_path("search"))
    said: list[str] = []

    class Context:
        lock = threading.RLock()
        state = State(selection=Selection(None, 1))

        def __init__(self) -> None:
            self.run = run

        def cached(self, make: Any) -> Any:
            self.state = replace(self.state, selection=selected_by_then)
            return SimpleNamespace(origins=origins)

        def send(self, event: Event) -> None:
            said.append(event.type)

    for selected_by_then in (Selection(None, 1), Selection()):
        said.clear()
        SelectionPanel(Context())._get_origins(GetOriginsRequest(id="1"))  # type: ignore[arg-type]
        for thread in threading.enumerate():
            if thread is not threading.current_thread() and thread.name == "origins":
                thread.join()
        assert said == (["origins"] if selected_by_then.element else [])


def test_the_card_comes_with_whatever_changes_it_and_once(tmp_path: Path) -> None:
    said: list[Event] = []
    scenes = ViserServers()
    try:
        library = RunLibrary([saved(small_run(), tmp_path / "plain.rrd")])
        session = InspectorSession("one", library, EmbeddedAnnotators(), scenes, said.append)
        session.receive(OpenRunRequest(id="1"))

        def sent() -> list[SelectionCard | None]:
            return [event.card for event in said if isinstance(event, SelectionEvent)]

        def cards(request: Request) -> list[SelectionCard | None]:
            said.clear()
            session.receive(request)
            return sent()

        (card,) = cards(SelectRequest(id="2", observed=0))
        assert card is not None
        assert card.observed == 0
        assert cards(SetViewRequest(id="3", view="above")) == []
        (there,) = cards(GoToPositionRequest(id="4", position=1))
        assert there is not None
        assert there.element == card.element
        assert there.mapped != card.mapped
        assert cards(SelectRequest(id="5")) == [None]
        said.clear()
        session.connected()  # a page that is back knows nothing
        assert sent() == [None]
    finally:
        scenes.close_all()


@pytest.mark.browser
def test_the_card_tells_of_cells_detections_and_labels(
    workspace: Workspace, tmp_path: Path, page: "Page"
) -> None:
    runs = [saved(small_run(), tmp_path / "plain.rrd"), workspace.run_path("search")]
    with Gateway(Inspector(runs)).running() as url:
        open_flat(page, url)
        page.click("[data-tab=selected]")
        card = page.locator("#selected-body")
        wait_for(page, lambda: "Nothing is selected" in card.inner_text(), "the hint")
        page.keyboard.press("Tab")
        wait_for(page, lambda: "At the true pose" in card.inner_text(), "the first detection")
        assert card.locator(".candidates li").count() >= 2
        before = page.locator("#matrix").bounding_box()
        page.keyboard.press("Escape")
        wait_for(page, lambda: "Nothing is selected" in card.inner_text(), "the hint again")
        assert page.locator("#matrix").bounding_box() == before  # nothing moves under the pointer
        open_page(page, url, "run=search&element=1")
        page.click("[data-tab=selected]")
        wait_for(page, lambda: "planter" in card.inner_text(), "who drew it")
        assert "Outside this frame's submap" in card.inner_text()
        assert "merged by map building" in card.inner_text()
        page.close()
