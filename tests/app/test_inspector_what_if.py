"""What-if on the inspector's page: tried at once, shown beside the run, on disk only when asked."""

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pytest
from inspecting import near, open_flat, pixels, record_street, wait_for

from semviz.inspector.scene.tried import draw_tried
from semviz.inspector.server import Inspector
from semviz.inspector.session import Selection, State
from semviz.inspector.what_if.offers import offers
from semviz.inspector.what_if.sweep import Sweep
from semviz.recording.reader import load_run
from semviz.recording.run import FrameRecord, Run
from semviz.trying.again import again
from semviz.trying.changes import KINDS, from_json
from semviz.trying.map_changes import DropElement
from semviz.trying.prior_changes import PriorAtTruth
from semviz.trying.solver_changes import UseMethod
from semviz.web.door import Door
from semviz.web.scene import Scene
from semviz_core.localize import Localizer, methods_at_hand

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
        self.names = {one for one in self.names if not one.startswith(prefix)}


FRAMES = (10, 12, 14)
LOST = 12
"""The frame whose fix is 80 m off."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of a street, one of which has its fix far off."""

    def spoil(record: FrameRecord) -> FrameRecord:
        if record.frame.index != LOST:
            return record
        one = record.localization
        x, y, z = one.prior.position_m.tolist()
        prior = replace(one.prior, position_m=[x, y + 80.0, z])
        found = Localizer().localize(one.observed, one.submap, one.camera, prior)
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
    with Door(Inspector([recorded])).running() as url:
        yield url


def all_offers(run: Run, state: State) -> list[dict[str, Any]]:
    return [one for group in offers(run, state) for one in group["offers"]]


def all_changes(offer: dict[str, Any]) -> list[dict[str, Any]]:
    """What an offer can send, with its own numbers."""
    if (choice := offer.get("choice")) is None:
        return [offer["change"]]
    return [offer["change"] | {choice["name"]: one["value"]} for one in choice["options"]]


def test_what_is_offered_can_be_tried(run: Run) -> None:
    """Every offer, with its own values, in every frame, whatever is selected."""
    seen, methods = set(), set()
    for position, record in enumerate(run.frames):
        element = int(record.localization.submap.id[0])
        for selection in (
            Selection(),
            Selection(0),
            Selection(None, element),
            Selection(0, element),
        ):
            state = replace(State(), run="first", position=position, selection=selection)
            for one in all_offers(run, state):
                for told in all_changes(one):
                    change = from_json(told)
                    seen.add(type(change))
                    answer = again(run, record, (change,)).localization
                    if isinstance(change, UseMethod):
                        methods.add((change.method, answer.method))
    assert {KINDS["drop element"], KINDS["force pair"], KINDS["move prior"]} <= seen
    assert {(one, one) for one in methods_at_hand()} <= methods


def test_what_is_selected_is_offered_first(run: Run) -> None:
    nothing = replace(State(), run="first")
    titles = [one["title"] for one in offers(run, nothing)]
    assert titles == ["Known beforehand", "Seen", "Solver"]
    pair = nothing.selecting(0, None, run)
    element = pair.selection.element
    assert element is not None
    first, second, *rest = offers(run, pair)
    assert second["title"] == "Detection #0"
    assert [one["title"] for one in rest] == titles
    assert first["offers"][0]["change"] == {"change": "drop element", "element": element}
    beyond = next(one for one in run.semantic_map.elements.id.tolist()
                  if one not in run.frames[0].localization.submap.id)  # fmt: skip
    outside = all_offers(run, nothing.selecting(None, beyond, run))
    assert not any(from_json(one["change"]) == DropElement(beyond) for one in outside)


def said(page: "Page", selector: str) -> Callable[[], str]:
    return lambda: page.locator(selector).inner_text()


@pytest.mark.browser
def test_the_most_telling_change_is_one_key(url: str, page: "Page", recorded: Path) -> None:
    before = recorded.read_bytes()
    open_flat(page, url, f"frame={LOST}")
    wait_for(page, lambda: page.locator("#why-body .advice").count() == 1, "advice on the card")
    assert "With the prior at the true place" in said(page, "#why-body .advice")()
    orange = near(pixels(page, "#image-canvas"), "#FF7A1A")  # the legend's
    page.keyboard.press("x")
    bar, card = said(page, "#trying-text"), said(page, "#what-if-body .answer")
    wait_for(page, lambda: "no pose → 0." in bar(), "before and after in the bar")
    assert bar().startswith("Trying with the prior at the true place: ")
    assert bar().endswith(" m. Nothing is changed.")
    assert "elements fit" in card()
    page.wait_for_timeout(300)
    assert near(pixels(page, "#image-canvas"), "#FF7A1A") > orange + 50  # the run has no pose
    page.click("#trying-drop")
    wait_for(page, lambda: not page.locator("#trying").is_visible(), "the bar gone")
    page.wait_for_timeout(300)
    assert near(pixels(page, "#image-canvas"), "#FF7A1A") < orange + 10
    assert recorded.read_bytes() == before
    assert [one.name for one in recorded.parent.iterdir()] == ["first.rrd"]


