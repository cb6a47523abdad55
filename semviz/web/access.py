"""Decide who may use a gateway: Host, Origin, fetch metadata and token of each request.

Another site reaches a local server by address, where the browser sends its Origin, or by DNS
rebinding, where its name arrives as Host. Other users of the machine reach loopback as well: they
do not know the token. It comes once in the address and then lives in a cookie.
"""

import errno
import hashlib
import hmac
import ipaddress
import logging
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from aiohttp import hdrs, web
from aiohttp.http_exceptions import HttpProcessingError
from aiohttp.typedefs import Handler, Middleware

PERSON: web.RequestKey[str] = web.RequestKey("person", str)
"""Name of the guest who sends a request; empty for who has the gateway's own token."""
SAFE_METHODS = frozenset({"GET", "HEAD"})
SAY_AGAIN_S = 60.0
"""The same refusal is logged once in this time: a page left open tries again every few seconds."""

PAGE_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'self'"
)
VIEW_POLICY = (  # viser's client is one self-unpacking file with workers and WebAssembly in it
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
    "style-src 'self' 'unsafe-inline'; object-src 'none'; base-uri 'none'; frame-ancestors 'self'"
)

log = logging.getLogger("semviz.web")


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address to bind."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def nobody() -> Mapping[str, str]:
    """The guests of a gateway that has none."""
    return {}


@dataclass(frozen=True)
class AccessPolicy:
    """Refuses requests of other sites, and requests without a token.

    There is the gateway's own token, and one of each guest.
    """

    local: bool
    """Whether the gateway is bound to loopback: only loopback names are valid hosts."""
    token: str | None
    port: int
    """Browsers send a host's cookies to all its ports: name and value of ours depend on it."""
    guests: Callable[[], Mapping[str, str]] = nobody
    """Names of guests by the SHA-256 of their tokens, asked for at each request."""
    _logged: dict[str, float] = field(default_factory=dict, compare=False)

    def middleware(self) -> Middleware:
        """Return the aiohttp middleware that applies this policy."""

        @web.middleware
        async def guarded(request: web.Request, handler: Handler) -> web.StreamResponse:
            refusal = self.refusal(request)
            if refusal:
                self._log(request, refusal)
                return web.Response(status=403, text=f"403: {refusal}\n")
            request[PERSON] = person = self._person(request) or ""
            if self.token is not None and "token" in request.query and _is_page(request):
                return self._admitted(request, person)
            try:
                return await handler(request)
            except OSError as error:
                if error.errno != errno.ENAMETOOLONG:
                    raise
                raise web.HTTPNotFound from None  # no file has such a name

        return guarded

    def refusal(self, request: web.Request) -> str | None:
        """Return why ``request`` is refused, in one line; None if it is allowed."""
        host = request.headers.get(hdrs.HOST, "")
        if not self._is_ours(host):
            return "this address is not served here; open the address that the terminal shows"
        origin = request.headers.get(hdrs.ORIGIN)
        if origin is None:
            if request.method not in SAFE_METHODS:
                return "a request that changes something must name its Origin"
        elif _netloc(origin) != host.lower():
            return "requests from other sites are refused"
        if _is_embedded_elsewhere(request):
            return "requests from other sites are refused"
        if self._person(request) is None:
            return "the token is missing or old; open the whole address that the terminal shows"
        return None

    @property
    def cookie(self) -> str:
        """Name of the cookie that admits a browser."""
        return f"semviz-{self.port}"

    def cookie_value(self, key: str) -> str:
        """Return the cookie for a key: the token, or the digest of a guest's. It reveals neither
        to another port that reads it."""
        return hmac.new(_bytes(key), self.cookie.encode(), "sha256").hexdigest()

    def _is_ours(self, host: str) -> bool:
        """Whether a host is this server, whatever the port: ssh -L may change the port."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if is_loopback(name):
            return True
        if self.local:
            return False
        return _is_address(name) or name in {socket.gethostname().lower(), socket.getfqdn().lower()}

    def _person(self, request: web.Request) -> str | None:
        """Return the guest who sends a request, "" for who has the token; None for a stranger."""
        if self.token is None:
            return ""
        given, cookie = request.query.get("token"), request.cookies.get(self.cookie, "")
        keys = {self.token: "", **self.guests()}
        if given is not None:
            digest = hashlib.sha256(_bytes(given)).hexdigest()
            named = [name for key, name in keys.items() if _same(key, digest if name else given)]
        if given is None or not named:
            named = [name for key, name in keys.items() if _same(cookie, self.cookie_value(key))]
        return named[0] if named else None

    def _admitted(self, request: web.Request, person: str) -> web.Response:
        """Move the token from the URL into a cookie, which keeps it out of history and logs.

        Lax, not Strict: a report or a mail may link to a frame, and the browser opens the first
        address from outside; Strict would withhold the cookie from both. Requests that other
        sites embed carry no cookie either way.
        """
        rest = request.rel_url.without_query_params("token")
        path = "/" + str(rest).lstrip("/")  # "//name/" would lead to another site
        response = web.Response(status=303, headers={"Location": path})
        key = next((key for key, name in self.guests().items() if name == person), self.token or "")
        value = self.cookie_value(key)
        response.set_cookie(self.cookie, value, path="/", httponly=True, samesite="Lax")
        return response

    def _log(self, request: web.Request, refusal: str) -> None:
        now = time.monotonic()
        if now - self._logged.get(refusal, -SAY_AGAIN_S) >= SAY_AGAIN_S:
            self._logged[refusal] = now
            log.warning("refused %s from %s: %s", ascii(request.path[:80]), request.remote, refusal)


def _is_page(request: web.Request) -> bool:
    """Whether this is the address of a page, as a person opens it."""
    return request.method == hdrs.METH_GET and request.path.endswith("/")


def _is_embedded_elsewhere(request: web.Request) -> bool:
    """Whether another site's page embeds this or fetches it; browsers tell, other clients do not.

    Another port of this host counts as another site: it may belong to another user.
    """
    if request.headers.get("Sec-Fetch-Site") not in ("cross-site", "same-site"):
        return False
    return request.headers.get("Sec-Fetch-Dest") != "document"


def _netloc(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return None


def _same(given: str, expected: str) -> bool:
    """Whether two secrets are equal, in a time that does not depend on where they differ."""
    return hmac.compare_digest(_bytes(given), _bytes(expected))


def _bytes(text: str) -> bytes:
    return text.encode(errors="backslashreplace")  # a request may contain any bytes


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


async def add_headers(request: web.Request, response: web.StreamResponse) -> None:
    """Add security headers, so that no other site can embed our pages or run their scripts.

    An aiohttp ``on_response_prepare`` signal.
    """
    policy = VIEW_POLICY if "view" in request.path.split("/") else PAGE_POLICY
    response.headers["Content-Security-Policy"] = policy
    response.headers["X-Content-Type-Options"] = "nosniff"
    response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
    response.headers["Referrer-Policy"] = "no-referrer"
    response.headers.setdefault("Cache-Control", "no-cache")


def http_log() -> logging.Logger:
    """Return the log of aiohttp's server: one line for a malformed request, all of a bug."""
    http = log.getChild("http")
    http.addFilter(_without_client_trace)
    return http


def _without_client_trace(record: logging.LogRecord) -> bool:
    error = record.exc_info[1] if record.exc_info else None
    if isinstance(error, HttpProcessingError):
        record.msg = f"{record.getMessage()}: {str(error.message).splitlines()[0][:120]!a}"
        record.args, record.exc_info = (), None
    return True
