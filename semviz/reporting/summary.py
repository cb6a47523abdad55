"""The tables of a report."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from semviz.comparing.comparison import compare_runs
from semviz.measure import settings_of
from semviz.pose_errors import errors_of
from semviz.reporting.facts import Reported
from semviz.tables import Table, figure, percent
from semviz_core.errors import SemvizError
from semviz_core.explaining.per_element import ElementRecord

LISTED = 10
"""So many of the worst frames of a run."""
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
_TRUST = (
    ("ok", "coverage"),
    ("ambiguous", "share_ambiguous"),
    ("cannot", "share_cannot"),
    ("sure and wrong", "share_sure_and_wrong"),
    ("ms, median", "median_time_ms"),
    ("ms, p95", "p95_time_ms"),
)


def tables(reported: Sequence[Reported]) -> list[Table]:
    """All that stand side by side."""
    found = [
        _metrics_table("RTE (m) and RRE (deg)", reported, _ERRORS),
        _metrics_table("Status and time", reported, _TRUST),
        verdict_table(reported),
    ]
    if len(reported) > 1:
        found.append(changes_table(reported))
    return [*found, settings_table(reported)]


def _metrics_table(
    title: str, reported: Sequence[Reported], columns: Sequence[tuple[str, str]]
) -> Table:
    rows = [
        (one.name, str(len(one.run.frames)), *(_cell(one, metric) for _, metric in columns))
        for one in reported
    ]
    header = ("run", "frames", *(name for name, _ in columns))
    return Table(title, header, tuple(rows), words=1)


def _cell(one: Reported, metric: str) -> str:
    is_share = metric.startswith("share") or metric == "coverage"
    return (percent if is_share else figure)(one.metrics[metric])


def verdict_table(reported: Sequence[Reported]) -> Table:
    """How many frames got which verdict, the most frequent first."""
    counts = [Counter(one.verdicts) for one in reported]
    total = Counter(name for one in reported for name in one.verdicts)
    names = sorted(total, key=lambda name: (-total[name], name))
    rows = [(name, *(str(count[name]) for count in counts)) for name in names]
    return Table("Verdicts", ("verdict", *(one.name for one in reported)), tuple(rows), words=1)


def changes_table(reported: Sequence[Reported]) -> Table:
    """Each run against the first, frame by frame."""
    base, *others = reported
    rows = [(one.name, *_changes(base, one)) for one in others]
    header = ("run", "frames in both", "fixed", "broken", "same", "map")
    return Table(f"Frame by frame against {base.name}", header, tuple(rows), words=1)


def _changes(base: Reported, other: Reported) -> tuple[str, ...]:
    try:
        found = compare_runs(base.run, other.run)
    except SemvizError:  # of another drive: nothing to compare, and reports are for such runs too
        return ("-",) * 5
    counts = (len(found.of("fixed")), len(found.of("broken")), len(found.of("same")))
    same_map = "same" if found.maps is None else "another"
    return str(len(found.frames)), *map(str, counts), same_map


def settings_table(reported: Sequence[Reported]) -> Table:
    """What was run, so that it can be run again."""
    columns = [_made_with(one) for one in reported]
    names = dict.fromkeys(name for column in columns for name in column)
    rows = [(name, *(column.get(name, "-") for column in columns)) for name in names]
    header = ("made with", *(one.name for one in reported))
    return Table("What was run", header, tuple(rows), words=len(header))


def _made_with(one: Reported) -> dict[str, str]:
    run = one.run
    camera, numbers = run.info.rig.left, [record.frame.index for record in run.frames]
    return {
        "file": str(one.path),
        "workspace": run.info.workspace or "-",
        "created": run.info.created,
        "sequence": run.semantic_map.frame.name,
        "frames": f"{len(numbers)}, from {numbers[0]} to {numbers[-1]}",
        "image size": f"{camera.width} x {camera.height}",
        "map elements": str(len(run.semantic_map)),
        **settings_of(run),
    }


def worst_table(one: Reported) -> Table:
    """The worst frames of a run, the worst first."""
    rows = [_frame_row(one, row) for row in one.worst(LISTED)]
    header = ("frame", "verdict", "reason", "RTE (m)", "RRE (deg)", "seen", "fit")
    return Table(f"{one.name}: worst frames", header, tuple(rows), words=3)


def _frame_row(one: Reported, row: int) -> tuple[str, ...]:
    record = one.run.frames[row]
    errors, result = errors_of(record), record.localization
    fit = 0 if result.refinement is None else int(result.refinement.inlier.sum())
    return (
        str(record.frame.index),
        one.verdicts[row],
        result.reason,
        figure(None if errors is None else errors.distance_m),
        figure(None if errors is None else errors.angle_deg),
        str(len(result.observed)),
        str(fit),
    )


def faults_table(one: Reported) -> Table:
    """What its frames say together of map and camera."""
    verdict = one.over_the_run
    camera = [] if verdict.calibration is None else [verdict.calibration]
    rows = [(str(fault.kind), fault.sentence) for fault in (*camera, *verdict.elements)]
    if not rows:
        compared = f"in {verdict.frames} frames with a pose to compare with"
        rows = [("nothing", f"No fault of map or camera comes back {compared}.")]
    return Table(f"{one.name}: wrong over the run", ("what", "as frames say"), tuple(rows), words=2)


def elements_table(one: Reported) -> Table:
    """Map elements that do not fit in most frames, the worst first."""
    header = ("element", "in view", "seen", "used", "outlier", "residual (px)", "error cost (m)")
    worst = [record for record in one.elements if record.outlier][:LISTED]
    rows = [_element_row(one, record) for record in worst] or [("none", *"-" * (len(header) - 1))]
    return Table(f"{one.name}: elements that fit worst", header, tuple(rows), words=1)


def _element_row(one: Reported, record: ElementRecord) -> tuple[str, ...]:
    semantic_map = one.run.semantic_map
    (rows,) = np.nonzero(semantic_map.elements.id == record.id)
    name = f"{record.id}, not mapped"
    if len(rows):
        class_id = int(semantic_map.elements.class_id[rows[0]])
        name = semantic_map.classes.element_name(class_id, record.id)
    counts = (len(record.in_view), len(record.seen), len(record.used), len(record.outlier))
    cost_m = None if np.isnan(record.mean_cost_m) else record.mean_cost_m
    off_px = None if np.isnan(record.median_px) else record.median_px
    return (name, *map(str, counts), figure(off_px), figure(cost_m))


def notes(reported: Sequence[Reported]) -> list[str]:
    """What readers of the numbers should know."""
    found = [f"{one.name}: {one.run.note}" for one in reported if one.run.note]
    for one in reported:
        unknown = sum(truth is None for truth in one.run.truths)
        if unknown == len(one.run.frames):
            found.append(f"{one.name}: no true poses, so errors are not known")
        elif unknown:
            found.append(f"{one.name}: {unknown} frames have no true pose")
    return found
