"""Report a detector's evaluation: tables, plots, and one HTML page with its errors.

The first table sets the figures beside those printed in the paper (Chen, Xue, Pang: Sparse
Semantic Map-Based Monocular Localization in Traffic Scenes Using Learned 2D-3D Point-Line
Correspondences. IEEE Robotics and Automation Letters, 2022).
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

from semviz.presentation.plots import add_grid, add_legend, line_style, new_figure, plain_numbers
from semviz.presentation.terminal import Table
from semviz.reports.html import Html, element, html_page, plot, table_section
from semviz.reports.run_plots import as_svg
from semviz.research import detection_crops
from semviz.research.detector_evaluation import Evaluation
from semviz_core.metrics import detection_summary
from semviz_core.metrics.detection import CRITERIA

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PRINTED = {
    "recall": "66 89 87 79",
    "RMSE (px)": "NA 1.81 4.10 3.17",
    "lateral ME (px)": "NA -1.38 -0.80 -0.61",
    "lateral SDE (px)": "NA 0.90 4.25 1.63",
    "longitudinal ME (px)": "NA -0.86 -1.74 1.49",
    "longitudinal SDE (px)": "NA 0.84 3.43 4.31",
    "angular ME (deg)": "-1.52 NA NA NA",
    "angular SDE (deg)": "1.32 NA NA NA",
}
"""The paper's table of detection accuracy: poles, triangular, rectangular and rounded signs."""
DIFFERENCES = (
    "Printed are the paper's figures, of 216 images of KITTI with its own labels. It does not say "
    "which detections are matched with which labels, nor how many are false; here both are stated. "
    "Here poles have lateral errors too, and what is far off or all but hidden does not count."
)
RULE = (
    "A sign is found within 4 px of its middle, or a quarter of its size; a pole where the visible "
    "parts share 30 % of what both cover, the line is within 4 px there and turned by less than "
    "5 deg. The best score takes the nearest of its class; a wrong class is a miss and a false "
    "one. What is out of reach (beyond 40 m, unless said otherwise, or nearer than 3 m), and poles "
    "of which less than 8 px are visible, do not count. Errors are found minus true: lateral and "
    "longitudinal are u and v of signs, across the line for poles. ME: mean, SDE: standard "
    "deviation."
)
STATED_RATES = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0)
NOTHING = "nothing"
_SHORT = {"pole": "pole", "triangular sign": "triangular", "rectangular sign": "rectangular",
          "rounded sign": "rounded"}  # fmt: skip


def evaluation_text(evaluation: Evaluation) -> str:
    """Return the evaluation for terminals of 120 columns."""
    figures = evaluation.figures
    settings = [f"{name}: {value}" for name, value in evaluation.settings.items()]
    notes = [f"note: {note}" for note in evaluation.notes]
    tables = (table.as_text() for table in detection_tables(figures))
    return "\n\n".join(["\n".join([*settings, *notes]), *tables, _time(figures)])


def _time(figures: detection_summary.DetectionFigures) -> str:
    if figures.time_ms_median is None:
        return "processor time for an image: not measured, the detections are stored ones"
    return (
        f"processor time for an image: median {figures.time_ms_median:.0f} ms, "
        f"p95 {figures.time_ms_p95:.0f} ms"
    )


def detection_tables(figures: detection_summary.DetectionFigures) -> list[Table]:
    """Return the tables that both text and page show."""
    return [
        _papers(figures),
        _curve(figures),
        _distances(figures),
        _ends(figures),
        _confusion(figures),
        _sigma_table(figures),
    ]


def _papers(figures: detection_summary.DetectionFigures) -> Table:
    """Return the paper's rows, then further ones."""
    header = [""]
    for name in figures.classes:
        header += [f"{_short(name)}: paper", "here"]
    title = f"Found: at {figures.false_a_frame:.2f} false a frame, {figures.frames} images"
    if figures.threshold > 0.0:
        title += f" (score {figures.threshold:.3f} or more)"
    kinds = list(figures.classes.values())
    rows = [
        ("recall", [_share_cell(kind.recall) for kind in kinds]),
        *((title, [_figure(getattr(kind.accuracy, name)) for kind in kinds])
          for title, name in CRITERIA.items()),
        ("precision", [_share_cell(kind.precision) for kind in kinds]),
        ("false a frame", [f"{kind.false_a_frame:.2f}" for kind in kinds]),
        ("to be found", [str(kind.recall.of) for kind in kinds]),
    ]  # fmt: skip
    return Table(title, tuple(header), tuple(_row_beside_printed(*row) for row in rows), words=1)


