"""Take the screenshots of the README and the docs, all of the simulated street.

    python docs/make_screenshots.py                all of them, in about ten minutes
    python docs/make_screenshots.py image compare  those of take_image and take_compare

Needs Chromium, the test extra and, for rerun's viewer, mesa-vulkan-drivers; no data set.
"""

import os
import shutil
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import chdir, closing, contextmanager
from itertools import product
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, sync_playwright

from semviz.annotator.server import Annotator
from semviz.annotator.team.blind_annotator import TeamAnnotator
from semviz.commands.detect import REPORT, DetectEvaluateCommand
from semviz.commands.localize import LocalizeCommand
from semviz.commands.maps import MapLocalizabilityCommand
from semviz.commands.runs import ReportCommand
from semviz.inspector.server import Inspector
from semviz.runs.reader import load_run
from semviz.web.gateway import Gateway
from semviz.workspace.blind import BlindWorkspace, blind_workspace
from semviz.workspace.demo import MAP, RUN, SEED, ensure_demo
from semviz.workspace.people import People
from semviz.workspace.workspace import Workspace
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.edits import AcceptFrame, AddObservation, Edit, ReviewFrame
from semviz_annotation.labels.labels import new_id
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.frame import Side
from semviz_core.base.map_file import save_map
from semviz_core.research.evaluation.roads import move_element
from semviz_core.simulation.street import Street

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from changing_runs import changing_workspace
from serving import at
from support.street_labels import careful, label_street

IMAGES = Path(__file__).resolve().parent / "images"
CHROMIUM = [
    "--no-sandbox",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
]
SHOWN_FRAME = 97
FORECAST_FRAME = 22
RERUN_FRAME = 26
SPACE_FRAME = 113
MOVED_FRAME = 28
MOVED_ELEMENT = 29
COMPARED_FRAMES = range(100, 112)
"""The pole that most of them detect is moved in the other map."""
LABELLED_FRAMES = range(3)
BY_COMMANDS = {
    "benchmark-bound.png": "semviz benchmark",
    "benchmark-ok-tradeoff.png": "bench/ok_tradeoff.py --plot",
    "benchmark-cumulative.png": "semviz benchmark",
    "paper-20m-histogram.png": "semviz benchmark --suite paper-20m",
    "detector-calibration.png": "bench/subpixel.py --planted --plot",
    "diagnosis-reliability.png": "bench/diagnosis_reliability.py --picture",
    "localizability-check.png": "bench/localizability.py --plot",
    "merged-drives.png": "bench/merged_drives.py --picture",
}
"""Plots of long measurements, by the command that the page beside them names."""
RERUN_PORT = 19_876
TITLE_PX = 36
SETTLED_MS = 15_000
LOADED_MS = 300_000
"""The first run on a machine compiles the solver."""
WIDTH, HEIGHT = 1600, 950
FRAMES = range(10)
"""Frames of the labelled street."""
TEAM_PICTURES = (({"width": WIDTH, "height": HEIGHT}, "dark", "annotate-team.png"),)


@contextmanager
def browser_page() -> Iterator[Page]:
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=CHROMIUM)
        yield browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="dark")
        browser.close()


@contextmanager
def inspecting(page: Page, address: str, *runs: Path) -> Iterator[str]:
    """Open the inspector at an address; yield its URL. ``runs`` default to that of the demo."""
    tool = Inspector(runs or [Workspace.open(ensure_demo()).run_path(RUN)])
    with closing(tool), Gateway(tool).running() as url:
        page.goto(at(url, address))
        page.wait_for_selector("#why-body .sentence", state="attached", timeout=LOADED_MS)
        yield url
        page.goto("about:blank")


@contextmanager
def annotating(
    page: Page, folder: str, labels: Callable[[Street], Iterator[Edit]]
) -> Iterator[None]:
    """Open the annotator on a labelled street, with its tour already seen."""
    workspace = Workspace.create_street(Path(folder) / "street", 7, FRAMES)
    with LabelStore.open(workspace.labels_path) as store:
        for edit in labels(workspace.street):
            store.apply(edit, "you")
    with closing(Annotator(workspace, author="you")) as tool, Gateway(tool).running() as url:
        page.add_init_script("localStorage.setItem('semviz.tour', 'seen')")
        page.goto(url)
        yield
        page.goto("about:blank")


