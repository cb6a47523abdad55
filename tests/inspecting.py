"""The inspector's page on a short run through the simulated street, and what tests ask of it."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, cast
from urllib.parse import parse_qs, urlsplit

import numpy as np

from semviz.recording.run import FrameRecord, RunInfo
from semviz.recording.writer import RunWriter
from semviz_core.localize import Localizer
from semviz_core.sources.priors import PriorOptions, simulate_prior
from semviz_core.sources.source import Side
from semviz_core.sources.street.street import Street

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
    street = Street(7)
    info = RunInfo(path.stem, "", "search", 0, "0", "2026-01-01T00:00:00", street.rig, "street")
    with RunWriter(path, info, street.truth_map) as writer:
        for index in indices:
            writer.write(spoil(_record(street, index, sides)))
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


def open_page(page: "Page", url: str, query: str = "") -> None:
    page.goto(f"{url}?{query}")
    page.wait_for_selector("#frame-list li")
    number = page.locator("#frame-number")  # waiting in the page needs eval, which it forbids
    wait_for(page, lambda: bool(number.text_content()), "the first frame")
    page.wait_for_timeout(500)


def open_flat(page: "Page", url: str, query: str = "") -> None:
    """Without the 3D pane, which takes seconds to draw."""
    page.route("**/view/**", lambda route: route.abort())
    open_page(page, url, query)


def open_blank(page: "Page", url: str) -> None:
    """An empty page in the tool's place, from where its modules can be called."""
    blank = "<!doctype html><link rel=icon href=data:,>"
    page.route("**/blank", lambda route: route.fulfill(body=blank, content_type="text/html"))
    page.goto(f"{url}blank")


def wait_for(page: "Page", said: Callable[[], bool], what: str, timeout_s: float = 20.0) -> None:
    for _ in range(int(timeout_s * 20)):
        if said():
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"never came: {what}")


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
