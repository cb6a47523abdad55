"""The view "Map over time": what it says of planted changes, decisions on them, the changed map."""

import json
import os
import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from annotator_page import annotating
from changing_runs import changing_workspace
from changing_street import ChangingStreet
from command_line import call
from inspector_page import in_url, open_flat, wait_for

from semviz.inspector.context import RunLibrary
from semviz.inspector.map_over_time.over_time import OverTime, PassSearch, over_time_event
from semviz.inspector.server import Inspector
from semviz.runs.reader import load_run
from semviz.web.gateway import Gateway
from semviz.workspace.maps.map_decisions import (
    DecisionConflictError,
    LabelPlace,
    asked_by_frame,
    decide,
    decide_in,
    decisions_path,
    read_decisions,
)
from semviz.workspace.workspace import Workspace
from semviz_core.base.map_file import load_map
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Page

Town = tuple[Workspace, list[Path], ChangingStreet]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return changing_workspace(tmp_path_factory.mktemp("over_time"), hidden=0.0)


@pytest.fixture(scope="module")
def over_time(town: Town) -> OverTime:
    return searched(town[0], town[1])


def searched(workspace: Workspace, runs: list[Path]) -> OverTime:
    search = PassSearch(RunLibrary(runs), workspace.read_map("main"), workspace)
    return search.work()


@pytest.fixture
def decisions(town: Town) -> Iterator[Path]:
    """The file of decisions, which the test starts without."""
    path = decisions_path(town[0])
    path.unlink(missing_ok=True)
    yield path
    path.unlink(missing_ok=True)


def gone(town: Town) -> str:
    return town[2].first_map.name_of(min(town[2].vanishes))


def test_each_change_is_told_with_the_frames_that_show_it(town: Town, over_time: OverTime) -> None:
    _, runs, world = town
    search = PassSearch(RunLibrary(runs), over_time.changes.semantic_map, town[0])
    search.value = over_time
    view = over_time_event(search, "main").found
    assert view is not None
    assert [one.date for one in view.passes][:2] == ["2026-03-03", "2026-03-12"]
    told = {change.name: change for change in view.changes}
    vanished = told[gone(town)]
    assert (vanished.kind, vanished.since) == ("vanished", 2)
    assert vanished.sentence.startswith("2 passes saw it, in ")
    assert " 5 did not, in " in vanished.sentence
    assert vanished.before is not None
    assert vanished.after is not None
    assert (vanished.before.run, vanished.before.is_seen) == ("pass-2", True)
    assert (vanished.after.run, vanished.after.is_seen) == ("pass-7", False)
    moved = told[world.first_map.name_of(*world.moves)]
    assert moved.kind == "moved"
    assert moved.before is not None
    assert moved.after is not None
    assert len(view.standing) + len({c.element for c in view.changes} - {None}) == view.elements
    for shot in (moved.before, moved.after):  # a detection lies where the card draws its ring
        run = load_run(town[0].run_path(shot.run))
        observed = run.frames[shot.position].localization.observed
        middle = [sum(end[axis] for end in shot.ends) / len(shot.ends) for axis in (0, 1)]
        nearest = min(
            abs(anchor[0] - middle[0]) for anchor in observed.anchor_px[observed.class_id == 0]
        )
        assert nearest < 12.0


def test_what_is_no_other_pass_is_left_out_and_one_pass_is_not_enough(town: Town) -> None:
    workspace, runs, _ = town
    twice = workspace.path / "again.rrd"
    twice.write_bytes(runs[0].read_bytes())
    search = PassSearch(RunLibrary([runs[0], twice]), workspace.read_map("main"), workspace)
    with pytest.raises(SemvizError, match="one pass cannot tell a miss from a change"):
        search.work()
    (left_out,) = search.left_out
    assert left_out.run == "again"
    assert "has the detections of pass-1" in left_out.reason
    twice.unlink()


