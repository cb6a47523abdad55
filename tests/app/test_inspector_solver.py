"""The tab "Solver": what a frame's answer came from, for every method, and what one has not."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from inspector_page import in_url, open_flat, wait_for
from small_runs import FRAMES, saved, small_run, spoiled, unanswered

from semviz.inspector.server import Inspector
from semviz.inspector.solver import letter, missing_stages, solver_view
from semviz.runs.run import FrameRecord, Run
from semviz.web.gateway import Gateway
from semviz.workspace.localization.sequence_tracker import SequenceTracker
from semviz.workspace.localization.simulated_measurements import simulated_odometry
from semviz_core.base.localization import Localization
from semviz_core.localization.localizer import Localizer
from semviz_core.simulation.street import Street

if TYPE_CHECKING:
    from playwright.sync_api import Page

FAILED = FRAMES[2]


def view_of(localization: Localization, at: int = 0) -> Any:
    """As the page gets it; of the frame at that position."""
    run = small_run()
    ids = run.frames[at].element_id[: len(localization.observed)]
    record = replace(run.frames[at], localization=localization, element_id=ids)
    return solver_view(replace(run, frames=(record,)), 0).model_dump(mode="json")


def test_a_searched_frame_tells_all_of_its_stages() -> None:
    result = small_run().frames[0].localization
    view = view_of(result)
    assert (
        [stage for stage, _ in view["stages"]]
        == list(result.time_ms)
        == ["search", "match", "refine"]
    )
    assert result.search is not None
    assert result.search.passed is not None
    assert 0 < result.search.passed <= result.search.hypotheses
    assert (view["search"]["tried"], view["search"]["passed"]) == (
        result.search.hypotheses,
        result.search.passed,
    )
    poses = view["search"]["poses"]
    assert [pose["letter"] for pose in poses] == [letter(row) for row in range(len(poses))]
    assert [pose["behind"] for pose in poses] == sorted(pose["behind"] for pose in poses)
    assert sum(pose["share"] for pose in poses) == pytest.approx(1.0)
    assert poses[0]["from_answer"]["m"] < 0.05
    assert view["notes"] == []


def test_pairs_are_those_of_the_answer_with_what_each_says() -> None:
    result = small_run().frames[0].localization
    fine = result.refinement
    assert fine is not None
    pairs = view_of(result)["pairs"]
    told = {(pair["observed"], pair["element"]) for pair in pairs}
    assert told == {(int(i), int(result.submap.id[j])) for i, j in fine.pairs}
    assert [pair["inlier"] for pair in pairs] == sorted(fine.inlier.tolist(), reverse=True)
    assert all(pair["is_true"] for pair in pairs)
    assert all(pair["support_nats"] is not None for pair in pairs)


def test_the_way_to_the_optimum_has_a_cost_and_a_length_for_each_step() -> None:
    result = small_run().frames[0].localization
    fine, trace = result.refinement, view_of(result)["trace"]
    assert fine is not None
    assert fine.steps is not None
    np.testing.assert_allclose(trace["cost"], fine.cost_trace, atol=0.006)
    assert [step["m"] for step in trace["steps"]] == fine.steps[:, 0].tolist()
    assert trace["moved"]["m"] < 0.05


def test_the_search_says_what_it_paired_under_each_pose() -> None:
    result = small_run().frames[0].localization
    assert result.search is not None
    assert result.search.mapped is not None
    assert result.refinement is not None
    best = result.search.mapped[0]
    seen = np.flatnonzero(best >= 0)
    assert np.column_stack([seen, best[seen]]).tolist() == result.refinement.pairs.tolist()
    pairs = [pose["pairs"] for pose in view_of(result)["search"]["poses"]]
    assert pairs == (result.search.mapped >= 0).sum(axis=1).tolist()


def test_direct_says_where_its_pairs_are_from() -> None:
    result = small_run().frames[0].localization
    found = Localizer("direct").localize(
        result.observed[[0]], result.submap, result.camera, result.prior
    )
    assert missing_stages(replace(result, method="direct"))[0].startswith("Direct: classes alone")
    assert view_of(found)["search"] is None
    assert missing_stages(found) == ["No search: see the reason under Why."]


def test_a_followed_frame_says_what_carries_its_pose() -> None:
    street, run = Street(7), small_run()
    follower = SequenceTracker(street.rig.left, street.truth_map, Localizer(), 50.0)
    moved = simulated_odometry(0)
    steps = [None, *(moved(*step) for step in pairwise(frame.frame for frame in run.frames))]
    found = [
        follower.localize(*asked(frame), step)
        for frame, step in zip(run.frames, steps, strict=True)
    ]
    last = found[-1]
    assert last.status == "ok"
    assert last.search is None
    assert missing_stages(last) == [
        "No search: the pose was predicted from the previous frame.",
        "No iterations: the pose follows from odometry and earlier frames.",
    ]
    view = view_of(last, -1)
    assert view["trace"] is None
    assert view["pairs"]


def asked(record: FrameRecord) -> tuple[Any, Any]:
    return record.localization.observed, record.localization.prior


def test_given_matches_and_old_runs_say_what_they_have_not() -> None:
    result = small_run().frames[0].localization
    assert result.refinement is not None
    assert result.search is not None
    given = replace(result, method="own matches", search=None, match=None)
    assert missing_stages(given) == ["No search: this method starts from given matches."]
    old = replace(
        result,
        search=replace(result.search, passed=None, mapped=None),
        refinement=replace(result.refinement, steps=None),
    )
    assert missing_stages(old) == [
        "Recorded by an older semviz with fewer steps; localize again to see all."
    ]
    view = view_of(old)
    assert view["search"]["passed"] is None
    assert view["search"]["poses"][0]["pairs"] is None
    assert view["trace"]["steps"] == []


# --- the page ---


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run: Run = spoiled(small_run(), {FAILED: unanswered})
    return saved(run, tmp_path_factory.mktemp("runs") / "solved.rrd")


@pytest.fixture
def url(recorded: Path) -> Iterator[str]:
    with Gateway(Inspector([recorded])).running() as url:
        yield url


@pytest.mark.browser
def test_the_tab_shows_the_frame_that_is_shown_and_leads_to_its_parts(
    url: str, page: "Page"
) -> None:
    open_flat(page, url, "card=solver")
    body = page.locator("#solver-body")
    wait_for(page, lambda: body.locator("h4").count() == 4, "all parts")
    assert body.locator("h4").all_text_contents()[:2] == ["Time", "Poses of the search"]
    body.locator(".pairs tbody tr").first.click()
    wait_for(page, lambda: body.locator(".pairs tr[aria-current=true]").count() == 1, "the pair")
    wait_for(page, lambda: in_url(page, "element") is not None, "the pair in the address")
    body.locator(".poses tbody tr").first.click()
    wait_for(page, lambda: body.locator(".poses tr[aria-current=true]").count() == 1, "the pose")
    body.locator(".poses tbody tr").first.click()
    wait_for(page, lambda: body.locator(".poses tr[aria-current=true]").count() == 0, "no pose")
    page.locator(f'#frame-list li:has-text("{FAILED}")').first.click()
    wait_for(page, lambda: body.locator(".pairs").count() == 0, "a frame without an answer")
    assert page.locator("#notice").is_hidden()
