"""What is told of a selection: candidates, residuals, sigmas, its part in the run, its labels."""

import json
import shutil
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from inspecting import open_flat, wait_for
from planted import TWICE, element_id, merge, planted_map, street
from small_runs import off_by, saved, small_run, spoiled, unanswered, without_truth

from semviz.inspector.mending.labelling import LabellingTools
from semviz.inspector.selection.element_card import element_card, origins_view
from semviz.inspector.selection.matrix import candidates_of_column, candidates_of_row
from semviz.inspector.selection.origins import Origins
from semviz.inspector.selection.selected import SelectedTopic, selected_view
from semviz.inspector.server import Inspector, InspectorSession
from semviz.inspector.session import Selection, State
from semviz.inspector.shelf import Shelf
from semviz.recording.run import FrameRecord, Run
from semviz.web.door import Door
from semviz.web.scenes import Scenes
from semviz.workspace import Workspace
from semviz_annotation.edits import DeleteMany, MoveObservation
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Page

Json = dict[str, Any]


def told(run: Run, observed: int | None, element: int | None, position: int = 0) -> Json:
    """As the page gets it, without what belongs to it being selected too."""
    shown = selected_view(run, State(position=position, selection=Selection(observed, element)))
    assert shown is not None
    json.dumps(shown, allow_nan=False)
    return shown


def pairs(record: FrameRecord) -> list[tuple[int, int]]:
    """Observed rows and elements' ids of the answer."""
    fine = record.localization.refinement
    assert fine is not None
    return [(int(i), int(record.localization.submap.id[j])) for i, j in fine.pairs]


def with_ids(record: FrameRecord, changed: dict[int, int]) -> FrameRecord:
    ids = record.element_id.copy()
    for row, one in changed.items():
        ids[row] = one
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
        before, after = (told(one, observed, element)["residuals"] for one in (run, wrong))
        assert after[0]["chi2"] > before[0]["chi2"]
        assert after[1] == before[1]
        assert after[1]["fits"]


def test_without_a_pose_the_reason_stands_in_its_place() -> None:
    run = without_truth(spoiled(small_run(), {small_run().frames[0].frame.index: unanswered}))
    observed, element = pairs(small_run().frames[0])[0]
    reasons = [one["reason"] for one in told(run, observed, element)["residuals"]]
    assert reasons == ["no pose", "not known"]
    assert told(run, observed, element)["said"] == ["This frame has no pairs.", ""]
    kinds = run.semantic_map.elements.class_id
    other = int(run.semantic_map.elements.id[kinds != kinds[0]][0])
    line = int(np.flatnonzero(run.frames[1].localization.observed.class_id == kinds[0])[0])
    assert told(run, line, other, 1)["residuals"][0]["reason"] == "classes differ"


def test_candidates_are_the_matrix_in_order_and_always_hold_the_true_one() -> None:
    run = small_run()
    for record in run.frames:
        one = record.localization
        assert one.match is not None
        ids = [*one.submap.id.tolist(), None]
        for row in range(len(one.observed)):
            listed = candidates_of_row(run, record, row)
            values = one.match.probability[row]
            for cell in listed:
                column = ids.index(cell["element"])
                assert cell["probability"] == values[column]
                assert cell["rank"] == 1 + np.sum(values > values[column])
            assert [cell["rank"] for cell in listed] == sorted(cell["rank"] for cell in listed)
            true = [cell["element"] for cell in listed if cell["isTrue"]]
            assert true == [one for one in ids if one == record.element_id[row]]
    assert candidates_of_column(run.frames[0], -5) == []


def test_an_unlikely_true_pair_is_listed_behind_the_likely_ones() -> None:
    record = small_run().frames[0]
    first, second = pairs(record)[:2]
    swapped = with_ids(record, {first[0]: second[1], second[0]: first[1]})
    *_, last = candidates_of_row(small_run(), swapped, first[0])
    assert (last["element"], last["isTrue"]) == (second[1], True)
    assert last["rank"] > 1


