"""Labels through the page as a person would: by mouse and keys, but to a hundredth of a pixel."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from playwright.sync_api import Page

Side = Literal["left", "right"]
Pixel = tuple[float, float]

POLE, TRIANGULAR, RECTANGULAR, ROUNDED = range(4)
CLICK_SCALE = 12.0
"""CSS pixels to the image pixel before a click: it lands within 0.05 px even if rounded."""
ZOOM_PER_WHEEL = 0.002
"""Logarithm of the zoom by one unit of the wheel."""
RIM = 4.0
"""CSS pixels along the canvas's edge where the browser's rounding may miss it."""
WAIT_MS = 30_000
EMPTY_PAGE = "<!doctype html><title></title>"


@dataclass(frozen=True)
class View:
    """Where an image lies on the screen, in CSS pixels of the page."""

    scale: float
    x: float
    y: float
    """Of the image's top-left corner, which is pixel (-0.5, -0.5)."""

    def screen(self, pixel: Pixel) -> Pixel:
        return (
            self.x + (pixel[0] + 0.5) * self.scale,
            self.y + (pixel[1] + 0.5) * self.scale,
        )


class LabelDriver:
    """Drives the page of ``semviz annotate`` that a Playwright ``page`` shows.

    Every drawing waits until it is on disk. AssertionError tells what the page said if it is not.
    """

    def __init__(self, page: "Page") -> None:
        self.page = page

    def open(self, url: str, with_map: bool = False, with_snap: bool = False) -> None:
        """Goes to the address that the terminal printed, and waits for the first image.

        The 3D map is an empty page, and switched off, unless asked for: without a graphics card it
        slows all down. So is snapping: what is clicked is what is meant.
        """
        if not with_map:
            self.page.route("**/view/**", lambda route: route.fulfill(body=EMPTY_PAGE))
        self.page.goto(url)
        self.page.wait_for_selector("#saved.saved", timeout=WAIT_MS)
        if not with_map:
            self.page.keyboard.press("f")
        if not with_snap:
            self.page.keyboard.press("m")
        self._wait_for_images(self.frame)

    @property
    def frame(self) -> int:
        """Number of the frame on screen."""
        return int(self.page.get_attribute(".tile.current", "data-frame", timeout=WAIT_MS) or "")

    @property
    def operation(self) -> int:
        """The last operation that the page calls saved."""
        text = self.page.inner_text("#saved")
        digits = "".join(filter(str.isdigit, text))
        return int(digits) if text.startswith("Saved") else -1

    @property
    def selected(self) -> str:
        """Name of the selected element, such as ``P-04``; empty if none is."""
        rows = self.page.locator("#elements .row.chosen .fill")
        return rows.first.inner_text() if rows.count() else ""

    def goto(self, frame: int) -> None:
        """Shows a frame, by its picture at the bottom."""
        if self.frame != frame:
            self.page.click(f'.tile[data-frame="{frame}"]')
            self.page.wait_for_selector(f'.tile.current[data-frame="{frame}"]', timeout=WAIT_MS)
        self._wait_for_images(frame)

    def is_listed(self, name: str) -> bool:
        """Whether an element is labelled or expected in this frame."""
        return self.page.locator(f'#elements .row:has(.fill:text-is("{name}"))').count() > 0

    def select(self, name: str) -> None:
        """Selects an element that is labelled or expected in this frame, by its name."""
        self.page.click(f'#elements .row:has(.fill:text-is("{name}"))')
        self.settle()

    def clear_selection(self) -> None:
        self.page.keyboard.press("Escape")
        self.settle()

    def draw_pole(
        self,
        side: Side,
        peak: Pixel,
        bottom: Pixel,
        element: str | None = None,
        peak_known: bool = True,
        bottom_known: bool = True,
    ) -> str:
        """Draws a pole, of ``element`` if given; returns the name of the element it became.

        Without ``element`` the page decides: an expected element nearby, or a new one.
        """
        before = self._begin(POLE, element)
        self._click(side, peak, shift=True)
        for key, known in (("c", peak_known), ("o", bottom_known)):
            if not known:
                self.page.keyboard.press(key)
        self._click(side, bottom)
        return self._saved(before, element)

    def draw_sign(
        self, side: Side, middle: Pixel, class_id: int, element: str | None = None
    ) -> str:
        """Draws a sign by its middle; otherwise like ``draw_pole``."""
        before = self._begin(class_id, element)
        self._click(side, middle, shift=True)
        return self._saved(before, element)

    def draw_pair(
        self,
        class_id: int,
        left: tuple[Pixel, Pixel | None],
        right: tuple[Pixel, Pixel | None],
        element: str | None = None,
    ) -> str:
        """Draws an element in both images, (peak, bottom) or (middle, None); returns its name."""
        name = element
        sides: tuple[tuple[Side, tuple[Pixel, Pixel | None]], ...] = (
            ("left", left),
            ("right", right),
        )
        for side, (anchor, end) in sides:
            if end is None:
                name = self.draw_sign(side, anchor, class_id, name)
            else:
                name = self.draw_pole(side, anchor, end, name)
        assert name is not None
        return name

    def press(self, key: str) -> None:
        """A key that saves nothing, such as ``0`` or ``Control+Shift+Z``'s parts."""
        self.page.keyboard.press(key)
        self.settle()

    def press_and_save(self, key: str) -> None:
        """A key that edits, such as ``Delete``, ``Enter`` or ``Control+z``."""
        before = self.operation
        self.page.keyboard.press(key)
        self.wait_saved(before)

    def wait_saved(self, before: int) -> None:
        """Waits until an operation after number ``before`` is on disk and nothing is on its way."""
        reached = """before => {
            const node = document.getElementById("saved");
            return node.classList.contains("saved")
                && Number(node.textContent.replace(/\\D/g, "")) > before
                && semviz.state.pending.length === 0;
        }"""
        try:
            self.page.wait_for_function(reached, arg=before, timeout=WAIT_MS)
        except Exception:
            said = self.page.text_content("#message") or ""
            shown = self.page.inner_text("#saved")
            raise AssertionError(f"not saved; the page says {said!r} and shows {shown!r}") from None
        self.settle()

    # -- zoom and clicks

    def view(self, side: Side) -> View:
        """Where the image of ``side`` lies now."""
        shown = self.page.get_attribute(f"#{side}-image canvas.marks", "data-view")
        scale, x, y = map(float, (shown or "").split())
        left, top, _, _ = self._box(side)
        return View(scale, left + x, top + y)

    def zoom_to(self, side: Side, pixel: Pixel, scale: float = CLICK_SCALE) -> None:
        """Zooms by the wheel with the pointer on ``pixel`` until ``scale`` is reached.

        What then lies at the rim of the canvas is dragged towards its middle.
        """
        self.press("0")
        whole = self.view(side)
        self.page.mouse.move(*self._inside(side, whole.screen(pixel)))
        factor = max(1.0, 1.01 * scale / whole.scale)
        self.page.mouse.wheel(0, -math.log(factor) / ZOOM_PER_WHEEL)
        zoomed = f"""scale => Number(document.querySelector("#{side}-image canvas.marks")
            .dataset.view.split(" ")[0]) >= scale"""
        self.page.wait_for_function(zoomed, arg=min(scale, factor * whole.scale), timeout=WAIT_MS)
        at = self.view(side).screen(pixel)
        if at != self._inside(side, at):
            self._drag_to_middle(side, at)

    def _drag_to_middle(self, side: Side, at: Pixel) -> None:
        box = self._box(side)
        middle = box[0] + box[2] / 2, box[1] + box[3] / 2
        start = self._inside(side, at)
        self.page.mouse.move(*start)
        self.page.mouse.down(button="right")
        for share in (0.5, 1.0):
            by = ((goal - now) * share for goal, now in zip(middle, at, strict=True))
            self.page.mouse.move(
                *(position + step for position, step in zip(start, by, strict=True))
            )
        self.page.mouse.up(button="right")
        self.settle()

    def _inside(self, side: Side, at: Pixel) -> Pixel:
        """The nearest place on the canvas that is not at its rim."""
        left, top, width, height = self._box(side)
        x = min(max(at[0], left + RIM), left + width - RIM)
        y = min(max(at[1], top + RIM), top + height - RIM)
        return x, y

    def _box(self, side: Side) -> tuple[float, float, float, float]:
        box = self.page.locator(f"#{side}-image canvas.marks").bounding_box()
        assert box is not None
        return box["x"], box["y"], box["width"], box["height"]

    def click_at(self, side: Side, pixel: Pixel) -> None:
        """A click on ``pixel`` at the zoom there is."""
        self.page.mouse.move(*self.view(side).screen(pixel))
        self.page.mouse.down()
        self.page.mouse.up()

    def settle(self) -> None:
        """Waits until the page has drawn what it knows."""
        self.page.evaluate(
            "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        )

    def _begin(self, class_id: int, element: str | None) -> int:
        if element is None:
            self.clear_selection()
        elif self.selected != element:
            self.select(element)
        self.page.keyboard.press(str(class_id + 1))
        return self.operation

    def _click(self, side: Side, pixel: Pixel, shift: bool = False) -> None:
        """Shift draws even where another element is."""
        self.zoom_to(side, pixel)
        if shift:
            self.page.keyboard.down("Shift")
        self.click_at(side, pixel)
        if shift:
            self.page.keyboard.up("Shift")

    def _saved(self, before: int, element: str | None) -> str:
        self.wait_saved(before)
        name = self.selected
        if element is not None and name != element:
            said = self.page.text_content("#message")
            raise AssertionError(f"drawn for {element} but became {name or 'nothing'}: {said}")
        self.press("0")
        return name

    def _wait_for_images(self, frame: int) -> None:
        shown = """frame => ["left", "right"].every(side => {
            const canvas = document.querySelector(`#${side}-image canvas.marks`);
            return canvas.dataset.frame === String(frame) && canvas.dataset.view;
        })"""
        self.page.wait_for_function(shown, arg=frame, timeout=WAIT_MS)
        labels = "() => semviz.state.shownFrame || !semviz.state.connected"
        self.page.wait_for_function(labels, timeout=WAIT_MS)
        self.settle()
