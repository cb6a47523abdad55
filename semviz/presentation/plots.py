"""Colours shared by all pages and plots, the style of plots, error histograms and curves.

Colours are distinct for colour-blind readers; element classes have their own
(`semviz_core.base.classes`). Shares are of all frames, including those without a pose.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semviz_core.base.localization import Status
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.metrics.pose_errors import Outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Tone:
    """A colour in sRGB hex; ``dark`` is for dark backgrounds and for every image."""

    dark: str
    light: str


TRUTH = Tone("#FFFFFF", "#111111")
ESTIMATE = Tone("#FF7A1A", "#C94A08")
PRIOR = Tone("#8B9198", "#74797F")
ALTERNATIVE = Tone("#B79CFF", "#6741D9")

STATUS: dict[Status, Tone] = {
    "ok": Tone("#5C9DED", "#1F62C8"),
    "ambiguous": Tone("#F5C542", "#A2811A"),
    "cannot": Tone("#F0532D", "#8E1B08"),
}

RESIDUAL_LIMITS_PX = (1.0, 2.0, 3.0, 5.0)
"""Upper limits of the residual colours except the last; the same in all frames."""
RESIDUAL = (
    Tone("#4A78C9", "#2C5AA0"),
    Tone("#8CC2E0", "#4F9BC4"),
    Tone("#F2E6A8", "#A8923A"),
    Tone("#F29A4A", "#D06A14"),
    Tone("#E0402A", "#A81C1C"),
)

USED_LIMITS = (2, 5, 10, 20)
"""Upper limits, in frames that used an element, of the colours except the last."""
USED = (
    Tone("#3F659F", "#96B2D6"),
    Tone("#6896C4", "#6989BF"),
    Tone("#99B4C2", "#3C60A8"),
    Tone("#C9D2C0", "#2A4183"),
    Tone("#FAF0BE", "#18225E"),
)
"""The part of the probability ramp that contrasts with the background of the 3D scene."""


def residual_level(residual_px: FloatArray) -> IntArray:
    """Return indices (k,) into RESIDUAL of residual lengths (k,) in pixels."""
    return np.searchsorted(RESIDUAL_LIMITS_PX, residual_px, side="right").astype(np.int64)


def rgba(color: str, alpha: float = 1.0) -> int:
    """Return ``#RRGGBB`` as the number 0xRRGGBBAA."""
    return int(color[1:], 16) << 8 | round(alpha * 255)


def residual_colors(residual_px: FloatArray) -> IntArray:
    """Return dark colours 0xRRGGBBAA (k,) of residual lengths (k,) in pixels."""
    return np.array([rgba(tone.dark) for tone in RESIDUAL])[residual_level(residual_px)]


COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
"""Distinct for colour-blind people too (Okabe and Ito 2008); line styles differ as well."""
STYLES = ("-", "--", "-.", ":")
GRID = "#E0E0E0"
Groups = dict[str, list[Outcome]]
"""Outcomes of frames by method or run."""
Error = Callable[[Outcome], float | None]
FARTHEST_M = 100.0
"""Upper limit of the error axis: larger errors would only compress the others."""
ERRORS: tuple[tuple[str, Error, tuple[float, float]], ...] = (
    ("RTE (m)", lambda outcome: outcome.rte_m, (0.01, FARTHEST_M)),
    ("RRE (deg)", lambda outcome: outcome.rre_deg, (0.02, 180.0)),
)
"""Name, value, and limits of the axis."""
MAX_BANDS = 3
"""Maximum number of quartile bands in one plot."""
MIN_IN_BIN = 5
"""Minimum number of frames for quartiles."""


def new_figure(width: float, height: float, title: str = "") -> "Figure":
    """Return an empty figure, size in inches. Raise SemvizError if matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise SemvizError("plots need matplotlib: install it, or turn plots off") from None
    figure = Figure(figsize=(width, height), layout="constrained")
    if title:
        figure.suptitle(title, fontsize="medium")
    return figure


def save_png(figure: "Figure", path: Path, dpi: int) -> None:
    """Write a figure, completely or not at all, with semviz as the program that made it."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format="png", metadata={"Software": "semviz"})


