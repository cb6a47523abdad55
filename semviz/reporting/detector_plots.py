"""The plots of a detector's evaluation."""

from typing import TYPE_CHECKING

from semviz.plot_style import add_grid, add_legend, line_style, new_figure, plain_numbers
from semviz.reporting.detector_tables import held_distances
from semviz_core.evaluation.detection_figures import FALSE_A_FRAME, DetectionFigures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MARKERS = ("o", "^", "s", "D")
LEAST_ERRORS = 5
"""A root mean square of fewer says little, and is not drawn."""


def detector_plots(figures: DetectionFigures) -> dict[str, "Figure"]:
    """By what they show."""
    return {
        f"Recall of each class against false detections a frame, of all classes together; "
        f"at the vertical line {FALSE_A_FRAME:g}": _against_false(figures),
        "Recall against distance; places that hold nothing to be found are left out": (
            _against_distance(figures)
        ),
        f"Errors against the sigma that is said, by bins of {LEAST_ERRORS} errors or more; honest "
        "is the dashed line, below it sigma is too large": _sigma(figures),
    }


def _against_false(figures: DetectionFigures) -> "Figure":
    figure = new_figure(9.0, 3.6)
    axis = figure.subplots()
    rates = [one.false_a_frame for one in figures.curve]
    for number, name in enumerate(figures.classes):
        recall = [_percent(one.recall[name]) for one in figures.curve]
        marker = MARKERS[number] if len(rates) < 3 else None
        axis.plot(rates, recall, label=name, marker=marker, **line_style(number))
    axis.axvline(FALSE_A_FRAME, color="0.6", linewidth=0.8)
    axis.set(xlabel="false detections a frame", ylabel="recall (%)", ylim=(0.0, 102.0))
    axis.set_xlim(0.0, max(rates[-1], 2.0 * FALSE_A_FRAME))
    add_grid(axis)
    add_legend(figure)
    return figure


def _against_distance(figures: DetectionFigures) -> "Figure":
    figure = new_figure(9.0, 3.2)
    axis = figure.subplots()
    bins = held_distances(figures)
    for number, (name, one) in enumerate(figures.classes.items()):
        shares = [_percent(one.recall_by_distance[place].share) for place in bins]
        axis.plot(
            list(bins.values()), shares, marker=MARKERS[number], label=name, **line_style(number)
        )
    axis.set(xlabel="distance", ylabel="recall (%)", ylim=(0.0, 102.0))
    add_grid(axis)
    add_legend(figure)
    return figure


def _sigma(figures: DetectionFigures) -> "Figure":
    figure = new_figure(9.0, 3.6)
    axis = figure.subplots()
    seen: list[float] = []
    for number, (name, bins) in enumerate(figures.sigma.items()):
        enough = [one for one in bins if one.errors >= LEAST_ERRORS and one.error_px > 0.0]
        sigma, error = [one.sigma_px for one in enough], [one.error_px for one in enough]
        axis.plot(sigma, error, marker=MARKERS[number], label=name, **line_style(number))
        seen += [*sigma, *error]
    low, high = min(seen, default=0.1) / 1.5, max(seen, default=10.0) * 1.5
    axis.plot([low, high], [low, high], color="0.6", linewidth=0.8, linestyle="--")
    axis.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
    axis.set(xlabel="sigma (px)", ylabel="error, RMS (px)")
    plain_numbers(axis.xaxis, axis.yaxis)
    add_grid(axis)
    add_legend(figure)
    return figure


def _percent(share: float | None) -> float:
    """NaN leaves a gap."""
    return float("nan") if share is None else 100.0 * share
