"""Write a run report as one HTML page, as Markdown, or as LaTeX.

Tables compare metrics, status, diagnoses, frames and settings of the runs. Each run has its
worst frames, recurring faults of map and camera, and elements that are often outliers.
"""

import shlex
from collections import Counter
from collections.abc import Sequence
from urllib.parse import urlencode

import numpy as np

from semviz.presentation.terminal import Table, figure, in_latex, in_markdown, percent
from semviz.reports.frame_images import frame_svg
from semviz.reports.html import Html, element, html_page, plot, table_element, table_section
from semviz.reports.run_plots import RunReport, as_svg, comparing_plots, plot_over_frames
from semviz.runs.comparison import compare_runs
from semviz.runs.diagnosis import diagnosis_sentence
from semviz.runs.metrics import errors_of, settings_of
from semviz.runs.run import FrameRecord
from semviz.runs.story import MOST_DIAGNOSED
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.element_statistics import ElementRecord

LISTED = 10
"""Number of worst frames, and of elements, listed per run."""
_ERRORS = (
    ("RTE", "mean_rte_m"),
    ("Q1", "q1_rte_m"),
    ("Q2", "median_rte_m"),
    ("Q3", "q3_rte_m"),
    ("<1 m", "share_below_1m"),
    ("RRE", "mean_rre_deg"),
    ("Q1", "q1_rre_deg"),
    ("Q2", "median_rre_deg"),
    ("Q3", "q3_rre_deg"),
    ("<1 deg", "share_below_1deg"),
)
_STATUS = (
    ("ok", "coverage"),
    ("ambiguous", "share_ambiguous"),
    ("cannot", "share_cannot"),
    ("overconfident", "share_sure_and_wrong"),
    ("ms, median", "median_time_ms"),
    ("ms, p95", "p95_time_ms"),
)


def comparison_tables(reports: Sequence[RunReport]) -> list[Table]:
    """Return the tables that compare the runs."""
    tables = [
        _metrics_table("RTE (m) and RRE (deg)", reports, _ERRORS),
        _metrics_table("Status and time", reports, _STATUS),
        diagnosis_table(reports),
    ]
    if len(reports) > 1:
        tables.append(changes_table(reports))
    return [*tables, settings_table(reports)]


def _metrics_table(
    title: str, reports: Sequence[RunReport], columns: Sequence[tuple[str, str]]
) -> Table:
    rows = [
        (
            report.name,
            str(len(report.table)),
            *(_cell(report, metric) for _, metric in columns),
        )
        for report in reports
    ]
    header = ("run", "frames", *(name for name, _ in columns))
    return Table(title, header, tuple(rows), words=1)


def _cell(report: RunReport, metric: str) -> str:
    is_share = metric.startswith("share") or metric == "coverage"
    return (percent if is_share else figure)(report.metrics[metric])


def diagnosis_table(reports: Sequence[RunReport]) -> Table:
    """Count the frames of each diagnosis, the most frequent first."""
    counts = [Counter(report.diagnoses) for report in reports]
    total = Counter(name for report in reports for name in report.diagnoses)
    names = sorted(total, key=lambda name: (-total[name], name))
    rows = [(name, *(str(count[name]) for count in counts)) for name in names]
    return Table(
        "Diagnoses", ("diagnosis", *(report.name for report in reports)), tuple(rows), words=1
    )


def changes_table(reports: Sequence[RunReport]) -> Table:
    """Compare each run with the first, frame by frame."""
    base, *others = reports
    rows = [(other.name, *_changes(base, other)) for other in others]
    header = ("run", "frames in both", "fixed", "broken", "same", "map")
    return Table(f"Frame by frame against {base.name}", header, tuple(rows), words=1)


def _changes(base: RunReport, other: RunReport) -> tuple[str, ...]:
    try:
        comparison = compare_runs(base.run, other.run)
    except SemvizError:  # another sequence: a report may hold it, but not compare it
        return ("-",) * 5
    counts = [len(comparison.of(change)) for change in ("fixed", "broken", "same")]
    same_map = "same" if comparison.maps is None else "another"
    return str(len(comparison.frames)), *map(str, counts), same_map