def add_legend(figure: "Figure") -> None:
    """Add one legend for all axes, below them."""
    entries = {
        label: handle
        for axis in figure.axes
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    if entries:
        figure.legend(entries.values(), entries, loc="outside lower center", ncols=4, frameon=False)


def add_grid(axis: "Axes") -> None:
    axis.grid(color=GRID, linewidth=0.7)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def plain_numbers(*axes: "Axis") -> None:
    """Label logarithmic axes with 0.1, 1, 10; short ones with 2 and 5 in between, too."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in axes:
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 200.0 * low else (1.0,)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def line_style(number: int) -> dict[str, Any]:
    """Return the style of line ``number`` of a plot."""
    color, style = COLORS[number % len(COLORS)], STYLES[number % len(STYLES)]  # 7 x 4 differ
    return {"color": color, "linestyle": style, "linewidth": 1.8}


def cumulative(title: str, groups: Groups) -> "Figure":
    """Plot the share of ALL frames below an error; without a pose, a frame is never below."""
    figure = new_figure(10.0, 4.2, title)
    for axis, (label, error, limits) in zip(figure.subplots(1, 2), ERRORS, strict=True):
        for number, (method, group) in enumerate(groups.items()):
            errors = np.sort(finite(map(error, group)))
            share = np.arange(1, len(errors) + 1) / len(group) * 100.0
            axis.plot(errors, share, label=method, **line_style(number))
        axis.axvline(1.0, color="0.6", linewidth=0.8, zorder=0)
        axis.set(xscale="log", xlim=limits, xlabel=label)
        axis.set(ylim=(0.0, 101.0), ylabel="frames below (%)")
        plain_numbers(axis.xaxis)
        add_grid(axis)
    add_legend(figure)
    return figure


def against_recall(title: str, groups: Groups) -> "Figure":
    """Plot median errors by recall, as in the paper; with quartiles if there are few methods."""
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
            if len(groups) > MAX_BANDS:
                continue
            color = line[0].get_color()
            axis.fill_between(middle, quartiles[:, 0], quartiles[:, 2], color=color, alpha=0.10)
            axis.plot(middle, quartiles[:, [0, 2]], **{**line_style(number), "linewidth": 0.7})
        axis.set(
            xlim=(0.0, 100.0),
            xlabel="visible mapped elements that were detected (%)",
            ylabel=f"{label}: median" + (" and quartiles" if len(groups) <= MAX_BANDS else ""),
        )
        if axis.lines:
            axis.set_yscale("log")
            plain_numbers(axis.yaxis)
        else:
            few = f"fewer than {MIN_IN_BIN} frames at every recall"
            axis.text(50.0, 0.5, few, ha="center", color="0.4")
            axis.set_yticks([])
        add_grid(axis)
    add_legend(figure)
    return figure


def _by_recall(
    group: list[Outcome], error: Error, edges: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean recall (b,) in percent and error quartiles (b, 3) of bins with enough frames."""
    recall, errors = finite_rows((outcome.facts.recall, error(outcome)) for outcome in group).T
    bins = np.clip(np.digitize(recall, edges), 1, len(edges) - 1)
    kept = [number for number in np.unique(bins) if (bins == number).sum() >= MIN_IN_BIN]
    middle = np.array([recall[bins == number].mean() * 100.0 for number in kept])
    quartiles = [np.percentile(errors[bins == number], [25.0, 50.0, 75.0]) for number in kept]
    return middle, np.array(quartiles, dtype=np.float64).reshape(-1, 3)


def finite(values: Iterable[float | None]) -> FloatArray:
    """Return the k values that are not None."""
    return np.array([value for value in values if value is not None], dtype=np.float64)


def finite_rows(pairs: Iterable[tuple[float | None, float | None]]) -> FloatArray:
    """Return the pairs (k, 2) without None."""
    rows = np.array(list(pairs), dtype=np.float64).reshape(-1, 2)  # None becomes NaN
    return rows[np.isfinite(rows).all(axis=1)]


BINS = 20
ROUND_LIMITS = (0.1, 0.2, 0.5, 1.0)
"""Possible limits of histograms, in m or deg."""
SHARE_INSIDE = 0.95
"""A histogram ends at the first round limit above this share of the errors."""
BESIDE = (1.11, 1.28)
"""Positions of the bars for larger errors and for frames without a pose, in axis lengths."""
MAX_OUTLINES = 3
"""Maximum number of histograms in one plot."""


def histograms(groups: Groups, title: str = "") -> "Figure":
    """Plot shares of all frames by RTE and RRE, at most MAX_OUTLINES groups in one plot.

    Larger errors, and frames without a pose, have bars of their own at the right.
    """
    names = list(groups)
    rows = [names[first : first + MAX_OUTLINES] for first in range(0, len(names), MAX_OUTLINES)]
    figure = new_figure(10.0, 0.6 + 3.0 * len(rows), title)
    axes = figure.subplots(len(rows), 2, squeeze=False, sharex="col", sharey="col")
    for column, (label, error, _) in enumerate(ERRORS):
        errors = {name: _values(group, error) for name, group in groups.items()}
        limit = _round_limit(np.concatenate(list(errors.values())))
        for axis, row in zip(axes[:, column], rows, strict=True):
            for name in row:
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
    """Return the errors (k,) of all frames; infinite for those without a pose."""
    values = (error(outcome) for outcome in group)
    return np.array([np.inf if value is None else value for value in values])


def _round_limit(errors: FloatArray) -> float:
    """Return the limit of a histogram of errors (k,)."""
    known = errors[np.isfinite(errors)]
    needed = float(np.quantile(known, SHARE_INSIDE)) if len(known) else ROUND_LIMITS[-1]
    return next((limit for limit in ROUND_LIMITS if limit >= needed), ROUND_LIMITS[-1])


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
