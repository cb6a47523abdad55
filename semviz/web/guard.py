"""Who may talk to the door: Host, Origin and token are checked before any tool sees a request."""

import hmac
import ipaddress
import socket
from dataclasses import dataclass
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

SAFE_METHODS = frozenset({"GET", "HEAD"})

PAGE_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; "
    "form-action 'self'; frame-ancestors 'self'"
)
VIEW_POLICY = (  # viser's client is one self-unpacking file with workers and WebAssembly in it
    "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
    "style-src 'self' 'unsafe-inline'; object-src 'none'; base-uri 'none'; frame-ancestors 'self'"
)


def is_loopback(host: str) -> bool:
    """Whether an address to bind is reachable from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Guard:
    """Refuses requests that another site, or somebody without the token, makes.

    A page of another site can reach a local server in two ways: by asking for our address, where
    the browser names that site as Origin; or by pointing its own name at our address (DNS
    rebinding), where the browser sends that name as Host. The token matters on addresses that
    other machines can reach; it comes once in the URL and then lives in a cookie.
    """

    local: bool
    """True where only loopback names are ours."""
    token: str | None
    cookie: str
    """Name of the cookie that holds the token; browsers share cookies between ports."""

    def middleware(self) -> Middleware:
        """The aiohttp middleware that asks this guard first."""

        @web.middleware
        async def guarded(request: web.Request, handler: Handler) -> web.StreamResponse:
            refusal = self.refusal(request)
            if refusal:
                return web.Response(status=403, text=f"403: {refusal}\n")
            if self.token is not None and "token" in request.query:
                return self._admitted(request)
            return await handler(request)

        return guarded

    def refusal(self, request: web.Request) -> str | None:
        """Why ``request`` is refused, in one line; None where it may pass."""
        host = request.headers.get("Host", "")
        if not self._is_ours(host):
            return "this address is not served here; open the address that the terminal shows"
        origin = request.headers.get("Origin")
        if origin is None:
            if request.method not in SAFE_METHODS:
                return "a request that changes something must name its Origin"
        elif urlsplit(origin).netloc.lower() != host.lower():
            return "requests from other sites are refused"
        if self.token is not None and not self._has_token(request):
            return "the token is missing; open the whole address that the terminal shows"
        return None

    def _is_ours(self, host: str) -> bool:
        """Names, not ports: a forwarded port (ssh -L) has another number on the far side."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if is_loopback(name):
            return True
        if self.local:
            return False
        return _is_address(name) or name in {socket.gethostname().lower(), socket.getfqdn().lower()}

    def _has_token(self, request: web.Request) -> bool:
        given = request.query.get("token") or request.cookies.get(self.cookie) or ""
        return hmac.compare_digest(given.encode(), (self.token or "").encode())

    def _admitted(self, request: web.Request) -> web.Response:
        """Moves the token from the URL into a cookie, so that it stays out of history and logs."""
        rest = {name: value for name, value in request.query.items() if name != "token"}
        answer = web.Response(
            status=303, headers={"Location": str(request.rel_url.with_query(rest))}
        )
        answer.set_cookie(self.cookie, self.token or "", httponly=True, samesite="Lax")
        return answer


async def add_headers(request: web.Request, response: web.StreamResponse) -> None:
    """aiohttp ``on_response_prepare`` signal: nothing of ours runs or shows in another site."""
    policy = VIEW_POLICY if "view" in request.path.split("/") else PAGE_POLICY
    response.headers["Content-Security-Policy"] = policy
    response.headers["X-Content-Type-Options"] = "nosniff"
    response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
    response.headers["Referrer-Policy"] = "no-referrer"
    response.headers.setdefault("Cache-Control", "no-cache")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