def settle(page: Page) -> None:
    """Wait until software rendering has drawn the page."""
    page.wait_for_timeout(SETTLED_MS)


def take_inspector(page: Page) -> None:
    with inspecting(page, f"?frame={SHOWN_FRAME}"):
        settle(page)
        page.screenshot(path=IMAGES / "serve.png")


def take_story(page: Page) -> None:
    with inspecting(page, "?show=story"):
        page.wait_for_selector("#story-causes .cause", timeout=LOADED_MS)
        page.wait_for_selector("#story-progress:empty", state="attached", timeout=LOADED_MS)
        page.click("#story-causes .cause >> nth=1")
        page.wait_for_timeout(500)
        page.screenshot(path=IMAGES / "serve-story.png")


def take_map_over_time(page: Page) -> None:
    """A street that changes after its third pass."""
    with tempfile.TemporaryDirectory() as folder:
        _, runs, _ = changing_workspace(Path(folder), changes=3, passes=8, images=True)
        with inspecting(page, "?show=over-time", *runs):
            page.wait_for_selector(".change-row", timeout=LOADED_MS)
            page.keyboard.press(".")
            page.keyboard.press("Delete")
            page.keyboard.press("Shift+.")
            page.wait_for_timeout(2000)
            page.screenshot(path=IMAGES / "serve-map-over-time.png")


def take_image(page: Page) -> None:
    """The image with the neighbouring frames, and a saved view as SVG."""
    with inspecting(page, f"?frame={MOVED_FRAME}") as url:
        settle(page)
        page.keyboard.press("4")
        page.keyboard.press("p")
        page.click('dialog [value="svg"] >> xpath=..')
        with page.expect_download() as download:
            page.click("dialog button.primary")
        download.value.save_as(IMAGES / "serve-error.svg")
        page.goto(at(url, f"?frame={SHOWN_FRAME}"))
        settle(page)
        for key in ("3", "Tab", "Shift+K"):
            page.keyboard.press(key)
        settle(page)
        page.locator("#image").screenshot(path=IMAGES / "serve-image.png")


def take_selected(page: Page) -> None:
    """The card of the pole that was labelled next to its true position, and the match matrix."""
    page.route("**/view/**", lambda route: route.abort())  # neither shows the 3D pane
    page.set_viewport_size({"width": WIDTH, "height": 1500})
    with inspecting(page, f"?frame={MOVED_FRAME}&element={MOVED_ELEMENT}&card=selected") as url:
        page.wait_for_selector("#selected-origins .origin", timeout=120_000)
        page.locator("#why").screenshot(path=IMAGES / "serve-selected.png")
        page.set_viewport_size({"width": WIDTH, "height": HEIGHT})
        page.goto(at(url, f"?frame={SHOWN_FRAME}"))
        settle(page)
        page.keyboard.press("Tab")
        page.wait_for_selector("#matrix-value:not(:empty)")
        page.locator("#matrix").screenshot(path=IMAGES / "serve-matrix.png")
    page.unroute("**/view/**")


def take_space(page: Page) -> None:
    """The map coloured by usage, with covariances."""
    with inspecting(page, f"?frame={SPACE_FRAME}"):
        page.wait_for_selector("#space-legend div")
        for key in ("v", "v", "Shift+V"):
            page.keyboard.press(key)
        settle(page)
        page.locator("#space").screenshot(path=IMAGES / "serve-space.png")


def take_solver(page: Page) -> None:
    """The elements over the demo's run, and the solver's stages in a frame with a wrong pose."""
    chosen = f"element={MOVED_ELEMENT}&list=elements&card=solver"
    with inspecting(page, f"?frame={MOVED_FRAME}&{chosen}"):
        page.wait_for_selector("#element-list li", timeout=120_000)
        page.click("#solver-body .poses tbody tr:nth-child(2)")
        settle(page)
        page.screenshot(path=IMAGES / "serve-solver.png")


