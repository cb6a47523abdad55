"""How many inputs a label costs: a scripted annotator labels 8 frames of simulated streets.

    python bench/labelling.py

The script sees what a person would: the street's truth is its eye. It clicks with a hand that
trembles by 1.5 CSS pixels, at the zoom that shows the whole image, with snapping on. It accepts a
proposal where both marks are right, turns it down where one is not, and draws what nobody proposed:
every pole and sign up to 40 m ahead that is visible in both images. The page counts its inputs: a
key or a click is one, a drag two. At the end every label is held against the truth.

Times are those of the keystroke-level model (Card, Moran & Newell 1980) with its own constants, for
an average typist: a key 0.28 s, a click 0.2 s, pointing 1.1 s, and a thought of 1.35 s before each
drawing, before each correction and once a frame.
"""

import argparse
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
from semviz_annotation.labels import Labels
from semviz_core.elements import Elements2D
from semviz_core.sources.street.street import Street

CHROMIUM = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FRAMES = 8
REACH_M = 40.0
RIGHT_PX = 2.0
"""A mark this near to the truth is right: across a pole, to a sign's middle."""
TREMOR_CSS_PX = 1.5
KEY_S, CLICK_S, POINT_S, THINK_S = 0.28, 0.2, 1.1, 1.35
SIDES = ("left", "right")
RIVALS = """
Inputs for one pole in both images of a frame, counted in the tools' documentation:
  VIAME/DIVE, stereo line measurement: about 5 (two clicks in each image, and a key to link them)
  CVAT, labelme: 5 and more (class, two clicks in each image; left and right are not linked)
  semviz, both images by hand: 4; with the partner proposed: 3; followed: one key for all in a frame
"""


@dataclass
class Work:
    """What the annotator did."""

    keys: int = 0
    clicks: int = 0
    thoughts: int = 0
    counts: Counter[str] = field(default_factory=Counter)

    @property
    def inputs(self) -> int:
        return self.keys + self.clicks

    @property
    def seconds(self) -> float:
        moves = self.clicks * (CLICK_S + POINT_S)
        return self.keys * KEY_S + moves + self.thoughts * THINK_S


@dataclass(frozen=True)
class Truth:
    """What there is to label in a frame: marks by element, in both images."""

    marks: dict[int, dict[str, tuple[np.ndarray, np.ndarray]]]
    class_id: dict[int, int]
    depth_m: dict[int, float]


class Labeller:
    """Labels a street through the page."""

    def __init__(self, page: Page, annotator: Annotator, street: Street, seed: int) -> None:
        self.page = page
        self.annotator = annotator
        self.street = street
        self.hand = np.random.default_rng(seed)
        self.work = Work()
        self.class_id = 0

    def label(self, frame: int) -> None:
        """One frame: proposals first, then what is missing; then on to the next."""
        self.work.thoughts += 1
        truth = truth_of(self.street, frame)
        self.settle()
        self.judge(frame, truth)
        for element in sorted(truth.marks, key=lambda one: truth.depth_m[one]):
            if not self.is_here(frame, truth, element):
                self.draw(truth, element, "left")
        self.settle()
        self.judge(frame, truth)
        for element in truth.marks:
            if "right" in self.lacking(frame, truth, element):
                self.draw(truth, element, "right")
        self.key("Control+Enter")
        self.settle()

    def judge(self, frame: int, truth: Truth) -> None:
        """Accepts what is weak but right, and turns down what is sure but wrong."""
        for offer in self.offers(frame):
            element = meant(offer, truth)
            if offer["sure"] == (element is not None):
                continue
            if element is None or not self.lacking(frame, truth, element):
                if offer["sure"]:
                    self.pick(offer["id"])
                    self.key("x")
                    self.work.counts["sure but wrong"] += 1
                continue
            self.pick(offer["id"])
            self.key(" ")
            self.work.counts["weak but right"] += 1

    def draw(self, truth: Truth, element: int, side: str) -> None:
        self.work.thoughts += 1
        self.work.counts["drawn"] += 1
        if truth.class_id[element] != self.class_id:
            self.class_id = truth.class_id[element]
            self.key(str(self.class_id + 1))
        anchor, end = truth.marks[element][side]
        self.click(side, anchor)
        if np.isfinite(end).all():
            self.click(side, end)
        self.saved()

    def pick(self, element_id: str) -> None:
        """By the fewest keys that lead to a proposal."""
        self.work.thoughts += 1
        for _ in range(40):
            current = self.page.evaluate("semviz.state.currentOffer?.id ?? null")
            if current == element_id:
                return
            self.key("Tab")
        raise SystemExit(f"proposal {element_id} is not in the list")

    # -- what there is

    def offers(self, frame: int) -> list[dict[str, Any]]:
        with self.annotator.lock:
            return self.annotator.session.frame(frame)["offers"]

    @property
    def labels(self) -> Labels:
        with self.annotator.lock:
            return self.annotator.session.labels

    def is_here(self, frame: int, truth: Truth, element: int) -> bool:
        """Labelled, or about to be: proposed and sure."""
        offered = any(one["sure"] and meant(one, truth) == element for one in self.offers(frame))
        return offered or len(self.lacking(frame, truth, element)) < 2

    def lacking(self, frame: int, truth: Truth, element: int) -> list[str]:
        """The images in which an element is not labelled."""
        return [
            side
            for side in SIDES
            if not any(
                is_right((row.anchor_px, row.end_px), truth.marks[element][side])
                for row in self.labels.in_frame(frame, side)  # type: ignore[arg-type]
            )
        ]

    # -- hands

    def key(self, key: str) -> None:
        self.work.keys += 1
        self.page.keyboard.press("Space" if key == " " else key)
        self.saved()

    def click(self, side: str, pixel: np.ndarray) -> None:
        self.work.clicks += 1
        canvas = self.page.locator(f"#{side}-image canvas.marks")
        box = canvas.bounding_box()
        assert box is not None
        shown = canvas.get_attribute("data-view") or ""
        scale, x, y = map(float, shown.split())
        at = (pixel + 0.5) * scale + [x, y] + self.hand.normal(0.0, TREMOR_CSS_PX, 2)
        u, v = np.clip(at, 2.0, [box["width"] - 2.0, box["height"] - 2.0])
        self.page.keyboard.down("Shift")  # draws, even where something is
        self.page.mouse.click(box["x"] + u, box["y"] + v)
        self.page.keyboard.up("Shift")

    def saved(self) -> None:
        self.page.wait_for_function("() => semviz.state.pending.length === 0")

    def settle(self) -> None:
        """Waits until the images were asked about everything that is proposed."""
        self.saved()
        self.page.wait_for_function(
            "() => semviz.state.labels.frame.index === semviz.state.frame"
            " && semviz.state.offers.every((one) => one.score !== null)"
        )


