"""semviz detect train"""

from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from semviz.commands.parsing import OptionalFloat, OptionalInt, OptionalText, parse_frames
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz_core.detection.labelled import LabelledImages
    from semviz_core.learning.street_images import StreetImages

STREETS, STREETS_BESIDE_LABELS = 400, 40
HELD_OUT = 64
"""So many crops are measured."""
IMAGES = "streets"


@dataclass(frozen=True)
class DetectTrain:
    """Train the detector's network on rendered streets, and on labels; the same command again
    goes on where it stopped.

    A checkpoint is written every minute, and at the end, on ctrl-C and on SIGTERM."""

    workspaces: Annotated[Positional[tuple[Path, ...]], arg(metavar="[WORKSPACE ...]")] = ()
    """Learn from what people labelled in these, too."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("detector")
    """The training's folder: rendered images, checkpoint, losses as JSON lines and as a plot."""
    start: Annotated[str | None, arg(name="from", metavar="WEIGHTS", help_behavior_hint="")] = None
    """Begin with these weights; 'shipped' for those that come with semviz."""
    streets: OptionalInt = None
    """So many rendered streets, each of ten images; 400, or 40 beside workspaces; 0 for labels
    only."""
    frames: OptionalText = None
    """FIRST:END[:STEP]: these frames of the workspaces only."""
    samples: OptionalInt = None
    """How many crops to see in all; as planned before, or 48000."""
    batch: int = 8
    """Crops a step."""
    seed: int = 0
    """Of the first weights, and of the crops."""
    workers: int = 1
    """Processes that render, and make crops."""
    precision: Literal["float32", "bf16"] = "float32"
    """bf16: computes with half as many bits, twice as fast on a GPU or a processor with AMX."""
    stop_after_s: OptionalFloat = None
    """Save and stop after so many seconds of training."""

    def run(self) -> int:
        if self.workers < 1:
            raise SemvizError(f"--workers {self.workers}: give 1 or more")

        from semviz.training_run import train
        from semviz_core.learning.detector_task import make_detector

        start = self._start()
        task = make_detector(self._source(), self.seed, start)
        weights = "FOLDER/detector.safetensors"
        then = [
            f"semviz weights {self.out} --out FOLDER",
            f"semviz detect evaluate --model {weights}",
            f"semviz detect WORKSPACE --model {weights}",
        ]
        return train(task, self, HELD_OUT, then)

    def _start(self) -> Path | None:
        from semviz_core.learning.weights import read_weights, shipped_weights

        if self.start is None:
            return None
        path = shipped_weights("detector") if self.start == "shipped" else Path(self.start)
        read_weights(path)  # said before streets are rendered, not after
        return path

    def _source(self) -> "LabelledImages":
        """Rendered streets, made where they are missing; labels; or both in turn."""
        from semviz_core.detection.joined import JoinedImages

        kinds: list[LabelledImages] = []
        if self.workspaces:
            from semviz.detector_data import workspace_images
            from semviz.workspace import Workspace

            opened = [Workspace.open(path) for path in self.workspaces]
            kinds.append(workspace_images(opened, parse_frames(self.frames)))
        elif self.frames is not None:
            raise SemvizError("--frames: says which frames of workspaces; name a workspace")
        if streets := self._streets():
            kinds.append(self._rendered(streets))
        if not kinds:
            raise SemvizError("--streets 0: nothing is left to learn from; name a workspace")
        return kinds[0] if len(kinds) == 1 else JoinedImages(tuple(kinds))

    def _streets(self) -> int:
        if self.streets is not None and not 0 <= self.streets <= 9_000:
            raise SemvizError(f"--streets {self.streets}: give 0 to 9000")
        usual = STREETS_BESIDE_LABELS if self.workspaces else STREETS
        return usual if self.streets is None else self.streets

    def _rendered(self, streets: int) -> "StreetImages":
        from semviz.progress import track
        from semviz_core.learning.street_images import StreetImages

        images = StreetImages(self.out / IMAGES, streets, max(2, streets // 20))
        missing = images.missing()
        try:
            with ProcessPoolExecutor(self.workers, get_context("spawn")) as pool:
                rendered = pool.map(images.render, missing)
                for _ in track(rendered, "rendering streets", len(missing)):
                    pass
        except BrokenProcessPool:
            raise SemvizError(
                "a process that renders died (out of memory?); the same command goes on"
            ) from None
        return images
