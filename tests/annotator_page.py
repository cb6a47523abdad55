"""The labelling page of a workspace, served in this process or in one that can be killed."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from drawn_marks import do, sign
from journeys.driver import EMPTY_PAGE, LabelDriver

from semviz.annotator.server import Annotator
from semviz.annotator.session import LabelSession
from semviz.web.gateway import Gateway
from semviz.workspace.people import People, Role
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.labels import Labels, Observation, new_id
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals
from semviz_core.base.frame import Side
from semviz_core.simulation.street import Street

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SIDES: tuple[Side, Side] = ("left", "right")
WAIT_MS = 60_000


@dataclass
class Served:
    """A workspace behind the gateway."""

    url: str
    annotator: Annotator

    @property
    def labels(self) -> Labels:
        return self.annotator.session.labels

    @property
    def observations(self) -> list[Observation]:
        """Oldest first: their ids begin with the time of their making."""
        return sorted(self.labels.observations.values(), key=lambda row: row.id)


@contextmanager
def annotating(workspace: Workspace) -> Iterator[Served]:
    annotator = Annotator(workspace, author="tester")
    try:
        with Gateway(annotator).running() as url:
            yield Served(url, annotator)
    finally:
        annotator.close()


def draw_signs(workspace: Workspace, places: list[tuple[int, float]], author: str) -> None:
    """One rounded sign each, at (frame, u), by ``author``, before the page is opened."""
    session = LabelSession(workspace, author)
    for frame, u in places:
        do(session, sign(frame, "left", (u, 40.0), class_id=3))
    session.close()


@contextmanager
def opened_pages(
    chromium: "Browser", url: str, owner: str, people: People, guests: Mapping[str, Role]
) -> Iterator[dict[str, "Page"]]:
    """The page of who started the server at ``url``, and one of each guest, by name."""
    base, opened = url.split("?")[0], {}
    invited = {name: f"{base}?token={people.invite(name, role)}" for name, role in guests.items()}
    for name, address in {owner: url, **invited}.items():
        page = chromium.new_context(viewport={"width": 1280, "height": 720}).new_page()
        page.route("**/view/**", lambda route: route.fulfill(body=EMPTY_PAGE))
        LabelDriver(page).open(address)
        opened[name] = page
    yield opened
    for page in opened.values():
        page.context.close()


def draw_on(page: "Page", frame: int, u: float) -> None:
    """Draw a rounded sign at (u, 40) of the left image of a frame, and wait until it is saved."""
    page.evaluate(
        """([frame, u, observation, element]) => semviz.submit({
          kind: 'draw', observation_id: observation, element_id: element, frame_index: frame,
          side: 'left', anchor_px: [u, 40], end_px: null, end_known: false, class_id: 3 })""",
        [frame, u, new_id(), new_id()],
    )
    settled(page)


def settled(page: "Page") -> None:
    """Wait until the page has no unsaved edit."""
    page.wait_for_function("() => !semviz.state.pending.length", timeout=WAIT_MS)


class Killable:
    """``semviz annotate`` in a process of its own, always on the same port with the same token."""

    token = "killable"

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = 0
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> str:
        command = [sys.executable, "-m", "semviz.cli", "annotate", str(self.folder), "--no-open"]
        command += ["--port", str(self.port), "--author", "tester"]
        environment = os.environ | {"SEMVIZ_TOKEN": self.token}
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
        assert self.process.stdout is not None
        for line in self.process.stdout:
            found = re.search(r"http://\S+:(\d+)/\S+", line)
            if found:
                self.port = int(found[1])
                return found[0]
        raise AssertionError("semviz annotate did not start")

    def kill(self) -> None:
        if self.process is not None:
            os.kill(self.process.pid, signal.SIGKILL)
            self.process.wait()
            self.process = None


def true_detections(street: Street, frame: int, sides: Sequence[Side]) -> Proposals:
    """Detections of a perfect detector, of whole elements within 30 m."""
    elements = street.truth_map.elements
    far_m = np.linalg.norm(elements.anchor_m - street.view(frame, "left").center_m, axis=1)
    near = elements.id[far_m < 30.0]
    found: list[Proposal] = []
    for side in sides:
        seen, ids = street.labels(frame, side)
        kept = np.isin(ids, near) & seen.anchor_known & (seen.end_known | ~seen.is_line)
        exact = replace(seen[kept], score=np.full(kept.sum(), 0.9))
        found += as_proposals(frame, side, exact, street.rig.left, "true", "centroid")
    return Proposals.of(found)
