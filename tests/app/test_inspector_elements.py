"""The tab "Elements": what is wrong over the run, each element in numbers; frames by element."""

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from inspector_page import in_url, open_flat, wait_for
from small_runs import FRAMES, run_with_a_moved_pole, saved, small_run, without_truth

from semviz.inspector.elements import (
    ElementStatistics,
    Findings,
    RunAnalysis,
    best_frame,
    elements_event,
    evidence_text,
    findings_view,
    frames_of,
)
from semviz.inspector.server import Inspector
from semviz.runs.diagnosis import frame_diagnosis, run_diagnosis, run_elements
from semviz.runs.run import Run
from semviz.web.gateway import Gateway
from semviz_core.base.elements import joined
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.diagnosis.element_statistics import ElementRecord
from semviz_core.diagnosis.fault import EvidenceItem, Fault, FrameDiagnosis, RunFault
from semviz_core.diagnosis.run import RunDiagnosis

if TYPE_CHECKING:
    from playwright.sync_api import Page


def view_of(run: Run, diagnosis: RunDiagnosis | None = None) -> Any:
    """As the page gets it."""
    found = Findings(diagnosis or run_diagnosis(run), run_elements(run))
    return findings_view(run, found).model_dump(mode="json")


def test_an_element_that_moved_in_the_map_comes_out_on_top() -> None:
    run, pole = run_with_a_moved_pole()
    view = view_of(run)
    (fault,) = view["faults"]
    assert (fault["kind"], fault["element"]) == ("moved in the map", pole)
    assert run.frames[fault["position"]].frame.index in fault["frames"]
    assert np.any(run.frames[fault["position"]].element_id == pole)
    worst, *others = view["rows"]
    assert worst["id"] == pole
    assert worst["outlier"] == worst["seen"] >= 3
    assert np.any(run.frames[worst["position"]].element_id == pole)
    assert all(other["outlier"] < 2 for other in others)
    named = [k for k, frame in enumerate(run.frames) if pole in blamed(frame_diagnosis(run, frame))]
    assert worst["blamed"] == [["moved in the map", len(named)]]
    assert len(named) >= 3


def blamed(diagnosis: FrameDiagnosis) -> set[int]:
    faults = (diagnosis.fault, *diagnosis.secondary_faults)
    return {element for fault in faults for element in fault.elements}


def test_elements_at_one_position_are_each_others_duplicates() -> None:
    run, pole = run_with_a_moved_pole()
    elements = run.semantic_map.elements
    copy = replace(
        elements[elements.id == pole],
        id=np.array([9999]),
        anchor_m=elements.anchor_m[elements.id == pole] + [0.3, 0.4, 0.0],
    )
    doubled = SemanticMap(joined(elements, copy), run.semantic_map.frame)
    rows = view_of(replace(run, semantic_map=doubled))["rows"]
    (told,) = [row for row in rows if row["id"] == pole]
    assert (told["duplicate"], told["duplicate_m"]) == ("P-9999", pytest.approx(0.5))
    assert all(row["duplicate_m"] is None for row in rows if row["id"] not in (pole, 9999))


def test_where_nothing_is_wrong_nothing_is_named() -> None:
    for run in (small_run(), without_truth(small_run())):
        view = view_of(run)
        assert view["faults"] == []
        assert view["compared"] == len(FRAMES)
        assert view["rows"]
        assert not any(row["outlier"] for row in view["rows"])


def test_what_has_no_element_in_the_map_is_seen_by_its_detection() -> None:
    missing = RunFault(
        "missing in the map", "3 frames see it.", (EvidenceItem("frames", 3),), (987654,),
        rows=(4, 2, 1), frames=(0, 1, 2),
    )  # fmt: skip
    run = small_run()
    (line,) = view_of(run, RunDiagnosis(None, (missing,), 6))["faults"]
    assert (line["element"], line["observed"], line["position"]) == (None, 2, 1)
    assert line["frames"] == list(FRAMES[:3])


def test_a_fault_of_the_camera_comes_first_and_leads_to_many_pairs() -> None:
    run = small_run()
    camera = Fault("wrong calibration", "Off.", (EvidenceItem("focal length", -2.96, "%"),))
    (line,) = view_of(run, RunDiagnosis(camera, (), 6))["faults"]
    assert line["evidence"] == [["focal length", "-3.0 %"]]
    fits = [localization.refinement for localization in run.localizations]
    pairs = [0 if fit is None else len(fit.pairs) for fit in fits]
    assert pairs[line["position"]] == max(pairs)


def test_evidence_has_as_many_decimals_as_it_is_worth() -> None:
    assert evidence_text(EvidenceItem("off", 101.31, "px")) == "101 px"
    assert evidence_text(EvidenceItem("off", 1.141, "m")) == "1.14 m"
    assert evidence_text(EvidenceItem("frames", 9)) == "9"
    assert evidence_text(EvidenceItem("true over stated sigma", 4.42)) == "4.4"
    assert evidence_text(EvidenceItem("yaw", 0.61, "deg per step")) == "0.6 deg per step"


