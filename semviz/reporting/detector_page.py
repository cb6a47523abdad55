"""A detector's evaluation as one HTML file: tables, plots, and what it missed and invented."""

from collections.abc import Callable, Sequence

from semviz.detector_evaluation import Evaluation
from semviz.reporting.crops import Fault, invented, invented_crop, missed, missed_crop
from semviz.reporting.detector_plots import detector_plots
from semviz.reporting.detector_tables import DIFFERENCES, RULE, tables
from semviz.reporting.html import Html, element
from semviz.reporting.plots import as_svg
from semviz.reporting.sheet import html_page, plot, table_section

LEGEND = (
    "What a picture is about is in its middle. White: what is truly there, grey where it does not "
    "count. Thin, in the colours of their classes: what was found with a score that is high enough."
)


def as_html(evaluation: Evaluation, pictures: int) -> str:
    """The page; with so many pictures of what was missed and of what was invented each.

    Without times, which differ from call to call: the same evaluation is the same file.
    """
    papers, *others = tables(evaluation.figures)
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
        *_section("Missed, the nearest first", missed, missed_crop, evaluation, pictures),
        *_section("False, the surest first", invented, invented_crop, evaluation, pictures),
    )


def _header(evaluation: Evaluation) -> Html:
    told = "; ".join(f"{name} {value}" for name, value in evaluation.settings.items())
    return element(
        "header",
        element("h1", f"Detector {evaluation.settings['model']}"),
        element("p", f"{told}."),
    )


def _section(
    title: str,
    find: Callable[[Evaluation], Sequence[Fault]],
    crop: Callable[[Evaluation, Fault], Html],
    evaluation: Evaluation,
    pictures: int,
) -> list[Html]:
    faults = find(evaluation)
    shown = faults[:pictures]
    if not shown:
        return []
    count = f"{len(shown)} of {len(faults)}. " if len(shown) < len(faults) else f"{len(shown)}. "
    crops = element("div", *(crop(evaluation, one) for one in shown), class_="crops")
    return [element("h2", title), element("p", count + LEGEND, class_="dim"), crops]
