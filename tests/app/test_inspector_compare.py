"""Two runs side by side: a fault is planted in the map of one, and the page says what it broke."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from fonts import FONTS
from inspector_page import changed, in_url, near, open_page, pixels, settle, wait_for
from serving import at

from semviz.inspector.comparison import Side, SideBySide
from semviz.inspector.server import Inspector
from semviz.runs.comparison import compare_runs
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz.runs.writer import RunWriter
from semviz.web.gateway import Gateway
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localization.localizer import Localizer
from semviz_core.research.evaluation.roads import move_element
from semviz_core.simulation.street import Street

if TYPE_CHECKING:
    from playwright.sync_api import Page

FRAMES = (10, 12, 14, 20, 54, 56)
SPOILED = 29
"""The pole that stands elsewhere in the map of the second run."""
MOVED_M = 3.5
SEEN = 4
"""So few others are seen that a moved pole matters."""
IMAGES = ("#base-image-canvas", "#image-canvas")
BROKEN, ACCENT = "#8E1B08", "#4DABF7"


def record(street: Street, semantic_map: SemanticMap, path: Path, frames: tuple[int, ...]) -> Path:
    import cv2

    info = RunInfo(path.stem, "", "search", 0, "0", "2026-01-01T00:00:00", street.rig, path.stem)
    with RunWriter(path, info, semantic_map) as writer:
        for index in frames:
            frame = street.frames[index]
            observed, ids = street.labels(index, "left")
            others = np.flatnonzero(ids != SPOILED)[:SEEN]
            rows = np.sort(np.concatenate([np.flatnonzero(ids == SPOILED), others]))
            assert frame.T_map_camera is not None
            prior = simulate_prior(frame.T_map_camera, PriorOptions((1.0, 2.0)), (0, index))
            submap = semantic_map.crop(prior.position_m, 50.0)
            found = Localizer().localize(observed[rows], submap, street.rig.left, prior)
            jpeg = cv2.imencode(".jpg", street.image(index, "left")[:, :, ::-1])[1].tobytes()
            writer.write(FrameRecord(frame, found, ids[rows], jpeg))
    return path


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """A run in the true map, one in a faulty map without the last frame, one of another drive."""
    folder, street = tmp_path_factory.mktemp("runs"), Street(7)
    faulty = move_element(street.truth_map, SPOILED, (0.0, MOVED_M, 0.0))
    elsewhere = replace(street.truth_map, frame=MapFrame("other-street"))
    return (
        record(street, street.truth_map, folder / "good.rrd", FRAMES),
        record(street, faulty, folder / "spoiled.rrd", FRAMES[:-1]),
        record(street, elsewhere, folder / "elsewhere.rrd", FRAMES[:1]),
    )


@pytest.fixture(scope="module")
def runs(paths: tuple[Path, ...]) -> tuple[Run, Run]:
    return load_run(paths[0]), load_run(paths[1])


@pytest.fixture
def url(paths: tuple[Path, ...]) -> Iterator[str]:
    with Gateway(Inspector(paths)).running() as url:
        yield url


@pytest.fixture
def compared(page: "Page", url: str) -> "Page":
    """The spoiled run against the good one, without the 3D pane, which takes seconds to draw."""
    page.route("**/view/**", lambda route: route.abort())
    page.goto(at(url, "?run=spoiled&frame=12&base=good&beside=yes"))
    page.wait_for_selector("#change-list li")
    wait_for(page, lambda: page.locator("#count-broken").text_content() != "", "the comparison")
    page.wait_for_timeout(300)
    return page


def broken(runs: tuple[Run, Run]) -> list[int]:
    return [frame.index for frame in compare_runs(*runs).of("broken")]


def listed(page: "Page") -> list[int]:
    return [int(text) for text in page.locator("#change-list .index").all_text_contents()]


def test_the_planted_fault_breaks_frames_and_only_those_that_see_it(runs: tuple[Run, Run]) -> None:
    sees = {frame.frame.index for frame in runs[0].frames if SPOILED in frame.element_id}
    assert len(broken(runs)) >= 2
    assert set(broken(runs)) <= sees
    assert sees < set(FRAMES)


def test_broken_frames_and_the_changed_element_come_out_by_name(
    compared: "Page", runs: tuple[Run, Run]
) -> None:
    page, wrong = compared, broken(runs)
    assert sorted(listed(page)) == wrong
    rows = page.locator("#map-change-list .map-change")
    assert rows.all_text_contents() == [f"P-{SPOILED}moved {MOVED_M} m{len(wrong)} broken"]
    setups = page.locator("#setup-table dd").all_text_contents()
    assert setups[0] == "good → spoiled"
    assert page.locator("#compare-notes").text_content() == (
        "1 frame is only in the base, and left out."
    )
    worse = page.locator("#metric-table [aria-label='worse in B']")
    assert worse.count() >= 2
    rows.first.click()
    wait_for(page, lambda: in_url(page, "element") == str(SPOILED), "the element")
    wait_for(page, lambda: in_url(page, "frame") == str(wrong[0]), "a frame that it broke")
    wait_for(page, lambda: near(pixels(page, "#base-image-canvas"), ACCENT) > 60, "its ring in A")


def marks(page: "Page", color: str) -> list[tuple[float, float]]:
    """Middles of the scatter's marks of one colour, in the page, from the top."""
    from scipy import ndimage

    wanted = [int(color[at : at + 2], 16) for at in (1, 3, 5)]
    image = pixels(page, "#scatter-canvas")
    found, count = ndimage.label(np.abs(image - wanted).max(axis=2) < 40)
    sizes = ndimage.sum_labels(np.ones_like(found), found, range(1, count + 1))
    numbers = 1 + np.flatnonzero(sizes > 15)
    box = page.locator("#scatter-canvas").bounding_box()
    assert box is not None
    middles = ndimage.center_of_mass(np.ones_like(found), found, numbers)
    return [(box["x"] + x, box["y"] + y) for y, x in middles]


