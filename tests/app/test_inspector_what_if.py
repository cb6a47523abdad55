"""What-if on the inspector's page: tried at once, shown beside the run, on disk only when asked."""

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import pytest
from inspector_page import near, open_flat, pixels, record_street, wait_for

from semviz.inspector.scene.scene_view import draw_what_if_camera
from semviz.inspector.server import Inspector
from semviz.inspector.state import Selection, State
from semviz.inspector.what_if import Sweep
from semviz.inspector.what_if_options import ChangeValues, WhatIfOption, what_if_options
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run
from semviz.web.gateway import Gateway
from semviz.web.scene import SceneDrawer
from semviz.what_if.change import PriorAtTruth
from semviz.what_if.request_changes import DropElement, UseMethod
from semviz.what_if.solve import KINDS, from_json, solve_with_changes
from semviz_core.localization.localizer import Localizer, available_methods

if TYPE_CHECKING:
    from playwright.sync_api import Page


class FakeScene:
    """Remembers under which names something is drawn."""

    def __init__(self) -> None:
        self.names: set[str] = set()

    def draw_camera(self, name: str, *_: object) -> None:
        self.names.add(name)

    def draw_label(self, name: str, *_: object) -> None:
        self.names.add(name)

    def clear_under(self, prefix: str) -> None:
        self.names = {name for name in self.names if not name.startswith(prefix)}


FRAMES = (10, 12, 14)
LOST = 12
"""The frame whose fix is 80 m off."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of a street, one of which has its fix far off."""

    def spoil(record: FrameRecord) -> FrameRecord:
        if record.frame.index != LOST:
            return record
        result = record.localization
        x, y, z = result.prior.position_m.tolist()
        prior = replace(result.prior, position_m=[x, y + 80.0, z])
        found = Localizer().localize(result.observed, result.submap, result.camera, prior)
        return replace(record, localization=found)

    path = tmp_path_factory.mktemp("runs") / "first.rrd"
    return record_street(path, FRAMES, spoil=spoil)


@pytest.fixture(scope="module")
def run(recorded: Path) -> Run:
    return load_run(recorded)


@pytest.fixture  # tests ask for it before the page, so that the page closes first
def url(recorded: Path) -> Iterator[str]:
    for made in recorded.parent.glob("*-tried-*"):
        made.unlink()
    with Gateway(Inspector([recorded])).running() as url:
        yield url


def all_offers(run: Run, state: State) -> list[WhatIfOption]:
    return [option for group in what_if_options(run, state) for option in group.options]


def all_changes(option: WhatIfOption) -> list[ChangeValues]:
    """What an option can send, with its own numbers."""
    choice = option.choice
    if choice is None:
        return [option.change]
    return [option.change | {choice.name: setting.value} for setting in choice.options]


def test_what_is_offered_can_be_tried(run: Run) -> None:
    """Every offer, with its own values, in every frame, whatever is selected."""
    seen, methods = set(), set()
    for position, record in enumerate(run.frames):
        element = int(record.localization.submap.id[0])
        tried: list[ChangeValues] = []  # much is offered whatever is selected
        for selection in (
            Selection(),
            Selection(0),
            Selection(None, element),
            Selection(0, element),
        ):
            state = replace(State(), run="first", position=position, selection=selection)
            for offer in all_offers(run, state):
                for told in all_changes(offer):
                    if told in tried:
                        continue
                    tried.append(told)
                    change = from_json(told)
                    seen.add(type(change))
                    answer = solve_with_changes(run, record, (change,)).localization
                    if isinstance(change, UseMethod):
                        methods.add((change.method, answer.method))
    assert {KINDS["drop element"], KINDS["force pair"], KINDS["move prior"]} <= seen
    assert {(method, method) for method in available_methods()} <= methods


def test_what_is_selected_is_offered_first(run: Run) -> None:
    nothing = replace(State(), run="first")
    titles = [group.title for group in what_if_options(run, nothing)]
    assert titles == ["Prior and submap", "Detections", "Solver"]
    pair = nothing.with_selection(0, None, run)
    element = pair.selection.element
    assert element is not None
    first, second, *rest = what_if_options(run, pair)
    assert second.title == "Detection #0"
    assert [group.title for group in rest] == titles
    assert first.options[0].change == {"change": "drop element", "element": element}
    beyond = next(element_id for element_id in run.semantic_map.elements.id.tolist()
                  if element_id not in run.frames[0].localization.submap.id)  # fmt: skip
    outside = all_offers(run, nothing.with_selection(None, beyond, run))
    assert not any(from_json(result.change) == DropElement(beyond) for result in outside)


def said(page: "Page", selector: str) -> Callable[[], str]:
    return lambda: page.locator(selector).inner_text()


@pytest.mark.browser
def test_the_most_telling_change_is_one_key(url: str, page: "Page", recorded: Path) -> None:
    before = recorded.read_bytes()
    open_flat(page, url, f"frame={LOST}")
    wait_for(page, lambda: page.locator("#why-body .suggestion").count() == 1, "the suggestion")
    assert "With the prior at the true position" in said(page, "#why-body .suggestion")()
    orange = near(pixels(page, "#image-canvas"), "#FF7A1A")  # the legend's
    page.keyboard.press("x")
    bar, card = said(page, "#what-if-text"), said(page, "#what-if-body .answer")
    wait_for(page, lambda: "no pose → 0." in bar(), "before and after in the bar")
    assert bar().startswith("What if: solved with the prior at the true position: ")
    assert bar().endswith(" m. Nothing is saved.")
    assert "Inliers" in card()
    drawn = lambda: near(pixels(page, "#image-canvas"), "#FF7A1A")  # noqa: E731
    wait_for(page, lambda: drawn() > orange + 50, "the what-if pose: the run has none")
    page.click("#what-if-drop")
    wait_for(page, lambda: not page.locator("#what-if-bar").is_visible(), "the bar gone")
    wait_for(page, lambda: drawn() < orange + 10, "the picture as it was")
    assert recorded.read_bytes() == before
    assert [path.name for path in recorded.parent.iterdir()] == ["first.rrd"]


