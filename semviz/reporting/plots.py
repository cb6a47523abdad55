"""The plots of a report, as SVG that follows the page's colours."""

import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from semviz.benchmark.histograms import histograms
from semviz.benchmark.plots import FARTHEST_M, against_recall, cumulative
from semviz.palette import STATUS
from semviz.plot_style import (
    COLORS,
    GRID,
    add_grid,
    new_figure,
    plain_numbers,
)
from semviz.reporting.facts import FAR_M, Reported
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.evaluation.metrics import STATUSES
from semviz_core.evaluation.outcomes import Outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEAST_M = 1e-3
"""Smaller errors are drawn at the lower edge."""
PLOT_WIDTH_PT = 640.0
BAR_SHARE, WIDEST_BAR_PT = 0.7, 8.0
"""How wide the bar of a frame is: of what it could have, and at most."""
_THEMED = {
    GRID: "var(--hairline)",
    **{color: f"var(--series-{number})" for number, color in enumerate(COLORS)},
    **{tone.light: f"var(--{status})" for status, tone in STATUS.items()},
}
"""Colours of the figures that the page gives in its own."""


def comparing_plots(reported: Sequence[Reported]) -> dict[str, "Figure"]:
    """Of all runs with errors together, by what they show; none without true poses."""
    groups = {
        one.name: one.outcomes
        for one in reported
        if any(outcome.rte_m is not None for outcome in one.outcomes)
    }
    if not groups:
        return {}
    plots = {
        "How large errors are: share of all frames with a true pose": histograms(groups),
        "Share of all frames below an error": cumulative("", groups),
    }
    if any(one.facts.recall is not None for group in groups.values() for one in group):
        plots["Error against the share of what is in view that was detected"] = against_recall(
            "", groups
        )
    return plots


def over_the_drive(one: Reported) -> "Figure":
    """Above, where errors are known: RTE by status, with a mark on what is sure and wrong. Below:
    the status of every frame."""
    has_errors = any(outcome.rte_m is not None for outcome in one.outcomes)
    figure = new_figure(10.0, 3.2 if has_errors else 1.2)
    heights = (4.0, 1.0) if has_errors else (1.0,)
    axes = figure.subplots(len(heights), sharex=True, squeeze=False, height_ratios=heights).ravel()
    numbers = [record.frame.index for record in one.run.frames]
    width = min(BAR_SHARE * PLOT_WIDTH_PT / (numbers[-1] - numbers[0] + 1), WIDEST_BAR_PT)
    if has_errors:
        _draw_errors(axes[0], one.outcomes, width)
    _draw_status(axes[-1], one, width)
    axes[-1].set(xlim=(numbers[0] - 0.5, numbers[-1] + 0.5), xlabel="frame")
    axes[-1].xaxis.get_major_locator().set_params(integer=True)
    return figure


def as_svg(figure: "Figure", name: str) -> str:
    """One ``svg`` element, the same for the same figure; ``name`` tells its ids from others'."""
    import matplotlib as mpl

    written = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(written, format="svg", transparent=True, metadata=nothing)
    svg = written.getvalue()
    svg = svg[svg.index("<svg") :]
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', svg))
    svg = re.sub(r' id="([^"]+)"', lambda found: found[0] if found[1] in used else "", svg)
    for color, themed in _THEMED.items():
        svg = svg.replace(color.lower(), themed)
    return svg


def _draw_errors(axis: "Axes", outcomes: Sequence[Outcome], width: float) -> None:
    found = [(one.frame, one.status, one.rte_m) for one in outcomes if one.rte_m is not None]
    status = np.array([one[1] for one in found])
    frame = np.array([one[0] for one in found])
    error_m = np.clip([one[2] for one in found], LEAST_M, FARTHEST_M)
    for name in ("ok", "ambiguous"):
        rows = status == name
        _draw_bars(axis, frame[rows], LEAST_M, error_m[rows], STATUS[name].light, width)
    wrong = (status == "ok") & (error_m > FAR_M)
    axis.plot(frame[wrong], error_m[wrong], "v", color=STATUS["cannot"].light)
    axis.axhline(FAR_M, color="0.6", linewidth=0.8)
    top = min(2.0 * max(error_m.max(), FAR_M), 2.0 * FARTHEST_M)
    axis.set(yscale="log", ylim=(max(error_m.min() / 2.0, LEAST_M), top), ylabel="RTE (m)")
    plain_numbers(axis.yaxis)
    add_grid(axis)


def _draw_status(axis: "Axes", one: Reported, width: float) -> None:
    """A row for each status, so that colour alone tells nothing."""
    for row, status in enumerate(STATUSES):
        frame = [
            record.frame.index for record in one.run.frames if record.localization.status == status
        ]
        top = np.full(len(frame), row + 0.4)
        _draw_bars(axis, np.array(frame), row - 0.4, top, STATUS[status].light, width)
    axis.set_yticks(range(len(STATUSES)), STATUSES, fontsize="small")
    axis.set_ylim(len(STATUSES) - 0.5, -0.5)
    axis.spines[["top", "right"]].set_visible(False)


def _draw_bars(
    axis: "Axes", frame: IntArray, low: float, high: FloatArray, color: str, width: float
) -> None:
    """A bar over each frame (k,), all as one path: long drives stay small files."""
    x = np.repeat(frame.astype(np.float64), 3)
    y = np.stack([np.full(len(frame), low), high, np.full(len(frame), np.nan)], axis=1).ravel()
    axis.plot(x, y, color=color, linewidth=width, solid_capstyle="butt")
