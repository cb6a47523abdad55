"""Show the check of a drive's poses as text and as a plot."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semviz.presentation.plots import COLORS, add_grid, new_figure, save_png
from semviz.workspace.poses.pose_choices import Choice, PoseOperation
from semviz.workspace.poses.pose_review import PoseReview, PoseStretch, used_poses
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import check_replaceable
from semviz_core.pose_checks.comparison import BASELINE, RIGHT_U, RIGHT_V
from semviz_core.pose_checks.faults import PoseCheck

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from semviz.workspace.workspace import Workspace

_NO_FAULT = "no fault found"


def check_text(check: PoseCheck, evidence: Sequence[str]) -> str:
    """Return the faults with their remedies, and how good the other poses are.

    ``evidence`` is what labels say about each fault; empty where they say nothing.
    """
    comparison = check.comparison
    pairs = int(comparison.compared.sum())
    lines = [f"{len(check.frames)} frames, {pairs} pairs compared with the images"]
    lines += [text] if (text := unchecked_text(check)) else []
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


def unchecked_text(check: PoseCheck) -> str:
    """Return where the images show too little to check poses; empty if they do everywhere."""
    if not check.unchecked:
        return ""
    stretches = ", ".join(f"{first} to {last}" for first, last in check.unchecked)
    return f"too little evidence to check the poses of frames {stretches}"


def warning_lines(check: PoseCheck, workspace: Path) -> list[str]:
    """Return one line per fault, with the command that shows more."""
    return [f"poses: {fault.text} (semviz poses check {workspace})" for fault in check.faults]


def review_lines(review: "PoseReview") -> list[str]:
    """Return one line per fault of the given poses: what it is, who agrees, what was chosen."""
    lines = [f"poses: {stretch_text(review, stretch)}" for stretch in review.stretches]
    if review.open:
        where = review.workspace.path
        lines.append(f"poses: choose what to do: semviz poses choose {where}, or annotate, F4")
    return lines


def stretch_text(review: "PoseReview", stretch: "PoseStretch") -> str:
    """Return ``frames 0-11: poses turned by up to 0.7 deg left; stereo and 9 elements agree``."""
    text, operation = stretch.fault.text, review.choice_for(stretch)
    has_stereo = stretch.check.motions.has_stereo
    evidence = None if stretch.seen is None else stretch.seen.evidence
    if evidence is not None:
        witness = "stereo" if has_stereo else "the images"
        text += f"; {witness} and {evidence.agreeing} of {evidence.elements} elements agree"
    elif stretch.can_refine:
        text += "; stereo says so" if has_stereo else "; the images say so"
    return text if operation is None else f"{text}; {DONE[operation.choice]} by {operation.author}"


def review_as_dict(review: "PoseReview") -> dict[str, Any]:
    """Return the faults of the given poses, with evidence and choices, for JSON."""
    faults = []
    for stretch in review.stretches:
        evidence = None if stretch.seen is None else stretch.seen.evidence
        operation = review.choice_for(stretch)
        faults.append(
            {
                **asdict(stretch.fault),
                "text": stretch_text(review, stretch),
                "labels": None if evidence is None else asdict(evidence),
                "choice": None if operation is None else operation.as_dict(),
            }
        )
    return {"faults": faults, "used": used_poses(review.workspace)}


DONE: dict[Choice, str] = {
    "refine": "refined",
    "leave out": "left out",
    "keep": "kept as they are",
    "ask": "to be asked again",
}


def choice_text(operation: PoseOperation) -> str:
    """Return what was chosen, for whom it matters."""
    subject = "" if operation.subject == "frames" else f", {operation.subject}"
    return f"{operation.where}{subject}: {DONE[operation.choice]}"


def choice_lines(workspace: "Workspace") -> list[str]:
    """Return one line per choice made for the poses of a workspace."""
    return [
        f"{choice_text(one)} ({one.author}, {one.time[:10]})"
        for one in workspace.pose_choices().present
    ]


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