def test_decisions_are_found_again_with_other_passes_and_never_silently_replaced(
    town: Town, over_time: OverTime, decisions: Path
) -> None:
    workspace, runs, _ = town
    found = over_time.changes
    (name,) = (one.name for one in found.changes if one.kind == "new")
    decide(decisions, found, [(name, "keep", None)], "mara", 0)
    fewer = searched(workspace, runs[:6]).changes
    (change,) = (one for one in fewer.changes if one.kind == "new")
    change = replace(change, name="n-09")
    elsewhere = replace(change, place_m=(change.place_m[0] + 2.0, *change.place_m[1:]))
    assert read_decisions(decisions).on(elsewhere, fewer.semantic_map.digest) is None
    kept = read_decisions(decisions).on(change, fewer.semantic_map.digest)
    assert kept is not None
    assert (kept.answer, kept.author) == ("keep", "mara")
    with pytest.raises(DecisionConflictError, match=f"mara decided on {name} meanwhile"):
        decide(decisions, found, [(name, "make", None)], "jon", 0)
    assert read_decisions(decisions).on(change, fewer.semantic_map.digest) == kept
    decide(decisions, found, [(name, "open", None)], "mara", 1)
    assert read_decisions(decisions).on(change, fewer.semantic_map.digest) is None
    assert len(read_decisions(decisions).decisions) == 2
    moved_kind = replace(change, kind="moved")
    decide(decisions, found, [(name, "make", None)], "mara", 2)
    assert read_decisions(decisions).on(moved_kind, fewer.semantic_map.digest) is None


