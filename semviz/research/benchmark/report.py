"""Report a benchmark as aligned text, Markdown, JSON and plots, beside the paper's table I.

Source: Chen, Xue, Pang: Sparse Semantic Map-Based Monocular Localization in Traffic Scenes
Using Learned 2D-3D Point-Line Correspondences. IEEE Robotics and Automation Letters, 2022.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from semviz.presentation import plots
from semviz.presentation.terminal import Table, figure, percent
from semviz.research.benchmark.suites import SUITES, Suite
from semviz_core.common.files import replacing
from semviz_core.metrics.pose_errors import Outcome, Spread
from semviz_core.research.evaluation.outcomes import ALL, STRATA, Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure


METHODS = (
    "matchnet", "deepi2p", "bpnpnet", "paper-no-semantics",
    "matchnet-semantic", "deepi2p-semantic", "bpnpnet-semantic", "paper",
    "EPnP with true pairs", "paper with true costs", "paper with true P", "correspondences",
    "learned", "search", "true matches", "bound",
)  # fmt: skip
"""Default methods of the suites that show the paper's table."""
_FROM_PIXELS = (
    "deepi2p-pixels", "deepi2p-pixels-cells", "true frustum", "true cells", "fix alone",
)  # fmt: skip
"""Further ones where frames have a picture and a cloud."""
_PRINTED_STRATA = {ALL: "all", ">= 6 true": ">= 6"}
"""Strata shown beside the printed rows, with their names there; the suite's own tables show all."""
_PRINTED_FIGURES = (
    "Printed is table I of the paper: 459 frames of KITTI 09 and 10. Shares and times are from its "
    "text; times are those of a Titan Xp, without the detection of elements. Means and quartiles "
    "measured here are over the frames with a pose, of which there are so many of so many; shares "
    "are of all frames, times of one core."
)
_DATA = (
    "Data: the paper's elements were labelled and detected in KITTI's images; neither labels nor "
    "code are public. Here elements are simulated, with --kitti-poses along KITTI's drives and "
    "where its surveyed poles stand, and seen with the errors of the paper's own tables (noise "
    "paper) or with 1 px (noise low)."
)
_TRAINING = (
    "Training: the paper's networks learned from 2,984 frames of KITTI 00 to 08, those that come "
    "with semviz from simulated roads alone{}. All methods measured here are implementations of "
    "our own, by what is published."
)
_READINGS = (
    "The paper does not say how 2D3D-MatchNet and DeepI2P match elements instead of pixels and "
    "scans: their point rows are readings of ours, small, and trained for ten minutes. `EPnP "
    "with true pairs` is what their solver makes of perfect matches. "
)
PAPER_SUITES = {
    "paper": (
        _PRINTED_FIGURES,
        _DATA,
        "Frames: the paper has picked the 3.29 % of its images that show four elements or more. "
        "Here frames are anywhere along the drives and false detections count, so that about a "
        "quarter of those with four detections hold fewer than four true matches. Frames with six "
        "and more therefore stand apart.",
        "Submap: within 20 m in the paper; here within 50 m of a fix that is 5 to 10 m off, "
        "because tops of poles come into the image from 17 m on. The heading is unknown in both.",
        _TRAINING.format(""),
    ),
    "paper-20m": (
        "What one may conclude: No printed figure is confirmed or refuted here, since the paper's "
        "elements and code are not public. All measured rows are of the same frames, so they "
        "compare these implementations with each other and with `true matches`, the best that "
        "matching can reach. Where `search` or `correspondences` find a pose and the paper's "
        "networks do not, the frame has one; `paper with true costs` is what better matching "
        "could make of it under the paper's priors, and `paper with true P` without them.",
        _PRINTED_FIGURES,
        _DATA,
        _READINGS + "The two rows from pixels need scans and images: see suite street-paper.",
        "Protocol, as the paper states it: a submap within 20 m, a fix within 5 m, the map turned "
        "by any angle, frames that show four elements or more.",
        "Where the paper leaves it open: all elements within 20 m of the camera are seen, none "
        "is false, and half of the bottoms are hidden; all are mapped, 3 % twice, with the errors "
        "of its table; submaps are around the fix; gravity and the road's height are known to the "
        "methods that use them, which the paper's do not.",
        _TRAINING.format(", on 30,000 frames of this protocol, turned anew for each sample"),
    ),
    "street-paper": (
        "What one may conclude: No printed figure is confirmed or refuted here, since pictures, "
        "scans and elements are simulated and the networks small. All measured rows are of the "
        "same frames, so they compare these implementations with each other, with perfect matches "
        "(`true matches`), with perfect labels (`true frustum`, `true cells`) and with chance "
        "(`fix alone`). Nothing follows for DeepI2P or 2D3D-MatchNet as such, for real "
        "scans, or for their run times.",
        _PRINTED_FIGURES,
        "`deepi2p-pixels` is a small re-implementation of DeepI2P (1.2 million weights, trained "
        "on 12,000 pictures of simulated streets; published: 4 million), with inverse "
        "camera projection as solver; `deepi2p-pixels-cells` is the same network with cells and "
        "EPnP. 2D3D-MatchNet from pixels is not re-implemented: on these "
        "streets, 5 of 48 ISS keypoints that an image shows have a SIFT keypoint within 3 px, and "
        "4 would by chance.",
        _READINGS.strip(),
        "Frames: simulated streets that nothing was trained on, mapped on another day, when other "
        "cars were parked; where six elements within 20 m are detected, with the errors, misses "
        "and false detections of the paper's tables. Map: as labelled from the drive, with its "
        "errors, 5 % missing, 5 % moved since. A fix within 5 m, the heading unknown, submaps "
        "within 20 m of it, clouds within 40 m, from seven scans.",
        _TRAINING.format(
            ", on frames of suite paper-20m, where no element is missed and none is false"
        ),
    ),
}
"""Suites with the paper's table: how printed and measured figures differ."""


