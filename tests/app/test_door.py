"""The door: who gets in, what comes out, and that it shuts."""

import asyncio
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

import aiohttp
import pytest
from aiohttp import web

from semviz.web.door import Door
from semviz.web.scenes import Scenes
from semviz.web.sessions import Message, Send, Sessions
from semviz_core.errors import SemvizError

Result = TypeVar("Result")

UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


class EchoSession:
    def __init__(self, send: Send) -> None:
        self._send = send
        self.closed = False

    def connected(self) -> None:
        self._send({"type": "hello"})

    def receive(self, message: Message) -> None:
        if "fault" in message:
            raise SemvizError(str(message["fault"]))
        if message.get("slow"):
            time.sleep(0.1)
        self._send({"type": "echo", "number": message["number"]})

    def close(self) -> None:
        self.closed = True


class EchoTool:
    title = "echo"

    def __init__(self) -> None:
        self.scenes = Scenes()
        self.made: list[str] = []
        self._sessions = Sessions(self._make)

    def _make(self, session_id: str, send: Send) -> EchoSession:
        self.made.append(session_id)
        return EchoSession(send)

    def routes(self) -> list[web.AbstractRouteDef]:
        async def page(_: web.Request) -> web.Response:
            return web.Response(text="a page")

        return [web.get("/", page), web.post("/", page), *self._sessions.routes()]


@pytest.fixture
def tool() -> EchoTool:
    return EchoTool()


@pytest.fixture
def url(tool: EchoTool) -> Iterator[str]:
    with Door(tool).running() as url:
        yield url


