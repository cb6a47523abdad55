"""The commands evaluate, compare, report, repair and trajectory."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

from tyro.conf import Positional, UseAppendAction, arg

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.runs.run import Run
    from semviz.runs.tables import Row
    from semviz_annotation.map_formats.conversion import ConversionTally
    from semviz_core.base.frame import Frame
    from semviz_core.metrics.pose_errors import Summary


@dataclass(frozen=True)
class EvaluateCommand:
    """Evaluate runs against ground truth: errors, status, diagnoses, runtime.

    Example: 'semviz evaluate town/runs/search.rrd --json --csv frames.csv'."""

    runs: Positional[tuple[Path, ...]]
    """Runs (.rrd)."""
    json: bool = False
    """Print one JSON object instead of tables."""
    csv: parsing.OptionalPath = None
    """Also write one row per frame to this file."""
    force: parsing.Force = False

    def run(self) -> int:
        from semviz.runs.stored_run import from_sound_frames
        from semviz.runs.tables import write_csv
        from semviz.workspace.outputs import check_outputs, starts_with

        if not self.runs:
            raise SemvizError("name at least one run, for example town/runs/first.rrd")
        if self.csv is not None:
            ours = starts_with(b"run,frame,time_s,status,rte_m")
            check_outputs(self.csv, ours, force=self.force, reads=self.runs)
        found = [from_sound_frames(path, self._evaluated) for path in self.runs]
        if self.csv is not None:
            write_csv([row for one in found for row in one.rows], self.csv)
        if self.json:
            rows = [
                {"run": str(path), **one.summary.as_json(), "diagnoses": one.diagnoses}
                for path, one in zip(self.runs, found, strict=True)
            ]
            print(json.dumps(rows[0] if len(rows) == 1 else {"runs": rows}))
        else:
            for path, one in zip(self.runs, found, strict=True):
                diagnoses = ", ".join(f"{kind} {n}" for kind, n in one.diagnoses.items())
                print(f"{path}  {one.note}\n{one.summary.as_text()}\ndiagnoses: {diagnoses}\n")
        return 0

    def _evaluated(self, run: "Run") -> "_Evaluated":
        from semviz.runs.metrics import summarize_run
        from semviz.runs.table_metrics import found_diagnoses
        from semviz.runs.tables import frame_rows

        summary = summarize_run(run)
        rows = [] if self.csv is None else frame_rows(run)
        return _Evaluated(run.note, summary, found_diagnoses(run), rows)


class _Evaluated(NamedTuple):
    """What is said of a run."""

    note: str
    summary: "Summary"
    diagnoses: dict[str, int]
    rows: "list[Row]"
    """One for each frame, if they are wanted."""


@dataclass(frozen=True)
class CompareCommand:
    """Compare two runs of one sequence: fixed and broken frames, metrics, and different settings.

    As a gate for scripts, exit with status 1 if a condition of --fail-if holds. Example: 'semviz
    compare old.rrd new.rrd --fail-if "median_rte_m > 1.05*base"'."""

    base: Annotated[Positional[Path], arg(metavar="BASE")]
    """Reference run (.rrd)."""
    other: Annotated[Positional[Path], arg(metavar="OTHER")]
    """Run (.rrd) to compare with the reference."""
    fail_if: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="CONDITION")] = ()
    """For example 'median_rte_m > 1.05*base'; may be repeated. A wrong name lists all metrics."""
    json: bool = False
    """Print one JSON object, with every frame, instead of text."""

    def run(self) -> int:
        from semviz.runs.comparison import compare_runs, comparison_text
        from semviz.runs.metrics import check_complete, parse_condition
        from semviz.runs.stored_run import open_run

        conditions = [parse_condition(text) for text in self.fail_if]
        base, other = (open_run(path, checks_frames=True) for path in (self.base, self.other))
        for path, run in ((self.base, base), (self.other, other)):
            if conditions:
                check_complete(run, str(path))
        comparison = compare_runs(base, other)
        failed = [condition for condition in conditions if condition.holds(*comparison.measured)]
        if self.json:
            sides = {"base": str(self.base), "other": str(self.other)}
            failures = {"failed": [condition.text for condition in failed]}
            print(json.dumps({**sides, **comparison.as_dict(), **failures}))
        else:
            print(f"base: {self.base}\nother: {self.other}\n{comparison_text(comparison)}")
            for condition in failed:
                print(f"failed: {condition.as_text(*comparison.measured)}")
        return 1 if failed else 0


Format = Literal["html", "md", "latex"]
_MARKS: dict[Format, tuple[bytes, ...]] = {
    "html": (b"<!DOCTYPE html>", b"<title>semviz report: "),
    "md": (b"# ", b"\n## RTE (m) and RRE (deg)\n"),
    "latex": (b"\\begin{table}", b"\\caption{RTE (m) and RRE (deg)}"),
}
"""What the start of a report contains, in this order."""
FORMATS: dict[str, Format] = {".html": "html", ".htm": "html", ".md": "md", ".tex": "latex"}


