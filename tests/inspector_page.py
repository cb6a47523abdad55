"""The inspector's page on a short simulated run, and helpers of its tests."""

import io
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, cast
from urllib.parse import parse_qs, urlsplit

import numpy as np
from serving import at
from streets import street

from semviz.runs.run import FrameRecord, RunInfo
from semviz.runs.writer import RunWriter
from semviz_core.base.frame import Side
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localization.localizer import Localizer
from semviz_core.simulation.street import Street

if TYPE_CHECKING:
    from playwright.sync_api import Page

Spoil = Callable[[FrameRecord], FrameRecord]
BOTH: tuple[Side, ...] = ("left", "right")


def record_street(
    path: Path,
    indices: tuple[int, ...],
    sides: tuple[Side, ...] = ("left",),
    spoil: Spoil = lambda record: record,
) -> Path:
    """What is labelled in frames of a street, localized in the true map; images of ``sides``."""
    seven = street(7)
    info = RunInfo(path.stem, "", "search", 0, "0", "2026-01-01T00:00:00", seven.rig, "street")
    with RunWriter(path, info, seven.truth_map) as writer:
        for index in indices:
            writer.write(spoil(_record(seven, index, sides)))
    return path


def _record(street: Street, index: int, sides: tuple[Side, ...]) -> FrameRecord:
    frame = street.frames[index]
    observed, ids = street.labels(index, "left")
    assert frame.T_map_camera is not None
    prior = simulate_prior(frame.T_map_camera, PriorOptions((1.0, 2.0)), (0, index))
    submap = street.truth_map.crop(prior.position_m, 50.0)
    found = Localizer().localize(observed, submap, street.rig.left, prior)
    left, right = (_jpeg(street, index, side) if side in sides else None for side in BOTH)
    return FrameRecord(frame, found, ids, left, right)


def _jpeg(street: Street, index: int, side: Side) -> bytes:
    import cv2

    return cv2.imencode(".jpg", street.image(index, side)[:, :, ::-1])[1].tobytes()


FIRST = "frame=10"
"""The first frame of most tests' runs, which would else open at their worst one."""


def open_page(page: "Page", url: str, query: str = "") -> None:
    """Open an address, by default at frame 10, and wait for its first frame.

    The list of frames comes earlier, with the run. The rest of the address (tabs, selection) is
    applied with the first frame, and until then it would undo what a test clicks.
    """
    page.goto(at(url, f"?{query}" if "frame=" in query else f"?{FIRST}&{query}"))
    status = page.locator("#status")  # waiting in the page needs eval, which it forbids
    wait_for(page, lambda: bool(status.text_content()), "the first frame")
    page.wait_for_timeout(500)


def open_flat(page: "Page", url: str, query: str = "") -> None:
    """Without the 3D pane, which takes seconds to draw."""
    page.route("**/view/**", lambda route: route.abort())
    open_page(page, url, query)


def open_blank(page: "Page", url: str) -> None:
    """An empty page in the tool's place, from where its modules can be called."""
    blank = "<!doctype html><link rel=icon href=data:,>"
    page.route("**/blank*", lambda route: route.fulfill(body=blank, content_type="text/html"))
    page.request.get(url)  # the cookie: the blank page does not come from the server
    page.goto(at(url, "blank"))


def settle(page: "Page") -> None:
    """Until the page has drawn what it knows."""
    page.evaluate(
        "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )


def changed(page: "Page", selector: str, before: np.ndarray) -> float:
    """By how much an element looks different, on average, in shades of 255."""
    return float(np.abs(pixels(page, selector) - before).mean())


def wait_for(page: "Page", holds: Callable[[], bool], what: str, timeout_s: float = 60.0) -> None:
    """Wait until a condition holds; a busy machine may take seconds for a request."""
    deadline = time.monotonic() + timeout_s
    while not holds():
        if time.monotonic() > deadline:
            raise AssertionError(f"never came: {what}")
        page.wait_for_timeout(50)


def in_url(page: "Page", name: str) -> str | None:
    values: list[str | None] = [*parse_qs(urlsplit(page.url).query).get(name, []), None]
    return values[0]


def pixels(page: "Page", selector: str) -> np.ndarray:
    """(h, w, 3) what an element looks like."""
    return rgb_of(page.locator(selector).screenshot())


def rgb_of(picture: bytes) -> np.ndarray:
    """(h, w, 3) int, of a PNG file."""
    from PIL import Image

    with Image.open(io.BytesIO(picture)) as image:
        return cast(np.ndarray, np.array(image.convert("RGB")).astype(int))


def near(image: np.ndarray, color: str) -> int:
    """How many pixels look like ``color``."""
    wanted = [int(color[at : at + 2], 16) for at in (1, 3, 5)]
    return int((np.abs(image - wanted).max(axis=2) < 24).sum())
