"""How many inputs a label costs: a scripted annotator labels 8 frames of simulated streets.

    python bench/labelling.py
    python bench/labelling.py --detector own        after 'semviz detect'
    python bench/labelling.py --detector simulated  one as good as the paper's

The script sees what a person would: the street's truth is its eye. It clicks with a hand that
trembles by 1.5 CSS pixels, at the zoom that shows the whole image, with snapping on. It accepts a
proposal where both marks are right, turns it down where one is not, and draws what nobody proposed:
every pole and sign up to 40 m ahead that is visible in both images. The page counts its inputs: a
key, a click or a turn of the wheel is one, a drag two. At the end every label is held against the
truth.

Times are those of the keystroke-level model (Card, Moran & Newell 1980) with its own constants, for
an average typist: a key 0.28 s, a click 0.2 s, pointing 1.1 s, and a thought of 1.35 s before each
drawing, before each correction and once a frame.
"""

import argparse
import subprocess
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

from semviz.annotator.server import Annotator
from semviz.web.door import Door
from semviz.workspace import Workspace
from semviz_annotation.detections import as_proposals
from semviz_annotation.labels import Labels
from semviz_annotation.proposals import Proposals, save_proposals
from semviz_core.elements import Elements2D
from semviz_core.sources.source import Side
from semviz_core.sources.street.detector import SimulatedDetector
from semviz_core.sources.street.street import Street

CHROMIUM = ["--no-sandbox", "--enable-unsafe-swiftshader"]
FRAMES = 8
REACH_M = 40.0
RIGHT_PX, RIGHT_M = 2.0, 0.04
"""A mark this near to the truth, by one or the other, is right: across a pole, to a middle."""
ALONG_PX, ALONG_M = 6.0, 0.12
"""And along a pole, where the mark says that an end is seen and it is."""
TREMOR_CSS_PX = 1.5
KEY_S, CLICK_S, POINT_S, THINK_S = 0.28, 0.2, 1.1, 1.35
PATIENCE_MS = 300_000
"""On a busy machine."""
SIDES: tuple[Side, Side] = ("left", "right")
BY_HAND = """
Inputs that a pole in both images of a frame needs, counted by its steps (other tools were not run):
  each image by itself (labelme, CVAT):   5 and more: class, two clicks in each image; not linked
  linked by hand afterwards:              6 and more: the same, and a key to link them
  semviz, both by hand:                   5: class, two clicks in each image; linked by the rays
  semviz, first frame:                    3: class, two clicks; the frame's key takes its partner
  semviz, later frames:                   none of its own: the frame's key takes it
"""


@dataclass
class Work:
    """What the annotator did."""

    keys: int = 0
    clicks: int = 0
    points: int = 0
    """At something, for a key."""
    thoughts: int = 0
    least: int = 0
    """Inputs if all went well but for the first drawing of each element: the floor."""
    counts: Counter[str] = field(default_factory=Counter)
    pressed: Counter[str] = field(default_factory=Counter)

    @property
    def inputs(self) -> int:
        return self.keys + self.clicks

    @property
    def seconds(self) -> float:
        moves = (self.clicks + self.points) * POINT_S
        return self.keys * KEY_S + self.clicks * CLICK_S + moves + self.thoughts * THINK_S


@dataclass(frozen=True)
class Truth:
    """What is visible in a frame: marks by element, in one image or both."""

    marks: dict[int, dict[str, tuple[np.ndarray, np.ndarray]]]
    known: dict[int, dict[str, tuple[bool, bool]]]
    """Whether a pole's peak and bottom are to be seen."""
    class_id: dict[int, int]
    depth_m: dict[int, float]
    focal_px: float

    @property
    def wanted(self) -> list[int]:
        """What is to be labelled: near, and in both images. Class by class."""
        both = [one for one, marks in self.marks.items() if len(marks) == len(SIDES)]
        near = [one for one in both if self.depth_m[one] < REACH_M]
        return sorted(near, key=lambda one: (self.class_id[one], self.depth_m[one]))

    def is_right(self, element: int, side: Side, anchor: Any, end: Any) -> bool:
        if side not in self.marks[element]:
            return False
        return error_px((anchor, end), self.marks[element][side]) <= self.within_px(
            element, RIGHT_PX, RIGHT_M
        )

    def are_ends_right(self, element: int, side: Side, offered: dict[str, Any]) -> bool:
        """Of a proposed mark that ``is_right``: those that it says are seen, and are."""
        if offered["end"] is None:
            return True
        both_known = np.array([offered["anchor_known"], offered["end_known"]])
        both_known &= self.known[element][side]
        ends = np.array([offered["anchor"], offered["end"]])
        gaps = np.linalg.norm(ends - self.marks[element][side], axis=1)
        return bool((gaps[both_known] <= self.within_px(element, ALONG_PX, ALONG_M)).all())

    def within_px(self, element: int, pixels: float, metres: float) -> float:
        return max(pixels, metres * self.focal_px / self.depth_m[element])


