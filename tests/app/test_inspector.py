"""The inspector's page in a real browser: what people do, and what they then see."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from fonts import FONTS
from inspector_page import (
    changed,
    in_url,
    near,
    open_flat,
    open_page,
    pixels,
    record_street,
    settle,
    wait_for,
)
from streets import street

from semviz.inspector.server import Inspector
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run
from semviz.runs.writer import write_run
from semviz.web.gateway import Gateway
from semviz_core.base.localization import Alternative
from semviz_core.base.pose import Pose
from semviz_core.localization.localizer import Localizer

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, WebSocketRoute

pytestmark = pytest.mark.browser

FRAMES = (10, 12, 14, 16, 18)
FAILED = 14
"""The frame in which only two elements are seen."""
MARKUP = "<img src=x onerror=document.title='taken'>"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run through the simulated street, with images, one failure and hostile words."""
    rig = street(7).rig

    def spoil(record: FrameRecord) -> FrameRecord:
        if record.frame.index != FAILED:
            return record
        result = record.localization
        found = Localizer().localize(result.observed[[0, 1]], result.submap, rig.left, result.prior)
        hostile = replace(found, reason=f"{found.reason} {MARKUP}")
        return replace(record, localization=hostile, element_id=record.element_id[:2])

    folder = tmp_path_factory.mktemp("runs")
    return record_street(folder / "first.rrd", FRAMES, spoil=spoil)


@pytest.fixture(scope="module")
def run(recorded: Path) -> Run:
    return load_run(recorded)


@pytest.fixture
def tool(recorded: Path) -> Inspector:
    broken = recorded.with_name("broken.rrd")
    broken.write_bytes(b"RRF2 and then nothing that makes sense")
    return Inspector([recorded, broken])


@pytest.fixture  # tests ask for it before the page, so that the page closes first
def url(tool: Inspector) -> Iterator[str]:
    with Gateway(tool).running() as url:
        yield url


def test_page_shows_the_run_and_its_worst_frame_first(url: str, page: "Page", run: Run) -> None:
    open_page(page, url)
    rows = page.locator("#frame-list li")
    assert rows.count() == len(FRAMES)
    assert rows.first.locator(".index").text_content() == str(FAILED)
    assert page.locator("#frame-number").text_content() == "Frame 10 of 18"
    assert page.locator("#status").text_content() == "Ok"
    page.goto(url)
    number = page.locator("#frame-number")
    wait_for(page, lambda: number.text_content() == f"Frame {FAILED} of 18", "the worst frame")
    open_page(page, url)
    matrix = page.locator("#matrix-about").get_attribute("title")
    seen, mapped = len(run.frames[0].localization.observed), len(run.frames[0].localization.submap)
    assert matrix == f"{seen} detected × {mapped} mapped"
    image = pixels(page, "#image-canvas")
    assert image.std() > 20
    assert near(image, "#EFE154") > 50


def test_stepping_changes_numbers_picture_and_address(url: str, page: "Page") -> None:
    open_page(page, url)
    numbers = page.locator("#numbers").text_content()
    before = pixels(page, "#image-canvas")
    page.keyboard.press(".")
    wait_for(page, lambda: in_url(page, "frame") == "12", "frame 12")
    assert page.locator("#frame-number").text_content() == "Frame 12 of 18"
    assert page.locator("#numbers").text_content() != numbers
    wait_for(
        page,
        lambda: (np.abs(pixels(page, "#image-canvas") - before).max(axis=2) > 30).mean() > 0.2,
        "another picture",
    )
    page.keyboard.press(",")
    wait_for(page, lambda: in_url(page, "frame") == "10", "back at frame 10")
    wait_for(page, lambda: changed(page, "#image-canvas", before) < 1, "the first picture")


def test_timeline_click_goes_to_its_frame(url: str, page: "Page") -> None:
    open_flat(page, url)
    box = page.locator("#timeline-canvas").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + box["width"] - 20, box["y"] + 30)
    wait_for(page, lambda: in_url(page, "frame") == "18", "the last frame")
    assert page.locator("#frame-list li[aria-current=true] .index").text_content() == "18"


