"""semviz evaluate"""

import json
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from semviz.commands.parsing import OptionalPath


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
        from semviz.recording.reader import load_run
        from semviz.summary import summarize_run, write_csv
        from semviz_core.errors import SemvizError

        if not self.runs:
            raise SemvizError("name at least one run, such as town/runs/first.rrd")
        loaded = [(path, load_run(path)) for path in self.runs]
        summaries = [(path, summarize_run(run)) for path, run in loaded]
        if self.csv is not None:
            write_csv(loaded, self.csv)
        if self.json:
            rows = [{"run": str(path), **summary.as_dict()} for path, summary in summaries]
            print(json.dumps(rows[0] if len(rows) == 1 else {"runs": rows}))
        else:
            print("\n\n".join(f"{path}\n{summary.as_text()}" for path, summary in summaries))
        return 0
