"""A drive of ten frames is labelled by keys alone: drawn, accepted, corrected, reviewed."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import SIDES, Served, annotating, settled
from journeys.driver import LabelDriver
from streets import street, street_workspace

from semviz_core.base.elements import Elements2D

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser
FRAMES, NEAR_M, RIGHT_PX = 10, 40.0, 3.0
WAIT_MS = 60_000


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with annotating(street_workspace(tmp_path / "street", 7, FRAMES)) as served:
        yield served


def seen(frame: int, side: str) -> dict[int, tuple[int, np.ndarray, np.ndarray]]:
    """Class, anchor and end by element."""
    drive = street(7, FRAMES)
    marks, ids = drive.labels(frame, "left" if side == "left" else "right")
    return {
        number: (int(marks.class_id[row]), marks.anchor_px[row], marks.end_px[row])
        for row, number in enumerate(ids.tolist())
    }


def wanted() -> list[int]:
    """Two poles and two signs, wholly in view in the first frame and still ahead in the last."""
    drive = street(7, FRAMES)
    both: Elements2D
    both, ids = drive.labels(0, "left")
    elements = drive.truth_map.elements
    away = np.linalg.norm(elements.anchor_m - drive.view(0, "left").center_m, axis=1)
    near = set(elements.id[(away > 12.0) & (away < NEAR_M)].tolist())
    whole = both.anchor_known & (both.end_known | ~both.is_line)
    last = {side: seen(FRAMES - 1, side) for side in SIDES}
    found = [
        (int(both.class_id[row]) > 0, number)
        for row, number in enumerate(ids.tolist())
        if whole[row] and number in near and all(number in last[side] for side in SIDES)
    ]
    return [
        number
        for is_sign in (False, True)
        for _, number in [one for one in found if one[0] is is_sign][:2]
    ]


class Keyboard:
    """Uses the page by keys alone."""

    def __init__(self, page: "Page") -> None:
        self.page = page

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)

    def ready(self) -> None:
        """Until all is saved and the images of the frame are searched."""
        settled(self.page)
        self.page.wait_for_function(
            "() => semviz.state.shownFrame && !semviz.state.shownFrame.is_searching",
            timeout=WAIT_MS,
        )

    def cursor_to(self, pixel: np.ndarray) -> None:
        """Tens of pixels with Shift, then single ones."""
        u, v = self.page.evaluate("semviz.state.cursor.pixel")
        for by, keys in ((pixel[0] - u, ("Left", "Right")), (pixel[1] - v, ("Up", "Down"))):
            key = f"Arrow{keys[int(by > 0)]}"
            tens, ones = divmod(round(abs(by)), 10)
            self.press(*[f"Shift+{key}"] * tens, *[key] * ones)

    def draw(self, class_id: int, anchor: np.ndarray, end: np.ndarray) -> None:
        """A sign's middle; a whole pole by one point where it is shown, else peak and bottom."""
        self.press(f"Digit{class_id + 1}", "+")
        is_pole = bool(np.isfinite(end).all())
        self.cursor_to(anchor + 0.6 * (end - anchor) if is_pole else anchor)
        self.page.wait_for_function("() => !semviz.tools.ghosts.isBusy", timeout=WAIT_MS)
        by_hand = is_pole and not self.is_shown(anchor, end)
        if by_hand:
            self.press("Shift+P")  # no whole poles: peak, then bottom
            self.cursor_to(anchor)
            self.press("+")
            self.cursor_to(end)
        self.press("+", *["Shift+P"] * by_hand, "Escape", "Escape")  # no cursor, no selection
        settled(self.page)

    def is_shown(self, anchor: np.ndarray, end: np.ndarray) -> bool:
        """Whether the page shows this whole pole under the cursor."""
        ghost = self.page.evaluate("semviz.state.ghost")
        return ghost is not None and bool(
            np.abs(np.subtract([ghost["anchor"], ghost["end"]], [anchor, end])).max() < RIGHT_PX
        )

    def accept_and_go_on(self) -> None:
        self.ready()
        self.press("Control+Shift+Enter")

    def accept_strip(self) -> None:
        """What does not fit on the screen is looked at by further presses."""
        self.page.wait_for_function(
            "() => semviz.state.view === 'filmstrip' && semviz.filmstrip.found.size"
            " && !semviz.filmstrip.isSearching",
            timeout=WAIT_MS,
        )
        while self.page.evaluate("semviz.state.view") == "filmstrip":
            self.press("Control+Shift+Enter")
        settled(self.page)


def test_ten_frames_are_labelled_and_reviewed_without_a_mouse(served: Served, page: "Page") -> None:
    page.add_init_script("addEventListener('pointerdown', () => { window.pointed = true; }, true)")
    page.set_viewport_size({"width": 1280, "height": 720})
    LabelDriver(page).open(served.url, with_snap=True)
    keyboard, chosen = Keyboard(page), wanted()
    assert len(chosen) >= 3
    page.keyboard.press("Escape")  # the tour
    keyboard.press("Shift+E")  # key frames
    for number in chosen:
        keyboard.draw(*seen(0, "left")[number])
    keyboard.accept_and_go_on()
    for _ in range(2):  # frame 5 and the strip before it, then the last frame
        keyboard.accept_and_go_on()
        keyboard.accept_strip()
    keyboard.press("Control+g")
    page.keyboard.type("0")
    keyboard.press("Enter")
    for frame in range(FRAMES):  # a look at each, and what the strip does not mark is marked
        page.wait_for_function(f"() => semviz.state.frame === {frame}")
        keyboard.ready()
        if not served.labels.review(frame).startswith("reviewed"):
            keyboard.press("Enter")
            settled(page)
        said = page.evaluate("[document.activeElement.outerHTML, semviz.state.view]")
        assert served.labels.review(frame) == "reviewed", (page.inner_text("#message"), said)
        keyboard.press(".")
    page.wait_for_selector(f"#reviewed:has-text('{FRAMES} / {FRAMES}')")

    labels = served.labels
    assert len(labels.elements) == len(chosen)
    frames = {row.frame_index for row in labels.observations.values()}
    assert frames == set(range(FRAMES))
    errors = []
    for row in (row for row in labels.observations.values() if row.anchor_known):
        class_id = labels.element(row.element_id).class_id
        true = [one for one in seen(row.frame_index, row.side).values() if one[0] == class_id]
        errors.append(min(np.hypot(*np.subtract(row.anchor_px, anchor)) for _, anchor, _ in true))
    assert len(errors) > FRAMES * len(chosen)
    assert np.mean(np.array(errors) < RIGHT_PX) > 0.9

    keyboard.press("Tab")  # one is selected, nudged, and put back
    before = {row.id: row.anchor_px for row in served.observations}
    keyboard.press("ArrowRight")
    settled(page)
    moved = [row for row in served.observations if row.anchor_px != before[row.id]]
    assert len(moved) == 1
    keyboard.press("Control+z")
    settled(page)
    assert {row.id: row.anchor_px for row in served.observations} == before
    assert not page.evaluate("Boolean(window.pointed)")
