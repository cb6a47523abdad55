"""The plots of a benchmark: a PNG file each."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semviz.benchmark.histograms import histograms
from semviz.plot_style import (
    COLORS,
    add_grid,
    add_legend,
    line_style,
    new_figure,
    plain_numbers,
)
from semviz_core.arrays import FloatArray
from semviz_core.evaluation.outcomes import Outcome
from semviz_core.evaluation.tables import ALL, STRATA, Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MARKERS = {"ok": ("o", COLORS[0]), "ambiguous": ("x", COLORS[1])}
FARTHEST_M = 100.0
"""A pose that is further off is only wrong; how far says nothing and would squeeze the others."""
ERRORS: tuple[tuple[str, Callable[[Outcome], float | None], tuple[float, float]], ...] = (
    ("RTE (m)", lambda one: one.rte_m, (0.01, FARTHEST_M)),
    ("RRE (deg)", lambda one: one.rre_deg, (0.02, 180.0)),
)
"""Name, value, limits of the axis."""
MOST_BANDS = 3
"""More quartile bands over each other cannot be read."""
LEAST_IN_BIN = 5
"""Quartiles of fewer frames say nothing."""
Groups = dict[str, list[Outcome]]
"""Outcomes of frames with enough detections, by method; only methods that found poses."""


def draw(outcomes: Iterable[Outcome], rows: Sequence[Row], folder: Path) -> None:
    """Write the plots of each suite and noise to ``folder``.

    Raises SemvizError where matplotlib is not installed.
    """
    for (suite, noise), groups in _grouped(outcomes).items():
        title = f"{suite}, noise {noise}"
        timed = [row for row in rows if (row.suite, row.noise, row.stratum) == (suite, noise, ALL)]
        figures = {"cumulative": cumulative(title, groups), "time": times(title, timed)}
        if groups:
            figures["histogram"] = histograms(groups, title)
        facts = [one.facts for group in groups.values() for one in group]
        if any(one.bound_m is not None for one in facts):
            figures["bound"] = against_bound(title, groups)
        if any(one.recall is not None for one in facts):
            figures["recall"] = against_recall(title, groups)
        for name, figure in figures.items():
            figure.savefig(folder / f"{_file_name(suite)}-{noise}-{name}.png", dpi=120)


def cumulative(title: str, groups: Groups) -> "Figure":
    """Share of ALL frames below an error: a curve that ends below 100 % left some unanswered."""
    figure = new_figure(10.0, 4.2, title)
    for axis, (label, error, limits) in zip(figure.subplots(1, 2), ERRORS, strict=True):
        for number, (method, group) in enumerate(groups.items()):
            found = np.sort(_finite(map(error, group)))
            share = np.arange(1, len(found) + 1) / len(group) * 100.0
            axis.plot(found, share, label=method, **line_style(number))
        axis.axvline(1.0, color="0.6", linewidth=0.8, zorder=0)
        axis.set(xscale="log", xlim=limits, xlabel=label)
        axis.set(ylim=(0.0, 101.0), ylabel="frames below (%)")
        plain_numbers(axis.xaxis)
        add_grid(axis)
    add_legend(figure)
    return figure


def against_bound(title: str, groups: Groups) -> "Figure":
    """RTE of each frame over the median error of its Cramer-Rao bound; 100 m stands for more."""
    columns = max(min(len(groups), 3), 1)
    rows = max(-(-len(groups) // columns), 1)
    figure = new_figure(3.4 * columns + 0.6, 3.2 * rows + 0.8, title)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    bounds = _finite(one.facts.bound_m for group in groups.values() for one in group)
    both = [bounds.min(initial=1.0), bounds.max(initial=1.0)]
    for axis, (method, group) in zip(axes, groups.items(), strict=False):
        for status, (marker, color) in MARKERS.items():
            points = _finite_rows(
                (one.facts.bound_m, one.rte_m) for one in group if one.status == status
            )
            bound, rte = np.minimum(points, FARTHEST_M).T
            axis.scatter(
                bound,
                rte,
                s=12,
                marker=marker,
                color=color,
                alpha=0.6,
                linewidths=0.8,
                label=status,
            )
        axis.plot(both, both, color="0.3", linewidth=1.0, label="1:1", zorder=0)
        axis.set(xscale="log", yscale="log")
        axis.tick_params(labelbottom=True)
        axis.set_title(method, fontsize="medium")
        plain_numbers(axis.xaxis, axis.yaxis)
        add_grid(axis)
    for axis in axes[len(groups) :]:
        axis.remove()
    figure.supxlabel("median error of an efficient estimator on the frame (m)", fontsize="medium")
    figure.supylabel("RTE (m)", fontsize="medium")
    axes[0].legend(loc="lower right", fontsize="small")
    return figure


def against_recall(title: str, groups: Groups) -> "Figure":
    """Median errors by recall of the image, as in the paper; with quartiles if methods are few."""
    figure = new_figure(10.0, 4.2, title)
    edges = np.linspace(0.0, 1.0, 11)
    for axis, (label, error, _) in zip(figure.subplots(1, 2), ERRORS, strict=True):
        for number, (method, group) in enumerate(groups.items()):
            middle, quartiles = _by_recall(group, error, edges)
            if not len(middle):
                continue
            line = axis.plot(
                middle, quartiles[:, 1], marker="o", label=method, **line_style(number)
            )
            if len(groups) > MOST_BANDS:
                continue
            color = line[0].get_color()
            axis.fill_between(middle, quartiles[:, 0], quartiles[:, 2], color=color, alpha=0.10)
            axis.plot(middle, quartiles[:, [0, 2]], **{**line_style(number), "linewidth": 0.7})
        axis.set(
            xlim=(0.0, 100.0),
            xlabel="visible mapped elements that were detected (%)",
            ylabel=f"{label}: median" + (" and quartiles" if len(groups) <= MOST_BANDS else ""),
        )
        if axis.lines:
            axis.set_yscale("log")
            plain_numbers(axis.yaxis)
        else:
            few = f"fewer than {LEAST_IN_BIN} frames at every recall"
            axis.text(50.0, 0.5, few, ha="center", color="0.4")
            axis.set_yticks([])
        add_grid(axis)
    add_legend(figure)
    return figure


def times(title: str, rows: Sequence[Row]) -> "Figure":
    """Median (bar) and 95th percentile (tick) of each stage and of the whole frame."""
    bars = [
        (f"{row.method}: {stage}" if stage else f"{row.method}, whole", stage, time)
        for row in rows
        for stage, time in [*row.stages_ms.items(), ("", row.time_ms)]
    ]
    figure = new_figure(8.0, 0.26 * len(bars) + 1.4, title)
    axis = figure.subplots()
    for place, (_, stage, time) in enumerate(bars):
        if time.median is None or time.p95 is None:
            continue
        color = COLORS[4] if stage else COLORS[0]
        axis.barh(place, time.median, color=color, height=0.7)
        axis.plot([time.median, time.p95], [place, place], color="0.2", linewidth=1.0)
        axis.plot(time.p95, place, "|", color="0.2", markersize=9)
    axis.set(xscale="log", xlabel="time (ms): bar to the median, tick at the 95th percentile")
    plain_numbers(axis.xaxis)
    axis.set_yticks(range(len(bars)), [name for name, _, _ in bars])
    axis.invert_yaxis()
    add_grid(axis)
    return figure


def _grouped(outcomes: Iterable[Outcome]) -> dict[tuple[str, str], Groups]:
    found: dict[tuple[str, str], Groups] = {}
    for one in outcomes:
        if not STRATA[ALL](one.facts):
            continue
        found.setdefault((one.suite, one.noise), {}).setdefault(one.method, []).append(one)
    return {
        key: {
            method: group
            for method, group in groups.items()
            if any(one.rte_m is not None for one in group)
        }
        for key, groups in found.items()
    }


def _by_recall(
    group: list[Outcome], error: Callable[[Outcome], float | None], edges: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean recall (%) of each bin with enough frames (b,), and quartiles of errors (b, 3)."""
    recall, errors = _finite_rows((one.facts.recall, error(one)) for one in group).T
    bins = np.clip(np.digitize(recall, edges), 1, len(edges) - 1)
    kept = [number for number in np.unique(bins) if (bins == number).sum() >= LEAST_IN_BIN]
    middle = np.array([recall[bins == number].mean() * 100.0 for number in kept])
    quartiles = [np.percentile(errors[bins == number], [25.0, 50.0, 75.0]) for number in kept]
    return middle, np.array(quartiles, dtype=np.float64).reshape(-1, 3)


def _finite(values: Iterable[float | None]) -> FloatArray:
    return np.array([value for value in values if value is not None], dtype=np.float64)


def _finite_rows(pairs: Iterable[tuple[float | None, float | None]]) -> FloatArray:
    """(k, 2) the pairs of which neither part is None."""
    rows = np.array(list(pairs), dtype=np.float64).reshape(-1, 2)  # None becomes NaN
    return rows[np.isfinite(rows).all(axis=1)]


def _file_name(suite: str) -> str:
    return suite.replace(" ", "-").replace("%", "percent")
