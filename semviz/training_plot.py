"""A training's losses and held-out figures as a plot."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from semviz.plot_style import add_grid, add_legend, line_style, new_figure
from semviz_core.files import replacing

COLUMNS = 3
KINDS = {"losses": "training, mean of 200 steps", "held_out": "held out"}
NO_FIGURES = ("items",)


def draw(history: Sequence[dict[str, Any]], title: str, path: Path) -> None:
    """One small plot for each loss and figure, over the samples seen; nothing if there is none.

    Raises SemvizError where matplotlib is not installed or ``path`` cannot be written.
    """
    found = (name for kind in KINDS for line in history for name in line.get(kind, {}))
    names = [name for name in dict.fromkeys(found) if name not in NO_FIGURES]
    if not names:
        return
    from matplotlib.ticker import EngFormatter, MaxNLocator

    columns = min(COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure = new_figure(3.6 * columns + 0.4, 2.5 * rows + 0.7, title)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    for axis, name in zip(axes, names, strict=False):
        for number, (kind, label) in enumerate(KINDS.items()):
            lines = [line for line in history if name in line.get(kind, {})]
            samples, values = [one["samples"] for one in lines], [one[kind][name] for one in lines]
            axis.plot(samples, values, label=label, marker=".", **line_style(number))
        axis.set_title(name, fontsize="medium")
        axis.xaxis.set_major_locator(MaxNLocator(5))
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        add_grid(axis)
    for axis in axes[max(len(names) - columns, 0) : len(names)]:
        axis.set_xlabel("samples")
        axis.tick_params(labelbottom=True)
    for axis in axes[len(names) :]:
        axis.remove()
    add_legend(figure)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
