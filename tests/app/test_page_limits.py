"""Many pages: a client's number of them is capped, and closed ones leave nothing behind."""

import asyncio
import gc
import threading
import time
import tracemalloc
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import psutil
import pytest
from annotator_page import annotating
from echo_tool import EchoTool, ask, finished
from numpy.typing import NDArray
from serving import at

from semviz.annotator.server import Annotator
from semviz.web import sessions
from semviz.web import tool as web_tool
from semviz.web.gateway import Gateway
from semviz.workspace.workspace import Workspace

VISER = (f"viser-v{version('viser')}",)
PAGES = 100
AT_ONCE = 4
MEMORY = 0.75 * 2**20
"""What 100 pages may leave, bytes: caches of addresses and cookies. One viser server has 1 MB."""
RSS = 12 * 2**20


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace.create_street(tmp_path / "street", 5, range(4))


def wait_until(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not holds() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert holds()


async def visit(http: aiohttp.ClientSession, url: str) -> None:
    """A page with its 3D scene, opened and closed."""
    async with http.ws_connect(at(url, "socket"), max_msg_size=0) as page:
        hello = await page.receive_json(timeout=60)
        kind = ""
        while kind != "scene":
            kind = (await page.receive_json(timeout=60))["type"]
        view = at(url, f"view/{hello['session']}")
        async with http.ws_connect(view, protocols=VISER, max_msg_size=0) as scene:
            await scene.receive(timeout=60)


async def visit_often(url: str, count: int) -> None:
    async with aiohttp.ClientSession() as http:
        for _ in range(count // AT_ONCE):
            await asyncio.gather(*[visit(http, url) for _ in range(AT_ONCE)])


def threads() -> int:
    """Without those of asyncio's pool, which starts its six when it needs them."""
    return sum(not thread.name.startswith("asyncio_") for thread in threading.enumerate())


def leftovers(tool: Annotator, threads_before: int) -> NDArray[np.int64]:
    """Bytes that Python allocated, and those of the process, once pages and threads have ended."""
    wait_until(lambda: tool.pages == () and tool.scenes.count == 0)
    tool.scene_thread.submit(lambda: None).result()
    wait_until(lambda: threads() <= threads_before)  # a stopped server may still be ending
    gc.collect()
    return np.array([tracemalloc.get_traced_memory()[0], psutil.Process().memory_info().rss])


@pytest.mark.timeout(600)
def test_a_hundred_pages_leave_nothing(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two hundreds, the one that leaves less: what is made once and kept is no leak."""
    monkeypatch.setattr(sessions, "LINGER_S", 0.1)
    tracemalloc.start()
    try:
        with annotating(workspace) as served:
            finished(visit_often(served.url, 40))  # caches fill
            wait_until(lambda: served.annotator.scenes.count == 0)
            threads_before = threads()
            left = [leftovers(served.annotator, threads_before)]
            for _ in range(2):
                finished(visit_often(served.url, PAGES))
                left.append(leftovers(served.annotator, threads_before))
    finally:
        tracemalloc.stop()
    assert (np.diff(left, axis=0).min(axis=0) < (MEMORY, RSS)).all(), left


def test_a_client_has_a_limited_number_of_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """One more is refused in words; one that waits for its page gives way at once."""
    monkeypatch.setattr(sessions, "MAX_PAGES", 3)
    tool = EchoTool()

    async def open_page(http: aiohttp.ClientSession, url: str) -> Any:
        page = await http.ws_connect(at(url, "socket"))
        return page, await page.receive_json(timeout=20)

    async def talk(url: str) -> None:
        async with aiohttp.ClientSession() as http:
            pages = [(await open_page(http, url))[0] for _ in range(3)]
            refused, message = await open_page(http, url)
            assert (message["type"], message["code"]) == ("error", "busy")
            assert message["text"] == "3 pages are open already; close one, and this one opens"
            assert (await refused.receive(timeout=20)).type is aiohttp.WSMsgType.CLOSE
            assert refused.close_code == 1013
            await pages[0].close()
            await asyncio.sleep(0.3)
            another, message = await open_page(http, url)
            assert message["type"] == "hello"
            for page in (*pages[1:], another):
                await page.close()

    with Gateway(tool).running() as url:
        finished(talk(url))
    assert len(tool.made) == 4


def test_a_scene_has_few_connections_with_short_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_tool, "MAX_MESSAGE", 1000)
    tool = EchoTool()

    async def talk(url: str) -> None:
        view = at(url, "view/one")
        async with aiohttp.ClientSession() as http:
            sockets = [
                await http.ws_connect(view, protocols=VISER) for _ in range(web_tool.MAX_SOCKETS)
            ]
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await http.ws_connect(view, protocols=VISER)
            assert refused.value.status == 429
            await sockets[0].send_bytes(b"\0" * 2000)
            while not sockets[0].closed:
                await sockets[0].receive(timeout=20)
            assert sockets[0].close_code == 1009
            await asyncio.sleep(0.5)
            await http.ws_connect(view, protocols=VISER)

    with Gateway(tool).running() as url:
        tool.scenes.scene("one")
        finished(talk(url))


def test_a_closed_page_gets_no_new_scene(workspace: Workspace) -> None:
    """An edit of another page may still be on its way to it."""
    with annotating(workspace) as served:
        tool = served.annotator
        page = tool._open("one", lambda _: None)
        page.close()
        page.send_frame_list([])
        page._redraw()
        tool.scene_thread.submit(lambda: None).result()
        assert tool.scenes.count == 0


@pytest.mark.parametrize("path", ["image/{}/left.png", "thumbnail/{}.jpg", "view/{}/"])
@pytest.mark.parametrize("digits", [10, 5000])
def test_ids_of_many_digits_are_not_found(
    path: str, digits: int, workspace: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    with annotating(workspace) as served:
        assert ask(served.url, "/" + path.format("9" * digits)).status == 404
    assert [record for record in caplog.records if record.exc_info] == []