def _row_beside_printed(title: str, ours: Sequence[str]) -> tuple[str, ...]:
    """Return a row with the paper's figures, if any, beside ours."""
    printed = PRINTED.get(title, "- - - -").replace("NA", "-").split()
    if title == "recall":
        printed = [f"{value} %" for value in printed]
    return title, *(cell for pair in zip(printed, ours, strict=True) for cell in pair)


def _curve(figures: detection_summary.DetectionFigures) -> Table:
    """Return recall at some rates of false positives."""
    names = tuple(_short(name) for name in figures.classes)
    rows = tuple(
        (f"{point.false_a_frame:g}", f"{point.threshold:.3f}", *map(_share, point.recall.values()))
        for point in figures.curve
        if point.false_a_frame in STATED_RATES or point is figures.curve[-1]
    )
    header = ("false a frame", "score from", *names)
    return Table("Recall against false detections", header, rows, words=0)


def _distances(figures: detection_summary.DetectionFigures) -> Table:
    bins = occupied_distances(figures)
    rows = tuple(
        (
            _short(name),
            *(_percent_of(class_figures.recall_by_distance[interval]) for interval in bins),
        )
        for name, class_figures in figures.classes.items()
    )
    return Table("Recall by distance", ("", *bins.values()), rows, words=1)


def occupied_distances(figures: detection_summary.DetectionFigures) -> dict[int, str]:
    """Return the non-empty distance bins by index."""
    return {
        interval: f"{low:g} to {high:g} m"
        for interval, (low, high) in enumerate(pairwise(detection_summary.DISTANCES_M))
        if any(class_.recall_by_distance[interval].of for class_ in figures.classes.values())
    }


def _ends(figures: detection_summary.DetectionFigures) -> Table:
    """Return the figures of the ends of poles."""
    rows = [
        row
        for class_ in figures.classes.values()
        if class_.peaks is not None and class_.bottoms is not None
        for row in (_row_of_ends("peak", class_.peaks), _row_of_ends("bottom", class_.bottoms))
    ]
    header = ("", "seen, and said so", "hidden, and said so", "along RMSE (px)")
    return Table("Ends of the poles found", header, tuple(rows), words=1)


def _row_of_ends(name: str, ends: detection_summary.EndsFigures) -> tuple[str, ...]:
    return name, _percent_of(ends.seen), _percent_of(ends.hidden), _figure(ends.along_rmse_px)


def _confusion(figures: detection_summary.DetectionFigures) -> Table:
    names = [*map(_short, figures.classes), NOTHING]
    rows = tuple(
        (name, *(str(count) if count else "" for count in row))
        for name, row in zip(names, figures.confusion, strict=True)
    )
    return Table("What was there (rows), found as (columns)", ("", *names), rows, words=1)


def _sigma_table(figures: detection_summary.DetectionFigures) -> Table:
    rows = tuple(
        (
            name,
            f"{group.sigma_px:.2f}",
            f"{group.error_px:.2f}",
            f"{group.ratio:.2f}",
            str(group.errors),
        )
        for name, bins in figures.sigma.items()
        for group in bins
    )
    header = ("", "sigma (px)", "error RMS (px)", "RMS of error / sigma", "errors")
    return Table("How honest sigma is", header, rows, words=1)


def _short(name: str) -> str:
    return _SHORT.get(name, name)


def _share_cell(share: detection_summary.Share) -> str:
    return _share(share.share)


def _percent_of(share: detection_summary.Share) -> str:
    return f"{_share(share.share)} of {share.of}" if share.of else "-"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}".replace("%", " %")


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


MARKERS = ("o", "^", "s", "D")
LEAST_ERRORS = 5
"""Bins with fewer errors are not drawn."""


def detector_plots(figures: detection_summary.DetectionFigures) -> dict[str, "Figure"]:
    """Return the plots by caption."""
    return {
        f"Recall of each class against false detections a frame, of all classes together; "
        f"at the vertical line {detection_summary.FALSE_A_FRAME:g}": _against_false(figures),
        "Recall against distance; places that hold nothing to be found are left out": (
            _against_distance(figures)
        ),
        f"Errors against the sigma that is said, by bins of {LEAST_ERRORS} errors or more; honest "
        "is the dashed line, below it sigma is too large": _sigma_plot(figures),
    }