def take_compare(page: Page) -> None:
    """The demo's run compared with one in a map in which a pole was moved."""
    with tempfile.TemporaryDirectory() as folder:
        town = Path(shutil.copytree(ensure_demo(), Path(folder) / "town"))
        workspace = Workspace.open(town)
        run = load_run(workspace.run_path(RUN))
        seen = np.concatenate([run.frames[index].element_id for index in COMPARED_FRAMES])
        often = int(np.bincount(seen[seen >= 0]).argmax())
        save_map(
            move_element(run.semantic_map, often, (1.2, 1.9, 0.0)), workspace.map_path("newer")
        )
        other = workspace.run_path("newer")
        LocalizeCommand(town, map="newer", out=other, observations="simulated", seed=SEED).run()
        address = f"?run=newer&base={RUN}&beside=yes&frame=0"
        with inspecting(page, address, workspace.run_path(RUN), other):
            page.click("#map-change-list li", timeout=60_000)
            settle(page)
            page.screenshot(path=IMAGES / "serve-compare.png")


def take_forecast(page: Page) -> None:
    with inspecting(page, f"?frame={FORECAST_FRAME}"):
        settle(page)
        page.click("#forecast")
        page.wait_for_selector("#forecast-legend .scale", timeout=120_000)
        settle(page)
        page.screenshot(path=IMAGES / "serve-forecast.png")


def take_what_if(page: Page) -> None:
    """A frame with a wrong pose, solved again without the moved pole."""
    with inspecting(page, f"?frame={MOVED_FRAME}"):
        settle(page)
        page.keyboard.press("x")
        settle(page)
        page.screenshot(path=IMAGES / "serve-what-if.png")


def take_label(page: Page) -> None:
    """The label behind the moved pole, opened from a frame with a wrong pose."""
    with tempfile.TemporaryDirectory() as folder:
        town = Path(shutil.copytree(ensure_demo(), Path(folder) / "town"))
        with inspecting(page, f"?frame={MOVED_FRAME}", Workspace.open(town).run_path(RUN)):
            page.wait_for_selector("#why-actions button", timeout=60_000)
            with page.expect_popup() as opened:
                page.keyboard.press("o")
            labels = opened.value
            labels.set_viewport_size({"width": WIDTH, "height": HEIGHT})
            labels.wait_for_selector("#card >> text=P-29", timeout=60_000)
            labels.keyboard.press("0")
            labels.click("#tour >> text=End")
            settle(labels)
            labels.screenshot(path=IMAGES / "serve-label.png")
            labels.close()


def take_report(page: Page) -> None:
    run = Workspace.open(ensure_demo()).run_path(RUN)
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        shutil.copy(run, "demo.rrd")
        ReportCommand((Path("demo.rrd"),)).run()
        page.goto(Path("report.html").resolve().as_uri())
        page.screenshot(path=IMAGES / "report.png")
        page.goto("about:blank")


def take_detector_report(page: Page) -> None:
    """The images of missed detections."""
    with tempfile.TemporaryDirectory() as folder:
        DetectEvaluateCommand(out=Path(folder)).run()
        page.goto((Path(folder) / REPORT).as_uri())
        page.evaluate("document.querySelector('.crops').scrollIntoView(); scrollBy(0, -300)")
        page.screenshot(path=IMAGES / "detector-report.png")
        page.goto("about:blank")


def take_rerun() -> None:
    """A run in rerun's viewer, rendered in software; the title bar, which only says so, is cut."""
    import cv2
    import numpy as np
    from rerun.experimental import ViewerClient

    run = Workspace.open(ensure_demo()).run_path(RUN)
    os.environ["VK_DRIVER_FILES"] = "/usr/share/vulkan/icd.d/lvp_icd.x86_64.json"
    viewer = ViewerClient.spawn(headless=True, port=RERUN_PORT, hide_welcome_screen=True)
    try:
        viewer.open(str(run))
        time.sleep(SETTLED_MS / 1e3)  # while it loads, it jumps to the last frame
        viewer.set_time("frame", sequence=RERUN_FRAME)
        time.sleep(SETTLED_MS / 1e3)
        shown = cv2.imdecode(np.frombuffer(viewer.take_screenshot(), np.uint8), cv2.IMREAD_COLOR)
        assert shown is not None
        small = cv2.resize(shown[TITLE_PX:], None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(IMAGES / "rerun.png"), small)
    finally:
        viewer.quit()


