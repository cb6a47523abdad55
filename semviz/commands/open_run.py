"""semviz open"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class OpenRun:
    """Open a run in rerun's own viewer."""

    run_file: Positional[Path]
    """The .rrd file."""

    def run(self) -> int:
        from semviz.recording.reader import check_run_file

        check_run_file(self.run_file)
        viewer = [sys.executable, "-m", "rerun_cli", "--bind", "127.0.0.1"]
        return subprocess.call([*viewer, str(self.run_file)])
