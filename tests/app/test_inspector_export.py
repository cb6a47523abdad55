"""Views saved as files: an SVG and a PNG hold what the page shows, and look the same."""

import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from inspector_page import open_blank, open_flat, open_page, record_street, rgb_of, wait_for

from semviz.inspector.image import RenderPanel, png_on
from semviz.inspector.messages import RenderSceneRequest
from semviz.inspector.server import Inspector
from semviz.runs.reader import load_run
from semviz.runs.run import Run
from semviz.web.gateway import Gateway
from semviz.web.protocol import ErrorEvent, Event
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SVG = "{http://www.w3.org/2000/svg}"
FRAMES = (10, 12)
FLAT = ("Image", "Around", "Match probability", "Timeline")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_street(tmp_path_factory.mktemp("runs") / "a run.rrd", FRAMES)


@pytest.fixture(scope="module")
def run(recorded: Path) -> Run:
    return load_run(recorded)


@pytest.fixture
def url(recorded: Path) -> Iterator[str]:
    with Gateway(Inspector([recorded])).running() as url:
        yield url


def save(
    page: "Page", folder: Path, view: str, file: str, photo: bool = True, theme: str = "dark"
) -> Path:
    """What the dialog saves of a view, as PNG at its own size or as SVG."""
    page.keyboard.press("p")
    dialog = page.locator("dialog.export")
    wants = {"view": view, "format": file, "scale": "1", "theme": theme}
    if dialog.locator("[name=photo]").is_enabled():
        dialog.locator("[name=photo]").set_checked(photo)
    for name, value in wants.items():
        choice = dialog.locator(f'[name={name}][value="{value}"]')
        if choice.is_enabled():
            choice.locator("xpath=..").click()
    with page.expect_download() as download:
        dialog.locator("button.primary").click()
    path = folder / download.value.suggested_filename
    download.value.save_as(path)
    wait_for(page, lambda: dialog.count() == 0, "the dialog closed")
    return path


def texts(path: Path) -> list[str]:
    return [state.text or "" for state in ElementTree.parse(path).iter(f"{SVG}text")]


@pytest.mark.browser
def test_svg_of_the_image_holds_what_the_state_shows(
    url: str, page: "Page", run: Run, tmp_path: Path
) -> None:
    open_flat(page, url)
    path = save(page, tmp_path, "Image", "svg")
    assert path.name == "a-run-frame-10-image.svg"
    result, classes = run.frames[0].localization, run.semantic_map.classes
    assert result.refinement is not None
    submap = result.submap[result.refinement.pairs[:, 1]]
    matched = {
        classes.element_name(int(class_id), int(id))
        for class_id, id in zip(submap.class_id, submap.id, strict=True)
    }
    written = set(texts(path))
    assert len(matched & written) > len(matched) / 2  # labels that would overlap are left out
    assert {"residual, drawn 8×", "detected", "map"} <= written
    root = ElementTree.parse(path).getroot()
    (photo,) = root.iter(f"{SVG}image")
    assert photo.attrib["href"].startswith("data:image/jpeg;base64,")
    lines = [node for node in root.iter(f"{SVG}path") if node.attrib.get("stroke") == "#efe154"]
    assert len(lines) >= int(result.observed.is_line.sum())


@pytest.mark.browser
def test_modes_and_photo_show_in_name_and_content(url: str, page: "Page", tmp_path: Path) -> None:
    open_flat(page, url)
    page.keyboard.press("4")
    pressed = page.locator("[data-mode=error]")
    wait_for(page, lambda: pressed.get_attribute("aria-pressed") == "true", "the mode")
    path = save(page, tmp_path, "Image", "svg", photo=False, theme="light")
    assert path.name == "a-run-frame-10-image-error.svg"
    root = ElementTree.parse(path).getroot()
    assert not list(root.iter(f"{SVG}image"))
    assert root[0].attrib["fill"] == "#ffffff"
    assert "estimate" in texts(path)


@pytest.mark.browser
def test_svg_and_png_look_the_same(
    url: str, page: "Page", chromium: "Browser", tmp_path: Path
) -> None:
    """All that the drawing functions use is written right, text and clipping too."""
    open_flat(page, url)
    for key in ("Tab", "Shift+K"):
        page.keyboard.press(key)
    wait_for(page, lambda: page.locator("#neighbours").is_visible(), "the frames around")
    page.wait_for_timeout(500)
    for view in FLAT:
        drawn = save(page, tmp_path, view, "png", photo=False, theme="light")
        vector = save(page, tmp_path, view, "svg", photo=False, theme="light")
        expected = rgb_of(drawn.read_bytes())
        height, width, _ = expected.shape
        assert vector.stem == drawn.stem
        assert f'width="{width}" height="{height}"' in vector.read_text()
        other = chromium.new_page(viewport={"width": width, "height": height})
        other.goto(vector.as_uri())
        apart = np.abs(rgb_of(other.screenshot()) - expected).max(axis=2)
        other.close()
        assert (expected.std(axis=(0, 1)) > 5).all(), view
        assert (apart > 60).mean() < 3e-4, view