def draw_route() -> None:
    picture = IMAGES / "localizability-route.png"
    MapLocalizabilityCommand(ensure_demo(), map=MAP, plot=picture, force=True).run()


def take_annotator(page: Page) -> None:
    with tempfile.TemporaryDirectory() as folder, annotating(page, folder, first_labels):
        settle(page)
        page.click(f'.tile[data-frame="{LABELLED_FRAMES[-1]}"]')
        page.click("#elements .row")
        settle(page)
        page.screenshot(path=IMAGES / "annotate.png")


def take_review(page: Page) -> None:
    """A decision of map building as a question."""
    with tempfile.TemporaryDirectory() as folder, annotating(page, folder, forgetful_labels):
        page.click("#build")
        page.wait_for_selector('#build[title$="up to operation 1"]', timeout=120_000)
        page.click('#jumps .row:has-text("Map decisions")')
        settle(page)
        page.screenshot(path=IMAGES / "annotate-review.png")


def take_tracks(page: Page) -> None:
    """The view Tracks: labels of a pole about to be deleted."""
    with tempfile.TemporaryDirectory() as folder, annotating(page, folder, tracked_labels):
        page.wait_for_selector("#saved.saved", timeout=LOADED_MS)
        page.keyboard.press("F3")
        page.wait_for_function(
            "frames => semviz.tracks.table.total > 0 && !semviz.tracks.table.waiting"
            " && semviz.tracks.table.numbersAt.size === frames",
            arg=len(FRAMES),
            timeout=LOADED_MS,
        )
        page.evaluate("""() => {
            const { tracks } = semviz;
            const longest = tracks.shown.find((row) => row.name.startsWith("P-"));
            tracks.choose(longest, tracks.placeOf(3));
        }""")
        page.wait_for_function("() => semviz.tracks.details", timeout=LOADED_MS)
        for key in ("Shift+ArrowRight", "Shift+ArrowRight", "Delete"):
            page.keyboard.press(key)
        page.wait_for_selector("#track-bar", timeout=LOADED_MS)
        page.wait_for_function(
            """() => [...document.querySelectorAll("button.view canvas")].every((canvas) => {
                const { width, height } = canvas;
                return canvas.getContext("2d").getImageData(width / 2, height / 2, 1, 1).data[3];
            })""",
            timeout=LOADED_MS,
        )
        settle(page)
        page.screenshot(path=IMAGES / "annotate-tracks.png")


def take_filmstrip(page: Page) -> None:
    """The frames between two key frames."""
    with tempfile.TemporaryDirectory() as folder, annotating(page, folder, key_frames):
        page.wait_for_selector("#saved.saved", timeout=LOADED_MS)
        page.evaluate("semviz.go(5)")
        page.keyboard.press("F7")
        page.wait_for_function(
            "() => semviz.filmstrip.frames.length && !semviz.filmstrip.isSearching",
            timeout=LOADED_MS,
        )
        settle(page)
        page.screenshot(path=IMAGES / "annotate-filmstrip.png")


def take_team(page: Page) -> None:
    """The view Team: the review queue, and a frame that two people labelled blind."""
    with tempfile.TemporaryDirectory() as folder:
        workspace = Workspace.create_street(Path(folder) / "street", 7, FRAMES)
        people = People(workspace.path)
        for name in ("jon", "lin", "mara"):
            people.invite(name, "annotate")
        label(workspace, "mara", FRAMES[:-4], sigma_px=0.4)
        with closing(TeamAnnotator(workspace, author="eva")) as tool:
            store = tool.session.team.store
            for index in (0, 1):
                store.apply(AcceptFrame(index), "eva")
            for name, text in (("mara", "0-5 mara"), ("jon", "6-9 jon")):
                store.state("assign", text, name)
            shares = tool.shares
            shares.assign((FRAMES[-4], FRAMES[-1]), 100.0, ("mara", "jon"), "eva")
            for name, sigma_px in (("mara", 0.5), ("jon", 1.0)):
                label(blind_workspace(workspace, name), name, FRAMES[-4:-1], sigma_px)
            with Gateway(tool).running() as url:
                page.add_init_script("localStorage.setItem('semviz.tour', 'seen')")
                page.goto(at(url, "?view=team"))
                page.wait_for_function("() => window.semviz?.team.known", timeout=LOADED_MS)
                for size, theme, name in TEAM_PICTURES:
                    page.set_viewport_size(size)
                    page.emulate_media(color_scheme=theme)
                    page.keyboard.press("Shift+J")
                    page.wait_for_function(
                        "() => semviz.team.compared.shown && semviz.team.compared.bitmaps.size > 1",
                        timeout=LOADED_MS,
                    )
                    page.click("#compared-elements .row:has-text('within')")
                    page.wait_for_timeout(1000)
                    page.screenshot(path=IMAGES / name)
                page.goto("about:blank")


