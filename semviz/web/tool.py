"""A web tool as an application: its routes, the shared files, its 3D scenes, tools inside it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn, Protocol
from weakref import WeakSet

from aiohttp import web

from semviz.web.scene_proxy import SceneProxy
from semviz.web.sessions import OPEN_SOCKETS
from semviz.web.viser_servers import ViserServers

STATIC = Path(__file__).parent / "static"
"""Style sheet and ES modules that both tools' pages share, served under ``/static/``."""
MAX_UPLOAD = 16 * 2**20
"""Largest body of a request, bytes."""


class Tool(Protocol):
    """A web tool that the gateway serves."""

    @property
    def title(self) -> str:
        """Name of the tool and its data, for the terminal."""
        ...

    @property
    def scenes(self) -> ViserServers:
        """Its 3D scenes; the gateway proxies ``/view/SESSION/`` to them and finally closes them."""
        ...

    def routes(self) -> list[web.AbstractRouteDef]:
        """Return its routes: page, JSON, websocket; ``/static/`` and ``/view/`` are reserved."""
        ...


def tool_application(tool: Tool, **options: Any) -> web.Application:
    """Return the application of a tool; ``options`` are those of aiohttp's application."""
    app = web.Application(client_max_size=MAX_UPLOAD, **options)
    app.add_routes(tool.routes())
    app.add_routes(SceneProxy(tool.scenes).routes())
    app.router.add_static("/static/", STATIC)
    app[OPEN_SOCKETS] = WeakSet()
    return app


class InnerTools(web.AbstractResource, web.AbstractRouteDef):
    """Tools inside a tool, under ``/PREFIX/NAME/``: same port, same access policy.

    One of the outer tool's routes. Tools may be added from any thread while it is served.
    """

    def __init__(self, prefix: str) -> None:
        super().__init__()
        self._prefix = f"/{prefix}"
        self._tools: dict[str, web.PrefixedSubAppResource] = {}

    def add(self, name: str, tool: Tool) -> None:
        """Serve ``tool`` under ``/PREFIX/NAME/`` from now on."""
        app = tool_application(tool)
        resource = web.PrefixedSubAppResource(f"{self._prefix}/{name}", app)
        app.freeze()
        self._tools[name] = resource

    def clear(self) -> None:
        """Serve none of the tools any more."""
        self._tools.clear()

    def register(self, router: web.UrlDispatcher) -> list[web.AbstractRoute]:
        router.register_resource(self)
        return []

    async def resolve(
        self, request: web.Request
    ) -> tuple[web.UrlMappingMatchInfo | None, set[str]]:
        """Pass a request to the tool that its path names; part of aiohttp's routing."""
        name = request.rel_url.path_safe.removeprefix(f"{self._prefix}/").partition("/")[0]
        resource = self._tools.get(name)
        return (None, set()) if resource is None else await resource.resolve(request)

    @property
    def canonical(self) -> str:
        return self._prefix

    def raw_match(self, path: str) -> bool:
        return path == self._prefix

    def get_info(self) -> Any:
        return {"prefix": self._prefix}

    def add_prefix(self, prefix: str) -> NoReturn:
        raise NotImplementedError("tools inside a tool inside a tool")

    def url_for(self, **_: str) -> NoReturn:
        raise NotImplementedError("a page's address is relative")

    def __len__(self) -> int:
        return 0

    def __iter__(self) -> Iterator[web.AbstractRoute]:
        return iter(())
