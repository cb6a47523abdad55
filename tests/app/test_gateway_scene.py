"""3D scenes through the gateway: they load, with the colours of the palette."""

import io
import re
from typing import TYPE_CHECKING

import numpy as np
import pytest
from aiohttp import web
from hypothesis import given
from hypothesis import strategies as st
from serving import at

from semviz.web import shapes
from semviz.web.gateway import Gateway
from semviz.web.scene import SceneDrawer
from semviz.web.shapes import PALETTES, rgb, scene_rgb
from semviz.web.tool import STATIC
from semviz.web.viewpoint import Viewer, Viewpoint
from semviz.web.viser_servers import ViserServers
from semviz_core.base.pose import Pose

if TYPE_CHECKING:
    from playwright.sync_api import Page


HIDDEN = "[data-floating-window], .mantine-Notifications-root"


class SceneTool:
    title = "scene"

    def __init__(self) -> None:
        self.scenes = ViserServers()

    def routes(self) -> list[web.AbstractRouteDef]:
        return []


@pytest.mark.browser
@pytest.mark.parametrize("theme", ["dark", "light"])
def test_scene_shows_exact_colours_through_the_door(page: "Page", theme: str) -> None:
    from PIL import Image

    tool = SceneTool()
    with Gateway(tool).running() as url:
        server = tool.scenes.scene("one")
        scene = SceneDrawer(server, "light" if theme == "light" else "dark")
        colors = [scene.palette.prior, scene.palette.road, PALETTES["light"].estimate]
        for column, color in enumerate(colors):
            post = np.array([[[column - 1.0, 0.0, -1.0], [column - 1.0, 0.0, 1.0]]])
            scene.draw_lines(f"/line/{column}", post, color, 40.0)
            aside = post[:, :, [0]] * [1.0, 0, 0] + [[0.3, 0, -1.0], [0.3, 0, 1.0]]
            many = aside + np.linspace(0.0, 0.1, 200)[:, None, None] * [1.0, 0, 0]
            scene.draw_path(f"/hair/{column}", many.reshape(-1, 3), color)  # a field of hairlines
        Viewer(server).show(Viewpoint(np.array([0.0, -4.0, 0.0]), np.zeros(3)))
        page.goto(at(url, "view/one/"))
        for _ in range(300):
            page.wait_for_timeout(100)
            if server.get_clients():
                break
        page.add_style_tag(content=f"{HIDDEN} {{ display: none !important }}")
        page.wait_for_timeout(1500)
        assert len(server.get_clients()) == 1
        shot = np.array(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
        box = page.viewport_size
        assert box is not None
        middle_y, focal = box["height"] // 2, box["height"] / 2 / np.tan(np.deg2rad(55.0) / 2)
        for column, color in enumerate(colors):
            x = round(box["width"] / 2 + (column - 1.0) * focal / 4.0)
            if theme == "light" and color == scene.palette.road:
                continue  # brighter than the tone curve reaches
            hair = x + round(0.35 * focal / 4.0)
            assert np.abs(shot[middle_y, x] - rgb(color)).max() <= 2, color
            assert np.abs(shot[middle_y, hair] - rgb(color)).max() <= 2, color


def displayed(given_rgb: tuple[int, int, int]) -> np.ndarray:
    """three.js's ACESFilmicToneMapping, written anew from its shader."""
    encoded = np.array(given_rgb) / 255
    low = encoded <= 0.04045
    light = np.where(low, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4) / 0.6
    into = [[0.59719, 0.35458, 0.04823], [0.076, 0.90834, 0.01566], [0.0284, 0.13383, 0.83777]]
    out = [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605]]
    out.append([-0.00327, -0.07276, 1.07602])
    v = np.array(into) @ light
    fitted = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.432951) + 0.238081)
    shown = np.clip(np.array(out) @ fitted, 0, 1)
    dark = shown <= 0.0031308
    return np.asarray(255 * np.where(dark, shown * 12.92, 1.055 * shown ** (1 / 2.4) - 0.055))


@given(st.tuples(*[st.integers(60, 190)] * 3))
def test_tone_mapping_is_undone(color: tuple[int, int, int]) -> None:
    found = scene_rgb("#{:02X}{:02X}{:02X}".format(*color))
    if min(found) > 0 and max(found) < 255:  # the curve reaches it
        assert np.abs(displayed(found) - color).max() <= 2.5


def test_style_sheet_and_python_agree() -> None:
    text = (STATIC / "base.css").read_text()
    blocks = re.findall(r":root(\[[^]]*\])? \{(.*?)\}", text, re.DOTALL)
    assert [selector for selector, _ in blocks] == ["", '[data-theme="light"]']
    for theme, (_, body) in zip(("dark", "light"), blocks, strict=True):
        css = dict(re.findall(r"--([\w-]+): (#\w{6});", body))
        palette = PALETTES[theme]
        for name in ("scene", "road", "grid", "faint", "accent"):
            assert css[name] == getattr(palette, name)
        for name in ("truth", "estimate", "prior", "alternative"):
            assert css[name] == getattr(palette, name)
        assert [css[f"residual-{level}"] for level in range(5)] == list(palette.residual)


@given(st.floats(0.05, 3), st.floats(0.05, 3), st.floats(0.5, 20))
def test_dashes_lie_on_their_line_and_cover_its_share(
    dash: float, gap: float, length: float
) -> None:
    line = np.array([[[0.0, 0.0, 0.0], [length, 0.0, 0.0]]])
    cut = shapes.dashed(line, dash, gap)
    starts, ends = cut[:, 0, 0], cut[:, 1, 0]
    assert (starts >= 0).all()
    assert (ends <= length + 1e-9).all()
    assert (ends - starts <= dash + 1e-9).all()
    assert np.allclose(starts[1:] - ends[:-1], gap)


@given(st.floats(-3, 3), st.floats(-50, 50), st.floats(-50, 50))
def test_view_keeps_its_place_relative_to_the_vehicle(turn: float, x: float, y: float) -> None:
    from semviz.web.viewpoint import _carried, behind

    level = Pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    after = Pose.from_rotvec([0, 0, turn], [x, y, 1.0]) @ level
    moved, expected = _carried(behind(level), level, after), behind(after)
    assert np.allclose(moved.eye_m, expected.eye_m)
    assert np.allclose(moved.target_m, expected.target_m)


def test_no_client_can_share_a_scene() -> None:
    scenes = ViserServers()
    try:
        assert scenes.scene("one").request_share_url() is None
    finally:
        scenes.close_all()
