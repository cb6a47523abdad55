"""What a frame of `semviz localize` costs, in one process and in several.

    python bench/localize_jobs.py [--images none] [--jobs 2] [--frames 200]

Processor time per frame of a simulated street: of the first process, and of all others together.
A run of a few frames is subtracted, so starting and loading do not count. With as many cores as
processes, the largest of these times is the one that a frame takes.
"""

import resource
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from semviz.workspace.localization.localize import (
    CROP_RADIUS_M,
    LocalizeOptions,
    localize_workspace,
    record,
)
from semviz.workspace.workspace import TRUTH, Workspace

FEW = 40


@dataclass(frozen=True)
class Options:
    frames: int = 200
    jobs: int = 2
    images: Literal["embedded", "none"] = "embedded"


def main(options: Options) -> None:
    most = FEW + options.frames
    with tempfile.TemporaryDirectory() as folder:
        workspace = Workspace.create_street(Path(folder, "street"), 5, range(most))
        for jobs in (1, options.jobs):
            few, many = (cpu_s(workspace, count, jobs, options) for count in (FEW, most))
            first, others = (1e3 * (b - a) / options.frames for a, b in zip(few, many, strict=True))
            shared = f", others {others / jobs:.1f} ms each" if jobs > 1 else ""
            print(f"jobs {jobs}: first process {first:.1f} ms{shared}")


def cpu_s(workspace: Workspace, frames: int, jobs: int, options: Options) -> tuple[float, float]:
    """Return the processor time (s) of this process and of its children for some frames."""
    simulated = LocalizeOptions(observations="simulated", crop_radius_m=CROP_RADIUS_M["simulated"])
    localization = localize_workspace(workspace, TRUTH, simulated, range(frames), jobs=jobs)
    path, whom = workspace.path / "run.rrd", (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    before = [resource.getrusage(who) for who in whom]
    record(localization, path, workspace="", map_name=TRUTH, images=options.images)
    used = [
        now.ru_utime + now.ru_stime - then.ru_utime - then.ru_stime
        for now, then in zip(map(resource.getrusage, whom), before, strict=True)
    ]
    return used[0], used[1]


if __name__ == "__main__":
    main(tyro.cli(Options))