class Labeller:
    """Labels a street through the page."""

    def __init__(self, page: Page, annotator: Annotator, street: Street, seed: int) -> None:
        self.page = page
        self.annotator = annotator
        self.street = street
        self.hand = np.random.default_rng(seed)
        self.work = Work()
        self.class_id = 0
        self.drawn: set[int] = set()

    def label(self, frame: int) -> None:
        """One frame: proposals first, then what is missing; then on to the next."""
        self.work.thoughts += 1
        truth = truth_of(self.street, frame)
        self.settle()
        self.judge(frame, truth)
        missing = [one for one in truth.wanted if not self.is_here(frame, truth, one)]
        for element in missing:
            self.draw(frame, truth, element, "left")
        self.settle()
        if missing:
            self.judge(frame, truth)
        for element in truth.wanted:
            if self.lacking(frame, truth, element) and not self.is_offered(frame, truth, element):
                self.draw(frame, truth, element, "right")
        self.key("Control+Enter")
        self.work.least += 1

    def judge(self, frame: int, truth: Truth) -> None:
        """Turns down what is sure but wrong, and accepts what is weak but right."""
        for offer in self.offers(frame):
            element = self.meant(offer, truth)
            if offer["sure"] and element is None:
                self.point_at(offer)
                self.key("x")
                self.work.counts["sure but wrong"] += 1
            elif not offer["sure"] and element is not None and self.lacking(frame, truth, element):
                self.point_at(offer)
                self.key(" ")
                self.work.counts["weak but right"] += 1

    def draw(self, frame: int, truth: Truth, element: int, side: Side) -> None:
        """With snapping where its preview is right, without where it isn't; then corrected."""
        self.work.thoughts += 1
        self.work.counts["drawn"] += 1
        before = self.work.inputs
        if truth.class_id[element] != self.class_id:
            self.class_id = truth.class_id[element]
            self.key(str(self.class_id + 1))
        marks = truth.marks[element][side]
        if element not in self.drawn:  # its clicks, and the key of its class
            self.drawn.add(element)
            self.work.least += self.work.inputs - before + int(np.isfinite(marks).sum() / 2)
        self.click(side, marks[0])
        if np.isfinite(marks[1]).all():
            peak_known, bottom_known = truth.known[element][side]
            if not peak_known and not self.is_at_border(marks[0]):  # there the page knows
                self.key("c")
            self.hover(side, marks[1])
            if self.is_bottom_shown() != bottom_known and not self.is_at_border(marks[1]):
                self.key("o")
            self.click(side, marks[1], snapped=self.is_preview_right(truth, element, side))
        self.saved()
        self.correct(frame, truth, element, side)

    def is_at_border(self, pixel: np.ndarray) -> bool:
        camera = self.street.rig.left
        return bool(
            (pixel < 2.0).any() or (pixel > [camera.width - 3.0, camera.height - 3.0]).any()
        )

    def is_preview_right(self, truth: Truth, element: int, side: Side) -> bool:
        snapped = self.page.evaluate("semviz.state.look?.snapped ?? null")
        return snapped is None or truth.is_right(element, side, snapped["anchor"], snapped["end"])

    def is_bottom_shown(self) -> bool:
        """Whether the page takes the bottom under the pen for one that is seen."""
        said = "semviz.state.look?.snapped?.end_known ?? semviz.state.drawing.end_known"
        return bool(self.page.evaluate(said))

    def correct(self, frame: int, truth: Truth, element: int, side: Side) -> None:
        """Zooms in and drags the ends of what was just drawn to where they belong."""
        marks = truth.marks[element][side]
        rows = self.labels.in_frame(frame, side)
        if not rows:
            raise SystemExit(f"not drawn; the page says {self.page.text_content('#message')!r}")
        row = max(rows, key=lambda one: one.id)  # the newest
        if truth.is_right(element, side, row.anchor_px, row.end_px):
            return
        self.work.thoughts += 1
        self.work.counts["corrected"] += 1
        self.page.mouse.move(*self.on_screen(side, np.array(row.anchor_px)))
        self.wheel(-1)
        ends = [(row.anchor_px, marks[0])] + ([(row.end_px, marks[1])] if row.end_px else [])
        for drawn, true in ends:
            if np.hypot(*np.subtract(true, drawn)) > RIGHT_PX / 2.0:
                self.drag(side, np.array(drawn), true)
        self.whole()

    def point_at(self, offer: dict[str, Any]) -> None:
        """The pointer over a proposal, so that the keys are for it; where another is on top of it,
        a click on its row."""
        self.work.thoughts += 1
        self.work.points += 1
        side = "left" if "left" in offer else "right"
        mark = offer[side]
        ends = np.array([one for one in (mark["anchor"], mark["end"]) if one is not None])
        self.page.mouse.move(*self.on_screen(side, ends.mean(axis=0)))
        if self.page.evaluate("semviz.state.currentOffer?.id") != offer["id"]:
            shown = "({ elements, expected, nearby }) => [...elements, ...expected, ...nearby]"
            ids = self.page.evaluate(f"({shown})(semviz.state).map((one) => one.id)")
            self.page.locator("#elements .row").nth(ids.index(offer["id"])).click()
            self.work.clicks += 1

    # -- what there is

    def offers(self, frame: int) -> list[dict[str, Any]]:
        with self.annotator.lock:
            return self.annotator.session.frame(frame)["offers"]

    def meant(self, offer: dict[str, Any], truth: Truth) -> int | None:
        """The element that a proposal is right for; None where that is not the one it is of."""
        element = meant(offer, truth)
        for row in self.labels.of_element(offer["id"])[:1]:
            then = truth_of(self.street, row.frame_index)
            mark = row.side, row.anchor_px, row.end_px
            labelled = [one for one in then.marks if then.is_right(one, *mark)]
            return element if not labelled or element in labelled else None
        return element

    @property
    def labels(self) -> Labels:
        with self.annotator.lock:
            return self.annotator.session.labels

    def is_here(self, frame: int, truth: Truth, element: int) -> bool:
        """Labelled in one of the images, or about to be."""
        return self.is_offered(frame, truth, element) or (
            len(self.lacking(frame, truth, element)) < len(SIDES)
        )

    def is_offered(self, frame: int, truth: Truth, element: int) -> bool:
        """Proposed and sure: the key at the end takes it."""
        return any(one["sure"] and self.meant(one, truth) == element for one in self.offers(frame))

    def lacking(self, frame: int, truth: Truth, element: int) -> list[str]:
        """The images in which an element is to be seen and not labelled."""
        return [
            side
            for side in truth.marks[element]
            if not any(
                truth.is_right(element, side, row.anchor_px, row.end_px)
                for row in self.labels.in_frame(frame, side)
            )
        ]

    # -- hands

    def key(self, key: str) -> None:
        self.work.keys += 1
        self.work.pressed[key] += 1
        self.page.keyboard.press("Space" if key == " " else key)
        self.saved()

    def hover(self, side: Side, pixel: np.ndarray) -> None:
        """The pointer over a pixel, until the page says what is there."""
        self.page.mouse.move(*self.on_screen(side, pixel))
        self.page.wait_for_function("() => !semviz.looking.waiting")

    def click(self, side: Side, pixel: np.ndarray, snapped: bool = True) -> None:
        self.work.clicks += 1
        if not snapped:
            self.work.counts["snap off"] += 1
            self.key("m")
        self.page.keyboard.down("Shift")  # draws, even where something is
        self.page.mouse.click(*self.on_screen(side, pixel, self.hand))
        self.page.keyboard.up("Shift")
        if not snapped:
            self.key("m")

    def wheel(self, turns: int) -> None:
        """Zooms at the pointer, threefold a turn."""
        self.work.clicks += 1
        before = self.zoom()
        self.page.mouse.wheel(0, turns * np.log(3.0) / 0.002)
        while self.zoom() == before:
            self.page.wait_for_timeout(20)

    def whole(self) -> None:
        """Zooms out."""
        self.key("0")
        self.page.evaluate(
            "new Promise((done) => requestAnimationFrame(() => setTimeout(done, 50)))"
        )

    def zoom(self) -> str | None:
        return self.page.get_attribute("#left-image canvas.marks", "data-view")

    def drag(self, side: Side, start: np.ndarray, end: np.ndarray) -> None:
        self.work.clicks += 2
        self.page.mouse.move(*self.on_screen(side, start))
        self.page.mouse.down()
        self.page.mouse.move(*self.on_screen(side, end, self.hand), steps=4)
        self.page.mouse.up()
        self.saved()

    def on_screen(
        self, side: Side, pixel: np.ndarray, hand: np.random.Generator | None = None
    ) -> tuple[float, float]:
        """Where a pixel is; where ``hand`` hits that means it."""
        canvas = self.page.locator(f"#{side}-image canvas.marks")
        box = canvas.bounding_box()
        assert box is not None
        scale, x, y = map(float, (canvas.get_attribute("data-view") or "").split())
        u, v = (pixel + 0.5) * scale + [x, y]
        if hand is not None:
            u, v = np.array([u, v]) + hand.normal(0.0, TREMOR_CSS_PX, 2)
        return box["x"] + u, box["y"] + v

    def saved(self) -> None:
        self.page.wait_for_function("() => semviz.state.pending.length === 0")

    def settle(self) -> None:
        """Waits for the images, and until they were asked about everything that is proposed."""
        self.saved()
        self.page.wait_for_function(
            """() => {
                const { frame, labels } = semviz.state;
                const shown = [...document.querySelectorAll("canvas.marks")];
                return shown.every((one) => one.dataset.frame === String(frame))
                    && labels.frame.index === frame && !labels.frame.looking;
            }"""
        )


