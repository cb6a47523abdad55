"""30 people label one workspace at once: click to saved beside one person alone, in one run.

    python bench/annotator_team.py
    python bench/annotator_team.py --people 8 --edits 50

Each person is a page's websocket with a token of its own: it steps through frames of its own range,
fetches their images and those of the next frames once, as a browser does, draws a sign, moves every
third one, and waits between two edits. At the end all pages have seen the
same last operation, every edit is in the log in the name of who made it, and the log is checked.
The processor time of an edit does not depend on what else the machine does; it sets the ceiling.
The workspace is as in annotator_scale.py; images do not show the labels.
"""

import asyncio
import contextlib
import os
import tempfile
import time
import uuid
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tests_support  # noqa: F401
import tyro
from aiohttp import ClientSession, ClientWebSocketResponse
from annotator_scale import Client, Options, make_workspace
from pages import report, serving
from serving import at

from semviz.workspace.people import People
from semviz.workspace.workspace import Workspace
from semviz_annotation.storage.integrity import check_labels


@dataclass(frozen=True)
class TeamOptions:
    people: int = 30
    edits: int = 300
    pause_ms: int = 1000
    """Between two edits of a person, on average: as somebody quick."""
    frames: int = 1000
    elements: int = 200
    seed: int = 0


@dataclass
class Labeller:
    """One person with one page."""

    name: str
    client: Client
    first: int
    rng: np.random.Generator
    fetch: Callable[[str], Awaitable[int]]
    """Gets the bytes of an image."""
    times: list[float] = field(default_factory=list)
    images: dict[str, int] = field(default_factory=dict)
    """Bytes of those that the browser has by now."""
    last: str = ""

    async def work(self, options: TeamOptions) -> None:
        for number in range(options.edits):
            await self.client.listen(self.rng.uniform(0.5, 1.5) * options.pause_ms / 1000.0)
            frame = self.first + number % max(1, options.frames // (2 * options.people))
            if number % 3 == 2:
                await self._apply(
                    {
                        "kind": "move",
                        "observation_id": self.last,
                        "anchor_px": [float(self.rng.uniform(10, 1200)), 30.0],
                        "end_px": None,
                    }
                )
            else:
                await self._draw(frame)

    async def _draw(self, frame: int) -> None:
        message = {"type": "go_to_frame", "id": str(uuid.uuid4()), "frame": frame}
        await self.client.ask(message, lambda told: told["type"] == "frame")
        for near in (frame, frame + 1, max(0, frame - 1)):
            for side in ("left", "right"):
                image = f"image/{near}/{side}.png"
                if image not in self.images:
                    self.images[image] = await self.fetch(image)
        self.last = str(uuid.uuid4())
        await self._apply(
            {
                "kind": "draw",
                "observation_id": self.last,
                "element_id": str(uuid.uuid4()),
                "frame_index": frame,
                "side": "left",
                "anchor_px": [float(self.rng.uniform(10, 1200)), 20.25],
                "end_px": None,
                "class_id": 3,
                "anchor_known": True,
                "end_known": False,
            }
        )

    async def _apply(self, edit: dict[str, Any]) -> None:
        request = str(uuid.uuid4())
        message = {"type": "apply_edit", "id": request, "edit": edit}
        saved = partial(_is_saved, request)
        self.times.append(await self.client.ask(message, saved))


def server_cpu_s() -> float:
    """Processor time of this process's children so far, whatever else the machine does."""
    total = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            values = path.read_text().rpartition(")")[2].split()
            if int(values[1]) == os.getpid():
                total += int(values[11]) + int(values[12])
    return total / os.sysconf("SC_CLK_TCK")


def _is_saved(request: str, told: dict[str, Any]) -> bool:
    """As the number at the top right: the operation is on disk."""
    return bool(told["type"] == "saved_operation" and told["reply_to"] == request)


async def run(url: str, tokens: dict[str, str], options: TeamOptions, workspace: Workspace) -> None:
    async with ClientSession() as http:
        alone = (await _labellers(http, url, dict(list(tokens.items())[:1]), options))[0]
        await alone.work(options)
        report("one person: click to saved", alone.times)
        team = [alone, *await _labellers(http, url, dict(list(tokens.items())[1:]), options)]
        alone.times.clear()
        start, before_s = time.perf_counter(), server_cpu_s()
        await asyncio.gather(*(_work_and_stay(one, team, options) for one in team))
        took_s, cpu_s = time.perf_counter() - start, server_cpu_s() - before_s
        report(f"{len(team)} people: click to saved", [ms for one in team for ms in one.times])
        edits = len(team) * options.edits
        print(f"{'edits a second, all together':<44} {edits / took_s:6.1f}")
        print(f"{'processor time of the server, an edit':<44} {1000.0 * cpu_s / edits:6.0f} ms")
        fetched = sum(len(one.images) for one in team)
        print(f"{'images fetched, an edit':<44} {fetched / edits:6.2f}")
        with workspace.open_labels() as store:
            last = store.end
        start = time.perf_counter()
        ends = await asyncio.gather(*(_end_seen(one.client, last.number) for one in team))
        print(
            f"{'until all pages show the last operation':<44} {time.perf_counter() - start:6.2f} s"
        )
        assert set(ends) == {last.hash}, "the pages do not show the same labels"


async def _work_and_stay(one: Labeller, team: list[Labeller], options: TeamOptions) -> None:
    """Works, then reads on until all are ready: a page that doesn't is taken for gone."""
    await one.work(options)
    while any(len(other.times) < options.edits for other in team):
        await one.client.listen(1.0)


async def _labellers(
    http: ClientSession, url: str, tokens: dict[str, str], options: TeamOptions
) -> list[Labeller]:
    base = url.split("?")[0]
    made = []
    for number, (name, token) in enumerate(tokens.items()):
        socket: ClientWebSocketResponse = await http.ws_connect(
            at(f"{base}?token={token}", "socket"), max_msg_size=0
        )
        client = Client(socket)
        await client.hear(lambda told: told["type"] == "workspace")
        first = number * options.frames // options.people
        rng = np.random.default_rng([options.seed, number])
        fetch = partial(_fetched, http, f"{base}?token={token}")
        made.append(Labeller(name, client, first, rng, fetch))
    return made


async def _fetched(http: ClientSession, url: str, image: str) -> int:
    async with http.get(at(url, image)) as answer:
        assert answer.status == 200, await answer.text()
        return len(await answer.read())


async def _end_seen(client: Client, number: int) -> str:
    """The hash of the last operation, once the page has seen it."""
    told = await client.ask_for(
        {"type": "go_to_frame", "id": str(uuid.uuid4()), "frame": 0},
        lambda told: told["type"] == "frame" and told["frame"]["operation"] >= number,
    )
    return str(told["frame"]["hash"])


def main(options: TeamOptions) -> None:
    print(f"load before: {os.getloadavg()[0]:.1f}; {os.cpu_count()} processors")
    with tempfile.TemporaryDirectory() as folder:
        made = make_workspace(
            Path(folder), Options(elements=options.elements, frames=options.frames)
        )
        people = People(made.path)
        tokens = {f"p{n:02}": people.invite(f"p{n:02}", "annotate") for n in range(options.people)}
        with made.open_labels() as store:
            before = store.last_operation
        with serving("annotate", str(made.path)) as (url, _):
            asyncio.run(run(url, tokens, options, made))
        with made.open_labels() as store:
            authors = [row.author for row in store.operations(after=before)]
        expected = dict.fromkeys(tokens, options.edits) | {"p00": 2 * options.edits}
        assert {name: authors.count(name) for name in tokens} == expected, "an edit is missing"
        checked = check_labels(made.labels_path)
        print(f"{len(authors):,} edits are in the log, and {checked.operations:,} operations sound")


if __name__ == "__main__":
    main(tyro.cli(TeamOptions))
