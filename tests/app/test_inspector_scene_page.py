"""The 3D pane of the inspector in a browser: marks, viewpoints and steps."""

import io
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from serving import at
from small_runs import small_run

from semviz.inspector.messages import GoToViewpointRequest
from semviz.inspector.navigation import ViewpointPanel
from semviz.inspector.scene.scene_cameras import mark_positions_m
from semviz.inspector.server import HANDLERS, Inspector
from semviz.inspector.state import State
from semviz.runs.writer import RunWriter
from semviz.web.gateway import Gateway
from semviz.web.protocol import MalformedRequestError
from semviz.web.shapes import PALETTES, rgb
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from semviz.inspector.context import PageContext


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "first.rrd"
    run = small_run()
    with RunWriter(path, run.info, run.semantic_map) as writer:
        for record in run.frames:
            writer.write(record)
    return path


@pytest.fixture
def tool(recorded: Path) -> Inspector:
    return Inspector([recorded])


@pytest.fixture
def url(tool: Inspector) -> Iterator[str]:
    with Gateway(tool).running() as url:
        yield url


def wait_for(page: "Page", happened: Callable[[], bool], what: str) -> None:
    for _ in range(600):
        if happened():
            return
        page.wait_for_timeout(50)
    lost = [frame.evaluate("window.context?.isContextLost()") for frame in page.frames]
    raise AssertionError(f"never came: {what} (WebGL contexts lost: {lost})")


@pytest.mark.browser
def test_marks_colours_and_viewpoints(url: str, page: "Page", tool: Inspector) -> None:
    from PIL import Image

    mark = mark_positions_m(small_run())[3]
    eye = mark + np.array([0.0, -0.02, 10.0])
    page.goto(at(url, f"?eye={','.join(str(number) for number in (*eye, *mark))}"))
    page.wait_for_selector("#scene.ready")
    (server,) = tool.scenes._servers.values()
    wait_for(page, lambda: bool(server.get_clients()), "the 3D client")
    shot = Image.open(io.BytesIO(page.locator("#scene").screenshot())).convert("RGB")
    seen = [color for count, color in shot.getcolors(shot.width * shot.height) if count > 1000]
    assert rgb(PALETTES["light"].scene) in seen  # the page's ground, and not viser's

    (client,) = server.get_clients().values()
    wait_for(page, lambda: np.allclose(client.camera.position, eye, atol=0.05), "the link's view")

    box = page.locator("#scene").bounding_box()
    assert box is not None
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def gone_by_click() -> bool:  # the pane may still be loading when it is clicked first
        page.mouse.click(*middle)
        page.wait_for_timeout(500)
        return page.locator("#frame-number").text_content() == "Frame 16 of 20"

    wait_for(page, gone_by_click, "the frame of the mark")
    assert page.locator("#notice").is_hidden()  # nothing of the link was left out

    legend_line = page.locator("#space-legend")
    page.keyboard.press("v")
    wait_for(page, lambda: "Median residual" in (legend_line.text_content() or ""), "residuals")
    page.keyboard.press("Shift+V")
    wait_for(page, lambda: "1σ × 10" in (legend_line.text_content() or ""), "ellipsoids")

    page.keyboard.press("y")
    page.keyboard.type("over the road")
    page.keyboard.press("Enter")
    row = page.locator("#viewpoints-list .name")
    wait_for(page, lambda: row.text_content() == "over the road", "the viewpoint kept")
    kept = np.array(client.camera.position)
    page.keyboard.press("u")
    wait_for(page, lambda: client.camera.position[2] > 50.0, "the view from above")
    row.click()
    wait_for(page, lambda: np.allclose(client.camera.position, kept, atol=0.01), "the viewpoint")
    pressed = page.locator("[data-view][aria-pressed=true]")
    wait_for(page, lambda: pressed.count() == 0, "no view's button pressed")
    page.click("#viewpoints-list button[title=Delete]")
    wait_for(page, lambda: row.count() == 0, "the viewpoint gone")


