"""semviz detect evaluate"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from semviz.commands.benchmark import ONE_THREAD
from semviz.commands.parsing import OptionalFloat, OptionalPath, OptionalText, parse_frames
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz.known_images import KnownImage

REPORT = "report.html"


@dataclass(frozen=True)
class DetectEvaluate:
    """Say how good a detector is: what it finds and invents, class by class, how far off, how
    honest its sigma is, how fast. On rendered streets that nothing was trained on, or on labels."""

    workspaces: Annotated[Positional[tuple[Path, ...]], arg(metavar="[WORKSPACE ...]")] = ()
    """Workspaces whose labels are the truth; rendered streets if none is given."""
    model: Annotated[str | None, arg(metavar="MODEL", help_behavior_hint="")] = None
    """As for 'semviz detect'; what comes with semviz if not given."""
    measuring: Literal["edges", "paper"] = "edges"
    """How regions become elements."""
    streets: int = 20
    """So many streets, where no workspace is given."""
    frames_a_street: int = 5
    """So many frames of each."""
    frames: OptionalText = None
    """FIRST:END[:STEP]: in these frames of the workspaces only."""
    sides: Literal["left", "both"] = "left"
    """Look at left images, or at right ones too."""
    reach_m: float = 40.0
    """What is farther away does not count: neither missed nor false."""
    least_score: OptionalFloat = None
    """Figures of the detections that score so much; by default as few as give 0.2 false a frame."""
    out: OptionalPath = None
    """Folder for report.html: one page that needs no network, with pictures of what went wrong."""
    pictures: int = 24
    """Pictures of what was missed in the report, and as many of what was invented."""
    json: bool = False
    """Print one JSON object instead of tables."""

    def run(self) -> int:
        os.environ |= ONE_THREAD

        import cv2

        from semviz.detector_evaluation import evaluate
        from semviz.reporting.detector_page import as_html
        from semviz.reporting.detector_tables import as_text
        from semviz_core.detection.models import load_detector
        from semviz_core.files import check_replaceable, replacing

        self._check()
        cv2.setNumThreads(1)
        if self.out is not None:
            check_replaceable(self.out / REPORT)
        images = self._images()
        detector = load_detector(self.model, self.measuring)
        told = {"reach": f"{self.reach_m:g} m"}
        evaluation = evaluate(detector, images, self.least_score, told)
        if self.out is not None:
            page = as_html(evaluation, self.pictures)
            with replacing(self.out / REPORT) as temporary:
                temporary.write_text(page, encoding="utf-8", newline="\n")
        print(json.dumps(evaluation.as_json()) if self.json else as_text(evaluation))
        return 0

    def _check(self) -> None:
        from semviz_core.evaluation.detection import NEAREST_M

        for number, option, least in (
            (self.streets, "--streets", 1),
            (self.frames_a_street, "--frames-a-street", 1),
            (self.pictures, "--pictures", 0),
        ):
            if number < least:
                raise SemvizError(f"{option} {number}: give {least} or more")
        if not self.reach_m > NEAREST_M:
            raise SemvizError(f"--reach-m {self.reach_m:g}: give more than {NEAREST_M:g} m")
        if self.least_score is not None and not 0.0 <= self.least_score <= 1.0:
            raise SemvizError(f"--least-score {self.least_score:g}: give a number from 0 to 1")
        if self.frames is not None and not self.workspaces:
            raise SemvizError("--frames is for workspaces; of streets, say --frames-a-street")

    def _images(self) -> "list[KnownImage]":
        from semviz.known_images import labelled_images, street_images
        from semviz.workspace import Workspace
        from semviz_core.sources.source import Side

        sides: tuple[Side, ...] = ("left", "right") if self.sides == "both" else ("left",)
        if not self.workspaces:
            return list(street_images(self.streets, self.frames_a_street, sides, self.reach_m))
        frames = parse_frames(self.frames)
        opened = [Workspace.open(path) for path in self.workspaces]
        return [
            image for one in opened for image in labelled_images(one, frames, sides, self.reach_m)
        ]
