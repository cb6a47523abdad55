"""The decisions of a run's map in the inspector: seen, answered in the workspace, undone."""

import runpy
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from duplicated_pole import element_id, left_out, merge, planted_map, street

from semviz.inspector.decisions import Decisions
from semviz.inspector.server import Inspector
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord
from semviz.runs.writer import RunWriter
from semviz.web.gateway import Gateway
from semviz.workspace.maps.map_review import entry_key
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.rows import different_elements
from semviz_annotation.mapping.decisions import is_open
from semviz_annotation.storage.backup import backup_labels, restore_labels
from semviz_annotation.storage.store import ConflictError, ReplacedLogError
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Page

BENCH = Path(__file__).parents[2] / "bench" / "recording.py"
made_up: dict[str, Any] = runpy.run_path(str(BENCH))
JPEG: bytes = made_up["make_jpeg"]()


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """With a run whose map takes two label elements for one pole."""
    workspace = street(tmp_path_factory.mktemp("decided") / "street")
    labels = workspace.read_labels()
    decided = planted_map(workspace, labels, [merge(), left_out(labels)])
    info = replace(made_up["make_info"]("a run"), rig=workspace.source.rig)
    with RunWriter(workspace.run_path("search"), info, decided) as writer:
        for record in records(decided):
            writer.write(record)
    return workspace


def records(semantic_map: SemanticMap) -> list[FrameRecord]:
    """Of three frames, the map's only element is seen in the last."""
    found = []
    for record in made_up["make_records"](made_up["make_map"](length_m=60.0), 3, JPEG):
        result = replace(record.localization, submap=semantic_map.elements[[]], match=None)
        result = replace(result, refinement=None, alternatives=())
        unknown = np.full(len(result.observed), -1)
        found.append(replace(record, localization=result, element_id=unknown))
    seen = replace(found[2].localization, submap=semantic_map.elements)
    ids = found[2].element_id.copy()
    ids[0] = 1
    return [*found[:2], replace(found[2], localization=seen, element_id=ids)]


@pytest.fixture
def workspace(original: Workspace, tmp_path: Path) -> Workspace:
    shutil.copytree(original.path, tmp_path / "street")
    return Workspace.open(tmp_path / "street")


def decisions_of(path: Path) -> Decisions:
    return Decisions(load_run(path), path)


def entries(decisions: Decisions) -> list[dict[str, Any]]:
    return list(decisions.view(with_findings=True).model_dump(mode="json")["entries"])


def test_answers_are_saved_in_the_runs_workspace_and_undone(workspace: Workspace) -> None:
    decisions = decisions_of(workspace.run_path("search"))
    first, second, *findings = entries(decisions)
    assert [answer["name"] for answer in first["answers"]] == ["same", "two"]
    assert [element["map_id"] for element in first["elements"]] == [1, 1]
    assert [element["map_id"] for element in second["elements"]] == [None]
    decisions.answer(first["key"], "two")
    assert set(workspace.read_labels().review_decisions.values()) == {
        different_elements(element_id(1), element_id(2))
    }
    answered, *_ = entries(decisions)
    assert (answered["answers"], answered["undo"]) == ([], True)
    with pytest.raises(SemvizError, match="may be answered already"):
        decisions.answer(first["key"], "same")
    decisions.undo(first["key"])
    assert entries(decisions) == [first, second, *findings]
    assert not workspace.read_labels().review_decisions
    with pytest.raises(SemvizError, match="not answered here"):
        decisions.undo(first["key"])


