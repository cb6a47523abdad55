"""A picture of merged drives: their landmarks from above, and how each drive was moved."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semviz.presentation.plots import COLORS, save_png
from semviz_annotation.mapping.drives.merge import Merging

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ARROW_SHARE = 0.06
"""Length of the longest arrow, as a share of the picture."""
_MOST_NAMES = 12


def draw_merging(merging: Merging, names: Sequence[str], path: Path) -> None:
    """Write a PNG file: landmarks of one drive and of several, and each drive's way with arrows
    along its shifts, enlarged."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    axes = figure.subplots()
    passes = np.bincount(merging.landmark)
    at_m = merging.alignment.landmark_m[:, :2]
    for is_shared, color in ((False, "0.7"), (True, "0.25")):
        chosen = at_m[(passes > 1) == is_shared]
        label = "mapped by several drives" if is_shared else "mapped by one drive"
        axes.scatter(chosen[:, 0], chosen[:, 1], s=9.0, color=color, label=label, zorder=2)
    times = _draw_drives(axes, merging, names)
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small", frameon=False)
    figure.suptitle(f"Landmarks of {len(names)} drives; arrows: how drives were moved, {times:g}x")
    save_png(figure, path, dpi=120)


def _draw_drives(axes: "Axes", merging: Merging, names: Sequence[str]) -> float:
    """Draw the ways and shifts of all drives; return by how much shifts are enlarged."""
    knots, shift_m = merging.knots, merging.alignment.correction[:, :2]
    extent_m = float(np.ptp(knots.position_m[:, :2], axis=0).max(initial=1.0))
    longest_m = float(np.linalg.norm(shift_m, axis=1).max(initial=1e-3))
    times = max(float(f"{_ARROW_SHARE * extent_m / longest_m:.1g}"), 1.0)
    for number, name in enumerate(names):
        rows = np.flatnonzero(knots.drive == number)
        at_m, color = knots.position_m[rows, :2], COLORS[number % len(COLORS)]
        label = name if number < _MOST_NAMES else None
        axes.scatter(at_m[:, 0], at_m[:, 1], s=3.0, color=color, label=label, zorder=3)
        some = slice(None, None, 2)
        axes.quiver(
            *at_m[some].T,
            *(times * shift_m[rows][some]).T,
            color=color,
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.0025,
            zorder=4,
        )
    return times