def test_two_who_decide_at_once_both_stay(town: Town, over_time: OverTime, decisions: Path) -> None:
    names = [change.name for change in over_time.changes.changes[:2]]
    threads = [
        threading.Thread(
            target=decide, args=(decisions, over_time.changes, [(name, "keep", None)], name)
        )
        for name in names
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {one.author for one in read_decisions(decisions).decisions} == set(names)


def test_a_label_in_a_frame_of_another_workspace_is_in_its_list(
    town: Town, over_time: OverTime, decisions: Path, tmp_path: Path
) -> None:
    other = tmp_path / "june"
    other.mkdir()
    shutil.copy(town[0].path / "semviz.toml", other)
    folder = os.path.relpath(other.resolve(), town[0].path.resolve())
    place = LabelPlace(workspace=folder, run="pass-7", frame=21)
    found, name = over_time.changes, gone(town)
    decide_in(town[0], found, [(name, "label", place)], "mara", 0)
    assert asked_by_frame(decisions) == {}
    there = decisions_path(Workspace.open(other))
    assert asked_by_frame(there) == {21: (name,)}
    decide_in(town[0], found, [(name, "keep", None)], "jon", 1)
    assert asked_by_frame(there) == {}
    gone_place = place.model_copy(update={"workspace": f"{folder}-gone"})
    with pytest.raises(SemvizError):
        decide_in(town[0], found, [(name, "label", gone_place)], "mara", 2)
    assert len(read_decisions(decisions).decisions) == 2, "nothing is half decided"


def test_damaged_decisions_are_refused_and_kept(
    town: Town, over_time: OverTime, decisions: Path
) -> None:
    decide(decisions, over_time.changes, [(gone(town), "keep", None)], "mara")
    data = decisions.read_bytes().replace(b"mara", b"jane")
    decisions.write_bytes(data)
    with pytest.raises(SemvizError, match="its checksum differs"):
        decide(decisions, over_time.changes, [(gone(town), "make", None)], "jon")
    assert decisions.read_bytes() == data
    assert asked_by_frame(decisions) == {}


def test_the_command_reads_decisions_of_the_page(
    town: Town, over_time: OverTime, decisions: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    workspace, runs, _ = town
    name = gone(town)
    place = LabelPlace(workspace=".", run="pass-7", frame=21)
    decide(decisions, over_time.changes, [(name, "label", place)], "mara")
    command = ("map", "changes", workspace.path, *runs)
    status, output, _ = call(capsys, *command, "--write", "after", "--json")
    assert status == 0
    answers = {row["name"]: row["answer"] for row in json.loads(output)["changes"]}
    assert answers.pop(name) == "label"
    assert sorted(answers.values()) == ["make"] * 3 + ["open"], "one is unsure"
    after = load_map(workspace.map_path("after"))
    assert name in {after.name_of(id_) for id_ in after.elements.id.tolist()}
    status, output, _ = call(capsys, *command)
    assert f"decided: {name} ask for a label, by mara" in output
    assert asked_by_frame(decisions) == {21: (name,)}
    told = read_decisions(decisions).as_dict(over_time.changes)
    assert {row["name"]: row["answer"] for row in told["changes"]}[name] == "label"


@pytest.fixture(scope="module")
def served(town: Town) -> Iterator[str]:
    with Gateway(Inspector(town[1])).running() as url:
        yield url


@pytest.mark.browser
def test_the_page_leads_from_changes_to_frames_and_writes_the_decided_map(
    page: "Page", town: Town, served: str, decisions: Path
) -> None:
    workspace, _, _ = town
    before = workspace.map_path("main").read_bytes()
    open_flat(page, served, "run=pass-1&frame=10")
    page.keyboard.press("F4")
    rows = page.locator("#change-rows .change-row")
    wait_for(page, lambda: rows.count() == 5, "the changes")
    assert "7 passes, 3 Mar – 26 Apr 2026" in page.inner_text("#over-time-about")
    rows.filter(has_text=gone(town)).click()
    wait_for(page, lambda: in_url(page, "change") == gone(town), "the address")
    assert in_url(page, "show") == "over-time"
    assert "Vanished before pass-3" in page.inner_text("#change-why")
    cells = page.locator("#pass-rows .pass-row[aria-current=true] .cell")
    states = [cells.nth(at).get_attribute("class") for at in range(7)]
    assert states == ["cell seen"] * 2 + ["cell missed"] * 5

    def word(name: str, text: str) -> None:
        wait_for(page, lambda: text in rows.filter(has_text=name).inner_text(), text)

    page.keyboard.press("Delete")
    word(gone(town), "remove")
    page.keyboard.press("Control+z")
    word(gone(town), "open")
    page.keyboard.press("Enter")
    word(gone(town), "keep")
    page.keyboard.press("Shift+.")
    other = in_url_later(page, gone(town))
    page.keyboard.press("o")
    word(other, "wants label")
    page.keyboard.press("Shift+Enter")
    wait_for(page, lambda: "4 of 5" in page.inner_text("#change-done"), "all decided")
    with page.expect_download() as download:
        page.click("#changes-json")
    exported = json.loads(download.value.path().read_text())
    answers = {row["name"]: row["answer"] for row in exported["changes"]}
    assert (answers[gone(town)], answers[other], len(answers)) == ("keep", "label", 5)
    page.fill("#next-map", "main")
    page.click("#write-map")
    wait_for(page, lambda: "exists already" in page.inner_text("#notice"), "the refusal")
    page.fill("#next-map", "summer")
    page.click("#write-map")
    wait_for(page, lambda: "summer.parquet: " in page.inner_text("#diff-written"), "the map")
    assert workspace.map_path("main").read_bytes() == before
    summer = load_map(workspace.map_path("summer"))
    names = {summer.name_of(id_) for id_ in summer.elements.id.tolist()}
    assert other.startswith("n-")
    assert gone(town) in names, "kept"
    assert len(names) == len(load_map(workspace.map_path("main"))) - 1, "one vanished, none is new"
    page.locator(".picture").last.click()
    wait_for(page, lambda: page.locator("#over-time").is_hidden(), "the frame")
    wait_for(page, lambda: in_url(page, "run") == "pass-7", "the run of the last picture")


def in_url_later(page: "Page", before: str) -> str:
    wait_for(page, lambda: in_url(page, "change") not in (None, before), "another change")
    name = in_url(page, "change")
    assert name is not None
    return name


@pytest.mark.browser
def test_a_label_that_is_asked_for_is_in_the_jump_list_of_annotate(
    page: "Page", town: Town, over_time: OverTime, decisions: Path
) -> None:
    place = LabelPlace(workspace=".", run="pass-7", frame=21)
    decide(decisions, over_time.changes, [(gone(town), "label", place)], "mara")
    with annotating(town[0]) as annotator:
        page.goto(annotator.url)
        row = page.locator("#jumps :text('Labels asked for')")
        row.click()
        wait_for(page, lambda: in_url(page, "frame") == "21", "the frame")
        page.goto("about:blank")  # before its server goes


@pytest.mark.browser
def test_a_single_run_says_what_is_missing(page: "Page", town: Town) -> None:
    with Gateway(Inspector(town[1][:1])).running() as url:
        open_flat(page, url, "frame=10&show=over-time")
        progress = page.locator("#over-time-progress")
        wait_for(page, lambda: "one pass cannot tell" in progress.inner_text(), "the reason")
        assert page.locator("#over-time-hint").is_visible()
        assert not page.locator("#change-rows").is_visible()
