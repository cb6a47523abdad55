"""semviz open"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from semviz_core.errors import SemvizError


@dataclass(frozen=True)
class OpenRun:
    """Open a run in rerun's own viewer."""

    run_file: Positional[Path]
    """The .rrd file."""

    def run(self) -> int:
        if not self.run_file.is_file():
            raise SemvizError(f"{self.run_file}: no such run; make one with 'semviz localize'")
        viewer = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1"]
        return subprocess.call([*viewer, str(self.run_file)])
