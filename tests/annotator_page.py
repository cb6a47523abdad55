"""The labelling page of a workspace, served in this process or in one that can be killed."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from drawn_marks import do, sign

from semviz.annotator.server import Annotator
from semviz.annotator.session import LabelSession
from semviz.web.gateway import Gateway
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.labels import Labels, Observation
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals
from semviz_core.base.frame import Side
from semviz_core.simulation.street import Street

SIDES: tuple[Side, Side] = ("left", "right")


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
