"""Two people label for eight hours, replayed fast: what grows, and whether all edits are kept.

Two pages are connected to one annotator, as browsers are, each with its 3D scene. In turn they go
to a frame, draw, undo and redo; now and then a page is closed and opened again. Printed are memory,
threads, open files and the time of an edit, at each tenth. The last line compares the end with the
first tenth, when the caches are full: beyond ``--limit`` percent the exit status is 1. The labels,
which must grow, are counted, too.

    python bench/soak.py --edits 5760
"""

import argparse
import asyncio
import gc
import json
import statistics
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tests_support  # noqa: F401
from aiohttp import ClientSession, ClientWebSocketResponse
from serving import at

from semviz.annotator.server import Annotator
from semviz.web import sessions
from semviz.web.gateway import Gateway
from semviz.workspace.workspace import Workspace

FRAMES = 40
HOURS = 8
REOPEN_EVERY = 100
"""Edits of one person after which the page is opened again."""
TENTHS = 10
POOL = 2
"""Threads that a thread pool may start later."""
VISER = (f"viser-v{version('viser')}",)


@dataclass(frozen=True)
class Measure:
    """The state of the process after some edits."""

    edits: int
    rss_mb: float
    threads: int
    files: int
    edit_ms: float

    def print(self) -> None:
        print(
            f"{self.edits:6} edits: {self.rss_mb:7.1f} MB, {self.threads} threads, "
            f"{self.files} files, {self.edit_ms:.1f} ms an edit",
            flush=True,
        )


class Person:
    """One page and its 3D scene."""

    def __init__(self, http: ClientSession, url: str, seed: int) -> None:
        self._http = http
        self._url = url
        self._rng = np.random.default_rng(seed)
        self._readers: list[asyncio.Task[None]] = []
        self._page: ClientWebSocketResponse | None = None
        self._answers: dict[str, asyncio.Future[dict[str, Any]]] = {}
        self._has_drawn = False
        self.saved = 0
        self.refused = 0

    async def open(self) -> None:
        self._page = await self._http.ws_connect(at(self._url, "socket"), max_msg_size=0)
        hello = await self._page.receive_json()
        while (await self._page.receive_json())["type"] != "scene":
            pass
        view = at(self._url, f"view/{hello['session']}")
        scene = await self._http.ws_connect(view, protocols=VISER, max_msg_size=0)
        self._readers = [
            asyncio.create_task(self._read(self._page)),
            asyncio.create_task(_swallow(scene)),
        ]

    async def close(self) -> None:
        for reader in self._readers:
            reader.cancel()
        await asyncio.gather(*self._readers, return_exceptions=True)
        assert self._page is not None
        await self._page.close()

    async def edit(self) -> float:
        """Make one edit; return the milliseconds until it is saved or refused."""
        start = time.perf_counter()
        answer = await self._ask({"type": "apply_edit", "edit": self._any_edit()})
        if answer["type"] == "error":
            self.refused += 1
        else:
            self.saved += 1
        return 1e3 * (time.perf_counter() - start)

    async def go(self) -> None:
        await self._ask({"type": "go_to_frame", "frame": int(self._rng.integers(FRAMES))})

    def _any_edit(self) -> dict[str, Any]:
        chance = self._rng.random()
        if chance < 0.4 and self._has_drawn:
            return {"kind": "undo"}
        if chance < 0.5 and self._has_drawn:
            return {"kind": "redo"}
        anchor = [float(value) for value in self._rng.uniform((20, 20), (600, 150))]
        self._has_drawn = True
        return {
            "kind": "draw",
            "observation_id": str(uuid.uuid4()),
            "element_id": str(uuid.uuid4()),
            "frame_index": int(self._rng.integers(FRAMES)),
            "side": ("left", "right")[self._rng.integers(2)],
            "anchor_px": anchor,
            "end_px": None,
            "class_id": 3,
            "anchor_known": True,
            "end_known": False,
        }

    async def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        assert self._page is not None
        request_id = str(uuid.uuid4())
        answer = self._answers[request_id] = asyncio.get_running_loop().create_future()
        await self._page.send_json(request | {"id": request_id})
        try:
            return await asyncio.wait_for(answer, 60)
        finally:
            del self._answers[request_id]

    async def _read(self, socket: ClientWebSocketResponse) -> None:
        async for message in socket:
            event = json.loads(message.data)
            answer = self._answers.get(event.get("reply_to") or "")
            if answer is not None and not answer.done():
                answer.set_result(event)


async def _swallow(socket: ClientWebSocketResponse) -> None:
    async for _ in socket:
        pass


def measure(edits: int, times_ms: Sequence[float]) -> Measure:
    gc.collect()
    process = psutil.Process()
    rss_mb = process.memory_info().rss / 1e6
    median_ms = statistics.median(times_ms) if times_ms else 0.0
    return Measure(edits, rss_mb, threading.active_count(), process.num_fds(), median_ms)


async def replay(url: str, edits: int) -> tuple[list[Measure], int, int]:
    """Measures after each tenth; numbers of saved and refused edits."""
    measures: list[Measure] = []
    async with ClientSession() as http:
        people = [Person(http, url, seed) for seed in range(2)]
        for person in people:
            await person.open()
        times_ms: list[float] = []
        for number in range(1, edits + 1):
            person = people[number % 2]
            await person.go()
            times_ms.append(await person.edit())
            if number % (2 * REOPEN_EVERY) < 2:
                await person.close()
                await person.open()
            if number % (edits // TENTHS) == 0:
                await asyncio.sleep(3 * sessions.LINGER_S)
                measures.append(measure(number, times_ms))
                measures[-1].print()
                times_ms = []
        for person in people:
            await person.close()
        saved, refused = (sum(getattr(one, key) for one in people) for key in ("saved", "refused"))
    return measures, saved, refused


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--edits", type=int, default=5760, help="two people, one in 10 s, 8 hours")
    parser.add_argument("--limit", type=float, default=10.0, help="growth allowed, percent")
    options = parser.parse_args()
    sessions.LINGER_S = 0.3  # hours are seconds here
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "street"
        workspace = Workspace.create_street(folder, 7, range(FRAMES))
        with closing(Annotator(workspace)) as tool, Gateway(tool).running() as url:
            measures, saved, refused = asyncio.run(replay(url, options.edits))
        first = measures[0]
        with workspace.open_labels() as store:
            kept = len(store.labels.observations)
    last = measures[-1]
    growth = 100.0 * (last.rss_mb / first.rss_mb - 1.0)
    print(f"{saved} edits saved, {refused} refused; {kept} observations at the end")
    print(
        f"growth since the first tenth ({HOURS / TENTHS:.1f} h): {growth:+.1f} % memory, "
        f"{last.threads - first.threads:+} threads, {last.files - first.files:+} files"
    )
    return int(growth > options.limit or last.threads > first.threads + POOL)


if __name__ == "__main__":
    sys.exit(main())
