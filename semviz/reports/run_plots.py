"""The data of a run report, and its plots as SVG in the page's colours.

Each run has its metrics, diagnoses, and worst frames. The same figure gives the same SVG.
"""

import io
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semviz.presentation import plots
from semviz.presentation.plots import STATUS
from semviz.runs.diagnosis import run_diagnosis, run_elements
from semviz.runs.frame_table import STATUSES, FrameTable, frame_table
from semviz.runs.images import frame_image
from semviz.runs.metrics import Metrics
from semviz.runs.run import Run, run_names
from semviz.runs.stored_run import from_sound_frames
from semviz.runs.story import typical_positions
from semviz.runs.table_metrics import metrics_of
from semviz_core.base.localization import Status
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.element_statistics import ElementRecord
from semviz_core.diagnosis.reference import FrameReference
from semviz_core.diagnosis.run import RunDiagnosis
from semviz_core.metrics.pose_errors import Outcome, ProblemFacts, visible_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


FAR_M = 1.0
SEVERITY: dict[Status, int] = {"ok": 0, "ambiguous": 1, "cannot": 2}
"""Of frames that are not far off; the worst first."""


@dataclass(frozen=True, eq=False)
class RunReport:
    """A run with everything that a report shows of it. Its frames stay in its file."""

    name: str
    """The name that ``semviz serve`` shows."""
    path: Path
    run: Run
    elements: tuple[ElementRecord, ...]
    """Statistics of the map elements; outliers in most frames first."""
    recall: tuple[float | None, ...]
    """Of each frame with a reference pose: share of the mapped elements in view that were detected;
    None if unknown."""

    @classmethod
    def of(cls, name: str, path: Path, run: Run) -> "RunReport":
        """Read the frames once. Raise SemvizError if there are none."""
        if not len(run.frames):
            raise SemvizError(f"{path}: this run has no frames to report; localize again")
        recall: list[float | None] = []

        def measured(
            cases: Iterable[FrameReference], what: str, total: int
        ) -> Iterator[FrameReference]:
            for case in cases:
                recall.append(_recall(case))
                yield case

        elements = run_elements(run, measured)
        return cls(name, path, run, elements, tuple(recall))

    @property
    def table(self) -> FrameTable:
        return frame_table(self.run)

    @cached_property
    def metrics(self) -> Metrics:
        return metrics_of(self.run)

    @cached_property
    def diagnoses(self) -> tuple[str, ...]:
        """Name of each frame's diagnosis."""
        return tuple(self.table.texts_of(self.table.diagnosis))

    def image(self, row: int) -> bytes | None:
        """Return a frame's left image as JPEG or PNG; None if there is none."""
        return frame_image(self.run, self.path, row, "left")

    @cached_property
    def run_diagnosis(self) -> RunDiagnosis:
        """Recurring faults of map and camera, in a long run by typical frames."""
        return run_diagnosis(self.run, positions=typical_positions(self.run))

    @cached_property
    def outcomes(self) -> list[Outcome]:
        """Outcomes of the frames with a true pose, for plots."""
        return [_outcome(self, int(row)) for row in np.flatnonzero(self.table.has_truth)]

    def worst(self, count: int) -> list[int]:
        """Return the rows of the ``count`` worst frames, the worst first.

        They are overconfident, wrong, without pose, ambiguous, ok; within each by error.
        """
        table = self.table
        error_m = np.nan_to_num(table.distance_m)
        severity = np.array([SEVERITY[status] for status in STATUSES])[table.status]
        severity[error_m > FAR_M] = max(SEVERITY.values()) + 1
        severity[table.is_overconfident] = max(SEVERITY.values()) + 2
        return [int(row) for row in np.lexsort((-error_m, -severity))[:count]]

    def worst_of_each_diagnosis(self, count: int) -> list[int]:
        """Return the worst frame's row of each diagnosis, at most ``count``, worst first."""
        first: dict[str, int] = {}
        for row in self.worst(len(self.table)):
            first.setdefault(self.diagnoses[row], row)
        return list(first.values())[:count]


def load_reports(paths: Sequence[Path]) -> list[RunReport]:
    """Read runs. Raise SemvizError if one cannot be read, has no frames, or is named twice."""
    if len({path.resolve() for path in paths}) < len(paths):
        raise SemvizError("a run is named twice; name each run once")
    return [
        from_sound_frames(path, partial(RunReport.of, name, path))
        for name, path in zip(run_names(paths), paths, strict=True)
    ]


def _outcome(report: RunReport, row: int) -> Outcome:
    table = report.table
    has_pose = np.isfinite(table.distance_m[row])
    return Outcome(
        suite=report.run.semantic_map.frame.name,
        method=report.name,
        noise="",
        frame=int(table.index[row]),
        facts=ProblemFacts(detections=int(table.detections[row]), recall=report.recall[row]),
        status=STATUSES[table.status[row]],
        rte_m=float(table.distance_m[row]) if has_pose else None,
        rre_deg=float(table.angle_deg[row]) if has_pose else None,
        nees=None,
        total_ms=float(table.solve_ms[row]),
    )


