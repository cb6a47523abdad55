"""G6: addresses of both pages opened in Chromium: the final address, and the state of the server.

A page rewrites its address from all that it shows, so the final address is what it understood. The
messages between page and server do not matter here. Most addresses are followed as by the browser's
back and forward buttons, the first ones by loading the page.
"""

import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import urlopen

import numpy as np
from serving import at

from golden import workspaces
from golden.canonical import sha
from golden.command import run
from golden.files import FIXTURES, unpacked
from semviz import Workspace
from semviz.annotator.server import Annotator
from semviz.inspector.server import Inspector
from semviz.web.gateway import Gateway

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

COUNT, LOADED, PAGES = 500, 20, 4
STILL_S, LIMIT_S = 1.0, 60.0
"""Address and state are final if they did not change for STILL_S."""
CHOICES: dict[str, tuple[str, ...]] = {
    "run": ("search", "learned", "gone"),
    "frame": ("0", "4", "8", "20", "3", "x"),
    "image": ("estimate", "truth", "pairs", "error", "upside down"),
    "side": ("left", "right", "up"),
    "around": ("yes", "no", "perhaps"),
    "residuals": ("yes", "no"),
    "element": ("3", "4", "5", "7", "9", "12", "x"),
    "seen": ("0", "2", "5", "-1"),
    "list": ("frames", "elements", "map", "none"),
    "card": ("why", "selected", "solver", "what-if", "none"),
    "log": ("yes", "no"),
    "view": ("behind", "above", "camera", "sideways"),
    "colors": ("class", "residual", "times", "taste"),
    "sigma": ("yes", "no"),
    "others": ("yes", "no"),
    "base": ("search", "learned", "gone"),
    "beside": ("yes", "no"),
    "forecast": ("no", "maybe"),
    "status": ("ok", "ambiguous", "cannot", "fine"),
    "only": ("4", "5", "x"),
    "sort": ("out", "px", "cost", "name", "taste"),
    "class": ("pole", "rounded sign", "tree"),
    "stranger": ("<b>",),
}
"""``forecast`` is not turned on: its computation takes minutes."""
LABELLED = ("", "frame=5", "frame=23", "frame=99", "frame=x", "frame=7&element=P-03", "element=no")
PICTURES = ("image/0/left.png", "image/23/right.png", "image/99/left.png", "image/0/up.png")
FOLLOW = """query => {
  history.pushState(null, "", "?" + query);
  dispatchEvent(new PopStateEvent("popstate"));
}"""


def golden_values(folder: Path) -> dict[str, Any]:
    """Return the final address, and the values of the server's state, by address."""
    from playwright.sync_api import sync_playwright

    runs = _recorded(folder)
    with sync_playwright() as playwright:
        system = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=system, args=["--no-sandbox"])
        found = _inspected(browser, runs) | _annotated(browser, folder / "town")
        browser.close()
    return found


def queries() -> Iterator[str]:
    """Yield COUNT addresses; most name a run and a frame, and a few other settings."""
    rng = np.random.default_rng(0)
    for _ in range(COUNT):
        parameters = {}
        for name, texts in CHOICES.items():
            if rng.random() < (0.7 if name in ("run", "frame") else 0.2):
                parameters[name] = texts[rng.integers(len(texts))]
        yield urlencode(parameters)


def _recorded(folder: Path) -> list[Path]:
    """Two short runs through the workspace town."""
    workspaces.make(folder, "town")
    shutil.copy(unpacked(FIXTURES / "main.parquet.gz", folder), folder / "town" / "maps")
    paths = [folder / f"{method}.rrd" for method in ("search", "learned")]
    for path in paths:
        options = ("--frames", "0:24:4", "--images", "none", "--method", path.stem)
        run(folder, "localize", "town", "--out", path, *options)
    return paths


def _inspected(browser: "Browser", runs: list[Path]) -> dict[str, Any]:
    asked = list(queries())
    found: dict[str, Any] = {}
    with ExitStack() as stack:
        opened = [_Opened(browser, Inspector(runs), stack) for _ in range(PAGES)]
        for first in range(0, COUNT, PAGES):
            some = asked[first : first + PAGES]
            for query, page in zip(some, opened, strict=False):
                page.go(query, load=first < LOADED)
            for query, page in zip(some, opened, strict=False):
                found[f"{first:03} serve ?{query}"] = page.settled()
    return found


class _Opened:
    """A page, and the tool behind it that nobody else uses."""

    def __init__(self, browser: "Browser", tool: Inspector, stack: ExitStack) -> None:
        self._tool = tool
        self._url = stack.enter_context(Gateway(tool).running())
        self._page = _page(browser)

    def go(self, query: str, *, load: bool) -> None:
        if load:
            self._page.goto(at(self._url, f"?{query}"))
            self._page.wait_for_selector("#frame-list li", state="attached", timeout=LIMIT_S * 1e3)
        else:
            self._page.evaluate(FOLLOW, query)

    def settled(self) -> list[Any]:
        return _settled(lambda: [_query(self._page), self._state()])

    def _state(self) -> Any:
        """The values, in their order, of the session that was opened last."""
        *_, last = _states(self._tool, 7)
        return _values(last)


def _values(value: Any) -> Any:
    return (
        [_values(getattr(value, field.name)) for field in fields(value)]
        if is_dataclass(value)
        else value
    )


def _states(value: Any, depth: int) -> Iterator[Any]:
    """What sessions show: values with a position and a selection, wherever they are kept."""
    if is_dataclass(value) and {"position", "selection"} <= {field.name for field in fields(value)}:
        yield value
    elif depth:
        for inner in _inside(value):
            yield from _states(inner, depth - 1)


def _inside(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return list(value.values())
    is_ours = type(value).__module__.startswith("semviz.")
    return list(vars(value).values()) if is_ours and hasattr(value, "__dict__") else []


def _annotated(browser: "Browser", workspace: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    tool = Annotator(Workspace.open(workspace), author="golden")
    try:
        with Gateway(tool).running() as url:
            page = _page(browser)
            for query in LABELLED:
                page.goto(at(url, f"?{query}"))
                tile = page.locator(".tile.current")
                tile.wait_for()
                found[f"annotate ?{query}"] = _settled(
                    lambda tile=tile: [_query(page), tile.get_attribute("data-frame")]
                )
            for path in PICTURES:
                found[f"annotate {path}"] = _fetched(at(url, path))
    finally:
        tool.close()
    return found


def _page(browser: "Browser") -> "Page":
    """Without the 3D pane, which takes seconds to draw."""
    page = browser.new_context(viewport={"width": 1600, "height": 950}).new_page()
    page.route("**/view/**", lambda route: route.abort())
    return page


def _query(page: "Page") -> str:
    """Asked of the page itself; what Playwright knows of it may be old."""
    return str(page.evaluate("location.search"))


def _settled(look: Callable[[], Any]) -> Any:
    """What ``look`` sees once it stays the same; TimeoutError where it never does."""
    end, seen, since = time.monotonic() + LIMIT_S, object(), 0.0
    while time.monotonic() < end:
        with suppress(ValueError):  # there is no session yet
            now = look()
            if now != seen:
                seen, since = now, time.monotonic()
            elif time.monotonic() - since > STILL_S:
                return seen
        time.sleep(0.1)
    raise TimeoutError(f"still {seen}")


def _fetched(url: str) -> list[Any]:
    """Status and a hash of the body."""
    try:
        with urlopen(url) as answer:
            return [answer.status, sha(answer.read())]
    except HTTPError as error:
        return [error.code, ""]
