"""The backdrop in the 3D panes: behind everything, switched by D, told where there is none."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from annotator_page import annotating
from inspector_page import in_url, near, open_page, pixels, record_street, wait_for
from journeys.driver import LabelDriver
from planted_backdrop import COLOR, put_backdrop
from streets import street_workspace

from semviz.inspector.server import Inspector
from semviz.web.gateway import Gateway
from semviz.web.scene import NAME, BackdropLayer, SceneDrawer, muted
from semviz.web.shapes import PALETTES, Theme
from semviz.web.viser_servers import ViserServers
from semviz.workspace.maps.backdrop import backdrop_path
from semviz.workspace.workspace import Workspace
from semviz_core.base.classes import DEFAULT_CLASSES, POLE

if TYPE_CHECKING:
    from playwright.sync_api import Page

FRAMES = 60
"""As the street of ``record_street`` has: its poses depend on their number."""
SEEN_PX = 1500
"""Of the wall, in either pane."""
POLE_COLORS = DEFAULT_CLASSES[POLE].color, DEFAULT_CLASSES[POLE].color_light


def wall_color(theme: Theme) -> str:
    return "#" + muted(np.array([COLOR], np.uint8), theme)[0].tobytes().hex()


# What is drawn


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_the_map_s_colours_stand_out_from_any_backdrop(theme: Theme) -> None:
    """Whatever colour a surface has, a pole differs more from it than 2 : 1 in luminance or 60
    shades in one channel."""
    grid = np.stack(np.meshgrid(*[np.arange(0, 256, 51)] * 3), axis=-1).reshape(-1, 3)
    ground = muted(grid.astype(np.uint8), theme).astype(int)
    pole = POLE_COLORS[theme == "light"]
    color = np.array([int(pole[at : at + 2], 16) for at in (1, 3, 5)])
    assert np.abs(ground - color).max(axis=1).min() > 60


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_a_backdrop_is_nearer_to_the_ground_and_to_grey(theme: Theme) -> None:
    colors = np.random.default_rng(1).integers(0, 256, (500, 3)).astype(np.uint8)
    drawn = muted(colors, theme).astype(int)
    assert (np.ptp(drawn, axis=1) <= 0.5 * np.ptp(colors.astype(int), axis=1) + 30).all()
    text = PALETTES[theme].scene
    ground = np.array([int(text[at : at + 2], 16) for at in (1, 3, 5)])
    assert np.abs(drawn - ground).mean() < 0.6 * np.abs(colors.astype(int) - ground).mean()


def test_it_is_sent_once_for_each_theme(tmp_path: Path) -> None:
    made = put_backdrop(street_workspace(tmp_path / "street", 7, FRAMES))
    servers = ViserServers()
    try:
        server = servers.scene("one")
        sizes: list[int] = []
        interface = server.scene._websock_interface
        queue = interface.queue_message

        def note(message: Any) -> None:
            props = getattr(message, "props", None)
            values = getattr(message, "updates", {}) if props is None else vars(props)
            arrays = [one for one in values.values() if isinstance(one, np.ndarray)]
            if getattr(message, "name", "").startswith(NAME):
                sizes.append(sum(array.nbytes for array in arrays))
            queue(message)

        interface.queue_message = note  # type: ignore[method-assign]
        scene = SceneDrawer(server)
        layer = BackdropLayer(scene)
        layer.use(made)
        for shown in (True, False, True, True):
            layer.use(made)
            layer.draw(shown)
        assert sum(sizes) == 15 * len(made)
        scene.set_theme("light")
        layer.draw(True)
        assert sum(sizes) == 2 * 15 * len(made)
        layer.use(None)
        layer.draw(True)
        assert sum(sizes) == 2 * 15 * len(made)
    finally:
        servers.close_all()


# The pages


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    made = street_workspace(tmp_path / "street", 7, FRAMES)
    (made.path / "runs").mkdir(exist_ok=True)
    record_street(made.run_path("first"), (0, 1, 2))
    return made


@pytest.fixture
def inspector(workspace: Workspace) -> Iterator[str]:
    tool = Inspector([workspace.run_path("first")])
    try:
        with Gateway(tool).running() as url:
            yield url
    finally:
        tool.close()


def count(page: "Page", color: str) -> int:
    return near(pixels(page, "#scene"), color)


def wait_for_wall(page: "Page", theme: Theme, shown: bool) -> None:
    def is_so() -> bool:
        return (count(page, wall_color(theme)) > SEEN_PX) == shown

    await_picture(page, is_so, f"the wall {'shown' if shown else 'hidden'}")


def await_picture(page: "Page", said: Callable[[], bool], what: str) -> None:
    """Each look takes a while, and longer without a graphics card."""
    deadline = time.monotonic() + 60.0
    while not said():
        assert time.monotonic() < deadline, f"never came: {what}"
        page.wait_for_timeout(300)


def pressed(page: "Page") -> bool:
    return page.locator("#backdrop").get_attribute("aria-pressed") == "true"


@pytest.mark.browser
@pytest.mark.timeout(600)
def test_the_inspector_s_backdrop_is_behind_the_poles(
    inspector: str, workspace: Workspace, page: "Page"
) -> None:
    page.emulate_media(color_scheme="dark")
    put_backdrop(workspace)
    open_page(page, inspector)
    page.wait_for_selector("#scene.ready", timeout=60_000)
    wait_for_wall(page, "dark", True)
    assert pressed(page)
    page.keyboard.press("Shift+B")
    wait_for_wall(page, "dark", False)
    alone = count(page, POLE_COLORS[0])
    assert alone > 100
    page.keyboard.press("Shift+B")
    wait_for_wall(page, "dark", True)
    await_picture(page, lambda: count(page, POLE_COLORS[0]) > 0.9 * alone, "the poles before it")
    page.keyboard.press("Shift+B")
    wait_for_wall(page, "dark", False)
    wait_for(page, lambda: in_url(page, "backdrop") == "no", "the address")

    page.reload()
    page.wait_for_selector("#scene.ready", timeout=60_000)
    await_picture(page, lambda: count(page, POLE_COLORS[0]) > 0.9 * alone, "the map")
    assert not pressed(page)
    assert count(page, wall_color("dark")) < SEEN_PX
    page.click("#backdrop")
    wait_for_wall(page, "dark", True)
    page.keyboard.press("t")
    wait_for_wall(page, "light", True)
    page.keyboard.press("l")  # the camera's own image is there instead
    wait_for_wall(page, "light", False)
    page.keyboard.press("b")
    wait_for_wall(page, "light", True)


@pytest.mark.browser
@pytest.mark.timeout(600)
def test_the_inspector_says_how_to_make_one(
    inspector: str, workspace: Workspace, page: "Page"
) -> None:
    page.emulate_media(color_scheme="dark")
    open_page(page, inspector)
    page.wait_for_selector("#scene.ready", timeout=60_000)
    assert not pressed(page)
    page.keyboard.press("Shift+B")
    command = f"semviz map backdrop {workspace.path}"
    page.wait_for_selector(f"#notice:has-text('{command}')")
    assert not pressed(page)
    put_backdrop(workspace)
    page.keyboard.press("Shift+B")
    wait_for_wall(page, "dark", True)
    assert page.locator("#notice").is_hidden()


@pytest.mark.browser
@pytest.mark.timeout(600)
def test_the_annotator_s_backdrop_is_behind_the_map_and_its_switch_is_kept(
    workspace: Workspace, page: "Page", page_errors: list[str]
) -> None:
    page.emulate_media(color_scheme="dark")
    switch = page.locator("#backdrop")
    with annotating(workspace) as served:
        open_annotator(page, served.url)
        assert switch.get_attribute("aria-pressed") == "false"
        page.keyboard.press("Shift+B")
        page.wait_for_selector(f"#message:has-text('semviz map backdrop {workspace.path}')")
        wait_for(page, lambda: switch.get_attribute("aria-pressed") == "false", "the switch")
        put_backdrop(workspace)
        page.keyboard.press("Shift+B")
        wait_for_wall(page, "dark", True)
        assert switch.get_attribute("aria-pressed") == "true"
        switch.click()
        wait_for_wall(page, "dark", False)
        open_annotator(page, served.url)
        assert switch.get_attribute("aria-pressed") == "false"
        page.keyboard.press("Shift+B")
        wait_for_wall(page, "dark", True)
        open_annotator(page, served.url)
        wait_for_wall(page, "dark", True)
        assert switch.get_attribute("aria-pressed") == "true"
        backdrop_path(workspace).unlink()
        open_annotator(page, served.url)
        wait_for_wall(page, "dark", False)
        assert switch.get_attribute("aria-pressed") == "false"
        assert page.locator("#message").is_hidden()


def open_annotator(page: "Page", url: str) -> None:
    LabelDriver(page).open(url, with_map=True)
    page.wait_for_selector("#scene.ready", timeout=60_000)
    page.keyboard.press("Escape")  # ends the tour
