"""Plots of a run report, as SVG in the page's colours. The same figure gives the same SVG."""

import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from semviz.presentation import plots
from semviz.presentation.palette import STATUS
from semviz.reports.run_data import FAR_M, RunReport
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.metrics.pose_errors import STATUSES, Outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    numbers = [record.frame.index for record in report.run.frames]
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
        frame = [
            record.frame.index
            for record in report.run.frames
            if record.localization.status == status
        ]
        top = np.full(len(frame), row + 0.4)
        _draw_bars(axis, np.array(frame), row - 0.4, top, STATUS[status].light, width)
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