def finished(work: Coroutine[Any, Any, Result]) -> Result:
    """Runs in a thread: Playwright's fixtures leave a running event loop in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()


def ask(
    url: str, path: str = "/", method: str = "GET", headers: dict[str, str] | None = None
) -> http.client.HTTPResponse:
    parts = urlsplit(url)
    connection = http.client.HTTPConnection("127.0.0.1", parts.port or 80, timeout=10)
    connection.request(method, path, headers=headers or {})
    return connection.getresponse()


def test_page_comes_with_the_headers_that_keep_other_sites_out(url: str) -> None:
    answer = ask(url)
    assert (answer.status, answer.read()) == (200, b"a page")
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy
    assert "frame-ancestors 'self'" in policy
    assert "unsafe" not in policy
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8080", "10.1.2.3", "", "[bad"])
def test_foreign_host_is_refused(url: str, host: str) -> None:
    assert ask(url, headers={"Host": host}).status == 403


@pytest.mark.parametrize("host", ["localhost:9000", "127.0.0.1", "[::1]:80"])
def test_loopback_names_are_ours_on_any_forwarded_port(url: str, host: str) -> None:
    assert ask(url, headers={"Host": host}).status == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
@pytest.mark.parametrize("kind", ["get", "post", "socket"])
def test_foreign_origin_is_refused(url: str, origin: str, kind: str) -> None:
    headers = {"Origin": origin} | (UPGRADE if kind == "socket" else {})
    path = "/socket" if kind == "socket" else "/"
    assert ask(url, path, "POST" if kind == "post" else "GET", headers).status == 403


def test_our_own_origin_may_change_things_and_none_may_not(url: str) -> None:
    ours = {"Origin": url.rstrip("/")}
    assert ask(url, method="POST", headers=ours).status == 200
    assert ask(url, method="POST").status == 403
    assert ask(url, "/socket", headers=ours | UPGRADE).status == 101


def test_token_is_demanded_and_moves_into_a_cookie(tool: EchoTool) -> None:
    with Door(tool, token="s3cret").running() as url:
        assert url.endswith("/?token=s3cret")
        assert ask(url).status == 403
        assert ask(url, "/?token=wrong").status == 403
        entered = ask(url, "/?frame=3&token=s3cret")
        assert (entered.status, entered.headers["Location"]) == (303, "/?frame=3")
        cookie = entered.headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert ask(url, headers={"Cookie": cookie.split(";")[0]}).status == 200
        assert ask(url, "/socket", headers=UPGRADE).status == 403


def test_any_other_address_demands_a_token_of_its_own(tool: EchoTool) -> None:
    with Door(tool, host="0.0.0.0").running() as url:
        token = urlsplit(url).query
        assert len(token) > len("token=") + 15
        assert ask(url).status == 403
        assert ask(url, f"/?{token}").status == 303
        assert ask(url, f"/?{token}", headers={"Host": "10.1.2.3:80"}).status == 303
        assert ask(url, f"/?{token}", headers={"Host": "evil.example"}).status == 403


def test_busy_port_is_said_and_not_dodged(tool: EchoTool) -> None:
    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = busy.getsockname()[1]
        with pytest.raises(SemvizError, match=f"port {port} is in use; .*--port"):
            Door(tool, port=port).running().__enter__()


@pytest.mark.parametrize(("host", "port"), [("127.0.0.1", 99999), ("nowhere.invalid", 0)])
def test_impossible_addresses_are_one_line(tool: EchoTool, host: str, port: int) -> None:
    with pytest.raises(SemvizError) as caught:
        Door(tool, host=host, port=port).running().__enter__()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "path", ["/static/../door.py", "/static/%2e%2e/door.py", "/static//etc/passwd", "/static/"]
)
def test_static_files_end_at_their_folder(url: str, path: str) -> None:
    assert ask(url, "/static/base.css").status == 200
    assert ask(url, path).status in (403, 404)


def test_unknown_scene_is_not_found(url: str) -> None:
    assert ask(url, "/view/nobody/").status == 404
    assert ask(url, "/view/nobody", headers=UPGRADE).status == 404


def test_scenes_stop_with_the_door(tool: EchoTool) -> None:
    with Door(tool).running() as url:
        tool.scenes.scene("one")
        answer = ask(url, "/view/one/")
        assert answer.status == 200
        assert b"Viser" in answer.read()
        address = tool.scenes.address("one")
        assert address is not None
    host, port = address.rsplit(":", 1)
    assert tool.scenes.address("one") is None
    for closed in ((host, int(port)), ("127.0.0.1", urlsplit(url).port)):
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(closed, timeout=2)


def test_a_page_that_comes_back_finds_its_session(tool: EchoTool, url: str) -> None:
    async def visits() -> list[str]:
        async with aiohttp.ClientSession() as client:
            ids = []
            for query in ("", "?session={}", "?session=made-up"):
                asked = f"{url}socket{query.format(ids[0] if ids else '')}"
                async with client.ws_connect(asked) as page:
                    ids.append((await page.receive_json())["id"])
                    assert await page.receive_json() == {"type": "hello"}
            return ids

    first, again, other = finished(visits())
    assert first == again != other
    assert tool.made == [first, other]


def test_messages_are_answered_in_order_and_faults_are_shown(url: str) -> None:
    async def talk() -> list[Message]:
        async with aiohttp.ClientSession() as client, client.ws_connect(f"{url}socket") as page:
            await page.receive_json()
            await page.receive_json()
            await page.send_json({"number": 0, "slow": True})
            await page.send_json({"fault": "no frame 7; there are 3"})
            await page.send_str("{not json")
            await page.send_json({"other": 1})
            await page.send_json({"number": 1})
            return [json.loads((await page.receive()).data) for _ in range(5)]

    first, fault, garbage, internal, last = finished(talk())
    assert first == {"type": "echo", "number": 0}
    assert fault == {"type": "error", "text": "no frame 7; there are 3"}
    assert garbage["type"] == internal["type"] == "error"
    assert "KeyError" in internal["text"]
    assert last == {"type": "echo", "number": 1}


SERVE = """
import sys
sys.path.insert(0, sys.argv[1])
from test_door import EchoTool
from semviz.web.door import Door
tool = EchoTool()
tool.scenes.scene("one")
Door(tool).run(open_browser=False)
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_run_prints_its_address_only_and_ends_when_told(how: signal.Signals) -> None:
    command = [sys.executable, "-c", SERVE, str(Path(__file__).parent)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=dict(os.environ)
    )
    assert process.stdout is not None
    title, url = process.stdout.readline().strip().split(": ")
    assert title == "echo"
    assert process.stdout.readline() == "Ctrl-C stops it.\n"
    assert ask(url).status == 200
    process.send_signal(how)
    rest, _ = process.communicate(timeout=20)
    assert process.returncode == 0
    assert rest == ""


def test_it_ends_where_the_signal_goes_to_another_thread() -> None:
    """Then nothing interrupts the waiting main thread, as where it comes just before the wait."""
    told = (
        "import signal, sys, threading, time\n"
        "def tell():\n"
        "    while signal.getsignal(signal.SIGTERM) is signal.SIG_DFL: time.sleep(0.1)\n"
        "    time.sleep(1.0)\n"
        "    signal.pthread_kill(threading.get_ident(), signal.SIGTERM)\n"
        "threading.Thread(target=tell, daemon=True).start()\n"
    )
    command = [sys.executable, "-c", told + SERVE, str(Path(__file__).parent)]
    assert subprocess.run(command, capture_output=True, timeout=60).returncode == 0


def test_it_ends_even_if_a_scene_never_closes() -> None:
    code = (
        "import time\n"
        "from semviz.web.door import Door\n"
        "from semviz.web.scenes import Scenes\n"
        "class Stuck(Scenes):\n"
        "    def close_all(self): time.sleep(600)\n"
        "class Tool:\n"
        "    title = 'stuck'\n"
        "    scenes = Stuck()\n"
        "    def routes(self): return []\n"
        "Door(Tool()).run(open_browser=False)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert "http://" in process.stdout.readline()
    process.terminate()
    assert process.wait(timeout=60) == 0
