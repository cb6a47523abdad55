"""The labelling tool on 100,000 observations over 10,000 frames: opening, stepping, editing.

    python bench/annotator_scale.py
    python bench/annotator_scale.py --elements 600 --frames 1000 --no-page

The workspace is synthetic: labels by big_labels.py, and a folder in KITTI's layout in which a few
pairs of a simulated street serve all frames (as hard links), two laps around a circle. The images
do not show the labels, so searches in them fail; reading and drawing them costs the usual time. One
run: every step and edit counts.
"""

import asyncio
import contextlib
import json
import os
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tests_support  # noqa: F401
import tyro
from aiohttp import ClientSession, ClientWebSocketResponse, WSMsgType
from big_labels import STEP_M, make_big_labels
from pages import CHROMIUM, label, report, serving
from playwright.sync_api import sync_playwright
from serving import at

from semviz.workspace.workspace import Workspace
from semviz_core.base.pose import Pose
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

SEQUENCE = "00"
PAIRS = 5
"""Distinct ones."""
LEARNT_S = 90.0
"""By then the tool has placed all elements and knows how well each frame fits."""


@dataclass(frozen=True)
class Options:
    elements: int = 6000
    frames: int = 10_000
    steps: int = 200
    edits: int = 200
    pause_ms: int = 100
    """Between two steps or edits: as somebody quick."""
    page: bool = True
    """Also in Chromium, to the drawn pixel."""
    seed: int = 0


def make_workspace(folder: Path, options: Options) -> Workspace:
    root = folder / "kitti"
    write_images(root / "sequences" / SEQUENCE, options.frames)
    (root / "poses").mkdir()
    radius_m = options.frames * STEP_M / 2.0 / (2.0 * np.pi)
    lines = []
    for angle in np.arange(options.frames) * STEP_M / radius_m:
        center = [radius_m * (1.0 - np.cos(angle)), 0.0, radius_m * np.sin(angle)]
        pose = Pose.from_rotvec([0.0, angle, 0.0], center).as_matrix()[:3]
        lines.append(" ".join(f"{value:.9e}" for value in pose.ravel()))
    (root / "poses" / f"{SEQUENCE}.txt").write_text("\n".join(lines) + "\n")
    made = Workspace.create_kitti(folder / "big", root, SEQUENCE)
    count = make_big_labels(made.labels_path, options.elements, options.frames, options.seed)
    made.open_labels().close()
    print(f"{count:,} observations of {options.elements:,} elements in {options.frames:,} frames")
    return made


def write_images(folder: Path, frames: int) -> None:
    """Write a KITTI sequence of ``frames`` in which a few pairs of images serve all."""
    street = Street(0, StreetOptions(PAIRS))
    for camera, side in ((2, "left"), (3, "right")):
        images = folder / f"image_{camera}"
        images.mkdir(parents=True)
        for index in range(PAIRS):
            image = street.image(index, "left" if side == "left" else "right")
            assert cv2.imwrite(str(images / f"{index:06d}.png"), image[..., ::-1])
        for index in range(PAIRS, frames):
            os.link(images / f"{index % PAIRS:06d}.png", images / f"{index:06d}.png")
    K = street.rig.left.K
    P = np.column_stack([K, np.zeros(3)])
    right = P - np.eye(3, 4, 3) * K[0, 0] * street.rig.baseline_m
    lines = [
        f"P{camera}: " + " ".join(f"{value:.9e}" for value in projection.ravel())
        for camera, projection in ((2, P), (3, right))
    ]
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * i:.6e}\n" for i in range(frames)))


