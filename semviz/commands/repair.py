"""semviz repair"""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from semviz.commands.parsing import OptionalPath


@dataclass(frozen=True)
class Repair:
    """Write a whole file of a run that broke off: killed, or copied in part."""

    run_file: Positional[Path]
    """The .rrd file."""
    out: OptionalPath = None
    """The file to write; the run's own if not given."""

    def run(self) -> int:
        from semviz.recording.repair import repair

        out = self.out or self.run_file
        run = repair(self.run_file, out)
        print(f"{out}: {run.note or f'{len(run.frames)} frames, complete'}")
        return 0