def test_marks_of_the_scatter_open_their_frames(compared: "Page", runs: tuple[Run, Run]) -> None:
    page = compared
    opened = []
    for x, y in marks(page, BROKEN):
        page.mouse.click(x, y)
        wait_for(page, lambda: in_url(page, "frame") not in [*opened, "12"], "another frame")
        opened.append(in_url(page, "frame"))
    assert len(opened) >= 2
    in_b = {frame.index: frame.errors[1] for frame in compare_runs(*runs).of("broken")}
    assert {int(frame) for frame in opened if frame} <= in_b.keys()
    errors = [in_b[int(frame)] for frame in opened if frame]
    heights = [np.inf if error is None else error.distance_m for error in errors]
    assert heights == sorted(heights, reverse=True)  # the worst in B stands at the top
    current = page.locator("#change-list [aria-current=true] .index")
    assert current.text_content() == opened[-1]


def outside(page: "Page") -> Any:
    """What does not fit on the page."""
    return page.evaluate(
        """() => [...document.querySelectorAll(".panel, .topbar > *, #timeline > *, .side > *")]
        .map((one) => [one.id || one.className || one.textContent, one.getBoundingClientRect()])
        .filter(([, box]) => box.width && (box.right > innerWidth + 1
            || box.bottom > innerHeight + 1 || box.left < -1 || box.height < 8))
        .map(([name]) => name)"""
    )


@pytest.mark.parametrize("fonts", FONTS)
def test_nothing_of_two_runs_sticks_out(compared: "Page") -> None:
    for width, height in ((1280, 720), (1600, 950)):
        compared.set_viewport_size({"width": width, "height": height})
        settle(compared)
        assert outside(compared) == []


