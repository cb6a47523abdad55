"""Localizability told: as a table, as JSON values, and as a plot."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from semviz_core.classes import ClassSet
from semviz_core.detector_model import DetectorModel
from semviz_core.errors import SemvizError
from semviz_core.files import check_replaceable, replacing
from semviz_core.localizability.effects import Effect
from semviz_core.localizability.predict import Localizability, Stretch

AMBIGUOUS_SHARE = 0.5
"""From this share on a place is called ambiguous: most frames there are."""
LISTED = 10
"""So many stretches in the table."""
Json = dict[str, Any]


def as_text(predicted: Localizability, classes: ClassSet, detector: DetectorModel) -> str:
    """The worst stretches, where it is ambiguous, what would help, and what must stay."""
    stretches = predicted.stretches()
    lines = [
        f"{len(predicted.along_m)} positions on {predicted.along_m[-1]:.0f} m: expected error "
        f"{predicted.expected_m.mean():.2f} m, {predicted.lost.mean():.0%} of frames find too "
        f"little, {predicted.ambiguous.mean():.0%} are ambiguous",
        assumed(detector),
        f"{'worst stretches':<16}{'expected':>10}{'sigma':>10}{'heading':>11}{'found':>7}"
        f"{'too little':>12}{'ambiguous':>11}",
        *(_row(one) for one in stretches[:LISTED]),
    ]
    if len(stretches) > LISTED:
        lines.append(f"and {len(stretches) - LISTED} better ones")
    for first_m, last_m in ambiguous_places(predicted):
        lines.append(f"ambiguous from {first_m:.0f} to {last_m:.0f} m")
    for one in predicted.suggested:
        x, y, _ = one.element.anchor_m[0]
        place = f"{new_element(one, predicted, classes)}, at ({x:.1f}, {y:.1f})"
        lines.append(f"add a {place}: {change(one)}")
    for one in predicted.critical:
        name = classes.element_name(int(one.element.class_id[0]), int(one.element.id[0]))
        lines.append(f"keep {name}: without it {change(one)}")
    return "\n".join(lines)


def as_dict(predicted: Localizability, classes: ClassSet, detector: DetectorModel) -> Json:
    """Everything as JSON values: positions, stretches, elements; null where there is no answer."""
    return {
        "detector": detector._asdict(),
        "positions": [
            {
                "along_m": float(predicted.along_m[row]),
                "center_m": pose.translation.tolist(),
                "found": float(predicted.found[row]),
                "sigma_m": _finite(predicted.sigma_m[row]),
                "sigma_deg": _finite(predicted.sigma_deg[row]),
                "expected_m": float(predicted.expected_m[row]),
                "too_little": float(predicted.lost[row]),
                "ambiguous": float(predicted.ambiguous[row]),
            }
            for row, pose in enumerate(predicted.T_map_camera)
        ],
        "stretches": [
            {
                "first_m": one.first_m,
                "last_m": one.last_m,
                "found": one.found,
                "sigma_m": _finite(one.sigma_m),
                "sigma_deg": _finite(one.sigma_deg),
                "expected_m": one.expected_m,
                "too_little": one.lost,
                "ambiguous": one.ambiguous,
            }
            for one in predicted.stretches()
        ],
        "add": [_effect(one, classes, None) for one in predicted.suggested],
        "keep": [_effect(one, classes, int(one.element.id[0])) for one in predicted.critical],
    }


def assumed(detector: DetectorModel) -> str:
    """``for a detector that finds 75 % of what is mapped and in view up to 20 m, ...``."""
    return (
        f"for a detector that finds {detector.recall_near:.0%} of what is mapped and in view up to "
        f"{detector.near_m:.0f} m, {detector.recall_far:.0%} from {detector.far_m:.0f} m on"
    )


def ambiguous_places(predicted: Localizability) -> Iterator[tuple[float, float]]:
    """Where, along the route (m), stretches begin and end in which most frames are ambiguous."""
    inside = np.concatenate([[False], predicted.ambiguous >= AMBIGUOUS_SHARE, [False]])
    first = np.flatnonzero(inside[1:] & ~inside[:-1])
    last = np.flatnonzero(inside[:-1] & ~inside[1:]) - 1
    for begin, end in zip(first, last, strict=True):
        yield float(predicted.along_m[begin]), float(predicted.along_m[end])


def new_element(effect: Effect, predicted: Localizability, classes: ClassSet) -> str:
    """``pole on the left, 52 m along``."""
    kind = classes[int(effect.element.class_id[0])].kind
    place = effect.element.anchor_m[0]
    centers = np.array([pose.translation for pose in predicted.T_map_camera])
    row = int(np.linalg.norm(centers[:, :2] - place[:2], axis=1).argmin())
    aside = predicted.T_map_camera[row].inverse().apply(place)[0]
    return (
        f"{'pole' if kind == 'line' else 'sign'} on the {'right' if aside > 0.0 else 'left'}, "
        f"{predicted.along_m[row]:.0f} m along"
    )


def change(effect: Effect) -> str:
    """``0.62 to 0.31 m, from 30 to 55 m``."""
    return (
        f"{effect.before_m:.2f} to {effect.after_m:.2f} m, from {effect.first_m:.0f} to "
        f"{effect.last_m:.0f} m"
    )


def check_plot_path(path: Path) -> None:
    """SemvizError where ``draw`` could not write to ``path``."""
    if path.suffix != ".png":
        raise SemvizError(f"{path}: name a file that ends in .png")
    check_replaceable(path)


def draw(predicted: Localizability, path: Path) -> None:
    """Accuracy, elements found and ambiguity along the route, as a PNG file."""
    from semviz.plot_style import COLORS

    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise SemvizError("--plot needs matplotlib: install it, or leave --plot out") from None
    figure = Figure(figsize=(10.0, 5.2), layout="constrained")
    accuracy, found, share = figure.subplots(3, 1, sharex=True, height_ratios=(2.0, 1.0, 1.0))
    x = predicted.along_m
    sigma_m = np.where(np.isfinite(predicted.sigma_m), predicted.sigma_m, np.nan)
    accuracy.plot(x, predicted.expected_m, color=COLORS[1], label="expected error")
    accuracy.plot(x, sigma_m, color=COLORS[0], linestyle="--", label="sigma, if answered")
    accuracy.set(
        ylabel="m", yscale="log", ylim=(0.015, 1.2), yticks=[0.02, 0.05, 0.1, 0.2, 0.5, 1.0]
    )
    accuracy.yaxis.set_major_formatter("{x:g}")
    found.plot(x, predicted.found, color=COLORS[2])
    found.set(ylabel="elements found", ylim=(0.0, None))
    share.fill_between(x, 100.0 * predicted.lost, color="0.75", step="mid", label="too little")
    share.plot(x, 100.0 * predicted.ambiguous, color=COLORS[3], label="ambiguous")
    share.set(ylabel="frames (%)", ylim=(0.0, 101.0), xlabel="along the route (m)")
    for effect in predicted.suggested:
        accuracy.axvspan(effect.first_m, effect.last_m, color=COLORS[4], alpha=0.15, linewidth=0)
    for axis in (accuracy, share):
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small", frameon=False)
    for axis in (accuracy, found, share):
        axis.grid(color="0.88", linewidth=0.7)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle("What single frames will know; shaded: where a new element helps most")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def _row(one: Stretch) -> str:
    sigma = f"{one.sigma_m:.2f} m" if np.isfinite(one.sigma_m) else "none"
    heading = f"{one.sigma_deg:.2f} deg" if np.isfinite(one.sigma_deg) else "none"
    stretch = f"{one.first_m:.0f} to {one.last_m:.0f} m"
    return (
        f"{stretch:<16}{one.expected_m:>8.2f} m{sigma:>10}{heading:>11}{one.found:>7.1f}"
        f"{one.lost:>12.0%}{one.ambiguous:>11.0%}"
    )


def _effect(effect: Effect, classes: ClassSet, element_id: int | None) -> Json:
    return {
        "id": element_id,
        "class": classes[int(effect.element.class_id[0])].name,
        "anchor_m": effect.element.anchor_m[0].tolist(),
        "first_m": effect.first_m,
        "last_m": effect.last_m,
        "before_m": effect.before_m,
        "after_m": effect.after_m,
        "total_m2": effect.total_m2,
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