def _against_false(figures: detection_summary.DetectionFigures) -> "Figure":
    figure = new_figure(9.0, 3.6)
    axis = figure.subplots()
    rates = [point.false_a_frame for point in figures.curve]
    for number, name in enumerate(figures.classes):
        recall = [_as_percent(point.recall[name]) for point in figures.curve]
        marker = MARKERS[number] if len(rates) < 3 else None
        axis.plot(rates, recall, label=name, marker=marker, **line_style(number))
    axis.axvline(detection_summary.FALSE_A_FRAME, color="0.6", linewidth=0.8)
    axis.set(xlabel="false detections a frame", ylabel="recall (%)", ylim=(0.0, 102.0))
    axis.set_xlim(0.0, max(rates[-1], 2.0 * detection_summary.FALSE_A_FRAME))
    add_grid(axis)
    add_legend(figure)
    return figure


def _against_distance(figures: detection_summary.DetectionFigures) -> "Figure":
    figure = new_figure(9.0, 3.2)
    axis = figure.subplots()
    bins = occupied_distances(figures)
    for number, (name, class_figures) in enumerate(figures.classes.items()):
        shares = [
            _as_percent(class_figures.recall_by_distance[interval].share) for interval in bins
        ]
        axis.plot(
            list(bins.values()), shares, marker=MARKERS[number], label=name, **line_style(number)
        )
    axis.set(xlabel="distance", ylabel="recall (%)", ylim=(0.0, 102.0))
    add_grid(axis)
    add_legend(figure)
    return figure


def _sigma_plot(figures: detection_summary.DetectionFigures) -> "Figure":
    figure = new_figure(9.0, 3.6)
    axis = figure.subplots()
    seen: list[float] = []
    for number, (name, bins) in enumerate(figures.sigma.items()):
        enough = [group for group in bins if group.errors >= LEAST_ERRORS and group.error_px > 0.0]
        sigma, error = [group.sigma_px for group in enough], [group.error_px for group in enough]
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


def _as_percent(share: float | None) -> float:
    """NaN leaves a gap."""
    return float("nan") if share is None else 100.0 * share


LEGEND = (
    "What a picture is about is in its middle. White: what is truly there, grey where it does not "
    "count. Thin, in the colours of their classes: what was found with a score that is high enough."
)


def detector_report_html(evaluation: Evaluation, pictures: int) -> str:
    """Return the page, with up to ``pictures`` crops each of missed and of false detections.

    It holds no times, so that the same evaluation gives the same file.
    """
    papers, *others = detection_tables(evaluation.figures)
    plots = enumerate(detector_plots(evaluation.figures).items())
    return html_page(
        f"semviz detector: {evaluation.settings['model']}",
        _header(evaluation),
        *(element("p", f"Note: {note}.", class_="note") for note in evaluation.notes),
        table_section(papers),
        element("p", RULE, class_="dim"),
        element("p", DIFFERENCES, class_="dim"),
        *(plot(caption, as_svg(figure, f"plot-{number}")) for number, (caption, figure) in plots),
        *map(table_section, others),
        *_section(
            "Missed, the nearest first",
            detection_crops.missed_detections,
            detection_crops.missed_detection_crop,
            evaluation,
            pictures,
        ),
        *_section(
            "False, the surest first",
            detection_crops.false_positives,
            detection_crops.false_positive_crop,
            evaluation,
            pictures,
        ),
    )


def _header(evaluation: Evaluation) -> Html:
    settings = "; ".join(f"{name} {value}" for name, value in evaluation.settings.items())
    return element(
        "header",
        element("h1", f"Detector {evaluation.settings['model']}"),
        element("p", f"{settings}."),
    )


def _section(
    title: str,
    find: Callable[[Evaluation], Sequence[detection_crops.DetectionError]],
    crop: Callable[[Evaluation, detection_crops.DetectionError], Html],
    evaluation: Evaluation,
    pictures: int,
) -> list[Html]:
    faults = find(evaluation)
    shown = faults[:pictures]
    if not shown:
        return []
    count = f"{len(shown)} of {len(faults)}. " if len(shown) < len(faults) else f"{len(shown)}. "
    crops = element("div", *(crop(evaluation, fault) for fault in shown), class_="crops")
    return [element("h2", title), element("p", count + LEGEND, class_="dim"), crops]