def _recall(case: FrameReference) -> float | None:
    """Return the share of the mapped elements in view that were detected; None if unknown."""
    result = case.localization
    if case.truth is None or case.ids is None:
        return None
    visible = result.submap.id[visible_rows(result.submap, case.truth, result.camera)]
    return float(np.isin(visible, case.ids).mean()) if len(visible) else None


LEAST_M = 1e-3
"""Smaller errors are drawn at the lower edge."""
PLOT_WIDTH_PT = 640.0
BAR_SHARE, WIDEST_BAR_PT = 0.7, 8.0
"""Width of a frame's bar: share of the available width, and maximum."""
_THEMED = {
    plots.GRID: "var(--hairline)",
    **{color: f"var(--series-{number})" for number, color in enumerate(plots.COLORS)},
    **{tone.light: f"var(--{status})" for status, tone in STATUS.items()},
}
"""Colours of the figures, and the page's variables that replace them."""


def comparing_plots(reports: Sequence[RunReport]) -> dict[str, "Figure"]:
    """Return the plots of all runs with errors, by caption; none without true poses."""
    groups = {
        report.name: report.outcomes
        for report in reports
        if any(outcome.rte_m is not None for outcome in report.outcomes)
    }
    if not groups:
        return {}
    figures = {
        "Distribution of errors: share of all frames with a true pose": plots.histograms(groups),
        "Share of all frames below an error": plots.cumulative("", groups),
    }
    if any(outcome.facts.recall is not None for group in groups.values() for outcome in group):
        figures["Error by recall: share of the mapped elements in view that were detected"] = (
            plots.against_recall("", groups)
        )
    return figures


def plot_over_frames(report: RunReport) -> "Figure":
    """Plot every frame's status and, if known, its RTE; overconfident frames are marked."""
    has_errors = any(outcome.rte_m is not None for outcome in report.outcomes)
    figure = plots.new_figure(10.0, 3.2 if has_errors else 1.2)
    heights = (4.0, 1.0) if has_errors else (1.0,)
    axes = figure.subplots(len(heights), sharex=True, squeeze=False, height_ratios=heights).ravel()
    numbers = report.table.index.tolist()
    width = min(BAR_SHARE * PLOT_WIDTH_PT / (numbers[-1] - numbers[0] + 1), WIDEST_BAR_PT)
    if has_errors:
        _draw_errors(axes[0], report.outcomes, width)
    _draw_status(axes[-1], report, width)
    axes[-1].set(xlim=(numbers[0] - 0.5, numbers[-1] + 0.5), xlabel="frame")
    axes[-1].xaxis.get_major_locator().set_params(integer=True)
    return figure


def as_svg(figure: "Figure", name: str) -> str:
    """Return a figure as ``svg`` element; ``name`` makes its ids unique in the page."""
    import matplotlib as mpl

    written = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        no_metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(written, format="svg", transparent=True, metadata=no_metadata)
    svg = written.getvalue()
    svg = svg[svg.index("<svg") :]
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', svg))
    svg = re.sub(r' id="([^"]+)"', lambda match: match[0] if match[1] in used else "", svg)
    for color, themed in _THEMED.items():
        svg = svg.replace(color.lower(), themed)
    return svg


def _draw_errors(axis: "Axes", outcomes: Sequence[Outcome], width: float) -> None:
    points = [
        (outcome.frame, outcome.status, outcome.rte_m)
        for outcome in outcomes
        if outcome.rte_m is not None
    ]
    status = np.array([point[1] for point in points])
    frame = np.array([point[0] for point in points])
    error_m = np.clip([point[2] for point in points], LEAST_M, plots.FARTHEST_M)
    for name in ("ok", "ambiguous"):
        rows = status == name
        _draw_bars(axis, frame[rows], LEAST_M, error_m[rows], STATUS[name].light, width)
    wrong = (status == "ok") & (error_m > FAR_M)
    axis.plot(frame[wrong], error_m[wrong], "v", color=STATUS["cannot"].light)
    axis.axhline(FAR_M, color="0.6", linewidth=0.8)
    top = min(2.0 * max(error_m.max(), FAR_M), 2.0 * plots.FARTHEST_M)
    axis.set(yscale="log", ylim=(max(error_m.min() / 2.0, LEAST_M), top), ylabel="RTE (m)")
    plots.plain_numbers(axis.yaxis)
    plots.add_grid(axis)


def _draw_status(axis: "Axes", report: RunReport, width: float) -> None:
    """Draw a row of bars for each status, readable without colours."""
    for row, status in enumerate(STATUSES):
        frame = report.table.index[report.table.status == row]
        top = np.full(len(frame), row + 0.4)
        _draw_bars(axis, frame, row - 0.4, top, STATUS[status].light, width)
    axis.set_yticks(range(len(STATUSES)), STATUSES, fontsize="small")
    axis.set_ylim(len(STATUSES) - 0.5, -0.5)
    axis.spines[["top", "right"]].set_visible(False)


def _draw_bars(
    axis: "Axes", frame: IntArray, low: float, high: FloatArray, color: str, width: float
) -> None:
    """Draw a bar over each frame (k,), all as one path to keep files small."""
    x = np.repeat(frame.astype(np.float64), 3)
    y = np.stack([np.full(len(frame), low), high, np.full(len(frame), np.nan)], axis=1).ravel()
    axis.plot(x, y, color=color, linewidth=width, solid_capstyle="butt")
