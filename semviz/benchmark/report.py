"""The tables of a benchmark: aligned text, Markdown, JSON."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

from semviz.benchmark import paper_table
from semviz.tables import Table, figure, percent
from semviz_core.evaluation.tables import ALL, Row
from semviz_core.files import replacing

Columns = tuple[tuple[str, Callable[[Row], str]], ...]
"""Headers, and what stands under them in a row."""


@dataclass(frozen=True)
class Report:
    """What a benchmark found."""

    settings: dict[str, Any]
    notes: tuple[str, ...]
    """What readers of the numbers should know."""
    rows: tuple[Row, ...]

    def as_json(self) -> dict[str, Any]:
        """The object that ``semviz benchmark --json`` prints."""
        rows = [row.as_json() for row in self.rows]
        return {"settings": self.settings, "notes": list(self.notes), "rows": rows}

    def as_text(self) -> str:
        """For terminals of 120 columns."""
        told = [fill(one, 118) for one in self._differences()]
        return "\n\n".join([*told, *(table.as_text() for table in self._tables())])

    def as_markdown(self) -> str:
        made = ", ".join(f"{name} {value}" for name, value in self.settings.items())
        notes = [f"Note: {note}." for note in self.notes]
        tables = (table.as_markdown() for table in self._tables())
        parts = ["# Benchmark", f"Made with {made}.", *notes, *self._differences(), *tables]
        return "\n\n".join(parts) + "\n"

    def write(self, folder: Path) -> None:
        """``table.md`` and ``table.json``."""
        for name, text in (
            ("table.md", self.as_markdown()),
            ("table.json", json.dumps(self.as_json(), indent=1) + "\n"),
        ):
            with replacing(folder / name) as path:
                path.write_text(text)

    def _tables(self) -> list[Table]:
        """The paper's, then those of each suite and noise."""
        groups: dict[tuple[str, str], list[Row]] = {}
        for row in self.rows:
            groups.setdefault((row.suite, row.noise), []).append(row)
        papers = [group for (suite, _), group in groups.items() if suite == paper_table.SUITE]
        tables = [table for group in groups.values() for table in _tables_of(group)]
        return [*map(paper_table.beside_printed, papers), *tables]

    def _differences(self) -> tuple[str, ...]:
        """What readers of the paper's table should know."""
        there = any(row.suite == paper_table.SUITE for row in self.rows)
        return paper_table.DIFFERENCES if there else ()


def _tables_of(group: list[Row]) -> list[Table]:
    """Of one suite with one noise."""
    where = f"{group[0].suite}, noise {group[0].noise}"
    return [
        _table(f"{where}: RTE (m) and RRE (deg)", group, _ERRORS),
        _table(f"{where}: trust", group, _TRUST),
        _times_table(f"{where}: time (ms)", [row for row in group if row.stratum == ALL]),
    ]


def _table(title: str, group: list[Row], columns: Columns) -> Table:
    cells = tuple(tuple(cell(row) for _, cell in columns) for row in group)
    return Table(title, tuple(header for header, _ in columns), cells, words=2)


def _times_table(title: str, group: list[Row]) -> Table:
    cells = []
    for row in group:
        cells.append((row.method, "first call", _milliseconds(row, row.first_call_ms), "-"))
        for stage, time in {"whole": row.time_ms, **row.stages_ms}.items():
            spread = (_milliseconds(row, time.median), _milliseconds(row, time.p95))
            cells.append((row.method, stage, *spread))
    if not all(row.timed_alone for row in group):
        title += "; * too long: other processes were at work"
    return Table(title, ("method", "stage", "median", "p95"), tuple(cells), words=2)


def _milliseconds(row: Row, value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}" + ("" if row.timed_alone else "*")


_WHO: Columns = (
    ("method", lambda row: row.method),
    ("stratum", lambda row: row.stratum),
    ("frames", lambda row: str(row.accuracy.frames)),
)
_ERRORS: Columns = (
    *_WHO,
    ("RTE", lambda row: figure(row.accuracy.rte_m.mean)),
    ("Q1", lambda row: figure(row.accuracy.rte_m.q1)),
    ("Q2", lambda row: figure(row.accuracy.rte_m.q2)),
    ("Q3", lambda row: figure(row.accuracy.rte_m.q3)),
    ("<1 m", lambda row: percent(row.accuracy.share_below_1m)),
    ("RRE", lambda row: figure(row.accuracy.rre_deg.mean)),
    ("Q1", lambda row: figure(row.accuracy.rre_deg.q1)),
    ("Q2", lambda row: figure(row.accuracy.rre_deg.q2)),
    ("Q3", lambda row: figure(row.accuracy.rre_deg.q3)),
    ("<1 deg", lambda row: percent(row.accuracy.share_below_1deg)),
    ("/bound", lambda row: figure(row.bound_ratio_median)),
)
_TRUST: Columns = (
    *_WHO,
    ("ok", lambda row: percent(row.coverage)),
    ("ambig.", lambda row: percent(row.ambiguous)),
    ("cannot", lambda row: percent(row.cannot)),
    ("sure+wrong", lambda row: percent(row.confident_wrong)),
    ("ok >1 m", lambda row: percent(row.ok_above_1m)),
    ("NEES", lambda row: figure(row.nees_mean)),
    ("both <1", lambda row: percent(row.success)),
    ("RMS/bound", lambda row: figure(row.rms_over_bound)),
)