@dataclass(frozen=True)
class Printed:
    """A row of the paper's table I, as printed."""

    name: str
    rte_m: str
    """Mean, Q1, Q2, Q3."""
    rre_deg: str
    method: str | None = None
    """Our implementation of it."""
    below_1m: str = "-"
    time_ms: str = "-"

    def cells(self) -> tuple[str, ...]:
        rte, rre = self.rte_m.split(), self.rre_deg.split()
        return self.name, "printed", "459", *rte, self.below_1m, *rre, self.time_ms


PRINTED = (
    Printed("2D3D-MatchNet", "27.1 12.0 23.3 63.1", "134 115 127 162", time_ms="3100"),
    Printed(
        "DeepI2P", "42.9 15.4 32.7 96.2", "145 82.4 131 167", "deepi2p-pixels", time_ms="5700"
    ),
    Printed(
        "Point 2D3D-MatchNet", "18.4 6.72 13.5 27.3", "75.8 23.1 53.7 146", "matchnet"
    ),
    Printed("Point DeepI2P", "3.94 0.57 1.39 5.83", "24.1 5.37 13.2 36.5", "deepi2p"),
    Printed("BPnPNet", "1.14 0.21 0.49 1.57", "2.10 0.52 0.74 2.69", "bpnpnet", time_ms="100"),
    Printed(
        "Ours w/o Semantics", "0.49 0.14 0.21 0.97", "0.92 0.17 0.35 1.83", "paper-no-semantics"
    ),
    Printed(
        "Semantic Point 2D3D-MatchNet", "5.21 2.14 4.32 12.6", "24.3 6.49 18.6 37.2",
        "matchnet-semantic",
    ),
    Printed(
        "Semantic Point DeepI2P", "2.17 0.25 0.71 3.24", "8.69 2.15 6.21 12.4",
        "deepi2p-semantic",
    ),
    Printed("Semantic BPnPNet", "0.36 0.17 0.25 0.82", "0.65 0.23 0.39 1.22", "bpnpnet-semantic"),
    Printed("Ours", "0.22 0.09 0.18 0.29", "0.34 0.14 0.26 0.45", "paper", "99.5%", "100"),
)  # fmt: skip
"""The first two run on images and scans, the next four on detected elements, the last four on
elements with their classes."""