def test_words_for_pairs_false_detections_and_what_is_elsewhere() -> None:
    run = small_run()
    record = run.frames[0]
    (observed, element), (other, _) = pairs(record)[:2]
    assert told(run, observed, element)["said"] == [
        "A pair of the answer, and it fits.",
        "It is the true pair.",
    ]
    assert told(run, other, element)["said"][0] == "Not a pair of the answer."
    false = replace(run, frames=(with_ids(record, {observed: -1}), *run.frames[1:]))
    assert told(false, observed, None)["said"][1] == (
        f"Truly, #{observed} is nothing real: a false detection."
    )
    assert told(false, observed, None)["residuals"] == []
    assert told(false, None, element)["said"][1] == "Truly no detection is of it."
    far = int(run.semantic_map.elements.id[-1])
    assert far not in record.localization.submap.id
    assert told(run, None, far)["said"][0].startswith("Outside of this frame's submap, ")
    assert "ofRow" not in told(run, None, far)
    elsewhere = replace(run, frames=(with_ids(record, {observed: far}), *run.frames[1:]))
    assert "outside of the submap" in told(elsewhere, observed, None)["said"][1]
    assert told(without_truth(run), observed, element)["said"][1] == ""


def test_only_what_is_in_the_map_can_be_selected() -> None:
    run = small_run()
    with pytest.raises(SemvizError, match="has no element 12345"):
        State().selecting(None, 12345, run)
    assert selected_view(run, State()) is None
    observed, element = pairs(run.frames[0])[0]
    assert State().selecting(observed, None, run).selection == Selection(observed, element)
    assert State().selecting(None, element, run).selection == Selection(observed, element)


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
    one = replace(sign, anchor_m=anchor[None], covariance_m2=covariance)
    mapped = replace(run, semantic_map=replace(run.semantic_map, elements=one))
    (place,) = element_card(mapped, record, int(sign.id[0]))["place"]
    assert place["sigmaM"] == pytest.approx([0.1, 0.5, 0.2])
    assert place["distanceM"] == pytest.approx(np.hypot(20.0, 3.0))


def test_an_end_that_nobody_saw_is_called_so() -> None:
    run = small_run()
    poles = run.semantic_map.elements
    unseen = replace(poles, end_known=np.zeros(len(poles), dtype=bool))
    hidden = replace(run, semantic_map=replace(run.semantic_map, elements=unseen))
    _, element = next(
        pair for pair in pairs(run.frames[0]) if poles.is_line[poles.id == pair[1]][0]
    )
    assert [one["known"] for one in told(run, None, element)["place"]] == [True, True]
    assert [one["known"] for one in told(hidden, None, element)["place"]] == [True, False]


def test_its_part_in_the_run_counts_frames() -> None:
    run = small_run()
    observed, element = pairs(run.frames[0])[0]
    counted = dict(told(run, None, element)["inRun"])
    fits = sum(element in [id for _, id in pairs(one)] for one in run.frames)
    frames = len(run.frames)
    assert counted["Paired, fits"] == f"{fits}, {fits} of {frames} frames"
    seen = sum(element in record.element_id for record in run.frames)
    assert counted["Truly seen, paired rightly"] == f"{seen}, {fits} of {frames} frames"
    worse = replace(run, frames=(with_ids(run.frames[0], {observed: -1}), *run.frames[1:]))
    counted = dict(told(worse, None, element)["inRun"])
    assert counted["Truly seen, paired rightly"] == f"{seen - 1}, {fits - 1} of {frames} frames"


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
    for one in run.frames:
        nothing = replace(
            one.localization,
            submap=semantic_map.elements[[]],
            match=None,
            refinement=None,
            alternatives=(),
        )
        frames.append(FrameRecord(one.frame, nothing, np.full(len(one.element_id), -1)))
    return replace(run, semantic_map=semantic_map, frames=tuple(frames))


@pytest.fixture
def workspace(labelled: Path, tmp_path: Path) -> Workspace:
    shutil.copytree(labelled, tmp_path / "street")
    return Workspace.open(tmp_path / "street")


def origins_of(path: Path) -> tuple[Run, Origins]:
    from semviz.recording.reader import load_run

    run = load_run(path)
    return run, Origins(run, path)


def test_labels_are_counted_by_frame_and_side_and_who_drew_last_is_named(
    workspace: Workspace,
) -> None:
    run, origins = origins_of(workspace.run_path("search"))
    view = origins_view(run, origins, 1)
    json.dumps(view)
    first, second = view["entries"]
    assert view["reason"] == ""
    assert [first["number"], second["number"]] == [1, 2]
    assert (second["left"], second["right"]) == (len(TWICE), len(TWICE))
    assert second["frames"] == [(index, "LR") for index in TWICE]
    assert second["writer"]["author"] == "planter"
    assert second["writer"]["origin"] == "human"
    assert not second["isNewer"]
    assert [one["names"] for one in told(run, None, 1)["decisions"]] == [["P-01", "P-02"]]
    assert "labels, with their poses taken as exact" in told(run, None, 1)["meaning"]