def truth_of(street: Street, frame: int) -> Truth:
    pose = street.frames[frame].T_map_camera
    assert pose is not None
    elements = street.truth_map.elements
    depths = pose.inverse().apply(elements.anchor_m)[:, 2]
    seen = {side: by_id(*street.labels(frame, side)) for side in SIDES}
    visible = sorted(seen["left"].keys() | seen["right"].keys())
    marks = {
        one: {side: seen[side][one][:2] for side in SIDES if one in seen[side]} for one in visible
    }
    known = {
        one: {side: seen[side][one][3] for side in SIDES if one in seen[side]} for one in visible
    }
    return Truth(
        marks,
        known,
        {one: (seen["left"].get(one) or seen["right"][one])[2] for one in visible},
        dict(zip(elements.id.tolist(), depths.tolist(), strict=True)),
        float(street.rig.left.K[0, 0]),
    )


Seen = tuple[np.ndarray, np.ndarray, int, tuple[bool, bool]]


def by_id(seen: Elements2D, ids: np.ndarray) -> dict[int, Seen]:
    """Anchor, end, class, and which ends are known."""
    known = zip(seen.anchor_known.tolist(), seen.end_known.tolist(), strict=True)
    rows = zip(seen.anchor_px, seen.end_px, seen.class_id.tolist(), known, strict=True)
    return dict(zip(ids.tolist(), rows, strict=True))


