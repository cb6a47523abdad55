"""The images of the runs on offer, by HTTP."""

import asyncio
from dataclasses import dataclass
from pathlib import Path

from aiohttp import web

from semviz.inspector.shelf import Shelf
from semviz.recording.pictures import picture, why_no_picture
from semviz.recording.run import Run
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

SIDES: dict[str, Side] = {"left": "left", "right": "right"}
JPEG_START = b"\xff\xd8"
KEPT = "private, max-age=3600"
"""By browsers: their addresses hold when the run was made."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """The images of one run, which is in the file ``path``."""

    run: Run
    path: Path

    def response(self, position: int, side: Side) -> web.Response:
        """An image; where there is none, one line that says why, which is no error."""
        data = picture(self.run, self.path, position, side)
        if data is None:
            why = why_no_picture(self.run, self.path, position, side)
            return web.Response(text=why, headers={"Cache-Control": "no-store"})
        kind = "image/jpeg" if data.startswith(JPEG_START) else "image/png"
        return web.Response(body=data, content_type=kind, headers={"Cache-Control": KEPT})


def picture_route(shelf: Shelf) -> web.AbstractRouteDef:
    """``/image?run=NAME&position=K&side=left``: an image of a frame, as JPEG or PNG."""

    async def answer(request: web.Request) -> web.Response:
        query = request.query
        try:
            pictures = shelf.kept(query["run"], Pictures)
            position, side = int(query["position"]), SIDES[query.get("side", "left")]
            if not 0 <= position < len(pictures.run.frames):
                raise IndexError(position)
        except (SemvizError, ValueError, LookupError):
            raise web.HTTPNotFound(text="no such frame\n") from None
        return await asyncio.to_thread(pictures.response, position, side)

    return web.get("/image", answer)