@pytest.mark.browser
def test_what_is_kept_is_tried_on_all_frames_and_saved(
    url: str, page: "Page", recorded: Path
) -> None:
    open_flat(page, url, f"frame={LOST}")
    page.keyboard.press("x")
    wait_for(page, lambda: page.locator("#what-if-bar").is_visible(), "the bar")
    page.click("#what-if-keep")
    kept = said(page, "#what-if-body .kept")
    wait_for(page, lambda: "Kept changes" in kept(), "what is kept")
    page.click("text=Solve all frames")
    wait_for(page, lambda: "of 3 frames change: " in kept(), "all frames")
    assert "1 fixed, 0 broken" in kept()
    with page.expect_download() as file:
        page.click("#what-if-body a:has-text('Export')")
    told = json.loads(Path(file.value.path()).read_text())
    assert told == {"changes": [{"change": "prior at truth"}]}
    assert not list(recorded.parent.glob("*-tried-*"))
    page.click("text=Save as run")
    wait_for(page, lambda: "first-tried-1.rrd" in kept(), "where it is saved")
    made = load_run(recorded.with_name("first-tried-1.rrd"))
    assert [frame.localization.status for frame in made.frames] == ["ok"] * 3
    page.keyboard.press(".")
    wait_for(
        page, lambda: page.locator("#frame-number").inner_text() == "Frame 14 of 14", "frame 14"
    )
    answer = said(page, "#what-if-body .answer")
    wait_for(
        page,
        lambda: "With the kept changes (1)" in answer() and "→" in answer(),
        "it holds here too",
    )
    page.click("#what-if-body .kept .chip button")
    wait_for(page, lambda: page.locator("#what-if-body .kept").inner_text() == "", "nothing kept")
    assert page.locator("#what-if-body .answer").inner_text() == ""


def test_a_stopped_sweep_tells_what_it_tried_and_is_not_saved(run: Run) -> None:
    sweep = Sweep(run, (PriorAtTruth(),))
    over = threading.Event()

    def tell() -> None:
        if sweep.progress.startswith("solved: 0 of 3"):
            sweep.stop()  # after the frame in hand
        if sweep.is_over:
            over.set()

    sweep.start(tell)
    assert over.wait(60.0)
    assert sweep.value is not None
    assert [result.change.index for result in sweep.value] == [FRAMES[0]]
    assert sweep.view().text == "Stopped. No result changes in 1 frame."
    assert not sweep.view().can_save


@pytest.mark.browser
def test_numbers_are_typed_and_nonsense_is_refused_in_one_line(url: str, page: "Page") -> None:
    open_flat(page, url)
    page.click("[data-tab=what-if]")
    form = page.locator("#what-if-body form", has_text="Submap radius")
    form.locator("input").fill("30")
    form.locator("button").click()
    bar = said(page, "#what-if-text")
    wait_for(
        page, lambda: bar().startswith("What if: solved with a submap of 30 m: 0."), "the radius"
    )
    form.locator("input").fill("-3")
    form.locator("button").click()
    notice = said(page, "#notice")
    wait_for(page, lambda: "submap radius -3 m: give a positive number" in notice(), "why not")
    assert bar().startswith("What if: solved with a submap of 30 m")


@pytest.mark.browser
def test_another_method_is_chosen_from_all_at_hand(url: str, page: "Page") -> None:
    open_flat(page, url)
    page.click("[data-tab=what-if]")
    box = page.locator("#what-if-body select[aria-label=Method]")
    wait_for(page, lambda: box.count() == 1, "the methods")
    assert box.input_value() == "search"
    box.select_option("learned")
    bar = said(page, "#what-if-text")
    wait_for(page, lambda: bar().startswith("What if: solved with method learned: "), "the method")


@pytest.mark.browser
def test_a_selected_pair_is_forbidden_and_forced(url: str, page: "Page", run: Run) -> None:
    open_flat(page, url)
    page.keyboard.press("Tab")
    page.click("[data-tab=what-if]")
    page.locator("#what-if-body .options button", has_text="Is not ").last.click()
    bar = said(page, "#what-if-text")
    wait_for(
        page, lambda: "solved with detection #0 not as " in bar() and "→" in bar(), "forbidden"
    )
    fitting = said(page, "#what-if-body .answer dl")
    wait_for(page, lambda: "of" in fitting(), "how many fit")
    page.locator("#what-if-body .options button", has_text="Is ").first.click()
    wait_for(page, lambda: "solved with detection #0 as " in bar() and "→" in bar(), "forced")


def test_the_tried_camera_is_drawn_in_3d_and_taken_away(run: Run) -> None:
    drawn = FakeScene()
    answer = run.frames[0].localization
    draw_what_if_camera(cast(SceneDrawer, drawn), answer)
    assert drawn.names == {"/tried", "/tried-label"}
    draw_what_if_camera(
        cast(SceneDrawer, drawn), replace(answer, T_camera_map=None, status="cannot")
    )
    assert drawn.names == set()