def settings_table(reports: Sequence[RunReport]) -> Table:
    """List everything needed to repeat the runs."""
    columns = [_settings(report) for report in reports]
    names = dict.fromkeys(name for column in columns for name in column)
    rows = [(name, *(column.get(name, "-") for column in columns)) for name in names]
    header = ("setting", *(report.name for report in reports))
    return Table("Settings", header, tuple(rows), words=len(header))


def _settings(report: RunReport) -> dict[str, str]:
    run = report.run
    camera, numbers = run.info.rig.left, report.table.index
    return {
        "file": str(report.path),
        "workspace": run.info.workspace or "-",
        "created": run.info.created,
        "sequence": run.semantic_map.frame.name,
        "frames": f"{len(numbers)}, from {numbers[0]} to {numbers[-1]}",
        "image size": f"{camera.width} x {camera.height}",
        "map elements": str(len(run.semantic_map)),
        **settings_of(run),
    }


def worst_table(report: RunReport) -> Table:
    """List the worst frames of a run, the worst first."""
    rows = [_frame_row(report, row) for row in report.worst(LISTED)]
    header = ("frame", "diagnosis", "reason", "RTE (m)", "RRE (deg)", "detections", "inliers")
    return Table(f"{report.name}: worst frames", header, tuple(rows), words=3)


def _frame_row(report: RunReport, row: int) -> tuple[str, ...]:
    record = report.run.frames[row]
    errors, result = errors_of(record), record.localization
    inliers = 0 if result.refinement is None else int(result.refinement.inlier.sum())
    return (
        str(record.frame.index),
        report.diagnoses[row],
        result.reason,
        figure(None if errors is None else errors.distance_m),
        figure(None if errors is None else errors.angle_deg),
        str(len(result.observed)),
        str(inliers),
    )


def faults_table(report: RunReport) -> Table:
    """List the faults of priors, map and camera that recur."""
    diagnosis = report.run_diagnosis
    camera = [] if diagnosis.calibration is None else [diagnosis.calibration]
    faults = (*diagnosis.causes, *camera, *diagnosis.elements)
    rows = [(str(fault.kind), fault.sentence) for fault in faults]
    if not rows:
        frames = f"{diagnosis.frames} frames with a reference pose"
        rows = [("none", f"No recurring fault of priors, map or camera in {frames}.")]
    return Table(f"{report.name}: recurring faults", ("fault", "evidence"), tuple(rows), words=2)


def elements_table(report: RunReport) -> Table:
    """List the map elements that are outliers in most frames."""
    header = (
        "element",
        "in view",
        "detected",
        "used",
        "outlier",
        "residual (px)",
        "error cost (m)",
    )
    worst = [record for record in report.elements if record.outlier][:LISTED]
    rows = [_element_row(report, record) for record in worst] or [
        ("none", *"-" * (len(header) - 1))
    ]
    return Table(f"{report.name}: elements most often outliers", header, tuple(rows), words=1)


def tracks_table(report: RunReport) -> Table | None:
    """List the map elements that detections alone show, the least sure to exist first; None if
    people labelled all."""
    semantic_map = report.run.semantic_map
    records = {record.id: record for record in report.elements}
    tracks = sorted(
        (origin.log_odds, id_, origin)
        for id_, origin in zip(
            semantic_map.elements.id.tolist(), semantic_map.provenance, strict=False
        )
        if origin.log_odds is not None
    )
    if not tracks:
        return None
    header = ("element", "sure to exist", "detections in the map", "detected", "used", "outlier")
    rows = []
    for _, id_, origin in tracks[:LISTED]:
        seen = records.get(id_)
        counts = (0, 0, 0) if seen is None else map(len, (seen.seen, seen.used, seen.outlier))
        linked = str(len(origin.observation_ids))
        rows.append((semantic_map.name_of(id_), origin.existence, linked, *map(str, counts)))
    title = f"{report.name}: least sure of {len(tracks)} elements from detections"
    return Table(title, header, tuple(rows), words=1)


