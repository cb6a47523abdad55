"""The gateway: access, responses, proxying and shutdown."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import aiohttp
import pytest
from echo_tool import UPGRADE, EchoEvent, EchoTool, ask, finished, stranger
from serving import at

from semviz.web.gateway import Gateway
from semviz_core.common.errors import SemvizError


@pytest.fixture
def tool() -> EchoTool:
    return EchoTool()


@pytest.fixture
def url(tool: EchoTool) -> Iterator[str]:
    with Gateway(tool).running() as url:
        yield url


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


def test_our_own_origin_may_change_something_and_none_may_not(url: str) -> None:
    ours = {"Origin": url.partition("/?")[0]}
    assert ask(url, method="POST", headers=ours).status == 200
    assert ask(url, method="POST").status == 403
    assert ask(url, "/socket", headers=ours | UPGRADE).status == 101


def test_token_is_demanded_and_moves_into_a_cookie(tool: EchoTool) -> None:
    with Gateway(tool, token="s3cret").running() as url:
        assert url.endswith("/?token=s3cret")
        assert stranger(url).status == 403
        assert stranger(url, "/?token=wrong").status == 403
        entered = stranger(url, "/?frame=3&token=s3cret")
        assert (entered.status, entered.headers["Location"]) == (303, "/?frame=3")
        cookie = entered.headers["Set-Cookie"]
        assert cookie.startswith(f"semviz-{urlsplit(url).port}=")
        assert {"HttpOnly", "Path=/", "SameSite=Lax"} <= set(cookie.split("; "))
        assert "s3cret" not in cookie
        assert stranger(url, headers={"Cookie": cookie.split(";")[0]}).status == 200
        assert stranger(url, "/socket", headers=UPGRADE).status == 403
        assert stranger(url, "/socket?token=s3cret", headers=UPGRADE).status == 101


def test_any_other_address_demands_a_token_of_its_own(tool: EchoTool) -> None:
    with Gateway(tool, host="0.0.0.0").running() as url:
        token = urlsplit(url).query
        assert len(token) > len("token=") + 15
        assert stranger(url).status == 403
        assert stranger(url, f"/?{token}").status == 303
        assert stranger(url, f"/?{token}", headers={"Host": "10.1.2.3:80"}).status == 303
        assert stranger(url, f"/?{token}", headers={"Host": "evil.example"}).status == 403


def test_busy_port_is_said_and_not_dodged(tool: EchoTool) -> None:
    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = busy.getsockname()[1]
        with pytest.raises(SemvizError, match=f"port {port} is in use; .*--port"):
            Gateway(tool, port=port).running().__enter__()


@pytest.mark.parametrize(("host", "port"), [("127.0.0.1", 99999), ("nowhere.invalid", 0)])
def test_impossible_addresses_are_one_line(tool: EchoTool, host: str, port: int) -> None:
    with pytest.raises(SemvizError) as caught:
        Gateway(tool, host=host, port=port).running().__enter__()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "path",
    ["/static/../gateway.py", "/static/%2e%2e/gateway.py", "/static//etc/passwd", "/static/"],
)
def test_static_files_end_at_their_folder(url: str, path: str) -> None:
    assert ask(url, "/static/base.css").status == 200
    assert ask(url, path).status in (403, 404)


def test_unknown_scene_is_not_found(url: str) -> None:
    assert ask(url, "/view/nobody/").status == 404
    assert ask(url, "/view/nobody", headers=UPGRADE).status == 404


def test_scenes_stop_with_the_door(tool: EchoTool) -> None:
    with Gateway(tool).running() as url:
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


def echo(reply_to: str | None, number: int) -> dict[str, Any]:
    return {"type": "echo", "reply_to": reply_to, "number": number}


def test_a_page_that_comes_back_finds_its_session(tool: EchoTool, url: str) -> None:
    async def visits() -> list[str]:
        async with aiohttp.ClientSession() as client:
            ids = []
            for query in ("", "?session={}", "?session=made-up"):
                asked = at(url, f"socket{query.format(ids[0] if ids else '')}")
                async with client.ws_connect(asked) as page:
                    hello = await page.receive_json()
                    assert (hello["type"], hello["protocol"]) == ("hello", 3)
                    ids.append(hello["session"])
                    assert await page.receive_json() == echo(None, -1)
            return ids

    first, again, other = finished(visits())
    assert first == again != other
    assert tool.made == [first, other]


def test_a_stopped_tool_may_still_send_and_hang_up(tool: EchoTool) -> None:
    async def visit(url: str) -> None:
        async with aiohttp.ClientSession() as client, client.ws_connect(at(url, "socket")) as page:
            await page.receive_json()

    with Gateway(tool).running() as url:
        finished(visit(url))
    (connection,) = tool._sessions._connections.values()
    assert connection.loop.is_closed()
    tool._sessions.end_of("")
    connection.send(EchoEvent(reply_to=None, number=1))


def test_messages_are_answered_in_order_and_faults_are_shown(url: str) -> None:
    async def talk() -> list[dict[str, Any]]:
        async with aiohttp.ClientSession() as client, client.ws_connect(at(url, "socket")) as page:
            await page.receive_json()
            await page.receive_json()
            await page.send_json({"type": "echo", "id": "1", "number": 0, "slow": True})
            await page.send_json({"type": "echo", "id": "2", "fault": "no frame 7; there are 3"})
            await page.send_str("{not json")
            await page.send_json({"type": "echo", "id": "4", "bug": True})
            await page.send_json({"type": "echo", "id": "5", "number": 1})
            return [json.loads((await page.receive()).data) for _ in range(5)]

    first, fault, garbage, internal, last = finished(talk())
    assert first == echo("1", 0)
    said = {"reply_to": "2", "code": "invalid", "text": "no frame 7; there are 3", "retry": False}
    assert fault == {"type": "error"} | said
    assert (garbage["type"], garbage["reply_to"], garbage["code"]) == ("error", None, "invalid")
    assert (internal["type"], internal["reply_to"], internal["code"]) == ("error", "4", "internal")
    assert "KeyError" in internal["text"]
    assert last == echo("5", 1)


SERVE = """
import sys
sys.path.insert(0, sys.argv[1])
from echo_tool import EchoTool
from semviz.web.gateway import Gateway
tool = EchoTool()
tool.scenes.scene("one")
Gateway(tool).run(open_browser=False)
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_run_prints_its_address_only_and_ends_when_told(how: signal.Signals) -> None:
    command = [sys.executable, "-c", SERVE, str(Path(__file__).parents[1])]
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
    command = [sys.executable, "-c", told + SERVE, str(Path(__file__).parents[1])]
    assert subprocess.run(command, capture_output=True, timeout=60).returncode == 0


def test_it_ends_even_if_a_scene_never_closes() -> None:
    code = (
        "import time\n"
        "from semviz.web.gateway import Gateway\n"
        "from semviz.web.viser_servers import ViserServers\n"
        "class Stuck(ViserServers):\n"
        "    def close_all(self): time.sleep(600)\n"
        "class Tool:\n"
        "    title = 'stuck'\n"
        "    scenes = Stuck()\n"
        "    def routes(self): return []\n"
        "Gateway(Tool()).run(open_browser=False)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert "http://" in process.stdout.readline()
    process.terminate()
    assert process.wait(timeout=60) == 0
