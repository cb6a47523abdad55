"""Who gets in: other users of the machine, other sites, and malformed requests get nothing."""

import http.client
import logging
import socket
import stat
import sys
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from urllib.parse import urlsplit

import aiohttp
import pytest
from echo_tool import UPGRADE, EchoTool, ask, finished, stranger
from serving import at

from semviz.web import gateway
from semviz.web.gateway import Gateway
from semviz.web.sessions import MAX_REQUEST
from semviz.web.viser_servers import SECRET_HEADER, ViserServers
from semviz_core.common.errors import SemvizError


@pytest.fixture
def tool() -> EchoTool:
    return EchoTool()


@pytest.fixture
def url(tool: EchoTool) -> Iterator[str]:
    with Gateway(tool).running() as url:
        yield url


# -- connections


def test_silent_connections_are_ended_and_those_with_the_token_stay(
    tool: EchoTool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thousand of them took all files of the process: no page opened, no label was saved."""
    monkeypatch.setattr(gateway, "MOST_STRANGERS", 3)
    monkeypatch.setattr(gateway, "STRANGER_S", 0.5)
    with Gateway(tool).running() as url:
        address = ("127.0.0.1", urlsplit(url).port or 0)
        known = http.client.HTTPConnection(*address, timeout=5)
        for _ in range(2):  # the same connection
            known.request("GET", at(url, "static/base.css"))
            known.getresponse().read()
        silent = [socket.create_connection(address, timeout=5) for _ in range(4)]
        silent[0].settimeout(0.4)
        assert silent[0].recv(1) == b""  # one too many
        for other in silent[1:]:
            assert other.recv(1) == b""  # too long
        socket_before = known.sock
        known.request("GET", at(url, "static/base.css"))
        assert known.getresponse().status == 200
        assert known.sock is socket_before
        known.close()
        for each in silent:
            each.close()


# -- the token


def test_loopback_demands_a_token_too(url: str) -> None:
    assert len(urlsplit(url).query) > len("token=") + 15
    for path in ("/", "/static/base.css", "/view/x/", "/none", "/?token=", "/?token=%ff"):
        assert stranger(url, path).status == 403, path
    assert stranger(url, "/socket", UPGRADE).status == 403


def test_each_start_has_a_token_of_its_own(tool: EchoTool) -> None:
    with Gateway(tool).running() as first, Gateway(EchoTool()).running() as second:
        assert urlsplit(first).query != urlsplit(second).query
        assert stranger(second, f"/?{urlsplit(first).query}").status == 403


def test_cookie_of_another_port_opens_nothing(tool: EchoTool) -> None:
    """Browsers send a host's cookies to all its ports, whoever listens there."""
    with (
        Gateway(tool, token="same").running() as first,
        Gateway(EchoTool(), token="same").running() as second,
    ):
        _, _, value = stranger(first, "/?token=same").headers["Set-Cookie"].partition("=")
        moved = f"semviz-{urlsplit(second).port}={value.split(';')[0]}"
        assert stranger(second, headers={"Cookie": moved}).status == 403


def test_no_token_is_for_loopback_only(tool: EchoTool) -> None:
    with Gateway(tool, with_token=False).running() as url:
        assert url.endswith("/")
        assert stranger(url).status == 200
        assert stranger(url, headers={"Origin": "http://evil.example"}).status == 403
    with pytest.raises(SemvizError, match="loopback"):
        Gateway(tool, host="0.0.0.0", with_token=False)
    with pytest.raises(SemvizError, match="either"):
        Gateway(tool, token="x", with_token=False)


def test_any_token_survives_its_way_through_the_address(tool: EchoTool) -> None:
    with Gateway(tool, token='ü;"%& #').running() as url:
        assert stranger(url, f"/?{urlsplit(url).query}").status == 303
        assert ask(url).status == 200


def test_token_stays_on_no_page_and_leads_nowhere_else(url: str) -> None:
    token = urlsplit(url).query
    entered = stranger(url, f"//evil.example/?a=1&{token}&b=x,y")
    assert (entered.status, entered.headers["Location"]) == (303, "/evil.example/?a=1&b=x,y")
    assert stranger(url, f"/socket?{token}", UPGRADE).status == 101
    assert stranger(url, f"/static/base.css?{token}").status == 200


# -- other sites


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_other_sites_embed_nothing(url: str, site: str) -> None:
    """Another port of this host, which may be another user's, is the same site."""
    for kind in ("image", "iframe", "script", "empty"):
        assert ask(url, headers={"Sec-Fetch-Site": site, "Sec-Fetch-Dest": kind}).status == 403
    link = {"Sec-Fetch-Site": site, "Sec-Fetch-Dest": "document"}
    assert ask(url, headers=link).status == 200
    assert (
        ask(url, headers={"Sec-Fetch-Site": "same-origin", "Sec-Fetch-Dest": "image"}).status == 200
    )


# -- the browser's command line, which every user can read


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere it is private")
def test_the_browser_is_told_a_private_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    opened: list[str] = []
    done = threading.Event()

    def open_(url: str) -> bool:
        opened.append(url)
        done.set()
        return True

    monkeypatch.setattr(webbrowser, "open", open_)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("HOME", str(tmp_path))
    with gateway.opened("http://127.0.0.1:8080/?token=s3cret"):
        assert done.wait(10)
        assert "s3cret" not in opened[0]
        (file,) = tmp_path.iterdir()
        assert opened == [file.as_uri()]
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert "url=http://127.0.0.1:8080/?token=s3cret" in file.read_text()
    assert list(tmp_path.iterdir()) == []


# -- viser's servers


def test_viser_servers_answer_the_gateway_only(tool: EchoTool, url: str) -> None:
    tool.scenes.scene("one")
    address = tool.scenes.address("one")
    assert address is not None
    secret = tool.scenes.secret_header[SECRET_HEADER]

    def direct(headers: dict[str, str]) -> int:
        connection = http.client.HTTPConnection(address, timeout=10)
        connection.request("GET", "/", headers=headers)
        return connection.getresponse().status

    viser = {"Sec-WebSocket-Protocol": f"viser-v{version('viser')}"}
    for given in ({}, {SECRET_HEADER: ""}, {SECRET_HEADER: secret[:-1]}, {SECRET_HEADER: "\xff"}):
        assert direct(given) == 403
        assert direct(given | UPGRADE | viser) == 403
    assert direct({SECRET_HEADER: secret}) == 200
    assert direct({SECRET_HEADER: secret} | UPGRADE | viser) == 101
    assert ask(url, "/view/one/").status == 200
    assert ask(url, "/view/one", headers=UPGRADE | viser).status == 101
    assert stranger(url, "/view/one/", {SECRET_HEADER: secret}).status == 403
    other = ViserServers()
    assert other.secret_header != tool.scenes.secret_header


def test_a_viser_that_starts_otherwise_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """The contract with viser's internals: a change there is an error here, not an open port."""
    import websockets.asyncio.server as websocket_server
    from viser.infra import _infra

    assert _infra.websockets.asyncio.server is websocket_server
    assert version("viser") == "1.1.1", "read how viser starts its server; see viser_servers"
    serve = websocket_server.serve

    class Elsewhere:
        """viser, if it kept a reference of its own."""

        class asyncio:  # noqa: N801
            class server:  # noqa: N801
                pass

        exceptions = _infra.websockets.exceptions
        datastructures = _infra.websockets.datastructures

    Elsewhere.asyncio.server.serve = staticmethod(serve)  # type: ignore[attr-defined]
    monkeypatch.setattr(_infra, "websockets", Elsewhere)
    with pytest.raises(RuntimeError, match="unguarded"):
        ViserServers().scene("one")
    assert websocket_server.serve is serve


def test_malformed_requests_to_a_viser_server_are_one_line(
    caplog: pytest.LogCaptureFixture, tool: EchoTool, url: str
) -> None:
    tool.scenes.scene("one")
    host, _, port = str(tool.scenes.address("one")).rpartition(":")
    for data in (b"\x00\xff\n\n", b"GET / HTTP/1.1\r\nA: " + b"x" * 20_000 + b"\r\n\r\n"):
        with socket.create_connection((host, int(port)), timeout=10) as line:
            line.sendall(data)
            assert b"200" not in line.recv(100)
    assert all(record.exc_info is None for record in caplog.records)
    assert all("\n" not in record.getMessage() for record in caplog.records)


# -- malformed requests


def raw(url: str, data: bytes) -> bytes:
    """The first line of the answer."""
    with socket.create_connection(("127.0.0.1", urlsplit(url).port or 80), timeout=10) as line:
        line.sendall(data)
        return line.recv(65536).partition(b"\r\n")[0]


HOST = b"Host: localhost\r\n"
GET = b"GET / HTTP/1.1\r\n" + HOST
MALFORMED = {
    "no HTTP": (b"\x16\x03\x01\x02\x00\r\n\r\n", 400),
    "no version": (b"GET /\r\n\r\n", 403),
    "bad version": (b"GET / HTTP/9.9.9\r\n" + HOST + b"\r\n", 400),
    "bad length": (b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: -5\r\n\r\n", 400),
    "both lengths": (
        b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n",
        400,
    ),
    "long line": (b"GET /" + b"a" * 20_000 + b" HTTP/1.1\r\n" + HOST + b"\r\n", 400),
    "long header": (b"GET / HTTP/1.1\r\nX: " + b"a" * 20_000 + b"\r\n\r\n", 400),
    "many headers": (b"GET / HTTP/1.1\r\n" + b"X: a\r\n" * 40_000 + b"\r\n", 400),
    "bad header": (b"GET / HTTP/1.1\r\nno colon\r\n\r\n", 400),
    "zero byte": (b"GET / HTTP/1.1\r\nX: a\x00b\r\n\r\n", 400),
    "bad origin": (b"GET / HTTP/1.1\r\n" + HOST + b"Origin: http://[\r\n\r\n", 403),
    "bad host": (b"GET / HTTP/1.1\r\nHost: \xff\xfe\r\n\r\n", 403),
    "bad cookie": (
        b"GET / HTTP/1.1\r\n" + HOST + b"Cookie: semviz-%d=\xff\xfe\xed\xa0\x80\r\n\r\n",
        403,
    ),
    "odd cookies": (b"GET / HTTP/1.1\r\n" + HOST + b'Cookie: =;;a="\\777;\xe9=\xe9\r\n\r\n', 403),
    "bad token": (b"GET /?token=%%ff%%ed%%a0%%80 HTTP/1.1\r\n" + HOST + b"\r\n", 403),
    "raw token": (b"GET /?token=\xff\xfe HTTP/1.1\r\n" + HOST + b"\r\n", 400),
    "absolute": (b"GET http://[bad/ HTTP/1.1\r\n" + HOST + b"\r\n", 400),
    "other host": (b"GET http://evil.example/ HTTP/1.1\r\n" + HOST + b"\r\n", 403),
    "star": (b"OPTIONS * HTTP/1.1\r\n" + HOST + b"\r\n", 403),
    "connect": (b"CONNECT evil.example:80 HTTP/1.1\r\n" + HOST + b"\r\n", 403),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_requests_before_authentication(
    name: str, url: str, caplog: pytest.LogCaptureFixture
) -> None:
    data, status = MALFORMED[name]
    if b"%d" in data or b"%%" in data:
        data = data % ((urlsplit(url).port,) if b"%d" in data else ())
    with caplog.at_level(logging.WARNING):
        assert raw(url, data).split(b" ")[1:2] == [b"%d" % status]
    assert len(caplog.records) <= 1
    assert all(record.exc_info is None for record in caplog.records)
    assert all(len(record.getMessage().splitlines()) == 1 for record in caplog.records)
    assert ask(url).status == 200


@pytest.mark.parametrize(
    "path",
    [
        "/view/" + "9" * 5000 + "/",
        "/view/one/%00",
        "/view/one/%ff%fe",
        "/view/one/..%2f..%2fetc/passwd",
        "/view/one/%0d%0aX:a",
        "/static/%00",
        "/static/%ff",
        "/static/" + "a" * 5000,
        "/static/" + "a/" * 2000,
        "/%ed%a0%80/",
        "/socket/" + "9" * 5000,
    ],
)
def test_odd_paths_are_not_found(
    path: str, tool: EchoTool, url: str, caplog: pytest.LogCaptureFixture
) -> None:
    tool.scenes.scene("one")
    assert ask(url, path).status in (403, 404)
    assert [record for record in caplog.records if record.exc_info] == []


DIGITS = "9" * 5000
ODD_MESSAGES = {
    "digits": '{"type": "echo", "id": "1", "number": ' + DIGITS + "}",
    "many digits": '{"type": "echo", "id": "1", "number": ' + DIGITS[:4000] + "}",
    "infinite": '{"type": "echo", "id": "1", "number": 1e999}',
    "Infinity": '{"type": "echo", "id": "1", "number": Infinity}',
    "NaN": '{"type": "echo", "id": "1", "number": NaN}',
    "deep": "[" * 100_000,
    "deep and closed": '{"type": "echo", "id": ' + "[" * 100_000 + "]" * 100_000 + "}",
    "surrogate": '{"type": "echo", "id": "1", "fault": "\\ud800"}',
    "surrogate id": '{"type": "nothing", "id": "\\udfff"}',
    "surrogate key": '{"type": "echo", "id": "1", "\\ud800": 1}',
    "long key": '{"type": "echo", "id": "1", "%s": 1}' % ("k" * 100_000),
    "zero": "\0",
    "empty": "",
    "text": '"\\ud800"',
}


@pytest.mark.parametrize("name", ODD_MESSAGES)
def test_odd_messages_are_refused_in_one_line(
    name: str, url: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def talk() -> tuple[dict[str, str], dict[str, str]]:
        async with aiohttp.ClientSession() as http, http.ws_connect(at(url, "socket")) as page:
            await page.receive_json()
            await page.receive_json()
            await page.send_str(ODD_MESSAGES[name])
            refused = await page.receive_json(timeout=20)
            await page.send_json({"type": "echo", "id": "2", "number": 7})
            return refused, await page.receive_json(timeout=20)

    refused, after = finished(talk())
    assert (refused["type"], refused["code"]) == ("error", "invalid")
    assert len(refused["text"].splitlines()) == 1
    assert len(refused["text"]) < 400
    assert after == {"type": "echo", "reply_to": "2", "number": 7}
    assert caplog.records == []


def test_a_long_message_closes_the_connection(url: str, caplog: pytest.LogCaptureFixture) -> None:
    async def talk() -> int | None:
        async with aiohttp.ClientSession() as http, http.ws_connect(at(url, "socket")) as page:
            await page.receive_json()
            await page.receive_json()
            with suppress(ConnectionError):  # while this is still being sent
                await page.send_str("x" * 2 * MAX_REQUEST)
            message = await page.receive(timeout=20)
            while message.type is aiohttp.WSMsgType.TEXT:
                message = await page.receive(timeout=20)
            return page.close_code

    assert finished(talk()) in (1006, 1009)
    assert [record for record in caplog.records if record.exc_info] == []
