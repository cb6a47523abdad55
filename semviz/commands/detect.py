"""semviz detect"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from semviz.commands.parsing import OptionalFloat, OptionalText, parse_frames

if TYPE_CHECKING:
    from semviz.workspace import Workspace
    from semviz_annotation.proposals import Proposals
    from semviz_core.sources.source import Side


@dataclass(frozen=True)
class Detect:
    """Find poles and signs in the images of a workspace; what is found is proposed for labelling,
    and can be localized with. The same command again goes on where it was stopped. The word 'run'
    may be left out."""

    workspace: Positional[Path]
    """The workspace."""
    model: Annotated[str | None, arg(metavar="MODEL", help_behavior_hint="")] = None
    """Weights of 'semviz detect train', the .toml of an ONNX model, a folder of a transformers
    model or hf:NAME; what comes with semviz if not given."""
    measuring: Literal["edges", "paper"] = "edges"
    """How elements are measured within what the model finds: edges to a fraction of a pixel, or
    the paper's Canny and morphology."""
    frames: OptionalText = None
    """FIRST:END[:STEP]; all frames if not given."""
    sides: Literal["both", "left"] = "both"
    """Which images; the left ones are enough to localize."""
    least_score: OptionalFloat = None
    """Leave out what is less sure; if not given, the model has the say."""

    def run(self) -> int:
        from semviz.detecting import DetectOptions, detect_images, images_of
        from semviz.workspace import Workspace
        from semviz_core.detection.models import load_detector

        workspace = Workspace.open(self.workspace)
        options = DetectOptions(self.model, self.measuring, self.least_score)
        images = images_of(workspace, parse_frames(self.frames), self._sides(workspace))
        detector = load_detector(self.model, self.measuring)
        start_s = perf_counter()
        found = detect_images(workspace, detector, options, images)
        print(f"{workspace.proposals_path}: {_told(found, workspace)}")
        print(
            f"{perf_counter() - start_s:.0f} s; next: semviz annotate {self.workspace}; "
            f"semviz localize {self.workspace} --observations detected"
        )
        return 0

    def _sides(self, workspace: "Workspace") -> tuple["Side", ...]:
        has_right = workspace.source.rig.right is not None
        return ("left", "right") if self.sides == "both" and has_right else ("left",)


def _told(proposals: "Proposals", workspace: "Workspace") -> str:
    """How much was found, in how many images."""
    images = 0 if proposals.looked is None else len(proposals.looked.images)
    counts = Counter(row.class_id for row in proposals.found)
    kinds = [f"{counts[one.id]} {one.name}" for one in workspace.classes if counts[one.id]]
    return f"{len(proposals.found)} found in {images} images ({', '.join(kinds) or 'nothing'})"