def _element_row(report: RunReport, record: ElementRecord) -> tuple[str, ...]:
    semantic_map = report.run.semantic_map
    (rows,) = np.nonzero(semantic_map.elements.id == record.id)
    name = f"{record.id}, not mapped"
    if len(rows):
        class_id = int(semantic_map.elements.class_id[rows[0]])
        name = semantic_map.classes.element_name(class_id, record.id)
    counts = (len(record.in_view), len(record.seen), len(record.used), len(record.outlier))
    cost_m = None if np.isnan(record.mean_cost_m) else record.mean_cost_m
    median_px = None if np.isnan(record.median_px) else record.median_px
    return (name, *map(str, counts), figure(median_px), figure(cost_m))


def reader_notes(reports: Sequence[RunReport]) -> list[str]:
    """Return notes on incomplete and long runs, and on missing ground truth."""
    notes = [f"{report.name}: {report.run.note}" for report in reports if report.run.note]
    for report in reports:
        unknown = int((~report.table.has_truth).sum())
        if unknown == len(report.table):
            notes.append(f"{report.name}: no true poses, so errors are unknown")
        elif unknown:
            notes.append(f"{report.name}: {unknown} frames have no true pose")
        if len(report.table) > MOST_DIAGNOSED:
            typical = f"{MOST_DIAGNOSED:,} typical frames"
            notes.append(f"{report.name}: recurring faults are those of {typical}")
    return notes


INSPECTOR = "http://127.0.0.1:8080/"
"""Default address of ``semviz serve``."""
TRACKS = (
    "The detections of one landmark in the frames of the map are linked to a track, which is an "
    "element of the map. To reject a false one, press Exclude from the map in the inspector, or X "
    "in semviz annotate; it does not return."
)
DEFINITIONS = (
    "RTE: distance of the camera centres. RRE: angle between the rotations. Means and quartiles "
    "are of the frames with a pose and a true one; shares below 1 m and 1 deg, and overconfident "
    "(ok, but more than 1 m off), of all frames with a true pose; other shares of all frames."
)
ELEMENTS = (
    "Outlier: frames in which its detection is an outlier at the true pose or, if that is unknown, "
    "at the estimate; residual: the median. Error cost: mean increase of the error by the element, "
    "over the frames that use it (the pose is refined without it, not searched again); a negative "
    "cost means that it helps."
)


def run_report_html(reports: Sequence[RunReport], pictures: int) -> str:
    """Return the page, with at most ``pictures`` frame images per run."""
    side_by_side = comparison_tables(reports)
    return html_page(
        f"semviz report: {', '.join(report.name for report in reports)}",
        _header(reports),
        *(element("p", f"Note: {note}.", class_="note") for note in reader_notes(reports)),
        *map(table_section, side_by_side[:2]),
        element("p", DEFINITIONS, class_="dim"),
        *_comparing_figures(reports),
        *map(table_section, side_by_side[2:-1]),
        *(_run_section(report, pictures) for report in reports),
        table_section(side_by_side[-1]),
    )


def _header(reports: Sequence[RunReport]) -> Html:
    sequences = dict.fromkeys(report.run.semantic_map.frame.name for report in reports)
    frames = sum(len(report.table) for report in reports)
    command = f"semviz serve {shlex.join(str(report.path) for report in reports)}"
    return element(
        "header",
        element("h1", ", ".join(report.name for report in reports)),
        element("p", f"{', '.join(sequences)}: {frames} frames in {_runs(reports)}."),
        element(
            "p",
            "Frame numbers are links into the inspector; start it first: ",
            element("code", command),
            class_="dim screen",
        ),
    )


def _runs(reports: Sequence[RunReport]) -> str:
    return "1 run" if len(reports) == 1 else f"{len(reports)} runs"


def _comparing_figures(reports: Sequence[RunReport]) -> list[Html]:
    return [
        plot(caption, as_svg(figure, f"plot-{number}"))
        for number, (caption, figure) in enumerate(comparing_plots(reports).items())
    ]