class Client:
    """What the page does, without the page."""

    def __init__(self, socket: ClientWebSocketResponse) -> None:
        self._socket = socket

    async def ask(self, message: dict[str, Any], done: Callable[[dict[str, Any]], bool]) -> float:
        """Milliseconds until the answer for which ``done`` holds."""
        start = time.perf_counter()
        await self.ask_for(message, done)
        return 1000.0 * (time.perf_counter() - start)

    async def ask_for(
        self, message: dict[str, Any], done: Callable[[dict[str, Any]], bool]
    ) -> dict[str, Any]:
        """The answer for which ``done`` holds."""
        await self._socket.send_json(message)
        return await self.hear(done)

    async def listen(self, seconds: float) -> None:
        """Reads on: a page that doesn't is taken for gone."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self.hear(lambda told: False)

    async def hear(self, done: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        async for message in self._socket:
            if message.type != WSMsgType.TEXT:
                continue
            told: dict[str, Any] = json.loads(message.data)
            if told["type"] == "error":
                raise RuntimeError(told["text"])
            if done(told):
                return told
        raise RuntimeError("the tool has closed the connection")


async def by_socket(url: str, options: Options, first_s: float) -> None:
    """Steps and edits over the websocket: what the tool itself takes."""
    rng = np.random.default_rng(options.seed)
    start = time.perf_counter()
    async with (
        ClientSession() as http,
        http.ws_connect(at(url, "socket"), max_msg_size=0) as socket,
    ):
        client = Client(socket)
        await client.hear(lambda told: told["type"] == "workspace")
        await _go(client, 0, 0.0)
        opened_s = first_s + time.perf_counter() - start
        print(f"{'process to the first frame':<44} {opened_s:6.2f} s", flush=True)
        pause_s = options.pause_ms / 1000.0
        report("frame step, in the first minute", await _steps(client, options, 0, pause_s))
        report("edit to saved, likewise", await _edits(client, options, 0, pause_s))
        await client.listen(LEARNT_S)
        half = options.frames // 2
        report("frame step", await _steps(client, options, half, pause_s))
        jumps = rng.integers(0, options.frames, options.steps)
        report("jump to any frame", [await _go(client, int(jump), pause_s) for jump in jumps])
        report("edit to saved", await _edits(client, options, half, pause_s))


async def _steps(client: Client, options: Options, first: int, pause_s: float) -> list[float]:
    return [await _go(client, first + index, pause_s) for index in range(1, options.steps + 1)]


async def _go(client: Client, frame: int, pause_s: float) -> float:
    await asyncio.sleep(pause_s)
    return await client.ask(
        {"type": "go_to_frame", "id": str(frame), "frame": frame},
        lambda told: told["type"] == "frame" and told["frame"]["index"] == frame,
    )


async def _edits(client: Client, options: Options, first: int, pause_s: float) -> list[float]:
    """Signs drawn where nothing is expected, each in the next frame."""
    times = []
    for index in range(options.edits):
        await _go(client, first + index, pause_s)
        await asyncio.sleep(pause_s)
        request = str(uuid.uuid4())
        edit = {
            "kind": "draw",
            "observation_id": str(uuid.uuid4()),
            "element_id": str(uuid.uuid4()),
            "frame_index": first + index,
            "side": "left",
            "anchor_px": [600.5, 20.25],
            "end_px": None,
            "class_id": 3,
            "anchor_known": True,
            "end_known": False,
        }
        message = {"type": "apply_edit", "id": request, "edit": edit}
        times.append(await client.ask(message, partial(_is_saved, request)))
    return times


def _is_saved(request: str, told: dict[str, Any]) -> bool:
    return bool(told["type"] == "edit_saved" and told["reply_to"] == request)


def in_chromium(url: str) -> None:
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=CHROMIUM)
        label(browser, url, "page")
        browser.close()


def main(options: Options) -> None:
    print(f"load before: {os.getloadavg()[0]:.1f}; {os.cpu_count()} processors")
    with tempfile.TemporaryDirectory() as folder:
        made = make_workspace(Path(folder), options)
        with serving("annotate", str(made.path)) as (url, seconds):
            asyncio.run(by_socket(url, options, seconds))
            if options.page:
                in_chromium(url)


if __name__ == "__main__":
    main(tyro.cli(Options))
