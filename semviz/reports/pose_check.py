"""Show the check of a drive's poses as text and as a plot."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semviz.presentation.plots import COLORS, add_grid, new_figure, save_png
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import check_replaceable
from semviz_core.pose_checks.comparison import BASELINE, RIGHT_U, RIGHT_V
from semviz_core.pose_checks.faults import PoseCheck

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NO_FAULT = "no fault found"


def check_text(check: PoseCheck, evidence: Sequence[str]) -> str:
    """Return the faults with their remedies, and how good the other poses are.

    ``evidence`` is what labels say about each fault; empty where they say nothing.
    """
    comparison = check.comparison
    pairs = int(comparison.compared.sum())
    lines = [f"{len(check.frames)} frames, {pairs} pairs compared with the images"]
    for fault, labels in zip(check.faults, evidence, strict=True):
        lines += [fault.text, *([f"    {labels}"] if labels else []), f"    {fault.remedy}"]
    if not check.faults:
        lines.append(_NO_FAULT)
    sigma = comparison.pose_sigma
    lines.append(
        f"good poses, from frame to frame: {100.0 * sigma[:3].max():.1f} cm, "
        f"{np.rad2deg(sigma[3:].max()):.3f} deg (1 sigma)"
    )
    if check.motions.has_stereo:
        values, errors = comparison.rig.values, comparison.rig.sigma
        lines.append(
            f"right image beside its calibration: {values[RIGHT_U]:+.2f} px across "
            f"(+/- {errors[RIGHT_U]:.2f}), {values[RIGHT_V]:+.2f} px down "
            f"(+/- {errors[RIGHT_V]:.2f}); baseline {np.expm1(values[BASELINE]):+.2%} "
            f"(+/- {errors[BASELINE]:.2%})"
        )
    return "\n".join(lines)


def warning_lines(check: PoseCheck, workspace: Path) -> list[str]:
    """Return one line per fault, with the command that shows more."""
    return [f"poses: {fault.text} (semviz poses check {workspace})" for fault in check.faults]


def check_plot_path(path: Path) -> None:
    """Raise SemvizError if ``draw_check`` cannot write to ``path``."""
    if path.suffix != ".png":
        raise SemvizError(f"{path}: name a file that ends in .png")
    check_replaceable(path)


def draw_check(check: PoseCheck, path: Path) -> None:
    """Plot the innovations of all pairs, and what refining moves, with the faults marked."""
    count = len(check.faults)
    title = "Poses against images" + (f": {count} faults" if count > 1 else "")
    figure = new_figure(10.0, 6.4, title if count != 1 else f"Poses: {check.faults[0].text}")
    turn, shift, moved, sigmas = figure.subplots(4, 1, sharex=True)
    numbers = np.array([frame.index for frame in check.frames])
    comparison, refinement = check.comparison, check.refinement
    now = numbers[1:][comparison.compared]
    innovation = comparison.innovation[comparison.compared]
    for axis, values, unit in (
        (turn, np.rad2deg(innovation[:, 3:]), "turn of a pair (deg)"),
        (shift, innovation[:, :3], "shift of a pair (m)"),
    ):
        names = ("pitch", "yaw", "roll") if axis is turn else ("right", "down", "ahead")
        for column, name in enumerate(names):
            axis.plot(now, values[:, column], ".-", color=COLORS[column], label=name, linewidth=1)
        axis.set(ylabel=unit)
    turned = np.rad2deg(np.linalg.norm(refinement.turn_rad, axis=1))
    moved.plot(numbers, turned, color=COLORS[1], label="turn (deg)")
    length = np.linalg.norm(refinement.shift_m, axis=1)
    moved.plot(numbers, length, color=COLORS[0], linestyle="--", label="shift (m)")
    moved.set(ylabel="moved by refining")
    sigmas.bar(now, np.sqrt(comparison.chi2[comparison.compared]), color=COLORS[4], width=0.8)
    sigmas.set(ylabel="sigmas of a pair", xlabel="frame")
    sigmas.xaxis.get_major_locator().set_params(integer=True)
    for axis in (turn, shift, moved, sigmas):
        _mark_faults(axis, check)
        add_grid(axis)
    for axis in (turn, shift, moved):
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small", frameon=False)
    save_png(figure, path, dpi=120)


def _mark_faults(axis: "Axes", check: PoseCheck) -> None:
    first, last = check.frames[0].index, check.frames[-1].index
    for fault in check.faults:
        if (fault.first, fault.last) != (first, last):
            axis.axvspan(fault.first - 0.5, fault.last + 0.5, color=COLORS[5], alpha=0.25, lw=0)
