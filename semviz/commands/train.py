"""semviz train"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from semviz.commands.parsing import OptionalFloat, OptionalInt, OptionalPath
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz.progress import TrainingBar
    from semviz_core.learning.checkpoint import Course
    from semviz_core.learning.task import SampleSource
    from semviz_core.learning.training import Moment, TrainingOptions

INTERRUPTED = 130
PLOT = "losses.png"


@dataclass(frozen=True)
class Train:
    """Train what is learned; the same command again goes on where it stopped.

    A checkpoint is written every minute, and at the end, on ctrl-C and on SIGTERM. Several
    processes: torchrun --nproc-per-node 2 --no-python semviz train ..."""

    model: Annotated[Positional[str], arg(metavar="MODEL")]
    """paper, paper-no-semantics, bpnpnet, bpnpnet-semantic, matcher or verifier."""
    out: Annotated[Path, arg(metavar="DIR")]
    """The training's folder: checkpoint, losses as JSON lines and as a plot."""
    samples: OptionalInt = None
    """How many to see in all; as planned before, or as the model's own schedule has it."""
    batch: int = 12
    """Samples a step, over all processes together."""
    seed: int = 0
    """Of the first weights, and of the samples."""
    workers: int = 1
    """Processes that make samples, for each that trains."""
    workspace: Annotated[UseAppendAction[tuple[Path, ...]], arg(metavar="WORKSPACE")] = ()
    """Train on labels and maps of this one; may be given several times."""
    kitti_poses: OptionalPath = None
    """Folder with poses of KITTI (00.txt); the roads are simulated if not given."""
    pole_maps: OptionalPath = None
    """Folder with pole maps (kitti_00.npz), together with --kitti-poses."""
    precision: Literal["float32", "bf16"] = "float32"
    """bf16: a GPU's networks compute with half as many bits."""
    held_out: int = 240
    """How many samples that are never trained on are measured, at most 40 times in a training."""
    stop_after_s: OptionalFloat = None
    """Save and stop after so many seconds."""

    def run(self) -> int:
        from semviz.progress import TrainingBar, tell_of_compiling
        from semviz_core.learning.tasks import make_task
        from semviz_core.learning.training import Training

        tell_of_compiling()
        task = make_task(self.model, self._source(), self.seed)
        training = Training(task, self.out, self._options())
        if training.crew.leads:
            with TrainingBar(self.model, training.course) as bar:
                ending = training.run(lambda moment: self._tell(moment, bar))
            print(self._told(training.course, ending))
        else:
            ending = training.run()
        status = INTERRUPTED if ending == "interrupted" else 0
        training.crew.leave(status)
        return status

    def _options(self) -> "TrainingOptions":
        from semviz_core.learning.training import TrainingOptions

        return TrainingOptions(
            samples=self.samples,
            batch=self.batch,
            seed=self.seed,
            workers=self.workers,
            precision=self.precision,
            held_out=self.held_out,
            stop_after_s=float("inf") if self.stop_after_s is None else self.stop_after_s,
        )

    def _source(self) -> "SampleSource":
        """The task's own drills, on KITTI's roads if wanted; or labels."""
        from semviz_core.learning.drills import KittiFiles
        from semviz_core.learning.tasks import own_drills

        drills = own_drills(self.model)
        if (self.kitti_poses is None) != (self.pole_maps is None):
            raise SemvizError("--kitti-poses and --pole-maps belong together; give both")
        if self.kitti_poses is not None and self.pole_maps is not None:
            if self.workspace:
                raise SemvizError("--workspace and --kitti-poses: give one of them")
            return replace(drills, kitti=KittiFiles(self.kitti_poses, self.pole_maps))
        if self.workspace:
            from semviz.training_data import workspace_samples
            from semviz.workspace import Workspace

            opened = [Workspace.open(path) for path in self.workspace]
            return workspace_samples(opened, shift_m=drills.shift_m)
        return drills

    def _tell(self, moment: "Moment", bar: "TrainingBar") -> None:
        """The bar, and the plot whenever there is something new to see in it."""
        from semviz.training_plot import draw
        from semviz_core.learning.history import read_history
        from semviz_core.learning.training import HISTORY

        bar.show(moment)
        if moment.held_out:
            draw(read_history(self.out / HISTORY), self.model, self.out / PLOT)

    def _told(self, course: "Course", ending: str) -> str:
        figures = ", ".join(f"{name} {value:.3g}" for name, value in course.held_out.items())
        lines = [
            f"{self.out}: {ending} after {course.samples} of {course.of} samples, "
            f"{sum(course.seconds.values()):.0f} s in all",
            *([f"held out: {figures}"] if figures else []),
            f"next: semviz weights {self.out} --out FOLDER"
            if ending == "finished"
            else "next: the same command goes on",
        ]
        return "\n".join(lines)