@dataclass(frozen=True)
class ReportCommand:
    """Write a report of runs: settings, metrics, diagnoses and worst frames, as one page without
    network requests, or as tables.

    Example: 'semviz report town/runs/search.rrd town/runs/learned.rrd --out report.html'."""

    runs: Positional[tuple[Path, ...]]
    """Runs (.rrd), side by side; the first is the reference."""
    out: Path = Path("report.html")
    """File to write; its ending (.html, .md, .tex) selects the format."""
    format: Literal["by ending", "html", "md", "latex"] = "by ending"
    """html: the whole report; md, latex: its tables."""
    pictures: int = 6
    """Maximum number of frame images per run: the worst frame of each diagnosis."""
    force: parsing.Force = False
    json: parsing.Json = False

    def run(self) -> int:
        from semviz.reports.run_plots import load_reports
        from semviz.reports.run_report import as_latex, as_markdown, run_report_html
        from semviz.workspace.outputs import check_outputs, contains
        from semviz_core.common.files import replacing

        if not self.runs:
            raise SemvizError("name at least one run, for example town/runs/first.rrd")
        if self.pictures < 0:
            raise SemvizError(f"--pictures {self.pictures}: give 0 or more")
        kind = self._format()
        ours = contains(*_MARKS[kind])
        check_outputs(self.out, ours, force=self.force, reads=self.runs)
        reports = load_reports(self.runs)
        if kind == "html":
            text = run_report_html(reports, self.pictures)
        else:
            text = as_markdown(reports) if kind == "md" else as_latex(reports)
        with replacing(self.out) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
        size = len(text.encode())
        if self.json:
            print(json.dumps({"path": str(self.out), "format": kind, "bytes": size}))
        else:
            print(f"{self.out}: {size / 1000:.0f} kB")
        return 0

    def _format(self) -> Format:
        if self.format != "by ending":
            return self.format
        if self.out.suffix not in FORMATS:
            raise SemvizError(
                f"{self.out}: unknown ending; use {', '.join(FORMATS)}, or choose --format"
            )
        return FORMATS[self.out.suffix]


@dataclass(frozen=True)
class RepairCommand:
    """Write a new file from the sound frames of a run that was killed, copied in part, or damaged.

    Every frame is compared with its checksum.

    Example: 'semviz repair town/runs/search.partial.rrd --out town/runs/search.rrd'."""

    run_file: Positional[Path]
    """Run (.rrd)."""
    out: parsing.OptionalPath = None
    """File to write; default: replace the run."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object instead of a line."""

    def run(self) -> int:
        from semviz.runs.writer import repair
        from semviz.workspace import outputs

        out = self.out or self.run_file
        outputs.check_outputs(out, outputs.RUN, force=self.force, purpose="run")
        run = repair(self.run_file, out)
        unchecked = "; they had no checksums, so damage would not have been found"
        state = run.note or f"{len(run.frames)} frames, complete"
        text = f"{state}{'' if run.checked else unchecked}"
        content = {"file": str(out), "frames": len(run.frames), "lost": run.lost, "state": text}
        print(json.dumps(content) if self.json else f"{out}: {text}")
        return 0


@dataclass(frozen=True)
class TrajectoryCommand:
    """Export the poses of a run or a workspace in a format that evo reads.

    Example: 'semviz trajectory town/runs/search.rrd estimate.tum'."""

    source: Positional[Path]
    """Run (.rrd): its estimates; or workspace: its true poses."""
    file: Positional[Path]
    """File to write."""
    format: Literal["tum", "kitti"] = "tum"
    """tum: time and pose, in the map frame, z up; kitti: one pose per line, in KITTI's axes."""
    truth: bool = False
    """Export the true poses of a run instead of the estimates."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object instead of lines: counts, dropped items, assumed values."""

    def run(self) -> int:
        from semviz.workspace import outputs
        from semviz_annotation.map_formats.conversion import ConversionTally, ExchangeReport
        from semviz_core.datasets.trajectory import save_trajectory

        # Files of poses have no place for a mark, and a sequence's own may have any name.
        outputs.check_outputs(self.file, outputs.never, force=self.force, reads=[self.source])
        tally = ConversionTally()
        frames = self._frames(tally)
        save_trajectory(frames, self.file, self.format)
        _note_losses(frames, self.format, tally)
        posed = sum(frame.T_map_camera is not None for frame in frames)
        report = ExchangeReport.of(self.file, self.format, {"poses": posed}, tally)
        print(json.dumps(report.as_dict()) if self.json else report.as_text())
        return 0

    def _frames(self, tally: "ConversionTally") -> "Sequence[Frame]":
        """Return the frames with the poses to write."""
        if self.source.suffix != ".rrd":
            if self.truth:
                raise SemvizError("--truth is for runs: a workspace has true poses only")
            return parsing.open_workspace(self.source).source.frames
        from semviz.runs.reader import load_run

        run = load_run(self.source)
        return [frame.frame for frame in run.frames] if self.truth else _estimates(run, tally)


def _estimates(run: "Run", tally: "ConversionTally") -> "list[Frame]":
    """Return the frames of a run with its estimated poses."""
    estimates = [localization.T_camera_map for localization in run.localizations]
    statuses = Counter(localization.status for localization in run.localizations)
    tally.drop("covariances", sum(estimate is not None for estimate in estimates))
    tally.drop("the word 'ambiguous': such poses are written like others", statuses["ambiguous"])
    return [
        replace(record.frame, T_map_camera=None if pose is None else pose.inverse())
        for record, pose in zip(run.frames, estimates, strict=True)
    ]


def _note_losses(frames: "Sequence[Frame]", format_: str, tally: "ConversionTally") -> None:
    missing = [str(frame.index) for frame in frames if frame.T_map_camera is None]
    more = ", ..." if len(missing) > 10 else ""
    tally.drop(f"frames without a pose: {', '.join(missing[:10])}{more}", len(missing))
    if format_ == "kitti":
        tally.drop("times", len(frames))
        if [frame.index for frame in frames] != list(range(len(frames))):
            tally.drop("frame numbers: line n is the n-th frame, not frame n", len(frames))