@pytest.mark.browser
def test_what_is_kept_is_tried_on_all_frames_and_saved(
    url: str, page: "Page", recorded: Path
) -> None:
    open_flat(page, url, f"frame={LOST}")
    page.keyboard.press("x")
    wait_for(page, lambda: page.locator("#trying").is_visible(), "the bar")
    page.click("#trying-keep")
    kept = said(page, "#what-if-body .kept")
    wait_for(page, lambda: "Kept on this page" in kept(), "what is kept")
    page.click("text=Try on all frames")
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
    assert [one.localization.status for one in made.frames] == ["ok"] * 3
    page.keyboard.press(".")
    wait_for(
        page, lambda: page.locator("#frame-number").inner_text() == "Frame 14 of 14", "frame 14"
    )
    answer = said(page, "#what-if-body .answer")
    wait_for(
        page, lambda: "With what is kept (1)" in answer() and "→" in answer(), "it holds here too"
    )
    page.click("#what-if-body .kept .chip button")
    wait_for(page, lambda: page.locator("#what-if-body .kept").inner_text() == "", "nothing kept")
    assert page.locator("#what-if-body .answer").inner_text() == ""


def test_a_stopped_sweep_tells_what_it_tried_and_is_not_saved(run: Run) -> None:
    sweep = Sweep(run, (PriorAtTruth(),))
    over = threading.Event()

    def tell() -> None:
        if sweep.doing.startswith("tried: 0 of 3"):
            sweep.stop()  # after the frame in hand
        if sweep.is_over:
            over.set()

    sweep.ask(tell)
    assert over.wait(60.0)
    assert sweep.value is not None
    assert [one.change.index for one in sweep.value] == [FRAMES[0]]
    assert sweep.view()["text"] == "Stopped. No answer changes in 1 frame."
    assert not sweep.view()["canSave"]


@pytest.mark.browser
def test_numbers_are_typed_and_nonsense_is_refused_in_one_line(url: str, page: "Page") -> None:
    open_flat(page, url)
    page.click("[data-tab=what-if]")
    form = page.locator("#what-if-body form", has_text="Submap within")
    form.locator("input").fill("30")
    form.locator("button").click()
    bar = said(page, "#trying-text")
    wait_for(page, lambda: bar().startswith("Trying with a submap of 30 m: 0."), "the radius")
    form.locator("input").fill("-3")
    form.locator("button").click()
    notice = said(page, "#notice")
    wait_for(page, lambda: "crop radius -3 m: give a positive number" in notice(), "why not")
    assert bar().startswith("Trying with a submap of 30 m")


@pytest.mark.browser
def test_another_method_is_chosen_from_all_at_hand(url: str, page: "Page") -> None:
    open_flat(page, url)
    page.click("[data-tab=what-if]")
    box = page.locator("#what-if-body select[aria-label=Method]")
    wait_for(page, lambda: box.count() == 1, "the methods")
    assert box.input_value() == "search"
    box.select_option("wide")
    bar = said(page, "#trying-text")
    wait_for(page, lambda: bar().startswith("Trying with method wide: "), "the method")


@pytest.mark.browser
def test_a_selected_pair_is_forbidden_and_forced(url: str, page: "Page", run: Run) -> None:
    open_flat(page, url)
    page.keyboard.press("Tab")
    page.click("[data-tab=what-if]")
    page.locator("#what-if-body .offers button", has_text="Not ").last.click()
    bar = said(page, "#trying-text")
    wait_for(
        page, lambda: "Trying with detection #0 not as " in bar() and "→" in bar(), "forbidden"
    )
    fitting = said(page, "#what-if-body .answer dl")
    wait_for(page, lambda: "of" in fitting(), "how many fit")
    page.locator("#what-if-body .offers button", has_text="Surely ").first.click()
    wait_for(page, lambda: "Trying with detection #0 as " in bar() and "→" in bar(), "forced")


def test_the_tried_camera_is_drawn_in_3d_and_taken_away(run: Run) -> None:
    drawn = FakeScene()
    answer = run.frames[0].localization
    draw_tried(cast(Scene, drawn), answer)
    assert drawn.names == {"/tried", "/tried-label"}
    draw_tried(cast(Scene, drawn), replace(answer, T_camera_map=None, status="cannot"))
    assert drawn.names == set()