@pytest.mark.browser
def test_png_is_as_large_as_was_said(url: str, page: "Page", tmp_path: Path) -> None:
    open_flat(page, url)
    single = rgb_of(save(page, tmp_path, "Timeline", "png").read_bytes())
    page.keyboard.press("p")
    page.locator("[name=scale][value='4']").locator("xpath=..").click()
    said = page.locator("dialog.export p").text_content()
    with page.expect_download() as download:
        page.locator("dialog.export button.primary").click()
    height, width, _ = rgb_of(Path(download.value.path()).read_bytes()).shape
    assert said == f"{width} × {height} px"
    assert abs(height - 4 * single.shape[0]) <= 4
    assert abs(width - 4 * single.shape[1]) <= 4


@pytest.mark.browser
def test_what_svg_cannot_show_is_refused(url: str, page: "Page") -> None:
    open_blank(page, url)
    refusals = page.evaluate(
        """async () => {
          "use strict";
          const { SvgContext } = await import("/page/exporting/svg.js");
          const calls = [
            (context) => { context.shadowBlur = 3; },
            (context) => context.createLinearGradient(0, 0, 1, 1),
            (context) => context.ellipse(0, 0, 1, 2, 0, 0, 7),
            (context) => context.fill(new Path2D("M0 0h9v9")),
            (context) => context.fill("evenodd"),
            (context) => context.drawImage(new OffscreenCanvas(1, 1), 0, 0, 1, 1, 0, 0, 1, 1),
            (context) => { context.fillStyle = "color(srgb 1 0 0)"; context.fillRect(0, 0, 1, 1); },
            (context) => { context.font = "italic bold 2em serif"; context.fillText("x", 0, 0); },
          ];
          return calls.map((call) => {
            try { call(new SvgContext(9, 9)); } catch (error) { return error.message; }
            return "";
          });
        }"""
    )
    assert all(refusals), refusals


@pytest.mark.browser
def test_a_panel_that_svg_cannot_draw_is_said_in_the_dialog(url: str, page: "Page") -> None:
    open_flat(page, url)
    page.evaluate(
        """async () => {
          "use strict";
          const { Timeline } = await import("/page/timeline/timeline.js");
          const draw = Timeline.prototype.draw;
          Timeline.prototype.draw = function (context, ...size) {
            draw.call(this, context, ...size);
            context.shadowBlur = 3;
          };
        }"""
    )
    page.keyboard.press("p")
    dialog = page.locator("dialog.export")
    for name, value in (("view", "Timeline"), ("format", "svg")):
        dialog.locator(f'[name={name}][value="{value}"]').locator("xpath=..").click()
    dialog.locator("button.primary").click()
    said = dialog.locator("p")
    wait_for(page, lambda: "Not saved" in (said.text_content() or ""), "the refusal")
    assert "shadowBlur" in (said.text_content() or "")


@pytest.mark.browser
def test_the_3d_pane_is_saved_as_png_only(url: str, page: "Page", tmp_path: Path) -> None:
    open_page(page, url)
    page.wait_for_selector("#scene.ready")
    scene = page.locator("#scene").bounding_box()
    assert scene is not None
    page.wait_for_timeout(3000)
    path = save(page, tmp_path, "3D", "svg")
    assert path.name == "a-run-frame-10-3d.png"
    image = rgb_of(path.read_bytes())
    assert image.shape == (int(scene["height"]), int(scene["width"]), 3)
    assert image.std() > 3
    assert np.abs(image[0, 0] - [0xF7, 0xF8, 0xF9]).max() <= 2


def test_why_the_3d_pane_cannot_be_drawn_reaches_the_dialog() -> None:
    told: list[Event] = []

    class Blind:
        """A context whose 3D pane does not answer."""

        def send(self, event: Event) -> None:
            told.append(event)

        @property
        def scene(self) -> Any:
            raise SemvizError("the 3D pane does not answer")

    panel = RenderPanel(cast(Any, Blind()))
    for count, width in enumerate((9000, 0, 100)):
        panel._render(RenderSceneRequest(id=str(count), width=width, height=100))
        while len(told) <= count:
            time.sleep(0.01)
    refusals = [event for event in told if isinstance(event, ErrorEvent)]
    assert [event.reply_to for event in refusals] == ["0", "1", "2"]
    assert "9000 × 100 px" in refusals[0].text
    assert "0 × 100 px" in refusals[1].text
    assert "does not answer" in refusals[2].text


def test_transparent_places_show_the_ground() -> None:
    drawn = np.zeros((1, 3, 4), dtype=np.uint8)
    drawn[0, 1] = [200, 100, 50, 255]
    drawn[0, 2] = [200, 100, 50, 51]
    image = rgb_of(png_on(drawn, "#0A141E"))
    assert image.tolist() == [[[10, 20, 30], [200, 100, 50], [48, 36, 34]]]
