"""The paper's table I of localization accuracy, with the measured figures beside it.

Source: Chen, Xue, Pang: Sparse Semantic Map-Based Monocular Localization in Traffic Scenes
Using Learned 2D-3D Point-Line Correspondences. IEEE Robotics and Automation Letters, 2022.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from semviz.presentation.terminal import Table, figure, percent
from semviz_core.metrics.pose_errors import Spread
from semviz_core.research.evaluation.outcomes import ALL, Row

SUITE = "paper"
METHODS = (
    "bpnpnet", "paper-no-semantics", "bpnpnet-semantic", "paper", "paper with true P",
    "correspondences", "learned", "wide", "search", "true matches", "bound",
)  # fmt: skip
"""Default methods of the suite."""
STRATA = {ALL: "all", ">= 6 true": ">= 6"}
"""Strata shown beside the printed rows, with their names there; the suite's own tables show all."""
DIFFERENCES = (
    "Printed is table I of the paper: 459 frames of KITTI 09 and 10. Shares and times are from its "
    "text; times are those of a Titan Xp, without the detection of elements. Means and quartiles "
    "measured here are over the frames with a pose, of which there are so many of so many; shares "
    "are of all frames, times of one core.",
    "Data: the paper's elements were labelled and detected in KITTI's images; neither labels nor "
    "code are public. Here elements are simulated, with --kitti-poses along KITTI's drives and "
    "where its surveyed poles stand, and seen with the errors of the paper's own tables (noise "
    "paper) or with 1 px (noise low).",
    "Frames: the paper has picked the 3.29 % of its images that show four elements or more. Here "
    "frames are anywhere along the drives and false detections count, so that about a quarter of "
    "those with four detections hold fewer than four true matches. Frames with six and more "
    "therefore stand apart.",
    "Submap: within 20 m in the paper; here within 50 m of a fix that is 5 to 10 m off, because "
    "tops of poles come into the image from 17 m on. The heading is unknown in both.",
    "Training: the paper's networks learned from 2,984 frames of KITTI 00 to 08, those that come "
    "with semviz from simulated roads alone. All methods measured here are implementations of our "
    "own, by what is published.",
)
"""Differences between the printed and the measured figures."""


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
    Printed("DeepI2P", "42.9 15.4 32.7 96.2", "145 82.4 131 167", time_ms="5700"),
    Printed("Point 2D3D-MatchNet", "18.4 6.72 13.5 27.3", "75.8 23.1 53.7 146"),
    Printed("Point DeepI2P", "3.94 0.57 1.39 5.83", "24.1 5.37 13.2 36.5"),
    Printed("BPnPNet", "1.14 0.21 0.49 1.57", "2.10 0.52 0.74 2.69", "bpnpnet", time_ms="100"),
    Printed(
        "Ours w/o Semantics", "0.49 0.14 0.21 0.97", "0.92 0.17 0.35 1.83", "paper-no-semantics"
    ),
    Printed("Semantic Point 2D3D-MatchNet", "5.21 2.14 4.32 12.6", "24.3 6.49 18.6 37.2"),
    Printed("Semantic Point DeepI2P", "2.17 0.25 0.71 3.24", "8.69 2.15 6.21 12.4"),
    Printed("Semantic BPnPNet", "0.36 0.17 0.25 0.82", "0.65 0.23 0.39 1.22", "bpnpnet-semantic"),
    Printed("Ours", "0.22 0.09 0.18 0.29", "0.34 0.14 0.26 0.45", "paper", "99.5%", "100"),
)
"""The first two run on images, the next four on detected elements, the last four on elements with
their classes."""


def beside_printed(rows: Sequence[Row]) -> Table:
    """Return the table of one noise: each printed row with our rows of that method, then others."""
    kept = [row for row in rows if row.stratum in STRATA]
    cells: list[tuple[str, ...]] = []
    for printed in PRINTED:
        cells.append(printed.cells())
        cells += [_cells(row) for row in kept if row.method == printed.method]
    shown = {printed.method for printed in PRINTED}
    cells += [_cells(row) for row in kept if row.method not in shown]
    quartiles = ("Q1", "Q2", "Q3")
    header = ("method", "matches", "poses", "RTE", *quartiles, "<1 m", "RRE", *quartiles, "ms")
    return Table(f"the paper's table, noise {rows[0].noise}", header, tuple(cells), words=2)


def _cells(row: Row) -> tuple[str, ...]:
    accuracy, time = row.accuracy, figure(row.time_ms.median) + ("" if row.timed_alone else "*")
    poses = f"{round((1.0 - row.cannot) * accuracy.frames)}/{accuracy.frames}"
    below = percent(accuracy.share_below_1m)
    rte, rre = _spread(accuracy.rte_m), _spread(accuracy.rre_deg)
    return row.method, STRATA[row.stratum], poses, *rte, below, *rre, time


def _spread(spread: Spread) -> tuple[str, ...]:
    return tuple(figure(value) for value in (spread.mean, spread.q1, spread.q2, spread.q3))