def methods_of_table(suites: Sequence[Suite]) -> tuple[str, ...]:
    """Return the default methods of suites that show the paper's table."""
    return (*_FROM_PIXELS, *METHODS) if all(suite.has_pictures for suite in suites) else METHODS


def beside_printed(rows: Sequence[Row]) -> Table:
    """Return the table of one noise: each printed row with our rows of that method, then others."""
    kept = [row for row in rows if row.stratum in _PRINTED_STRATA]
    cells: list[tuple[str, ...]] = []
    for printed in PRINTED:
        cells.append(printed.cells())
        cells += [_cells(row) for row in kept if row.method == printed.method]
        if printed.method is None:
            cells.append(("not re-implemented", *["-"] * 12))
    shown = {printed.method for printed in PRINTED}
    cells += [_cells(row) for row in kept if row.method not in shown]
    quartiles = ("Q1", "Q2", "Q3")
    header = ("method", "matches", "poses", "RTE", *quartiles, "<1 m", "RRE", *quartiles, "ms")
    title = f"the paper's table, suite {rows[0].suite}, noise {rows[0].noise}"
    return Table(title, header, tuple(cells), words=2)


def by_published_measures(rows: Sequence[Row]) -> Table:
    """Return the errors of one noise as DeepI2P measures them."""
    quartiles = ("Q1", "Q2", "Q3")
    header = ("method", "poses", "translation", *quartiles, "Euler sum", *quartiles, "2 m, 5 deg")
    title = f"as DeepI2P measures (m, deg; below both, of all), suite {rows[0].suite}"
    cells = [
        (
            row.method, _poses(row), *_spread(row.translation_m), *_spread(row.euler_deg),
            percent(row.below_2m_5deg),
        )
        for row in rows
        if row.stratum == ALL
    ]  # fmt: skip
    return Table(f"{title}, noise {rows[0].noise}", header, tuple(cells), words=1)


def _poses(row: Row) -> str:
    frames = row.accuracy.frames
    return f"{round((1.0 - row.cannot) * frames)}/{frames}"


def _cells(row: Row) -> tuple[str, ...]:
    accuracy, time = row.accuracy, figure(row.time_ms.median) + ("" if row.timed_alone else "*")
    below = percent(accuracy.share_below_1m)
    rte, rre = _spread(accuracy.rte_m), _spread(accuracy.rre_deg)
    return row.method, _PRINTED_STRATA[row.stratum], _poses(row), *rte, below, *rre, time


def _spread(spread: Spread) -> tuple[str, ...]:
    return tuple(figure(value) for value in (spread.mean, spread.q1, spread.q2, spread.q3))


Columns = tuple[tuple[str, Callable[[Row], str]], ...]
"""Headers, each with the function that gives a row's cell."""