def _run_section(report: RunReport, pictures: int) -> Html:
    table = worst_table(report)
    links = [_frame_link(report, int(row[0])) for row in table.cells]
    return element(
        "section",
        element("h2", f"Run {report.name}"),
        plot(
            "Error and status over the drive",
            as_svg(plot_over_frames(report), f"drive-{report.name}"),
        ),
        element("h3", "Worst frames"),
        table_element(table, links),
        *_recurring_faults(report),
        *_tracks(report),
        *_worst_figures(report, pictures),
    )


def _recurring_faults(report: RunReport) -> list[Html]:
    """Return faults of map and camera, and elements that are often outliers."""
    return [
        element("h3", "Recurring faults"),
        table_element(faults_table(report)),
        element("h3", "Elements most often outliers"),
        table_element(elements_table(report)),
        element("p", ELEMENTS, class_="dim"),
    ]


def _tracks(report: RunReport) -> list[Html]:
    """Return the least sure elements from detections, if there are any."""
    table = tracks_table(report)
    if table is None:
        return []
    title = table.title.removeprefix(f"{report.name}: ")
    return [
        element("h3", title.capitalize()),
        table_element(table),
        element("p", TRACKS, class_="dim"),
    ]


def _frame_link(report: RunReport, frame: int) -> Html:
    address = f"{INSPECTOR}?{urlencode({'run': report.name, 'frame': frame})}"
    return element("a", str(frame), href=address)


def _worst_figures(report: RunReport, count: int) -> list[Html]:
    """Return the worst frame of each diagnosis, with its image and explanation."""
    rows = report.worst_of_each_diagnosis(count)
    if not rows:
        return []
    return [
        element("h3", "The worst frame of each diagnosis"),
        element(
            "p",
            "Detections have the colours of their classes and the names of their matched elements; "
            "the map is orange at the estimate, white at the true pose.",
            class_="dim",
        ),
        *(_frame_figure(report, row) for row in rows),
    ]


def _frame_figure(report: RunReport, row: int) -> Html:
    record, diagnosis = report.run.frames[row], report.diagnoses[row]
    count = report.diagnoses.count(diagnosis)
    frames = "1 frame" if count == 1 else f"{count} frames"
    title = f"Frame {record.frame.index} of {report.name}: {diagnosis}"
    return element(
        "figure",
        element(
            "figcaption",
            element("b", diagnosis.capitalize()),
            f", {frames}. The worst: frame ",
            _frame_link(report, record.frame.index),
            f"{_error_text(record)}. {diagnosis_sentence(report.run, record)}",
        ),
        frame_svg(record, report.image(row), report.run.semantic_map.classes, title),
    )


def _error_text(record: FrameRecord) -> str:
    errors = errors_of(record)
    if errors is None:
        return ""
    return f", {errors.distance_m:.2f} m and {errors.angle_deg:.2f} deg off"


def as_markdown(reports: Sequence[RunReport]) -> str:
    """Return all tables as Markdown, below a title."""
    names = ", ".join(report.name for report in reports)
    return (
        "\n\n".join(
            [
                f"# {in_markdown(names)}",
                *(f"Note: {in_markdown(note)}." for note in reader_notes(reports)),
                *(table.as_markdown() for table in _all_tables(reports)),
            ]
        )
        + "\n"
    )


def as_latex(reports: Sequence[RunReport]) -> str:
    """Return all tables as LaTeX to include in a paper; they need no package."""
    notes = [f"% Note: {in_latex(note)}." for note in reader_notes(reports)]
    return "\n\n".join([*notes, *(table.as_latex() for table in _all_tables(reports))]) + "\n"


def _all_tables(reports: Sequence[RunReport]) -> list[Table]:
    per_run = (worst_table, faults_table, elements_table, tracks_table)
    tables = (table(report) for report in reports for table in per_run)
    return [*comparison_tables(reports), *(table for table in tables if table is not None)]
