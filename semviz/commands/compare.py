"""semviz compare"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg


@dataclass(frozen=True)
class Compare:
    """Compare two runs of one drive: which frames are fixed, which are broken, and what differs.

    A gate for scripts: exit status 1 where a condition of --fail-if holds."""

    base: Annotated[Positional[Path], arg(metavar="BASE")]
    """The run (.rrd) to compare with."""
    other: Annotated[Positional[Path], arg(metavar="OTHER")]
    """The run that is judged."""
    fail_if: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="CONDITION")] = ()
    """Such as 'median_rte_m > 1.05*base'; may be given several times. A wrong name lists all."""
    json: bool = False
    """Print one JSON object, with every frame, instead of text."""

    def run(self) -> int:
        from semviz.comparing.comparison import compare_runs
        from semviz.comparing.conditions import check_whole, parse_condition
        from semviz.comparing.words import as_text
        from semviz.recording.reader import load_run

        conditions = [parse_condition(text) for text in self.fail_if]
        base, other = load_run(self.base), load_run(self.other)
        for path, run in ((self.base, base), (self.other, other)):
            if conditions:
                check_whole(run, str(path))
        comparison = compare_runs(base, other)
        failed = [one for one in conditions if one.holds(*comparison.measured)]
        if self.json:
            sides = {"base": str(self.base), "other": str(self.other)}
            failures = {"failed": [one.text for one in failed]}
            print(json.dumps({**sides, **comparison.as_dict(), **failures}))
        else:
            print(f"base: {self.base}\nother: {self.other}\n{as_text(comparison)}")
            for one in failed:
                print(f"failed: {one.as_text(*comparison.measured)}")
        return 1 if failed else 0