def test_what_others_draw_meanwhile_shows_and_counts_as_newer_than_the_map(
    workspace: Workspace,
) -> None:
    run, origins = origins_of(workspace.run_path("search"))
    assert len(origins.of(1)) == 2
    row = workspace.read_labels().of_element(element_id(2))[0]
    with workspace.open_labels() as store:
        moved = (row.anchor_px[0] + 0.5, row.anchor_px[1])
        store.apply(MoveObservation(row.id, moved), "anna")
    first, second = origins_view(run, origins, 1)["entries"]
    assert (second["writer"]["author"], second["isNewer"]) == ("anna", True)
    assert not first["isNewer"]
    with workspace.open_labels() as store:
        rows = store.labels.of_element(element_id(1)) + store.labels.of_element(element_id(2))
        store.apply(DeleteMany(tuple(one.id for one in rows)), "anna")
    view = origins_view(run, origins, 1)
    assert (view["entries"], view["reason"]) == (
        [],
        "Its labels were deleted since this map was built.",
    )


def test_without_the_labels_it_says_why(workspace: Workspace, tmp_path: Path) -> None:
    alone = tmp_path / "elsewhere" / "run.rrd"
    alone.parent.mkdir()
    shutil.copy(workspace.run_path("search"), alone)
    view = origins_view(*origins_of(alone), 1)
    assert view["entries"] == []
    assert "The labels are not at hand" in view["reason"]
    other = Workspace.create_street(tmp_path / "other", 7, range(2))
    shutil.copy(alone, other.run_path("search"))
    assert origins_view(*origins_of(other.run_path("search")), 1)["entries"] == []
    plain = small_run()
    view = origins_view(plain, Origins(plain, alone), int(plain.semantic_map.elements.id[0]))
    assert view["reason"] == "The map does not say which labels it was made of."


def test_labels_of_what_is_no_longer_selected_are_not_told(workspace: Workspace) -> None:
    run, origins = origins_of(workspace.run_path("search"))
    said: list[str] = []

    class Desk:
        lock = threading.RLock()
        state = State(selection=Selection(None, 1))

        def __init__(self) -> None:
            self.run = run

        def kept(self, make: Any) -> Any:
            self.state = replace(self.state, selection=selected_by_then)
            return SimpleNamespace(origins=origins)

        def say(self, kind: str, _: Any) -> None:
            said.append(kind)

    for selected_by_then in (Selection(None, 1), Selection()):
        said.clear()
        SelectedTopic(Desk()).verbs()["origins"]({})  # type: ignore[arg-type]
        for thread in threading.enumerate():
            if thread is not threading.current_thread() and thread.name == "origins":
                thread.join()
        assert said == (["origins"] if selected_by_then.element else [])


def test_the_card_comes_with_whatever_changes_it_and_once(tmp_path: Path) -> None:
    said: list[Json] = []
    scenes = Scenes()
    try:
        shelf = Shelf([saved(small_run(), tmp_path / "plain.rrd")])
        session = InspectorSession("one", shelf, LabellingTools(), scenes, said.append)
        session.receive({"verb": "open", "run": None, "theme": "dark"})

        def cards(message: Json) -> list[Json]:
            said.clear()
            session.receive(message)
            return [one["selected"] for one in said if one["type"] == "selected"]

        (card,) = cards({"verb": "select", "observed": 0})
        assert card["observed"] == 0
        assert cards({"verb": "look", "view": "above"}) == []
        (there,) = cards({"verb": "go", "position": 1})
        assert there["element"] == card["element"]
        assert there["place"] != card["place"]
        assert cards({"verb": "select"}) == [None]
        said.clear()
        session.connected()  # a page that is back knows nothing
        assert [one["selected"] for one in said if one["type"] == "selected"] == [None]
    finally:
        scenes.close_all()


@pytest.mark.browser
def test_the_card_tells_of_cells_detections_and_labels(
    workspace: Workspace, tmp_path: Path, page: "Page"
) -> None:
    runs = [saved(small_run(), tmp_path / "plain.rrd"), workspace.run_path("search")]
    with Door(Inspector(runs)).running() as url:
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
        page.goto(f"{url}?run=search&element=1")
        page.wait_for_selector("#frame-list li")
        page.click("[data-tab=selected]")
        wait_for(page, lambda: "planter" in card.inner_text(), "who drew it")
        assert "Outside of this frame's submap" in card.inner_text()
        assert "taken as one by the machine" in card.inner_text()
        page.close()
