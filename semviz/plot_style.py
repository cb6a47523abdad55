"""How all plots look: matplotlib figures in colours that everybody tells apart."""

from typing import TYPE_CHECKING, Any

from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
"""Told apart by colour-blind people too (Okabe and Ito 2008); line styles differ as well."""
STYLES = ("-", "--", "-.", ":")
GRID = "#E0E0E0"


def new_figure(width: float, height: float, title: str = "") -> "Figure":
    """An empty one, in inches. Raises SemvizError where matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise SemvizError("plots need matplotlib, which is not installed here") from None
    figure = Figure(figsize=(width, height), layout="constrained")
    if title:
        figure.suptitle(title, fontsize="medium")
    return figure


def add_legend(figure: "Figure") -> None:
    """One for all axes, below them; each label once."""
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
    """0.1, 1, 10 on a logarithmic axis, and 2 and 5 between where it is short."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in axes:
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 200.0 * low else (1.0,)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def line_style(number: int) -> dict[str, Any]:
    """Of the so many-th line of a plot."""
    color, style = COLORS[number % len(COLORS)], STYLES[number % len(STYLES)]  # 7 x 4 differ
    return {"color": color, "linestyle": style, "linewidth": 1.8}