def label(workspace: Workspace, name: str, frames: range, sigma_px: float) -> None:
    """Label frames as a careful person does, who overlooks a few elements, and review them."""
    seed = sum(name.encode())
    street = (workspace.outer if isinstance(workspace, BlindWorkspace) else workspace).source
    assert isinstance(street, Street)
    made = label_street(careful(street, sigma_px, seed), frames, memory=len(FRAMES)).labels
    with workspace.open_labels() as store:
        kept = tuple(
            row
            for row in made.observations.values()
            if hash_of(row.id, name) % 12
            and all(0.0 <= v <= 375.0 for _, v in (row.anchor_px, row.end_px or row.anchor_px))
        )
        elements = {row.element_id for row in kept}
        store.apply(ImportLabels(tuple(made.elements[i] for i in elements), kept), name)
        for index in frames:
            store.apply(ReviewFrame(index, "reviewed"), name)


def hash_of(id_: str, name: str) -> int:
    """A number that differs by label and person, the same each time."""
    return zlib.crc32(f"{id_} {name}".encode())


def first_labels(street: Street) -> Iterator[Edit]:
    """All elements in the first frames, but in the last only a third: the rest is proposed."""
    elements: dict[int, str] = {}
    sides: tuple[Side, Side] = ("left", "right")
    for index, side in product(LABELLED_FRAMES, sides):
        seen, numbers = street.labels(index, side)
        for row, number in enumerate(numbers.tolist()):
            if index != LABELLED_FRAMES[-1] or number % 3 == 0:
                class_id = None if number in elements else int(seen.class_id[row])
                element_id = elements.setdefault(number, new_id())
                mark = vars(Mark.of_element(seen, row))
                yield AddObservation(new_id(), element_id, index, side, **mark, class_id=class_id)


def forgetful_labels(street: Street) -> Iterator[Edit]:
    """Labels in all frames, with new elements every six frames: map building merges some."""
    made = label_street(careful(street, 0.5, 1), FRAMES, memory=6).labels
    yield ImportLabels(tuple(made.elements.values()), tuple(made.observations.values()))


def tracked_labels(street: Street) -> Iterator[Edit]:
    """Labels of whole elements in the first frames: the rest is proposed."""
    made = label_street(careful(street, 0.5, 1), FRAMES[:-2], memory=len(FRAMES)).labels
    yield ImportLabels(tuple(made.elements.values()), tuple(made.observations.values()))


def key_frames(street: Street) -> Iterator[Edit]:
    """Labels of every fifth frame."""
    made = label_street(careful(street, 0.5, 1), FRAMES[::5], memory=len(FRAMES)).labels
    yield ImportLabels(tuple(made.elements.values()), tuple(made.observations.values()))
    yield ReviewFrame(0, "reviewed")


WITHOUT_BROWSER = (draw_route, take_rerun)
IN_BROWSER = (
    take_inspector, take_story, take_map_over_time, take_image, take_space, take_selected,
    take_solver, take_compare,
    take_forecast, take_what_if, take_label, take_report, take_detector_report, take_annotator,
    take_review, take_filmstrip, take_tracks, take_team,
)  # fmt: skip


def main() -> None:
    names = sys.argv[1:]

    def is_wanted(take: Callable[..., None]) -> bool:
        return not names or take.__name__.partition("_")[2] in names

    for draw in filter(is_wanted, WITHOUT_BROWSER):
        draw()
    with browser_page() as page:
        for take in filter(is_wanted, IN_BROWSER):
            take(page)
    for path in sorted(IMAGES.glob("*.png")):
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