def test_list_click_goes_to_the_failure_and_says_why(url: str, page: "Page") -> None:
    open_flat(page, url)
    page.locator("#frame-list li").first.click()
    wait_for(page, lambda: in_url(page, "frame") == str(FAILED), "the failed frame")
    wait_for(page, lambda: page.locator("#status").text_content() == "Cannot", "its status")
    assert page.locator("#why h3").text_content() == "Missed detection"
    assert "2 elements seen" in (page.locator("#why .sentence").text_content() or "")
    assert "no pose" in (page.locator("#numbers").text_content() or "")


def test_words_from_the_run_are_never_markup(url: str, page: "Page") -> None:
    open_flat(page, url, f"frame={FAILED}")
    wait_for(page, lambda: page.locator("#why .sentence").count() == 1, "the sentence")
    assert MARKUP in (page.locator("#why .sentence").text_content() or "")
    assert page.locator("#why img, #frame-list img").count() == 0
    assert page.title() != "taken"


def test_matrix_cell_selects_the_pair_everywhere(url: str, page: "Page", run: Run) -> None:
    open_flat(page, url)
    before = near(pixels(page, "#image-canvas"), "#4DABF7")
    fine = run.frames[0].localization.refinement
    assert fine is not None
    observed, mapped = (int(pair) for pair in fine.pairs[0])
    box = page.locator("#matrix-canvas").bounding_box()
    assert box is not None
    submap = run.frames[0].localization.submap
    wanted = f"#{observed} × "
    places = [(x, y) for y in range(24, 90, 8) for x in range(36, int(box["width"]) - 40, 4)]
    for x, y in places:  # row by row, until over the pair
        page.mouse.move(box["x"] + x, box["y"] + y)
        said = page.locator("#matrix-value").text_content() or ""
        if said.startswith(wanted) and ", true" in said:
            break
    page.mouse.click(box["x"] + x, box["y"] + y)
    wait_for(page, lambda: in_url(page, "element") == str(submap.id[mapped]), "the element")
    marked = lambda: near(pixels(page, "#image-canvas"), "#4DABF7")  # noqa: E731
    wait_for(page, lambda: marked() > before + 60, "its mark in the image")
    page.keyboard.press("Escape")
    wait_for(page, lambda: in_url(page, "element") is None, "nothing selected")


def test_click_on_a_detection_selects_it(url: str, page: "Page", run: Run) -> None:
    open_flat(page, url)
    result = run.frames[0].localization
    assert result.refinement is not None
    observed, mapped = (int(row) for row in result.refinement.pairs[-1])
    box = page.locator("#image-canvas").bounding_box()
    assert box is not None
    scale = min(box["width"] / result.camera.width, box["height"] / result.camera.height)
    left = (box["width"] - scale * result.camera.width) / 2
    top = (box["height"] - scale * result.camera.height) / 2
    u, v = result.observed.anchor_px[observed] + 0.5
    page.mouse.click(box["x"] + left + scale * u, box["y"] + top + scale * v)
    wait_for(page, lambda: in_url(page, "element") == str(result.submap.id[mapped]), "the element")


def test_click_in_3d_selects_the_element(url: str, page: "Page", run: Run, tool: Inspector) -> None:
    open_page(page, url)
    page.wait_for_selector("#scene.ready")
    frame = page.locator("#scene")
    servers = list(tool.scenes._servers.values())
    wait_for(page, lambda: bool(servers[0].get_clients()), "the 3D client", 60)
    page.wait_for_timeout(1000)
    (client,) = servers[0].get_clients().values()
    box = frame.bounding_box()
    assert box is not None
    result = run.frames[0].localization
    assert result.refinement is not None
    eye, target = np.array(client.camera.position), np.array(client.camera.look_at)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    focal = box["height"] / 2 / np.tan(client.camera.fov / 2)
    middles = np.where(
        result.submap.is_line[:, None],
        (result.submap.anchor_m + result.submap.end_m) / 2,
        result.submap.anchor_m,
    )
    offset = middles - eye
    depth = offset @ forward
    x = box["width"] / 2 + focal * (offset @ right) / depth
    y = box["height"] / 2 + focal * (offset @ down) / depth
    inside = (depth > 2) & (x > 10) & (x < box["width"] - 10) & (y > 10) & (y < box["height"] - 60)
    nearest = int(np.flatnonzero(inside)[np.argmin(depth[inside])])
    page.mouse.click(box["x"] + x[nearest], box["y"] + y[nearest])
    wait_for(page, lambda: in_url(page, "element") == str(result.submap.id[nearest]), "the element")
    page.keyboard.press(".")  # the 3D pane has the focus, and the page its keys all the same
    wait_for(page, lambda: in_url(page, "frame") == "12", "frame 12")
    carried = run.frames[1].localization.T_camera_map
    assert carried is not None
    center = carried.inverse().translation
    before = np.linalg.norm(eye - center)
    wait_for(
        page,
        lambda: np.linalg.norm(client.camera.position - center) < before - 0.5,
        "the 3D view at the new frame",
    )


