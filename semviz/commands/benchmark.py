"""semviz benchmark"""

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from semviz.commands.parsing import OptionalPath, OptionalText
from semviz_core.errors import SemvizError

ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB")
}
"""Times are of one core; read when the libraries are loaded, and inherited by processes."""


@dataclass(frozen=True)
class Benchmark:
    """Compare methods on the same simulated frames: errors, trust, time, how near the bound."""

    methods: OptionalText = None
    """Such as search,direct; all that can run if not given, and for the suite paper those of its
    table. A wrong name lists the known ones."""
    noise: Literal["paper", "low", "both"] = "both"
    """Noise of the detections: the paper's table, or 1 px and 0.3 deg."""
    frames: int = 200
    """Number of frames of each suite and noise."""
    seed: int = 1000
    """Seed of the first frame; the next has the next. Seeds below 1000 are for tuning."""
    suite: str = "frames"
    """Such as frames,matched; hard means all hard sets, all everything; paper is the table of the
    paper with its printed figures. A wrong name lists them."""
    kitti_poses: OptionalPath = None
    """Folder with poses of KITTI (09.txt); the roads are simulated if not given."""
    pole_maps: OptionalPath = None
    """Folder with pole maps (kitti_09.npz), together with --kitti-poses."""
    sequences: str = "09,10"
    """Which of KITTI's sequences."""
    jobs: int = 1
    """Number of processes; more than one disturb each other, so their times are marked."""
    out: Path = Path("benchmark")
    """Folder for results, tables and plots. An interrupted run goes on from what is there."""
    plots: bool = True
    """Draw plots into the folder too (needs matplotlib)."""
    json: bool = False
    """Print one JSON object instead of tables."""

    def run(self) -> int:
        os.environ |= ONE_THREAD

        from semviz.benchmark.methods import choose_methods
        from semviz.benchmark.paper_table import METHODS, SUITE
        from semviz.benchmark.plan import Plan
        from semviz.benchmark.plots import draw
        from semviz.benchmark.report import Report
        from semviz.benchmark.runner import complete
        from semviz.benchmark.suites import Roads, choose_suites
        from semviz_core.evaluation.tables import rows

        for number, option, least in (
            (self.frames, "--frames", 1), (self.seed, "--seed", 0), (self.jobs, "--jobs", 1),
        ):  # fmt: skip
            if number < least:
                raise SemvizError(f"{option} {number}: give {least} or more")
        suites = choose_suites(self.suite)
        methods = self.methods or (",".join(METHODS) if self.suite == SUITE else None)
        chosen = choose_methods(methods, {suite.kind for suite in suites})
        plan = Plan(
            suites,
            noises=("paper", "low") if self.noise == "both" else (self.noise,),
            methods=chosen.by_kind,
            seeds=range(self.seed, self.seed + self.frames),
            roads=Roads(self.kitti_poses, self.pole_maps, tuple(self.sequences.split(","))),
        )
        notes = [*chosen.notes(), *plan.notes()]
        for note in notes:
            print(f"semviz: {note}", file=sys.stderr)
        outcomes = complete(plan, self.out / "results.jsonl", self.jobs)
        report = Report(plan.settings(), tuple(notes), tuple(rows(outcomes)))
        report.write(self.out)
        if self.plots:
            draw(outcomes, report.rows, self.out)
        print(json.dumps(report.as_json()) if self.json else report.as_text())
        return 0
