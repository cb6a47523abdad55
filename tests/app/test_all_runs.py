"""All runs of a batch as one table that leads to each of them."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from command_line import call
from inspector_page import wait_for
from serving import at
from small_runs import FRAMES, ambiguous, off_by, saved, small_run, spoiled, unanswered

from semviz.commands.tools import find_runs
from semviz.inspector.all_runs import run_rows
from semviz.inspector.context import RunLibrary
from semviz.inspector.server import Inspector
from semviz.web.gateway import Gateway

if TYPE_CHECKING:
    from playwright.sync_api import Page


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives, the last of which was interrupted and has no table."""
    folder = tmp_path_factory.mktemp("city") / "batches" / "localize"
    (folder / "runs").mkdir(parents=True)
    run = small_run()
    wrong = {10: ambiguous, 12: unanswered, 14: off_by(5.0), 16: off_by(5.0), 18: off_by(5.0)}
    saved(run, folder / "runs" / "june.rrd")
    saved(spoiled(run, wrong), folder / "runs" / "may.rrd")
    saved(replace(run, complete=False), folder / "runs" / "april.rrd")
    return folder


@pytest.fixture(scope="module")
def served(batch: Path) -> Iterator[str]:
    with Gateway(Inspector(find_runs([batch]))).running() as url:
        yield url


def test_rows_are_what_evaluate_says(batch: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = run_rows(RunLibrary(find_runs([batch])))
    april, june, may = found["runs"]
    assert april == {"run": "april"}
    assert (may["ok"], may["ambiguous"], may["cannot"], may["overconfident"]) == (4, 1, 1, 3)
    assert [found["all"][name] for name in ("frames", "ok", "cannot")] == [12, 10, 1]
    for row in (june, may):
        path = batch / "runs" / f"{row['run']}.rrd"
        evaluated = json.loads(call(capsys, "evaluate", path, "--json")[1])
        assert row["frames"] == evaluated["frames"] == len(FRAMES)
        assert row["rte_m"] == pytest.approx(evaluated["rte_m"]["q2"])
        assert row["share_below_1m"] == evaluated["share_below_1m"]


def column(page: "Page", number: int) -> list[str]:
    return page.locator(f"#rows td:nth-child({number})").all_inner_texts()


def test_the_table_is_sorted_and_leads_to_a_run(page: "Page", served: str) -> None:
    page.route("**/view/**", lambda route: route.abort())
    page.goto(at(served, ""))
    page.get_by_role("link", name="All runs").click()
    wait_for(page, lambda: page.locator("#rows tr").count() == 3, "the table")
    assert column(page, 1) == ["april no table at its end", "june", "may"]
    page.get_by_role("button", name="Overconfident").click()
    assert column(page, 9) == ["3", "0", ""]
    assert page.locator("th[aria-sort]").inner_text() == "Overconfident"
    page.get_by_role("button", name="Overconfident").click()
    assert column(page, 9) == ["0", "3", ""], "what is unknown comes last both ways"
    assert re.match(r"All frames\s+12\s+10\s+1\s+1", page.locator("#total").inner_text())
    page.locator("#rows tr").nth(1).click()
    wait_for(page, lambda: page.locator("#run").input_value() == "may", "the run")


def test_one_run_needs_no_table(page: "Page", batch: Path) -> None:
    with Gateway(Inspector(find_runs([batch / "runs" / "may.rrd"]))).running() as url:
        page.route("**/view/**", lambda route: route.abort())
        page.goto(at(url, ""))
        wait_for(page, lambda: page.locator("#run").input_value() == "may", "the run")
        assert page.locator("#all-runs").is_hidden()
