"""semviz train"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from semviz.commands.parsing import OptionalFloat, OptionalInt, OptionalPath
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz_core.learning.task import SampleSource


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
    """bf16: networks compute with half as many bits, on a GPU or a processor with AMX."""
    held_out: int = 240
    """How many samples that are never trained on are measured, at most 40 times in a training."""
    stop_after_s: OptionalFloat = None
    """Save and stop after so many seconds."""

    def run(self) -> int:
        from semviz.progress import tell_of_compiling
        from semviz.training_run import train
        from semviz_core.learning.tasks import make_task

        tell_of_compiling()
        task = make_task(self.model, self._source(), self.seed)
        return train(task, self, self.held_out, [f"semviz weights {self.out} --out FOLDER"])

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
