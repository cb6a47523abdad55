"""How large errors are: histograms, as in the paper."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from semviz.plot_style import add_grid, add_legend, line_style, new_figure
from semviz_core.arrays import FloatArray
from semviz_core.evaluation.outcomes import Outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BINS = 20
ROUND_LIMITS = (0.1, 0.2, 0.5, 1.0)
"""Where histograms may end, m or deg."""
SHARE_INSIDE = 0.95
"""A histogram ends at the first round limit below which so many of the errors are."""
BESIDE = (1.11, 1.28)
"""Where histograms show larger errors, and frames without a pose: in parts of their length."""
MOST_TOGETHER = 3
"""More outlines over each other cannot be read."""
Groups = dict[str, list[Outcome]]
"""Outcomes of frames with truth, by method or run; at least one."""
Error = Callable[[Outcome], float | None]
ERRORS: tuple[tuple[str, Error], ...] = (
    ("RTE (m)", lambda one: one.rte_m),
    ("RRE (deg)", lambda one: one.rre_deg),
)


def histograms(groups: Groups, title: str = "") -> "Figure":
    """Shares of all frames by RTE and RRE; at the right, set apart, what is larger, and frames
    without a pose. At most MOST_TOGETHER over each other."""
    names = list(groups)
    rows = [names[first : first + MOST_TOGETHER] for first in range(0, len(names), MOST_TOGETHER)]
    figure = new_figure(10.0, 0.6 + 3.0 * len(rows), title)
    axes = figure.subplots(len(rows), 2, squeeze=False, sharex="col", sharey="col")
    for column, (label, error) in enumerate(ERRORS):
        errors = {name: _values(group, error) for name, group in groups.items()}
        limit = _round_limit(np.concatenate(list(errors.values())))
        for axis, together in zip(axes[:, column], rows, strict=True):
            for name in together:
                _draw_histogram(axis, errors[name], limit, name, names.index(name))
            _set_axis(axis, label, limit)
    add_legend(figure)
    return figure


def _set_axis(axis: "Axes", label: str, limit: float) -> None:
    ticks = np.linspace(0.0, limit, 6)
    axis.axvline(limit, color="0.6", linewidth=0.8)
    axis.set_xticks(
        [*ticks, *(limit * np.array(BESIDE))],
        [*(f"{tick:g}" for tick in ticks.round(3)), "more", "no pose"],
    )
    axis.tick_params(labelbottom=True)
    axis.set(xlabel=label, ylabel="frames (%)", xlim=(0.0, 1.38 * limit))
    add_grid(axis)


def _values(group: list[Outcome], error: Error) -> FloatArray:
    """(k,) errors of all frames; infinite for those without a pose."""
    values = (error(one) for one in group)
    return np.array([np.inf if value is None else value for value in values])


def _round_limit(errors: FloatArray) -> float:
    """Where a histogram of errors (k,) ends."""
    found = errors[np.isfinite(errors)]
    wanted = float(np.quantile(found, SHARE_INSIDE)) if len(found) else ROUND_LIMITS[-1]
    return next((limit for limit in ROUND_LIMITS if limit >= wanted), ROUND_LIMITS[-1])


def _draw_histogram(axis: "Axes", errors: FloatArray, limit: float, name: str, number: int) -> None:
    edges = np.linspace(0.0, limit, BINS + 1)
    inside = errors[errors < limit]
    shares = np.histogram(inside, edges)[0] / len(errors) * 100.0
    without = np.isinf(errors).mean() * 100.0
    beside = (errors >= limit).mean() * 100.0 - without, without
    style = line_style(number)
    axis.stairs(shares, edges, fill=True, color=style["color"], alpha=0.15)
    axis.stairs(shares, edges, label=name, **style)
    for share, middle in zip(beside, BESIDE, strict=True):
        axis.stairs([share], [(middle - 0.06) * limit, (middle + 0.06) * limit], **style)