def test_address_brings_back_run_frame_and_selection(url: str, page: "Page", run: Run) -> None:
    element = int(run.frames[1].localization.submap.id[0])
    open_flat(page, url, f"run=first&frame=12&element={element}")
    assert page.locator("#frame-number").text_content() == "Frame 12 of 18"
    wait_for(page, lambda: in_url(page, "element") == str(element), "the element")


def test_two_pages_do_not_disturb_each_other(url: str, page: "Page", chromium: "Browser") -> None:
    open_page(page, url)
    context = chromium.new_context(viewport={"width": 1280, "height": 720})
    other = context.new_page()
    open_page(other, url)
    other.keyboard.press(".")
    other.keyboard.press(".")
    wait_for(other, lambda: in_url(other, "frame") == "14", "frame 14 in the other page")
    page.wait_for_timeout(300)
    assert in_url(page, "frame") == "10"
    assert page.locator("#frame-number").text_content() == "Frame 10 of 18"
    context.close()


def test_keys_faster_than_the_server_end_at_the_right_frame(url: str, page: "Page") -> None:
    open_flat(page, url)
    for _ in range(3):
        page.keyboard.press(".")
    page.keyboard.press(",")
    wait_for(page, lambda: in_url(page, "frame") == "14", "frame 14")
    wait_for(page, lambda: page.locator("#status").text_content() == "Cannot", "its status")


def test_a_key_back_to_the_frame_shown_wins_over_an_answer_on_its_way(
    url: str, page: "Page"
) -> None:
    """The frame shown is painted once more before that answer comes."""
    late: list[Callable[[], None]] = []
    asked: list[int] = []

    def between(socket: "WebSocketRoute") -> None:
        server = socket.connect_to_server()

        def pass_down(message: str | bytes) -> None:
            if asked and json.loads(message)["type"] == "frame":
                late.append(lambda: socket.send(message))
            else:
                socket.send(message)

        def pass_up(message: str | bytes) -> None:
            request = json.loads(message)
            if request["type"] == "go_to_position":
                asked.append(request["position"])
            server.send(message)

        server.on_message(pass_down)
        socket.on_message(pass_up)

    page.route_web_socket("**/socket*", between)
    open_flat(page, url)
    page.keyboard.press(".")
    page.keyboard.press(",")
    wait_for(page, lambda: len(late) == 1, "the answer to the first key")
    page.keyboard.press("r")  # paints the image
    settle(page)
    late.pop()()
    wait_for(page, lambda: len(late) == 1, "the answer to the second key")
    late.pop()()
    wait_for(page, lambda: in_url(page, "residuals") == "no", "an address that is up to date")
    assert asked == [1, 0]
    assert in_url(page, "frame") == "10"
    assert page.locator("#frame-number").text_content() == "Frame 10 of 18"


def test_a_broken_run_is_said_in_one_line_and_the_page_lives_on(url: str, page: "Page") -> None:
    open_flat(page, url)
    page.select_option("#run", "broken")
    notice = page.locator("#notice")
    wait_for(page, lambda: "broken.rrd" in (notice.text_content() or ""), "the notice")
    assert notice.is_visible()
    assert "\n" not in (notice.text_content() or "")
    page.keyboard.press(".")
    wait_for(page, lambda: in_url(page, "frame") == "12", "frame 12 of the run before")
    assert page.locator("#run").input_value() == "first"


