"""Localizability for people: the command, its plot, and the forecast in the inspector's page."""

import io
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from command_line import Call, call

from semviz.cli import main
from semviz.inspector.elements import Forecast
from semviz.inspector.server import Inspector
from semviz.runs.reader import load_run
from semviz.web.gateway import Gateway
from semviz.workspace.localization.localizability import positions, with_measured_recall
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.base.map_file import load_map, save_map
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.localizability.route import Conditions

if TYPE_CHECKING:
    from playwright.sync_api import Page

FRAMES = 12


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Call:
    """Exit status, output and error output of ``semviz map localizability``."""
    return partial(call, capsys, "map", "localizability")


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A localized street."""
    folder = tmp_path_factory.mktemp("streets") / "street"
    for command in (
        ["new", folder, "--simulate", 3, "--frames", f"0:{FRAMES}"],
        ["localize", folder, "--map", TRUTH],
    ):
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in command])
        assert ended.value.code == 0
    return folder


def test_the_table_names_stretches_and_what_would_help(run: Call, street: Path) -> None:
    status, output, errors = run(street, "--map", TRUTH)
    assert (status, errors) == (0, "")
    first, assumed, heads, *rows = output.splitlines()
    assert first.startswith(f"{FRAMES} positions on 11 m: expected error 0.")
    assert assumed.startswith("for a detector that finds 75% of the mapped elements")
    assert heads.split()[:4] == ["worst", "stretches", "expected", "sigma"]
    assert rows[0].startswith("0 to 11 m")
    assert any(row.startswith("keep P-") for row in rows)


def test_json_and_plot_say_the_same(run: Call, street: Path, tmp_path: Path) -> None:
    plot = tmp_path / "route.png"
    status, output, _ = run(street, "--map", TRUTH, "--frames", "0:12:2", "--json", "--plot", plot)
    assert status == 0
    told = json.loads(output)
    assert len(told["positions"]) == 6
    expected = [position["expected_m"] for position in told["positions"]]
    assert told["stretches"][0]["expected_m"] == pytest.approx(np.mean(expected))
    assert {"sigma_m", "sigma_deg", "too_little", "ambiguous"} <= told["positions"][0].keys()
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_without_poses_the_map_s_own_way_is_taken(run: Call, street: Path) -> None:
    """The frames of a range and the trajectory of the map lead along the same street."""
    workspace = Workspace.open(street)
    truth = load_map(workspace.map_path(TRUTH))
    assert truth.trajectory_m.shape == (FRAMES, 3)
    by_frames = positions(workspace.source.frames, truth)
    by_map = positions([], truth)
    assert len(by_frames) == len(by_map)
    for frame, other in zip(by_frames, by_map, strict=True):
        np.testing.assert_allclose(frame.translation, other.translation)
        assert frame.rotation[:, 2] @ other.rotation[:, 2] > np.cos(np.deg2rad(12.0))


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_labels_tell_how_much_of_the_map_is_seen(street: Path, share: float) -> None:
    """Of every frame, that share of what is in view; of none, the stated recall is kept."""
    workspace, rng = Workspace.open(street), np.random.default_rng(0)
    truth, camera = load_map(workspace.map_path(TRUTH)), workspace.source.rig.left
    stated = Conditions()
    seen = []
    for frame in workspace.source.frames:
        assert frame.T_map_camera is not None
        ids = truth.elements.id[rng.random(len(truth)) < share]
        seen.append((frame.T_map_camera, ids))
    detector = with_measured_recall(stated, truth, camera, seen).detector
    if not share:
        assert detector == stated.detector
        return
    assert detector.recall_near == pytest.approx(min(share, 0.98), abs=0.1)
    assert detector.recall_far == pytest.approx(min(share, 0.98), abs=0.1)


def test_what_cannot_be_predicted_costs_one_line(run: Call, street: Path, tmp_path: Path) -> None:
    workspace = Workspace.open(street)
    truth = load_map(workspace.map_path(TRUTH))
    save_map(SemanticMap(truth.elements[[]], truth.frame), workspace.map_path("empty"))
    for arguments, words in (
        ((street, "--map", "empty"), "the map is empty"),
        ((street, "--map", "nothing"), "no such map"),
        ((street, "--map", TRUTH, "--frames", "90:95"), "none of these frames"),
        ((street, "--map", TRUTH, "--plot", tmp_path / "route.pdf"), "ends in .png"),
    ):
        status, output, errors = run(*arguments)
        assert (status, output, errors.count("\n")) == (2, "", 1)
        assert words in errors
    assert not (tmp_path / "route.pdf").exists()


def test_a_forecast_is_worked_out_once_and_tells_how_far_it_is(street: Path) -> None:
    forecast = Forecast(load_run(street / "runs" / "search.rrd"), street)
    seen: list[str] = []
    forecast.start(
        lambda: seen.append("ready" if forecast.view().found else forecast.view().progress)
    )
    for _ in range(1200):
        if forecast.value is not None and seen[-1] == "ready":
            break
        time.sleep(0.05)
    assert any("predicting errors" in state for state in seen)
    assert seen[-1] == "ready"
    found = forecast.view().found
    assert found is not None
    assert len(found.expected_m) == FRAMES
    assert all(error_m is not None and 0.0 < error_m <= 1.0 for error_m in found.expected_m)
    first = forecast.value
    forecast.start(lambda: seen.append("again"))
    assert seen[-1] == "again"
    assert forecast.value is first


# --- the page ---


@pytest.fixture
def url(street: Path) -> Iterator[str]:
    with Gateway(Inspector([street / "runs" / "search.rrd"])).running() as url:
        yield url


def pixels(page: "Page", selector: str) -> np.ndarray:
    from PIL import Image

    shot = page.locator(selector).screenshot()
    return np.array(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def other(page: "Page", selector: str, before: np.ndarray) -> int:
    """How many pixels look different."""
    return int((np.abs(pixels(page, selector) - before).max(axis=2) > 30).sum())


def wait_for(page: "Page", said: Callable[[], bool], what: str, timeout_s: float = 60.0) -> None:
    for _ in range(int(timeout_s * 10)):
        if said():
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"never came: {what}")


@pytest.mark.browser
def test_the_forecast_is_a_band_a_legend_and_a_line(url: str, page: "Page") -> None:
    page.goto(url)
    page.wait_for_selector("#scene.ready")
    button, legend = page.locator("#forecast"), page.locator("#forecast-legend")
    wait_for(page, lambda: bool(page.locator("#frame-number").text_content()), "the first frame")
    page.wait_for_timeout(2000)
    assert button.get_attribute("aria-pressed") == "false"
    assert not legend.is_visible()
    space, line = pixels(page, "#scene"), pixels(page, "#timeline-canvas")
    page.keyboard.press("f")
    wait_for(page, lambda: legend.locator(".scale").count() == 1, "the forecast")
    assert button.get_attribute("aria-pressed") == "true"
    assert legend.locator(".scale small").all_text_contents() == ["0.1", "0.2", "0.4", "0.7", "m"]
    wait_for(page, lambda: other(page, "#scene", space) > 500, "the band")
    wait_for(page, lambda: other(page, "#timeline-canvas", line) > 100, "the line")
    button.click()
    wait_for(page, lambda: not legend.is_visible(), "the legend gone")
    wait_for(page, lambda: other(page, "#timeline-canvas", line) < 20, "no line")
    wait_for(page, lambda: other(page, "#scene", space) < 200, "no band")