def meant(offer: dict[str, Any], truth: Truth) -> int | None:
    """The element that all marks of a proposal are right for."""
    sides = [side for side in SIDES if side in offer]
    for element in truth.marks:
        if truth.class_id[element] == offer["class"] and all(
            truth.is_right(element, side, offer[side]["anchor"], offer[side]["end"])
            and truth.are_ends_right(element, side, offer[side])
            for side in sides
        ):
            return element
    return None


def error_px(mark: tuple[Any, Any], truth: tuple[np.ndarray, np.ndarray]) -> float:
    """Of a sign's middle; across the true line at both ends of a pole, if they overlap at all."""
    anchor, end = truth
    if (mark[1] is None) != (not np.isfinite(end).all()):
        return float("inf")
    if mark[1] is None:
        return float(np.hypot(*np.subtract(mark[0], anchor)))
    along = end - anchor
    gaps = np.subtract([mark[0], mark[1]], anchor)
    shares = gaps @ along / (along @ along)
    if shares.max() < 0.2 or shares.min() > 0.8:
        return float("inf")
    across = gaps @ np.array([along[1], -along[0]]) / np.linalg.norm(along)
    return float(np.abs(across).max())


def flags_right(labels: Labels, street: Street) -> float:
    """Share of the poles' ends in labels that are rightly said to be seen or not."""
    right = []
    for row in labels.observations.values():
        if row.end_px is None:
            continue
        marks = list(by_id(*street.labels(row.frame_index, row.side)).values())
        gaps = [error_px((row.anchor_px, row.end_px), one[:2]) for one in marks]
        if min(gaps, default=np.inf) <= RIGHT_PX:
            known = marks[int(np.argmin(gaps))][3]
            right += [row.anchor_known == known[0], row.end_known == known[1]]
    return float(np.mean(right))