def test_an_answer_never_overwrites_one_that_its_page_has_not_shown(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    mine, theirs = decisions_of(path), decisions_of(path)
    key, seen = entries(mine)[0]["key"], mine.view(with_findings=False).seen
    theirs.answer(key, "two", theirs.view(with_findings=False).seen)
    theirs.undo(key, theirs.view(with_findings=False).seen)
    with pytest.raises(ConflictError, match="changed the decision about"):
        mine.answer(key, "two", seen)
    assert not workspace.read_labels().review_decisions
    mine.answer(key, "two", mine.view(with_findings=False).seen)
    assert len(workspace.read_labels().review_decisions) == 1


def test_an_answer_in_replaced_labels_is_not_undone_in_a_restored_backup(
    workspace: Workspace, tmp_path: Path
) -> None:
    """The backup's operation of the same number is another answer, of the same author."""
    path, backup = workspace.run_path("search"), tmp_path / "backup.db"
    begun = Workspace.open(shutil.copytree(workspace.path, tmp_path / "elsewhere"))
    theirs, mine = decisions_of(begun.run_path("search")), decisions_of(path)
    key = entries(mine)[0]["key"]
    theirs.answer(key, "same")
    backup_labels(begun.labels_path, backup)
    mine.answer(key, "two")
    restore_labels(workspace.labels_path, backup)
    with pytest.raises(ReplacedLogError):
        mine.undo(key)
    assert not entries(mine)[0]["undo"]
    assert workspace.read_labels().review_decisions == begun.read_labels().review_decisions


def test_a_decision_leads_to_the_frame_that_sees_its_element(workspace: Workspace) -> None:
    decisions = decisions_of(workspace.run_path("search"))
    first, second, *findings = entries(decisions)
    assert decisions.place(first["key"]) == (2, 1)
    assert decisions.place(second["key"]) == (None, None)
    frames = {entry_key(finding): finding.frame_index for finding in decisions._findings}
    assert all(
        decisions.place(finding["key"]) == (frames[finding["key"]] or 2, 1) for finding in findings
    )
    with pytest.raises(SemvizError, match="no such decision"):
        decisions.place("something else")


def test_what_looks_odd_in_the_map_is_listed_and_has_no_answers(workspace: Workspace) -> None:
    decisions = decisions_of(workspace.run_path("search"))
    finding = entries(decisions)[2]
    assert (finding["kind"], finding["severity"]) == ("leaning pole", "error")
    assert len(decisions.view(with_findings=False).entries) == 2
    assert [element["map_id"] for element in finding["elements"]] == [1]
    with pytest.raises(SemvizError, match="a finding has no answers"):
        decisions.answer(finding["key"], "same")


def test_without_its_labels_a_run_only_shows_and_says_where_to_answer(
    workspace: Workspace, tmp_path: Path
) -> None:
    alone = tmp_path / "elsewhere" / "run.rrd"
    alone.parent.mkdir()
    shutil.move(workspace.run_path("search"), alone)
    decisions = decisions_of(alone)
    first, *_ = entries(decisions)
    assert (first["answers"], first["reason"]) == ([], "They fit one place")
    assert "Answer in 'semviz annotate WORKSPACE'" in decisions.view(False).note
    with pytest.raises(SemvizError, match="labels were not found"):
        decisions.answer(first["key"], "two")
    run = load_run(alone)
    named = replace(run, info=replace(run.info, workspace=str(workspace.path)))
    assert entries(Decisions(named, alone))[0]["answers"]


def test_a_workspace_with_other_labels_is_not_the_runs(
    workspace: Workspace, tmp_path: Path
) -> None:
    other = Workspace.create_street(tmp_path / "other", 7, range(2))
    path = other.run_path("search")
    shutil.copy(workspace.run_path("search"), path)
    assert entries(decisions_of(path))[0]["answers"] == []


@pytest.fixture
def url(workspace: Workspace) -> Iterator[str]:
    with Gateway(Inspector([workspace.run_path("search")])).running() as url:
        yield url


@pytest.mark.browser
def test_the_page_lists_selects_answers_and_undoes(
    url: str, workspace: Workspace, page: "Page"
) -> None:
    page.goto(url)
    page.wait_for_selector("#frame-list li")
    page.wait_for_selector("#decisions-open:text-is('2')")
    page.click("[data-tab=map]")
    page.click("#decision-list li >> nth=0")
    page.wait_for_selector(".decision[aria-current=true] >> text=They fit one place")
    page.wait_for_selector("#frame-number:has-text('2')")
    assert "P-01" in page.inner_text(".decision[aria-current=true]")
    page.click("text=Different landmarks")
    page.wait_for_selector("text=Undo the answer")
    (decision, _) = load_run(workspace.run_path("search")).semantic_map.decisions
    assert not is_open(decision, workspace.read_labels())
    page.click("text=Undo the answer")
    page.wait_for_selector("#decisions-open:text-is('2')")
    assert is_open(decision, workspace.read_labels())
    page.keyboard.press("h")
    page.wait_for_selector("#frame-list li")
