"""A report as one HTML file that asks nothing of any other machine, and runs no script."""

import shlex
from collections.abc import Sequence
from urllib.parse import urlencode

from semviz.pose_errors import errors_of
from semviz.recording.run import FrameRecord
from semviz.reporting.facts import Reported
from semviz.reporting.html import Html, element, table_element
from semviz.reporting.pictures import picture
from semviz.reporting.plots import as_svg, comparing_plots, over_the_drive
from semviz.reporting.sheet import html_page, plot, table_section
from semviz.reporting.summary import (
    elements_table,
    faults_table,
    notes,
    tables,
    worst_table,
)
from semviz.why import why_card

INSPECTOR = "http://127.0.0.1:8080/"
"""Where ``semviz serve`` listens unless told otherwise."""
DEFINITIONS = (
    "RTE: distance of the camera centres. RRE: angle between the rotations. Means and quartiles "
    "are of the frames with a pose and a true one; shares below 1 m and 1 deg, and sure and wrong "
    "(ok, and more than 1 m off), of all frames with a true pose; other shares of all frames."
)
ELEMENTS = (
    "Outlier: frames whose detection of it does not fit it, at the true pose where that is known, "
    "else under the answer; residual: the median. Error cost: how much larger the error is with it "
    "than without, on average over the frames that use it (fitted again to their other pairs, not "
    "searched again); below 0 it helps."
)


def as_html(reported: Sequence[Reported], pictures: int) -> str:
    """The page; with pictures of so many frames of each run."""
    side_by_side = tables(reported)
    return html_page(
        f"semviz report: {', '.join(one.name for one in reported)}",
        _header(reported),
        *(element("p", f"Note: {note}.", class_="note") for note in notes(reported)),
        *map(table_section, side_by_side[:2]),
        element("p", DEFINITIONS, class_="dim"),
        *_plots(reported),
        *map(table_section, side_by_side[2:-1]),
        *(_run_section(one, pictures) for one in reported),
        table_section(side_by_side[-1]),
    )


def _header(reported: Sequence[Reported]) -> Html:
    sequences = dict.fromkeys(one.run.semantic_map.frame.name for one in reported)
    frames = sum(len(one.run.frames) for one in reported)
    command = f"semviz serve {shlex.join(str(one.path) for one in reported)}"
    return element(
        "header",
        element("h1", ", ".join(one.name for one in reported)),
        element("p", f"{', '.join(sequences)}: {frames} frames in {_runs(reported)}."),
        element(
            "p",
            "Numbers of frames are links: run ",
            element("code", command),
            " first, and they open there.",
            class_="dim screen",
        ),
    )


def _runs(reported: Sequence[Reported]) -> str:
    return "1 run" if len(reported) == 1 else f"{len(reported)} runs"


def _plots(reported: Sequence[Reported]) -> list[Html]:
    return [
        plot(caption, as_svg(figure, f"plot-{number}"))
        for number, (caption, figure) in enumerate(comparing_plots(reported).items())
    ]


def _run_section(one: Reported, pictures: int) -> Html:
    table = worst_table(one)
    links = [_link(one, int(row[0])) for row in table.cells]
    return element(
        "section",
        element("h2", f"Run {one.name}"),
        plot("Error and status over the drive", as_svg(over_the_drive(one), f"drive-{one.name}")),
        element("h3", "Worst frames"),
        table_element(table, links),
        *_over_the_run(one),
        *_pictures(one, pictures),
    )


def _over_the_run(one: Reported) -> list[Html]:
    """Map and camera, as all frames together say."""
    return [
        element("h3", "Wrong over the run"),
        table_element(faults_table(one)),
        element("h3", "Elements that fit worst"),
        table_element(elements_table(one)),
        element("p", ELEMENTS, class_="dim"),
    ]


def _link(one: Reported, frame: int) -> Html:
    address = f"{INSPECTOR}?{urlencode({'run': one.name, 'frame': frame})}"
    return element("a", str(frame), href=address)


def _pictures(one: Reported, count: int) -> list[Html]:
    """The worst frame of each verdict, each with its story."""
    rows = one.worst_of_each_verdict(count)
    if not rows:
        return []
    return [
        element("h3", "The worst frame of each verdict"),
        element(
            "p",
            "Detections in the colours of their classes, named after what they were taken for; the "
            "map under the estimate in orange, under the true pose in white.",
            class_="dim",
        ),
        *(_pictured(one, row) for row in rows),
    ]


def _pictured(one: Reported, row: int) -> Html:
    record, verdict = one.run.frames[row], one.verdicts[row]
    alike = one.verdicts.count(verdict)
    frames = "1 frame" if alike == 1 else f"{alike} frames"
    about = f"Frame {record.frame.index} of {one.name}: {verdict}"
    return element(
        "figure",
        element(
            "figcaption",
            element("b", verdict.capitalize()),
            f", {frames}. The worst: frame ",
            _link(one, record.frame.index),
            f"{_off(record)}. {why_card(one.run, record)['sentence']}",
        ),
        picture(record, one.image(row), one.run.semantic_map.classes, about),
    )


def _off(record: FrameRecord) -> str:
    errors = errors_of(record)
    if errors is None:
        return ""
    return f", {errors.distance_m:.2f} m and {errors.angle_deg:.2f} deg off"
