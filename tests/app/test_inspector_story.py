"""The story of a run: no frame counts twice, causes come by size, and the page leads to frames."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from inspector_page import in_url, open_flat, wait_for
from serving import at
from small_runs import (
    Spoil,
    ambiguous,
    off_by,
    run_with_a_moved_pole,
    saved,
    small_run,
    spoiled,
    unanswered,
)

from semviz.inspector.context import RunLibrary
from semviz.inspector.server import Inspector
from semviz.inspector.state import State
from semviz.inspector.story import story_view
from semviz.inspector.views import run_view
from semviz.runs import diagnosis
from semviz.runs.diagnosis import (
    DetectionErrors,
    diagnosis_card,
    diagnosis_name,
    run_diagnosis,
)
from semviz.runs.reader import assemble, load_run, read_rows
from semviz.runs.run import DIAGNOSIS, FrameRecord, Run
from semviz.runs.story import frames_text, stretches, tell, typical_positions, worst_position
from semviz.web.gateway import Gateway
from semviz_core.diagnosis.fault import RunFault
from semviz_core.diagnosis.run import RunDiagnosis

if TYPE_CHECKING:
    from playwright.sync_api import Page


def lost_run() -> Run:
    """Two frames without a pose, one 3 m off, three right."""
    return spoiled(small_run(), {12: unanswered, 14: unanswered, 18: off_by(3.0)})


def test_a_run_without_failures_says_that_all_frames_are_right() -> None:
    story = tell(small_run(), run_diagnosis(small_run()))
    assert story.headline == "6 of 6 frames are within 1 m."
    assert story.causes == ()
    assert story.detail == ""


def test_the_worst_frame_is_sure_and_wrong_then_wrong_then_without_a_pose() -> None:
    wrong: dict[int, Spoil] = {14: off_by(9.0), 16: off_by(2.0), 18: off_by(3.0)}
    unsure = {14: lambda record: ambiguous(wrong[14](record))}  # frame 10 is the first
    cases = [{}, {14: unanswered}, {12: unanswered} | wrong, wrong | unsure]
    assert [worst_position(spoiled(small_run(), spoils)) for spoils in cases] == [0, 2, 2, 4]
    assert State().opened("lost", lost_run(), None).position == 4
    assert State().opened("lost", lost_run(), 12).position == 1


def test_every_wrong_frame_belongs_to_one_cause_and_the_largest_comes_first() -> None:
    run = lost_run()
    for diagnosed in (None, run_diagnosis(run)):
        story = tell(run, diagnosed)
        explained = [position for cause in story.causes for position in cause.frames]
        assert sorted(explained) == [1, 2, 4] == np.flatnonzero(story.is_wrong).tolist()
        sizes = [len(cause.frames) for cause in story.causes]
        assert sizes == sorted(sizes, reverse=True)
        assert story.headline.startswith("3 of 6 frames are within 1 m.")


def test_a_cause_of_the_whole_run_takes_the_frames_that_it_explains_from_their_own_diagnoses() -> (
    None
):
    run = lost_run()
    prior = RunFault("wrong heading prior", "The heading is 20 deg off.", frames=(0, 1, 2))
    story = tell(run, RunDiagnosis(None, (), len(run.frames), (prior,)))
    assert story.causes[0].kind == "wrong heading prior"
    assert story.causes[0].frames == (1, 2)  # frame 0 is right
    assert [cause.frames for cause in story.causes[1:]] == [(4,)]
    assert story.harmless == ()


def test_one_of_two_causes_is_told_with_the_other() -> None:
    run = lost_run()
    rolled = RunFault(
        "wrong gravity prior", "Rolled by 2 deg.", frames=(1, 2, 4), rivals=("wrong calibration",)
    )
    story = tell(run, RunDiagnosis(None, (), len(run.frames), (rolled,)))
    assert "Wrong gravity prior or wrong calibration explains the other 3" in story.headline


def test_a_cause_that_makes_no_frame_wrong_is_told_after_the_others() -> None:
    run = lost_run()
    mount = RunFault("wrong extrinsic", "The camera is mounted 0.6 m right.", frames=(0, 3, 5))
    story = tell(run, RunDiagnosis(None, (), len(run.frames), (mount,)))
    assert story.harmless == (mount,)
    assert mount.kind not in {cause.kind for cause in story.causes}
    assert story.detail.endswith("Also found, without a wrong frame of its own: wrong extrinsic.")
    (told,) = story_view(story).harmless
    assert (told.frames, told.is_of_run) == ((0, 3, 5), True)


def test_a_fault_of_an_element_explains_only_frames_that_it_is_the_diagnosis_of() -> None:
    run, pole = run_with_a_moved_pole()
    diagnosed = run_diagnosis(run)
    assert [fault.elements for fault in diagnosed.elements] == [(pole,)]
    assert len(diagnosed.elements[0].frames) == len(run.frames), "all frames show it"
    story = tell(run, diagnosed)
    (cause,) = story.causes
    assert (cause.kind, cause.is_of_run) == ("moved in the map", True)
    assert list(cause.frames) == np.flatnonzero(story.is_wrong).tolist() != []
    assert story.headline.endswith("Moved in the map explains the other one.")


def test_the_route_holds_every_frame_once_and_a_second_pass_joins_the_first() -> None:
    once = tell(small_run(), None)
    records = small_run().frames
    twice = tell(replace(small_run(), frames=(*records, *reversed(records))), None)
    for story in (once, twice):
        positions = sorted(position for part in story.route for position in part.frames)
        assert positions == list(range(len(story.run.frames)))
    assert len(twice.route) < 2 * len(once.route)
    assert twice.length_m == pytest.approx(2 * once.length_m)


def test_without_poses_of_any_kind_there_is_no_route() -> None:
    run = spoiled(small_run(), dict.fromkeys((10, 12, 14, 16, 18, 20), nowhere))
    story = tell(run, None)
    assert (story.route, story.length_m) == ((), 0)
    view = story_view(story)
    assert (view.median_m, view.overconfident, view.cannot) == (None, None, 6)
    assert view.headline.startswith("0 of 6 frames are ok.")


def nowhere(record: FrameRecord) -> FrameRecord:
    """Neither a pose, nor a prior, nor a true pose."""
    failed = unanswered(record)
    return replace(
        failed,
        frame=replace(failed.frame, T_map_camera=None),
        localization=replace(failed.localization, prior=None),
    )


def test_a_run_read_again_has_its_diagnoses_unless_they_are_damaged_or_of_another_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = lost_run()
    path = saved(
        replace(run, info=replace(run.info, version=version("semviz"))), tmp_path / "a.rrd"
    )
    old = saved(run, tmp_path / "old.rrd")
    names = [diagnosis_name(run, record) for record in run.frames]
    with monkeypatch.context() as patch:
        patch.setattr(diagnosis, "diagnose_frame", _refuse)
        read = load_run(path)
        assert [diagnosis_name(read, record) for record in read.frames] == names
        card = diagnosis_card(read, read.frames[1], DetectionErrors((), ()))
        with pytest.raises(AssertionError, match="diagnosed again"):
            [diagnosis_name(load_run(old), record) for record in load_run(old).frames]
    assert card == diagnosis_card(run, run.frames[1], DetectionErrors((), ()))
    rows, _ = read_rows(path)
    for _, row in rows[DIAGNOSIS]:
        row["structure"][0] = row["structure"][0].replace("kind", "kinb")
    damaged = assemble(path, rows, damaged=False)
    assert [diagnosis_name(damaged, record) for record in damaged.frames] == names


def test_what_a_healthy_frame_shows_is_named_with_its_element_and_by_how_much(
    tmp_path: Path,
) -> None:
    run, pole = run_with_a_moved_pole()
    run = replace(run, info=replace(run.info, version=version("semviz")))
    read = load_run(saved(run, tmp_path / "moved.rrd"))
    columns = run_view("moved", read).frames
    noticed = [
        columns.texts[noticed]
        for noticed, diagnosis in zip(columns.noticed, columns.diagnosis, strict=True)
        if columns.texts[diagnosis] == "healthy"
    ]
    name = run.semantic_map.name_of(pole)
    assert len(noticed) == 5
    told = [re.fullmatch(rf"moved in the map: {name} \((\d+) px\)", text) for text in noticed]
    assert all(match and int(match[1]) > 25 for match in told), noticed
    columns = run_view("first", small_run()).frames
    assert {columns.texts[row] for row in columns.noticed} == {""}


def _refuse(*_: object) -> None:
    raise AssertionError("diagnosed again")


@given(st.sets(st.integers(0, 60)))
def test_stretches_are_the_same_positions_and_never_touch(positions: set[int]) -> None:
    groups = stretches(sorted(positions))
    assert {p for first, last in groups for p in range(first, last + 1)} == positions
    assert all(left[1] + 1 < right[0] for left, right in pairwise(groups))


def test_frames_are_named_by_their_numbers() -> None:
    assert frames_text(small_run(), (1, 2, 4)) == "frames 12-14, 18"
    assert frames_text(small_run(), (0,)) == "frame 10"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    path = saved(lost_run(), tmp_path_factory.mktemp("story") / "lost.rrd")
    with Gateway(Inspector([path])).running() as url:
        yield url


def test_the_page_leads_from_a_cause_to_its_frames_and_to_one_of_them(
    page: "Page", served: str
) -> None:
    open_flat(page, served)
    assert page.locator("#story").is_hidden()
    page.keyboard.press("F3")
    wait_for(page, lambda: page.locator("#story-causes .cause").count() > 0, "the causes")
    assert "3 of 6 frames" in page.inner_text("#story-headline")
    wait_for(page, lambda: in_url(page, "show") == "story", "the address")
    listed = page.locator("#frame-list .row").count()
    page.locator("#story-causes .cause").first.click()
    assert page.locator("#frame-list .row").count() < listed
    chosen = page.locator("#story-causes .cause[aria-current=true]")
    assert chosen.count() == 1
    page.locator("#filters .chip", has_text="✕").click()
    assert (chosen.count(), page.locator("#frame-list .row").count()) == (0, listed)
    page.locator("#story-causes .examples button").first.click()
    wait_for(page, lambda: page.locator("#story").is_hidden(), "the frame")
    number = page.locator("#story-causes .examples button").first.text_content()
    wait_for(page, lambda: f"Frame {number} " in page.inner_text("#frame-number"), "its number")


def test_the_page_says_that_a_run_is_being_read_and_stops_saying_it(
    page: "Page", served: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    released, read = Event(), RunLibrary.run

    def slow(
        self: RunLibrary, name: str, report: Callable[[str, float], None] = lambda _, share: None
    ) -> Run:
        report("reading its frames", 0.25)
        released.wait(60.0)
        return read(self, name)

    monkeypatch.setattr(RunLibrary, "run", slow)
    page.route("**/view/**", lambda route: route.abort())
    page.goto(at(served, ""))
    notice = page.locator("#notice")
    wait_for(
        page,
        lambda: "Opening lost: reading its frames, 25 %" in (notice.text_content() or ""),
        "the notice",
    )
    released.set()
    wait_for(page, lambda: page.locator("#frame-list .row").count() > 0, "the run")
    assert notice.is_hidden()


def test_a_long_run_is_diagnosed_by_stretches_that_hold_its_worst_and_its_usual_frames() -> None:
    run = small_run()
    frames = tuple(
        replace(run.frames[0], frame=replace(run.frames[0].frame, index=index))
        for index in range(2_000)
    )
    spoil = off_by(3.0)
    wrong = range(730, 745)
    long = replace(
        run, frames=tuple(spoil(one) if one.frame.index in wrong else one for one in frames)
    )
    chosen = typical_positions(long, 400)
    assert len(chosen) == len(set(chosen)) == 400
    assert chosen == sorted(chosen)
    assert set(wrong) <= set(chosen)
    assert (chosen[0], chosen[-1]) == (0, 1_999)
    assert typical_positions(run, 400) == list(range(len(run.frames)))
