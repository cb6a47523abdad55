"""``semviz report``: one file, alone in the world, the same on a second call, and harmless."""

import os
import re
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from command_line import Call, call
from fonts import FONTS
from hypothesis import given
from hypothesis import strategies as st
from small_runs import (
    FRAMES,
    off_by,
    run_with_a_moved_pole,
    saved,
    small_run,
    spoiled,
    unanswered,
    without_truth,
)

from semviz.cli import main
from semviz.commands.tools import ServeCommand
from semviz.presentation.plots import histograms
from semviz.presentation.terminal import Table, figure, in_latex, in_markdown
from semviz.reports.frame_images import frame_svg
from semviz.reports.html import element
from semviz.reports.run_plots import RunReport, load_reports
from semviz.reports.run_report import INSPECTOR, comparison_tables, tracks_table
from semviz.runs.diagnosis import diagnosis_name
from semviz.runs.metrics import summarize_run
from semviz.runs.run import Run
from semviz_core.base.semantic_map import Provenance

if TYPE_CHECKING:
    from playwright.sync_api import Page

TAKEN = "<script>document.title='taken'</script><img src=x onerror=document.title='taken'>"
FAILED, WRONG = 14, 18


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Call:
    """Exit status, output and error output of ``semviz report``."""
    return partial(call, capsys, "report")


def pictured(run: Run) -> Run:
    """With an image in every frame, large enough that one is made smaller."""
    import cv2

    camera = run.info.rig.left
    image = np.full((camera.height, camera.width, 3), 90, np.uint8)
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    return replace(run, frames=tuple(replace(frame, image=jpeg) for frame in run.frames))


def spoiled_run() -> Run:
    """One frame without a pose, one overconfident frame."""
    return pictured(spoiled(small_run(), {FAILED: unanswered, WRONG: off_by(2.0)}))


def hostile_run() -> Run:
    """Everything that people and files name is markup."""
    run = spoiled_run()
    info = replace(
        run.info, map_name=TAKEN, workspace=TAKEN, observations=TAKEN, options={TAKEN: TAKEN}
    )
    frames = tuple(
        replace(frame, localization=replace(frame.localization, reason=TAKEN))
        for frame in run.frames
    )
    return replace(run, info=info, frames=frames)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("runs")
    return saved(small_run(), folder / "whole.rrd"), saved(spoiled_run(), folder / "spoiled.rrd")


@pytest.fixture(scope="module")
def report(runs: tuple[Path, Path]) -> Path:
    """Of both runs, as a page."""
    out = runs[0].with_name("report.html")
    with pytest.raises(SystemExit) as ended:
        main(["report", *map(str, runs), "--out", str(out)])
    assert ended.value.code == 0
    return out


