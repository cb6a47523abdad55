"""The hand of the scripted annotator: its inputs to the page, how far it misses, what they cost."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from playwright.sync_api import Page

from semviz_core.base.frame import Side

TREMOR_CSS_PX = 1.5
MARGIN_CSS_PX = 8.0
KEY_S, CLICK_S, POINT_S, THINK_S = 0.28, 0.2, 1.1, 1.35
FRAME, FIRST, STRIP = "a frame's key", "drawn first", "a filmstrip's key"
STEPS = (FRAME, FIRST, STRIP)
"""Causes of inputs that no better proposal saves."""


@dataclass(frozen=True)
class Spent:
    """Inputs that one action cost."""

    cause: str
    inputs: int
    frame: int
    about: str
    """What it was, for people who look into it."""
    element: int | None = None
    """The element that it was for."""
    class_id: int | None = None
    """Of what it was for; None for a whole frame."""


@dataclass
class Work:
    """What the annotator did."""

    keys: int = 0
    clicks: int = 0
    points: int = 0
    """At something, for a key."""
    thoughts: int = 0
    spent: list[Spent] = field(default_factory=list)
    pressed: Counter[str] = field(default_factory=Counter)
    sightings: list[tuple[int, int]] = field(default_factory=list)
    """Frame and element of what was to be labelled, or was labelled all the same."""

    @property
    def inputs(self) -> int:
        return self.keys + self.clicks

    @property
    def least(self) -> int:
        """Inputs if all went well but for the first drawing of each element: the floor."""
        return sum(step.inputs for step in self.spent if step.cause in STEPS)

    @property
    def seconds(self) -> float:
        moves = (self.clicks + self.points) * POINT_S
        return self.keys * KEY_S + self.clicks * CLICK_S + moves + self.thoughts * THINK_S

    def is_first(self, step: Spent) -> bool:
        """Whether inputs were for the first sighting of an element, in either image."""
        return step.element is not None and self.firsts.get(step.element) == step.frame

    @property
    def firsts(self) -> dict[int, int]:
        """The frame of each element's first sighting."""
        return {element: frame for frame, element in reversed(self.sightings)}

    def inputs_by_sighting(self) -> tuple[float, float]:
        """Return inputs for each element's first sighting, and for each later one, which bear all
        that is for no single element."""
        first = sum(step.inputs for step in self.spent if self.is_first(step))
        later, firsts = self.inputs - first, len(self.firsts)
        return first / max(firsts, 1), later / max(len(self.sightings) - firsts, 1)

    @contextmanager
    def on(
        self,
        cause: str,
        frame: int,
        about: str = "",
        element: int | None = None,
        class_id: int | None = None,
    ) -> Iterator[None]:
        """What is done within it is for ``cause``, but for what has a cause of its own there."""
        before = self.inputs - sum(step.inputs for step in self.spent)
        yield
        inputs = self.inputs - sum(step.inputs for step in self.spent) - before
        self.spent.append(Spent(cause, inputs, frame, about, element, class_id))


class Hand:
    """Presses keys, and moves the mouse, which trembles."""

    def __init__(self, page: Page, seed: int, tremor_css_px: float) -> None:
        self.page = page
        self.tremor_css_px = tremor_css_px
        self.hand = np.random.default_rng(seed)
        self.work = Work()
        self.zoomed_for: tuple[int, int] | None = None
        """Frame and element that it zoomed in on, until it zooms out."""

    def key(self, key: str) -> None:
        self.work.keys += 1
        self.work.pressed[key] += 1
        self.page.keyboard.press("Space" if key == " " else key)
        self.saved()

    def hover(self, side: Side, pixel: np.ndarray) -> None:
        """The pointer over a pixel, until the page says what is there."""
        self.page.mouse.move(*self.on_screen(side, pixel))
        self.page.wait_for_function("() => !semviz.previews.isBusy")

    def click(self, side: Side, pixel: np.ndarray, snapped: bool = True) -> None:
        self.work.clicks += 1
        if not snapped:
            self.key("m")
        self.page.keyboard.down("Shift")  # draws, even where something is
        self.page.mouse.click(*self.on_screen(side, pixel, trembles=True))
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
        frame, element = self.zoomed_for or (-1, None)
        self.zoomed_for = None
        with self.work.on("zooming out", frame, element=element):
            self.key("0")
        self.page.evaluate(
            "new Promise((done) => requestAnimationFrame(() => setTimeout(done, 50)))"
        )

    def zoom(self) -> str | None:
        return self.page.get_attribute("#left-image canvas.marks", "data-view")

    def is_in_view(self, side: Side, pixels: np.ndarray) -> bool:
        box = self.page.locator(f"#{side}-image canvas.marks").bounding_box()
        assert box is not None
        places = np.array([self.on_screen(side, pixel) for pixel in pixels]) - [box["x"], box["y"]]
        most = np.array([box["width"], box["height"]]) - MARGIN_CSS_PX
        return bool((places > MARGIN_CSS_PX).all() and (places < most).all())

    def drag(self, side: Side, start: np.ndarray, end: np.ndarray) -> None:
        self.work.clicks += 2
        self.page.mouse.move(*self.on_screen(side, start))
        self.page.mouse.down()
        self.page.mouse.move(*self.on_screen(side, end, trembles=True), steps=4)
        self.page.mouse.up()
        self.saved()

    def tremor(self) -> np.ndarray:
        """How far a hand misses, CSS px."""
        return self.hand.normal(0.0, self.tremor_css_px, 2)

    def on_screen(
        self, side: Side, pixel: np.ndarray, trembles: bool = False
    ) -> tuple[float, float]:
        """Where a pixel is; or where a hand hits that means it."""
        canvas = self.page.locator(f"#{side}-image canvas.marks")
        box = canvas.bounding_box()
        assert box is not None
        scale, x, y = map(float, (canvas.get_attribute("data-view") or "").split())
        u, v = (pixel + 0.5) * scale + [x, y]
        if trembles:
            u, v = np.array([u, v]) + self.tremor()
        return box["x"] + u, box["y"] + v

    def saved(self) -> None:
        self.page.wait_for_function("() => semviz.state.pending.length === 0")

    def settle(self) -> None:
        """Waits until the images were asked about all that is proposed."""
        self.saved()
        self.page.wait_for_function(
            """() => {
                const { frame, labels } = semviz.state;
                const shown = [...document.querySelectorAll("canvas.marks")];
                return shown.every((one) => one.dataset.frame === String(frame))
                    && labels.frame.index === frame && !labels.frame.is_searching;
            }"""
        )