PATIENT = """
// The page holds a picture for 300 ms, which a step of a busy machine may exceed.
const later = window.setTimeout.bind(window);
window.setTimeout = (act, ms, ...rest) => later(act, ms === 300 ? 10000 : ms, ...rest);
"""

PICTURES = """
window.pictures = 0; // of the 3D pane, with another content than the one before
window.context = null;
let drawn = null, before = null;
const { drawElements } = WebGL2RenderingContext.prototype;
WebGL2RenderingContext.prototype.drawElements = function (...all) {
  drawn = window.context = this;
  return drawElements.apply(this, all);
};
const refresh = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (callback) => refresh((time) => {
  drawn = null;
  callback(time);
  if (!drawn) return;
  const pixels = new Uint8Array(4 * drawn.drawingBufferWidth * drawn.drawingBufferHeight);
  const all = [0, 0, drawn.drawingBufferWidth, drawn.drawingBufferHeight];
  drawn.readPixels(...all, drawn.RGBA, drawn.UNSIGNED_BYTE, pixels);
  let changed = 0;
  if (before?.length === pixels.length) {
    for (let i = 0; i < pixels.length; i += 1) changed += Math.abs(pixels[i] - before[i]) > 12;
  }
  if (changed > 30) window.pictures += 1;
  before = pixels;
});
"""


@pytest.mark.browser
def test_a_step_is_one_picture_in_3d_though_its_cameras_come_before_the_rest(
    url: str, page: "Page", tool: Inspector, monkeypatch: pytest.MonkeyPatch
) -> None:
    page.add_init_script(f"if (window === top) {{ {PATIENT} }} else {{ {PICTURES} }}")
    page.goto(url)
    page.wait_for_selector("#scene.ready")
    (server,) = tool.scenes._servers.values()
    wait_for(page, lambda: bool(server.get_clients()), "the 3D client")
    pane = next(frame for frame in page.frames if "/view/" in frame.url)

    def is_drawn() -> bool:  # no new picture for two seconds
        before = pane.evaluate("window.pictures")
        page.wait_for_timeout(2000)
        return bool(before > 0 and pane.evaluate("window.pictures") == before)

    wait_for(page, is_drawn, "the first pictures")
    together = type(server).atomic

    @contextmanager
    def late(of: Any) -> Iterator[None]:
        with together(of):
            yield
            time.sleep(0.05)  # by then the cameras are long sent

    monkeypatch.setattr(type(server), "atomic", late)
    pictures = []
    for _ in range(3):
        pane.evaluate("window.pictures = 0")
        page.keyboard.press(".")
        wait_for(page, lambda: pane.evaluate("window.pictures") > 0, f"the picture of {page.url}")
        page.wait_for_timeout(700)
        pictures.append(pane.evaluate("window.pictures"))
    assert sorted(pictures)[1] == 1, pictures


@pytest.mark.parametrize("eye", [[0, 0], "there", None, [0, 0, float("nan")]])
def test_viewpoint_that_is_none_is_refused_in_one_line(eye: Any) -> None:
    request = {"type": "go_to_viewpoint", "id": "1", "eye": eye, "target": [1, 2, 3]}
    with pytest.raises(MalformedRequestError, match=r"go_to_viewpoint\.eye"):
        HANDLERS.decode(json.dumps(request))


def test_viewpoint_that_looks_at_itself_is_refused() -> None:
    panel = ViewpointPanel(cast("PageContext", SimpleNamespace(state=State())))
    request = GoToViewpointRequest(id="1", eye=(1.0, 2.0, 3.0), target=(1.0, 2.0, 3.0))
    with pytest.raises(SemvizError, match="coincide"):
        panel._go_to_viewpoint(request)


def test_colours_that_do_not_exist_are_refused_with_those_that_do() -> None:
    with pytest.raises(MalformedRequestError, match="'class', 'residual' or 'times'"):
        HANDLERS.decode('{"type": "set_map_colors", "id": "1", "colors": "taste"}')