BRIGHTNESS = """() => {
  const canvas = document.querySelector("#matrix-canvas");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let sum = 0, opaque = 0;
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3] < 255) continue;
    sum += data[i] + data[i + 1] + data[i + 2];
    opaque += 1;
  }
  return sum / (3 * opaque);
}"""


def test_theme_and_help(url: str, page: "Page") -> None:
    open_flat(page, url)
    before = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.keyboard.press("t")
    after = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert before != after
    page.keyboard.press("?")
    help_text = page.locator("dialog.help").text_content() or ""
    for said in ("Previous frame", "Pairs with outliers", "View from above", "Dark or light"):
        assert said in help_text
    page.keyboard.press("Escape")
    wait_for(page, lambda: page.locator("dialog").count() == 0, "the help closed")


def test_pictures_follow_the_theme_of_the_system(url: str, page: "Page") -> None:
    page.emulate_media(color_scheme="dark")
    open_flat(page, url)

    def brightness() -> float:
        return float(page.evaluate(BRIGHTNESS))

    wait_for(page, lambda: 0.0 < brightness() < 120.0, "a dark matrix")
    page.emulate_media(color_scheme="light")
    wait_for(page, lambda: brightness() > 150.0, "a light matrix")


@pytest.mark.parametrize("fonts", FONTS)
@pytest.mark.parametrize("size", [(1280, 720), (1600, 950)])
def test_nothing_sticks_out_of_the_window(url: str, page: "Page", size: tuple[int, int]) -> None:
    page.set_viewport_size({"width": size[0], "height": size[1]})
    open_flat(page, url)
    page.evaluate("document.getElementById('method').textContent = 'search in '.repeat(9)")
    out = page.evaluate(
        """() => [...document.querySelectorAll(".panel, .topbar > *, #timeline > *")]
        .map((one) => [one.id || one.className, one.getBoundingClientRect()])
        .filter(([, box]) => box.width && (box.right > innerWidth + 1
            || box.bottom > innerHeight + 1 || box.left < -1 || box.height < 8))
        .map(([name]) => name)"""
    )
    assert out == []
    assert page.locator("#why dl").evaluate("e => e.getBoundingClientRect().bottom") <= size[1]
    assert page.locator("#why-body").evaluate("e => e.scrollHeight <= e.clientHeight")
    for tab in ("selected", "solver", "what-if"):
        page.click(f"#why [data-tab={tab}]")
        assert page.locator("main").evaluate("e => e.scrollHeight <= e.clientHeight"), tab


@pytest.mark.parametrize("fonts", FONTS)
def test_an_alternative_pose_takes_one_line_of_the_card(
    run: Run, page: "Page", tmp_path: Path
) -> None:
    """Also the longest one, in a small window."""
    record = run.frames[0]
    estimate = record.localization.T_camera_map
    assert estimate is not None
    turn = Pose(np.diag([-1.0, 1.0, -1.0]), np.array([30.0, -3.0, 25.0]))
    others = tuple(Alternative(turn @ estimate, -12.0) for _ in range(6))
    localization = replace(record.localization, status="ambiguous", alternatives=others)
    path = tmp_path / "ambiguous.rrd"
    write_run([replace(record, localization=localization)], path, run.info, run.semantic_map)
    page.set_viewport_size({"width": 1280, "height": 720})
    with Gateway(Inspector([path])).running() as url:
        open_flat(page, url)
        rows = page.locator("#why-body dl div")
        poses = [row for row in rows.all() if "Pose " in row.inner_text()]
        assert poses
        height = rows.first.evaluate("e => e.getBoundingClientRect().height")
        for row in poses:
            assert row.evaluate("e => e.getBoundingClientRect().height") == height, row.inner_text()
        page.goto("about:blank")


CUT = """() => [...document.querySelectorAll(".topbar, .topbar *")]
  .filter((part) => part.offsetParent && part.clientWidth)
  .filter((part) => part.scrollWidth > part.clientWidth + 1)
  .map((part) => part.id || part.className)"""


def test_nothing_in_the_top_bar_is_cut_at_any_width(url: str, page: "Page") -> None:
    open_flat(page, url)
    for width in (1280, 1366, 1401, 1500, 1541, 1600, 1701, 1881):
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate(CUT) == [], width