def test_both_images_have_one_crop(compared: "Page") -> None:
    page = compared
    same = [pixels(page, selector) for selector in IMAGES]
    assert near(same[0], "#EFE154") > 20
    page.hover("#base-image-canvas")
    page.mouse.wheel(0, -400)
    for name, before in zip(IMAGES, same, strict=True):
        wait_for(page, lambda n=name, b=before: changed(page, n, b) > 8, f"{name} zoomed")
    settle(page)
    zoomed = [pixels(page, selector) for selector in IMAGES]
    sky = np.s_[: zoomed[0].shape[0] // 3]  # where little is drawn
    apart = np.abs(zoomed[0][sky] - zoomed[1][sky]).max(axis=2)
    assert (apart < 10).mean() > 0.9


def test_gates_are_judged_as_the_command_judges_them(
    compared: "Page", runs: tuple[Run, Run]
) -> None:
    page, count = compared, len(broken(runs))
    said = page.locator("#gate-said")
    page.fill("#gate-input", "brokn > 1")
    wait_for(page, lambda: "no 'brokn'" in (said.text_content() or ""), "what is wrong")
    page.fill("#gate-input", f"broken > {count - 1}")
    wait_for(page, lambda: said.text_content() == f"broken {count}: fails; Enter adds it", "it")
    page.press("#gate-input", "Enter")
    gates = page.locator("#gate-list li")
    wait_for(page, lambda: gates.count() == 3, "the third condition")
    assert gates.last.locator("svg").get_attribute("aria-label") == "fails"
    gates.last.locator("button").click()
    wait_for(page, lambda: gates.count() == 2, "two conditions")


def test_closing_leaves_a_line_of_broken_frames_on_the_timeline(
    compared: "Page", runs: tuple[Run, Run]
) -> None:
    page = compared
    page.keyboard.press("Escape")
    wait_for(page, lambda: in_url(page, "beside") is None, "the page of one run")
    assert in_url(page, "base") == "good"
    assert page.locator("#against").text_content() == "Against good"
    assert page.locator("#against-counts").text_content() == f"+0 fixed, −{len(broken(runs))}"
    line = lambda: near(pixels(page, "#timeline-canvas"), BROKEN)  # noqa: E731
    wait_for(page, lambda: line() > 20, "the broken frames on the timeline")
    page.keyboard.press("c")
    wait_for(page, lambda: in_url(page, "beside") == "yes", "both runs again")
    page.select_option("#base", "")
    wait_for(page, lambda: in_url(page, "base") is None, "no other run")
    page.keyboard.press("c")
    page.click("dialog.choose-run button")
    wait_for(page, lambda: page.locator("body.comparing:not(.awaiting)").count() == 1, "it again")
    page.click("#swap")
    wait_for(page, lambda: in_url(page, "base") == "spoiled", "A and B the other way round")
    wait_for(page, lambda: page.locator("#tab-alone").is_visible(), "what only B has")
    assert in_url(page, "run") == "good"
    assert page.locator("#count-fixed").text_content() == str(len(broken(runs)))
    page.click("#tab-alone")
    only = page.locator("#change-list li")
    wait_for(page, lambda: only.all_text_contents() == [f"{FRAMES[-1]}only in B"], "that frame")
    assert only.is_visible()


def test_another_drive_is_refused_in_one_line(page: "Page", url: str) -> None:
    page.route("**/view/**", lambda route: route.abort())
    open_page(page, url, "run=spoiled")
    page.keyboard.press("c")
    choices = page.locator("dialog.choose-run button")
    assert choices.all_text_contents() == ["good", "elsewhere"]
    choices.last.click()
    notice = page.locator("#notice")
    wait_for(page, lambda: "'other-street'" in (notice.text_content() or ""), "why not")
    assert "\n" not in (notice.text_content() or "")
    wait_for(page, lambda: in_url(page, "base") is None, "no other run")
    assert page.locator("#frames").is_visible()


def test_alone_it_says_how_to_serve_two(page: "Page", paths: tuple[Path, ...]) -> None:
    with Gateway(Inspector(paths[:1])).running() as url:
        page.route("**/view/**", lambda route: route.abort())
        open_page(page, url)
        page.click("#compare")
        said = page.locator("dialog.choose-run p").text_content()
        assert said == "Only this run is open. To compare two runs: semviz serve a.rrd b.rrd"
        page.goto("about:blank")


def test_frames_are_told_even_where_a_run_was_cut(runs: tuple[Run, Run], paths: Any) -> None:
    cut = replace(runs[1], frames=runs[1].frames[:2], complete=False)
    made = SideBySide(Side("good", runs[0], paths[0]), Side("cut", cut, paths[1]))
    assert [frame.index for frame in made.view().frames] == list(FRAMES[:2])
    assert made.view().only_base == FRAMES[2:]
    judged = made.gate("broken > 99")
    assert judged.fails is None
    assert "cut: --fail-if needs a complete run" in judged.values
    there = made.base_frame(FRAMES[3]).base
    assert there is not None
    assert there.frame.index == FRAMES[3]
    assert made.base_frame(11).base is None