def test_an_element_is_shown_where_it_is_furthest_off_or_else_in_the_middle() -> None:
    element_record = ElementRecord(
        1, in_view=[1, 2, 3, 4, 5], seen=[2, 3, 4], residual_px=[3.0, 9.0, 5.0]
    )
    assert best_frame(replace(element_record, outlier=[2, 4])) == 4
    assert best_frame(element_record) == 3
    assert best_frame(ElementRecord(1, in_view=[7])) == 7
    assert best_frame(ElementRecord(1)) is None


def test_frames_of_an_element_see_it_or_rest_on_it() -> None:
    run, pole = run_with_a_moved_pole()
    seen = [k for k, frame in enumerate(run.frames) if np.any(frame.element_id == pole)]
    assert frames_of(run, pole) == seen
    assert frames_of(run, 987654) == []


def test_it_is_worked_out_once_and_tells_how_far_it_is() -> None:
    run, told = small_run(), list[str]()
    works = RunAnalysis(run, Path("unused")), ElementStatistics(run, Path("unused"))

    def tell() -> None:
        event = elements_event(run, *works)
        told.append("ready" if event.found else event.progress)

    for work in works:
        work.start(tell)
        for _ in range(1200):
            if work.is_over:
                break
            time.sleep(0.05)
    tell()
    assert told[-1] == "ready"
    assert {text.split(":")[0] for text in told} > {"checking elements"}
    first = works[0].value
    works[0].start(lambda: told.append("again"))
    assert told[-1] == "again"
    assert works[0].value is first


# --- the page ---


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run, _ = run_with_a_moved_pole()
    run = replace(run, info=replace(run.info, version=version("semviz")))  # keeps its diagnoses
    return saved(run, tmp_path_factory.mktemp("runs") / "moved.rrd")


@pytest.fixture
def url(recorded: Path) -> Iterator[str]:
    with Gateway(Inspector([recorded])).running() as url:
        yield url


@pytest.mark.browser
def test_the_moved_pole_is_named_first_and_a_click_shows_it(url: str, page: "Page") -> None:
    _, pole = run_with_a_moved_pole()
    name = f"P-{pole:02d}"
    open_flat(page, url)
    page.keyboard.press("h")
    rows = page.locator("#element-list li")
    wait_for(page, lambda: rows.count() > 3, "the elements")
    assert rows.first.locator("b").text_content() == name
    fault = page.locator("#run-diagnosis .fault")
    assert name in (fault.text_content() or "")
    fault.click()
    wait_for(page, lambda: in_url(page, "element") == str(pole), "the pole is selected")
    wait_for(page, lambda: rows.first.get_attribute("aria-current") == "true", "its row")
    page.locator("#element-head button", has_text="element").click()
    names = [str(node.text_content()) for node in rows.locator("b").all()]
    assert names == sorted(names, key=lambda name: (name[0], int(name[2:])))
    page.locator("#finding-filter").select_option("moved in the map")
    wait_for(page, lambda: rows.count() == 1, "the blamed pole alone")
    assert rows.first.locator("b").text_content() == name
    wait_for(page, lambda: in_url(page, "finding") == "moved in the map", "the address")
    page.locator("#finding-filter").select_option("")
    page.locator("#element-head .blamed").click()
    counts = [int(node.text_content() or "") for node in rows.locator(".blamed").all()]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > 0
    poles = page.locator("#element-classes button[title=pole]")
    poles.click()
    assert rows.count() == int(poles.locator("span").text_content() or "")


@pytest.mark.browser
def test_frames_are_filtered_by_element_status_and_diagnosis_together(
    url: str, page: "Page"
) -> None:
    run, pole = run_with_a_moved_pole()
    with_pole = frames_of(run, pole)
    open_flat(page, url, f"element={pole}")
    listed = page.locator("#frame-list li:not(.none)")
    everything = listed.count()
    page.locator("#element-filter").click()
    wait_for(
        page, lambda: f"{len(with_pole)} ✕" in page.locator("#element-filter").inner_text(), "it"
    )
    assert page.locator("#filters button").first.inner_text().split() == [
        "All",
        str(len(with_pole)),
    ]
    page.locator("#filters button[title=ok]").click()
    ok = [k for k in with_pole if run.frames[k].localization.status == "ok"]
    shown = int(page.locator("#filters button[title=ok]").inner_text())
    assert shown == len(ok)
    wait_for(page, lambda: in_url(page, "only") == str(pole), "the address")
    wait_for(page, lambda: in_url(page, "status") == "ok", "the status in the address")
    page.locator("#element-filter").click()
    page.locator("#filters button").first.click()
    wait_for(page, lambda: listed.count() == everything, "all frames again")


@pytest.mark.browser
def test_what_was_noticed_is_listed_by_how_far_it_is_off(url: str, page: "Page") -> None:
    open_flat(page, url, "noticed=yes")
    cells = page.locator("#frame-list .diagnosis")
    wait_for(page, lambda: cells.count() > 3, "the frames")
    wait_for(page, lambda: "noticed" in page.inner_text("#found-head"), "the column's name")
    off_px = [int(re.findall(r"(\d+) px", str(cell.text_content()))[0]) for cell in cells.all()]
    assert off_px == sorted(off_px, reverse=True)