def truth_of(street: Street, frame: int) -> Truth:
    """What is visible in both images and near enough."""
    pose = street.frames[frame].T_map_camera
    assert pose is not None
    elements = street.truth_map.elements
    depths = pose.inverse().apply(elements.anchor_m)[:, 2]
    depth_m = dict(zip(elements.id.tolist(), depths.tolist(), strict=True))
    seen = {side: by_id(*street.labels(frame, side)) for side in SIDES}  # type: ignore[arg-type]
    both = [one for one in seen["left"] if one in seen["right"] and depth_m[one] < REACH_M]
    marks = {one: {side: seen[side][one][:2] for side in SIDES} for one in both}
    return Truth(marks, {one: seen["left"][one][2] for one in both}, depth_m)


def by_id(seen: Elements2D, ids: np.ndarray) -> dict[int, tuple[np.ndarray, np.ndarray, int]]:
    rows = zip(seen.anchor_px, seen.end_px, seen.class_id.tolist(), strict=True)
    return dict(zip(ids.tolist(), rows, strict=True))


def meant(offer: dict[str, Any], truth: Truth) -> int | None:
    """The element that all marks of a proposal are right for."""
    for element, marks in truth.marks.items():
        sides = [side for side in SIDES if side in offer]
        if truth.class_id[element] == offer["class"] and all(
            is_right((offer[side]["anchor"], offer[side]["end"]), marks[side]) for side in sides
        ):
            return element
    return None


def is_right(mark: tuple[Any, Any], truth: tuple[np.ndarray, np.ndarray]) -> bool:
    return error_px(mark, truth) <= RIGHT_PX


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


def errors_px(labels: Labels, street: Street) -> list[float]:
    """How far each label is from the nearest truth of its kind."""
    errors = []
    for row in labels.observations.values():
        marks = by_id(*street.labels(row.frame_index, row.side)).values()
        gaps = [error_px((row.anchor_px, row.end_px), one[:2]) for one in marks]
        errors.append(min(gaps, default=float("inf")))
    return errors


def run(seed: int, folder: Path, browser: Any) -> tuple[Work, list[float], str]:
    workspace = Workspace.create_street(folder / f"street-{seed}", seed, range(FRAMES))
    annotator = Annotator(workspace, author="script")
    street = workspace.street
    try:
        with Door(annotator).running() as url:
            page = browser.new_page(viewport={"width": 1600, "height": 950})
            page.add_init_script("localStorage.setItem('semviz.tour', 'seen')")
            page.goto(url)
            page.wait_for_selector("#saved.saved")
            page.keyboard.press("f")  # the 3D pane: slow without a graphics card
            labeller = Labeller(page, annotator, street, seed)
            for frame in range(FRAMES):
                labeller.label(frame)
            said = page.get_attribute("#effort", "title")
            page.close()
        return labeller.work, errors_px(annotator.session.labels, street), said
    finally:
        annotator.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1001, 1002, 1003])
    seeds = parser.parse_args().seeds
    inputs = labels = 0
    seconds = 0.0
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=CHROMIUM)
        for seed in seeds:
            work, errors, said = run(seed, Path(folder), browser)
            right = [one for one in errors if one <= RIGHT_PX]
            print(
                f"street {seed}: {len(errors)} observations in {FRAMES} frames, "
                f"{work.inputs / len(errors):.3f} inputs each ({work.keys} keys, {work.clicks} "
                f"clicks), {work.seconds:.0f} s; {len(right) / len(errors):.1%} within "
                f"{RIGHT_PX:g} px, median {np.median(right):.2f} px; {dict(work.counts)}"
            )
            print(f"  the page's own count since it was opened: {said}")
            inputs, labels = inputs + work.inputs, labels + len(errors)
            seconds += work.seconds
    pairs = labels / 2
    print(f"all: {inputs / labels:.3f} inputs per observation (goal 0.2)")
    print(f"1,000 stereo observations: {seconds / pairs * 1000 / 60:.1f} min (goal 20)")
    print(RIVALS)


if __name__ == "__main__":
    main()
