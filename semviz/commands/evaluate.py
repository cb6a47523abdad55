"""semviz evaluate"""

import json
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from semviz.commands.parsing import OptionalPath
from semviz_core.errors import SemvizError


@dataclass(frozen=True)
class Evaluate:
    """Measure runs against the true poses: translation and rotation errors, status, time."""

    runs: Positional[tuple[Path, ...]]
    """Runs (.rrd)."""
    json: bool = False
    """Print one JSON object instead of tables."""
    csv: OptionalPath = None
    """Write one row a frame to this file as well."""

    def run(self) -> int:
        from semviz.measure import summarize_run, write_csv
        from semviz.recording.reader import load_run

        if not self.runs:
            raise SemvizError("name at least one run, such as town/runs/first.rrd")
        loaded = [load_run(path) for path in self.runs]
        summaries = [summarize_run(run) for run in loaded]
        if self.csv is not None:
            write_csv(loaded, self.csv)
        if self.json:
            rows = [
                {"run": str(path), **one.as_json()}
                for path, one in zip(self.runs, summaries, strict=True)
            ]
            print(json.dumps(rows[0] if len(rows) == 1 else {"runs": rows}))
        else:
            for path, run, one in zip(self.runs, loaded, summaries, strict=True):
                print(f"{path}  {run.note}\n{one.as_text()}\n")
        return 0