def errors_px(labels: Labels, street: Street) -> list[float]:
    """How far each label is from the nearest truth of its kind."""
    errors = []
    for row in labels.observations.values():
        marks = by_id(*street.labels(row.frame_index, row.side)).values()
        gaps = [error_px((row.anchor_px, row.end_px), one[:2]) for one in marks]
        errors.append(min(gaps, default=float("inf")))
    return errors


def simulated_proposals(workspace: Workspace, seed: int) -> None:
    """What a detector as good as the paper's would propose for both images of each frame."""
    street = workspace.street
    detector = SimulatedDetector(street, "paper", seed)
    found = [
        one
        for index in range(FRAMES)
        for side in SIDES
        for one in as_proposals(
            index, side, detector.detect(index, side).observed, street.rig.left, "simulated"
        )
    ]
    save_proposals(Proposals.of(found), workspace.proposals_path)


def run(
    seed: int, folder: Path, browser: Any, detector: str, model: str | None
) -> tuple[Work, list[float], float, str]:
    workspace = Workspace.create_street(folder / f"street-{seed}", seed, range(FRAMES))
    if detector == "simulated":
        simulated_proposals(workspace, seed)
    elif detector == "own":
        which = [] if model is None else ["--model", model]
        subprocess.run(["semviz", "detect", str(workspace.path), *which], check=True)
    annotator = Annotator(workspace, author="script")
    street = workspace.street
    try:
        with Door(annotator).running() as url:
            page = browser.new_page(viewport={"width": 1600, "height": 950})
            page.set_default_timeout(PATIENCE_MS)
            page.add_init_script("localStorage.setItem('semviz.tour', 'seen')")
            page.goto(url)
            page.wait_for_selector("#saved.saved")
            page.keyboard.press("f")  # the 3D pane: slow without a graphics card
            labeller = Labeller(page, annotator, street, seed)
            for frame in range(FRAMES):
                labeller.label(frame)
            said = page.get_attribute("#effort", "title")
            page.close()
        made = annotator.session.labels
        return labeller.work, errors_px(made, street), flags_right(made, street), said
    finally:
        annotator.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1001, 1002, 1003])
    parser.add_argument("--detector", choices=["none", "simulated", "own"], default="none")
    parser.add_argument("--model", help="of --detector own, as 'semviz detect' takes it")
    arguments = parser.parse_args()
    seeds = arguments.seeds
    inputs = labels = least = 0
    seconds = 0.0
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=CHROMIUM)
        for seed in seeds:
            work, errors, flags, said = run(
                seed, Path(folder), browser, arguments.detector, arguments.model
            )
            right = [one for one in errors if one <= RIGHT_PX]
            print(
                f"street {seed}: {len(errors)} observations in {FRAMES} frames, "
                f"{work.inputs / len(errors):.3f} inputs each ({work.keys} keys, {work.clicks} "
                f"clicks), {work.seconds:.0f} s; {len(right) / len(errors):.1%} within "
                f"{RIGHT_PX:g} px, median {np.median(right):.2f} px; {dict(work.counts)}"
            )
            print(f"  keys: {dict(work.pressed)}")
            print(
                f"  the first drawings and the frames' keys alone: {work.least / len(errors):.3f}; "
                f"ends rightly said to be seen or hidden: {flags:.1%}"
            )
            least += work.least
            print(f"  the page's own count since it was opened: {said}")
            inputs, labels = inputs + work.inputs, labels + len(errors)
            seconds += work.seconds
    pairs = labels / 2
    print(f"all: {inputs / labels:.3f} inputs per observation (goal 0.2); ", end="")
    print(f"the first drawings and the frames' keys alone {least / labels:.3f}")
    print(f"1,000 stereo observations: {seconds / pairs * 1000 / 60:.1f} min (goal 20)")
    print(BY_HAND)


if __name__ == "__main__":
    main()