@dataclass(frozen=True)
class BenchmarkReport:
    """The results of a benchmark."""

    settings: dict[str, Any]
    notes: tuple[str, ...]
    """Caveats of the numbers."""
    rows: tuple[Row, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the object that ``semviz benchmark --json`` prints."""
        rows = [row.as_json() for row in self.rows]
        return {"settings": self.settings, "notes": list(self.notes), "rows": rows}

    def as_text(self) -> str:
        """Return the report for terminals of 120 columns."""
        notes = [fill(difference, 118) for difference in self._differences()]
        return "\n\n".join([*notes, *(table.as_text() for table in self._tables())])

    def as_markdown(self) -> str:
        made = ", ".join(f"{name} {value}" for name, value in self.settings.items())
        notes = [f"Note: {note}." for note in self.notes]
        tables = (table.as_markdown() for table in self._tables())
        parts = ["# Benchmark", f"Made with {made}.", *notes, *self._differences(), *tables]
        return "\n\n".join(parts) + "\n"

    def write(self, folder: Path) -> None:
        """Write ``table.md`` and ``table.json``."""
        for name, text in (
            ("table.md", self.as_markdown()),
            ("table.json", json.dumps(self.as_json(), indent=1) + "\n"),
        ):
            with replacing(folder / name) as path:
                path.write_text(text)

    def _tables(self) -> list[Table]:
        """Return the paper's table, then those of each suite and noise."""
        groups: dict[tuple[str, str], list[Row]] = {}
        for row in self.rows:
            groups.setdefault((row.suite, row.noise), []).append(row)
        papers = [group for (suite, _), group in groups.items() if suite in PAPER_SUITES]
        tables = [table for group in groups.values() for table in _tables_of(group)]
        pixels = [group for group in papers if SUITES[group[0].suite].has_pictures]
        return [*map(beside_printed, papers), *map(by_published_measures, pixels), *tables]

    def _differences(self) -> tuple[str, ...]:
        """Return what is said above the paper's table, if it is shown."""
        suites = dict.fromkeys(row.suite for row in self.rows)
        said = (text for suite in suites for text in PAPER_SUITES.get(suite, ()))
        return tuple(dict.fromkeys(said))


def _tables_of(group: list[Row]) -> list[Table]:
    """Return the tables of a suite with one noise."""
    where = f"{group[0].suite}, noise {group[0].noise}"
    return [
        _table(f"{where}: RTE (m) and RRE (deg)", group, _ERRORS),
        _table(f"{where}: trust", group, _TRUST),
        _times_table(f"{where}: time (ms)", [row for row in group if row.stratum == ALL]),
    ]


def _table(title: str, group: list[Row], columns: Columns) -> Table:
    cells = tuple(tuple(cell(row) for _, cell in columns) for row in group)
    return Table(title, tuple(header for header, _ in columns), cells, words=2)


def _times_table(title: str, group: list[Row]) -> Table:
    cells = []
    for row in group:
        cells.append((row.method, "first call", _milliseconds(row, row.first_call_ms), "-"))
        for stage, time in {"whole": row.time_ms, **row.stages_ms}.items():
            spread = (_milliseconds(row, time.median), _milliseconds(row, time.p95))
            cells.append((row.method, stage, *spread))
    if not all(row.timed_alone for row in group):
        title += "; * too long: other processes were at work"
    return Table(title, ("method", "stage", "median", "p95"), tuple(cells), words=2)


def _milliseconds(row: Row, value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}" + ("" if row.timed_alone else "*")


_WHO: Columns = (
    ("method", lambda row: row.method),
    ("stratum", lambda row: row.stratum),
    ("frames", lambda row: str(row.accuracy.frames)),
)
_ERRORS: Columns = (
    *_WHO,
    ("RTE", lambda row: figure(row.accuracy.rte_m.mean)),
    ("Q1", lambda row: figure(row.accuracy.rte_m.q1)),
    ("Q2", lambda row: figure(row.accuracy.rte_m.q2)),
    ("Q3", lambda row: figure(row.accuracy.rte_m.q3)),
    ("<1 m", lambda row: percent(row.accuracy.share_below_1m)),
    ("RRE", lambda row: figure(row.accuracy.rre_deg.mean)),
    ("Q1", lambda row: figure(row.accuracy.rre_deg.q1)),
    ("Q2", lambda row: figure(row.accuracy.rre_deg.q2)),
    ("Q3", lambda row: figure(row.accuracy.rre_deg.q3)),
    ("<1 deg", lambda row: percent(row.accuracy.share_below_1deg)),
    ("/bound", lambda row: figure(row.bound_ratio_median)),
)
_TRUST: Columns = (
    *_WHO,
    ("ok", lambda row: percent(row.coverage)),
    ("ambig.", lambda row: percent(row.ambiguous)),
    ("cannot", lambda row: percent(row.cannot)),
    ("sure+wrong", lambda row: percent(row.confident_wrong)),
    ("ok >1 m", lambda row: percent(row.ok_above_1m)),
    ("NEES", lambda row: figure(row.nees_mean)),
    ("both <1", lambda row: percent(row.success)),
    ("RMS/bound", lambda row: figure(row.rms_over_bound)),
)


MARKERS = {"ok": ("o", plots.COLORS[0]), "ambiguous": ("x", plots.COLORS[1])}


def draw_benchmark_plots(outcomes: Iterable[Outcome], rows: Sequence[Row], folder: Path) -> None:
    """Write the plots of each suite and noise to ``folder``.

    Raise SemvizError if matplotlib is not installed.
    """
    for (suite, noise), groups in _grouped(outcomes).items():
        title = f"{suite}, noise {noise}"
        timed = [row for row in rows if (row.suite, row.noise, row.stratum) == (suite, noise, ALL)]
        figures = {"cumulative": plots.cumulative(title, groups), "time": times(title, timed)}
        if groups:
            figures["histogram"] = plots.histograms(groups, title)
        facts = [outcome.facts for group in groups.values() for outcome in group]
        if any(fact.bound_m is not None for fact in facts):
            figures["bound"] = against_bound(title, groups)
        if any(fact.recall is not None for fact in facts):
            figures["recall"] = plots.against_recall(title, groups)
        for name, plot in figures.items():
            plots.save_png(plot, folder / f"{_file_name(suite)}-{noise}-{name}.png", dpi=120)


def against_bound(title: str, groups: plots.Groups) -> "Figure":
    """Plot the RTE of each frame over the median error of its Cramer-Rao bound, up to 100 m."""
    columns = max(min(len(groups), 3), 1)
    rows = max(-(-len(groups) // columns), 1)
    figure = plots.new_figure(3.4 * columns + 0.6, 3.2 * rows + 0.8, title)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    bounds = plots.finite(outcome.facts.bound_m for group in groups.values() for outcome in group)
    both = [bounds.min(initial=1.0), bounds.max(initial=1.0)]
    for axis, (method, group) in zip(axes, groups.items(), strict=False):
        for status, (marker, color) in MARKERS.items():
            points = plots.finite_rows(
                (outcome.facts.bound_m, outcome.rte_m)
                for outcome in group
                if outcome.status == status
            )
            bound, rte = np.minimum(points, plots.FARTHEST_M).T
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
        plots.plain_numbers(axis.xaxis, axis.yaxis)
        plots.add_grid(axis)
    for axis in axes[len(groups) :]:
        axis.remove()
    figure.supxlabel("median error of an efficient estimator on the frame (m)", fontsize="medium")
    figure.supylabel("RTE (m)", fontsize="medium")
    axes[0].legend(loc="lower right", fontsize="small")
    return figure


def times(title: str, rows: Sequence[Row]) -> "Figure":
    """Plot median (bar) and 95th percentile (tick) of each stage and of the whole frame."""
    bars = [
        (f"{row.method}: {stage}" if stage else f"{row.method}, whole", stage, time)
        for row in rows
        for stage, time in [*row.stages_ms.items(), ("", row.time_ms)]
    ]
    figure = plots.new_figure(8.0, 0.26 * len(bars) + 1.4, title)
    axis = figure.subplots()
    for place, (_, stage, time) in enumerate(bars):
        if time.median is None or time.p95 is None:
            continue
        color = plots.COLORS[4] if stage else plots.COLORS[0]
        axis.barh(place, time.median, color=color, height=0.7)
        axis.plot([time.median, time.p95], [place, place], color="0.2", linewidth=1.0)
        axis.plot(time.p95, place, "|", color="0.2", markersize=9)
    axis.set(xscale="log", xlabel="time (ms): bar to the median, tick at the 95th percentile")
    plots.plain_numbers(axis.xaxis)
    axis.set_yticks(range(len(bars)), [name for name, _, _ in bars])
    axis.invert_yaxis()
    plots.add_grid(axis)
    return figure


def _grouped(outcomes: Iterable[Outcome]) -> dict[tuple[str, str], plots.Groups]:
    by_suite: dict[tuple[str, str], plots.Groups] = {}
    for outcome in outcomes:
        if not STRATA[ALL](outcome.facts):
            continue
        by_suite.setdefault((outcome.suite, outcome.noise), {}).setdefault(
            outcome.method, []
        ).append(outcome)
    return {
        key: {
            method: group
            for method, group in groups.items()
            if any(outcome.rte_m is not None for outcome in group)
        }
        for key, groups in by_suite.items()
    }


def _file_name(suite: str) -> str:
    return suite.replace(" ", "-").replace("%", "percent")