def test_a_second_call_gives_the_same_bytes(
    report: Path, runs: tuple[Path, Path], tmp_path: Path
) -> None:
    again = tmp_path / "again.html"
    other = [sys.executable, "-m", "semviz.cli", "report", *map(str, runs), "--out", str(again)]
    done = subprocess.run(
        other, capture_output=True, text=True, env=os.environ | {"PYTHONHASHSEED": "7"}
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{again}: ")
    assert report.read_bytes() == again.read_bytes()
    assert report.stat().st_size < 500_000


def test_tables_hold_the_numbers_of_evaluate(runs: tuple[Path, Path]) -> None:
    reported = load_reports(runs)
    errors, trust, diagnoses, changes, made_with = comparison_tables(reported)
    for run_report, row in zip(reported, errors.cells, strict=True):
        summary = summarize_run(run_report.run).accuracy
        shown = [getattr(summary.rte_m, name) for name in ("mean", "q1", "q2", "q3")]
        assert row[:6] == (run_report.name, str(len(FRAMES)), *map(figure, shown))
        assert row[6] == f"{summary.share_below_1m:.1%}"
    assert trust.cells[1][2:6] == ("83.3%", "0.0%", "16.7%", "16.7%")
    counted = {name: (int(a), int(b)) for name, a, b in diagnoses.cells}
    for column, run_report in enumerate(reported):
        want = Counter(diagnosis_name(run_report.run, record) for record in run_report.run.frames)
        assert {name: count[column] for name, count in counted.items() if count[column]} == want
    assert changes.cells == (("spoiled", "6", "0", "2", "4", "same"),)
    assert ("method", "search", "search") in made_with.cells
    assert ("map elements", *[str(len(small_run().semantic_map))] * 2) in made_with.cells


def test_an_element_that_moved_in_the_map_is_named(tmp_path: Path, command: Call) -> None:
    run, element = run_with_a_moved_pole()
    out = tmp_path / "r.md"
    assert command(saved(run, tmp_path / "moved.rrd"), "--out", out)[0] == 0
    name = f"P-{element:02d}"
    wrong, worst = (part.splitlines()[4] for part in out.read_text().split("\n## ")[-2:])
    assert re.match(rf"\| moved in the map \| In \d frames: {name} is mapped", wrong)
    assert worst.startswith(f"| {name} |")


def test_elements_from_detections_are_listed_the_least_sure_first(runs: tuple[Path, Path]) -> None:
    labelled = load_reports(runs)[0]
    assert tracks_table(labelled) is None
    semantic_map = labelled.run.semantic_map
    made = [
        Provenance(observation_ids=("a", "b", "c"), log_odds=9.0 - 3.0 * row) for row in range(3)
    ]
    made += [Provenance()] * (len(semantic_map) - 3)
    run = replace(labelled.run, semantic_map=replace(semantic_map, provenance=tuple(made)))
    table = tracks_table(replace(labelled, run=run))
    assert table is not None
    names = [semantic_map.name_of(int(id_)) for id_ in semantic_map.elements.id[:3]]
    assert [row[:3] for row in table.cells] == [
        (names[2], "95.2 %", "3"),
        (names[1], "99.7 %", "3"),
        (names[0], "> 99.9 %", "3"),
    ]


def test_the_worst_frames_come_first_and_each_diagnosis_once(runs: tuple[Path, Path]) -> None:
    (spoiled_report,) = load_reports(runs[1:])
    numbers = [spoiled_report.run.frames[row].frame.index for row in spoiled_report.worst(2)]
    assert numbers == [WRONG, FAILED]
    rows = spoiled_report.worst_of_each_diagnosis(6)
    assert sorted(spoiled_report.diagnoses[row] for row in rows) == sorted(
        set(spoiled_report.diagnoses)
    )
    assert len(spoiled_report.worst_of_each_diagnosis(1)) == 1


def test_histograms_hold_every_frame(runs: tuple[Path, Path]) -> None:
    groups = {run_report.name: run_report.outcomes for run_report in load_reports(runs)}
    for axis in histograms(groups).axes:
        outlines = [patch for patch in axis.patches if not patch.get_fill()]
        total = sum(float(np.sum(outline.get_data().values)) for outline in outlines)
        assert total == pytest.approx(100.0 * len(groups))


def test_the_map_is_drawn_where_the_pose_has_it() -> None:
    """Exact labels in a true map: under the truth every detection lies on its element."""
    run = small_run()
    record = run.frames[0]
    drawn = frame_svg(record, record.image, run.semantic_map.classes, "")
    lines = re.findall(r'<path d="([^"]*)" stroke="(#\w+)"', drawn)
    points = {color: re.findall(r"M(-?[\d.]+) (-?[\d.]+)", trace) for trace, color in lines}
    white = np.array(points["#FFFFFF"], dtype=float)
    pole = run.semantic_map.classes[0]
    peaks = np.array(points[pole.color], dtype=float)[1::2]  # after their caps
    observed, submap = record.localization.observed, record.localization.submap
    whole = observed.anchor_known & np.isin(record.element_id, submap.id)
    whole = whole[observed.class_id == pole.id]
    assert len(peaks) == len(whole)
    apart = np.linalg.norm(white[None] - peaks[whole, None], axis=2).min(axis=1)
    assert len(apart) > 3
    assert apart.max() < 0.3


@pytest.mark.browser
def test_the_page_asks_for_nothing_and_runs_nothing(
    command: Call, page: "Page", tmp_path: Path
) -> None:
    path = saved(hostile_run(), tmp_path / "<script>document.title='taken'<!--.rrd")
    out = tmp_path / "report.html"
    assert command(path, "--out", out)[0] == 0
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.context.set_offline(True)
    page.goto(out.as_uri())
    page.wait_for_timeout(300)
    assert [url for url in asked if not url.startswith("data:")] == [out.as_uri()]
    assert page.title().startswith("semviz report: <script>")
    assert page.locator("script, img, iframe, link, object").count() == 0
    assert page.locator("h1").text_content() == "<script>document.title='taken'<!--"
    assert TAKEN in (page.locator("body").text_content() or "")
    links = [node.get_attribute("href") or "" for node in page.locator("a").all()]
    assert links
    assert all(link.startswith(f"{INSPECTOR}?run=") for link in links)


@pytest.mark.browser
@pytest.mark.parametrize("fonts", FONTS)
@pytest.mark.parametrize("size", [(1280, 720), (900, 720), (3840, 2160)])
def test_nothing_overlaps_or_sticks_out(report: Path, page: "Page", size: tuple[int, int]) -> None:
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.goto(report.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    boxes = page.evaluate(
        """() => [...document.querySelectorAll(
          "header, body > p, h2, h3, section > p, .table, figcaption, .plot, .picture")]
        .map((one) => one.getBoundingClientRect())
        .map((box) => [box.top, box.bottom, box.left, box.right])"""
    )
    assert len(boxes) > 20
    for above, below in pairwise(boxes):
        assert above[1] <= below[0] + 0.5
    assert all(box[2] >= 0 and box[3] <= size[0] for box in boxes)
    out_of_plots = page.evaluate(
        """() => [...document.querySelectorAll(".plot")].flatMap((plot) => {
          const outer = plot.getBoundingClientRect();
          return [...plot.querySelectorAll("text")].filter((one) => {
            const box = one.getBoundingClientRect();
            return box.left < outer.left - 1 || box.right > outer.right + 1
              || box.top < outer.top - 1 || box.bottom > outer.bottom + 1;
          }).map((one) => one.textContent);
        })"""
    )
    assert out_of_plots == []


@pytest.mark.browser
def test_light_dark_and_paper(report: Path, page: "Page") -> None:
    page.goto(report.as_uri())
    text = 'getComputedStyle(document.querySelector(".plot text")).fill'
    ground = "getComputedStyle(document.body).backgroundColor"
    seen = {}
    for media, scheme in (("screen", "light"), ("screen", "dark"), ("print", "dark")):
        page.emulate_media(media=media, color_scheme=scheme)  # type: ignore[arg-type]
        seen[media, scheme] = page.evaluate(ground), page.evaluate(text)
    assert seen["screen", "light"] == ("rgb(255, 255, 255)", "rgb(29, 31, 34)")
    assert seen["screen", "dark"] == ("rgb(27, 28, 30)", "rgb(230, 231, 233)")
    assert seen["print", "dark"] == seen["screen", "light"]


@pytest.mark.parametrize("ending", ["html", "md", "tex"])
def test_runs_without_truth_images_or_end_are_reported(
    command: Call, tmp_path: Path, ending: str
) -> None:
    cut = replace(without_truth(small_run()), complete=False)
    path, out = saved(cut, tmp_path / "cut.rrd"), tmp_path / f"report.{ending}"
    assert command(path, "--out", out)[0] == 0
    text = out.read_text()
    assert "Note: cut: This run was interrupted after frame 20; 6 frames are readable." in text
    assert "Note: cut: no true poses, so errors are unknown." in text
    assert "nan" not in re.sub(r"base64,[^\"]*", "", text).lower()


def test_markdown_and_latex_hold_the_same_tables(
    command: Call, runs: tuple[Path, Path], tmp_path: Path
) -> None:
    markdown, latex = tmp_path / "r.md", tmp_path / "r.txt"
    assert command(*runs, "--out", markdown)[0] == 0
    assert command(*runs, "--out", latex, "--format", "latex")[0] == 0
    of_each = 3  # worst frames, recurring faults, elements most often outliers
    count = len(comparison_tables(load_reports(runs))) + of_each * len(runs)
    assert markdown.read_text().count("\n## ") == count
    assert latex.read_text().count(r"\begin{tabular}") == count
    assert r"share\_below" not in latex.read_text()
    assert r"17\%" not in latex.read_text()
    assert r"16.7\%" in latex.read_text()


@given(st.text(max_size=40))
def test_no_text_becomes_markup(text: str) -> None:
    assert not re.search(r"[<>]", element("p", text)[3:-4])
    assert not re.search(r'["<>]', element("p", title=text)[10:-6])
    assert not re.search(r"(?<!\\)[|<`*\[\n]", re.sub(r"\\\\", "", in_markdown(text)))
    free = re.sub(r"\\[{}$&#%_]|\\text\w+\{\}", "", in_latex(text))
    assert not re.search(r"[\\{}$&#%_~^\n]", free)
    Table("t", ("a",), ((text,),), 1).as_markdown()


def test_what_cannot_be_reported_is_refused_in_one_line(
    command: Call, runs: tuple[Path, Path], tmp_path: Path
) -> None:
    empty = saved(replace(small_run(), frames=()), tmp_path / "empty.rrd")
    for arguments, said in (
        ((), "name at least one run"),
        ((runs[0], "--out", tmp_path / "report.pdf"), "unknown ending"),
        ((runs[0], runs[0]), "a run is named twice"),
        ((empty,), "this run has no frames"),
        ((tmp_path / "none.rrd",), "no such run"),
        ((runs[0], "--out", tmp_path, "--format", "html"), "a folder or a device"),
        ((runs[0], "--pictures", -1), "--pictures -1: give 0 or more"),
    ):
        status, output, errors = command(*arguments)
        assert (status, output) == (2, "")
        assert said in errors
        assert errors.count("\n") == 1
    assert not (tmp_path / "report.pdf").exists()


def test_links_lead_to_where_serve_listens() -> None:
    serve = ServeCommand()
    assert f"http://{serve.host}:{serve.port}/" == INSPECTOR


def test_names_are_those_of_serve(runs: tuple[Path, Path]) -> None:
    assert [run_report.name for run_report in load_reports(runs)] == ["whole", "spoiled"]
    assert isinstance(load_reports(runs)[0], RunReport)
