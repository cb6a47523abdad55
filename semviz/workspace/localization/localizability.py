"""Predict localizability under the settings of a sequence, as table, JSON and plot.

The conditions are those of a run, or the defaults; recall can be measured from observations.
Positions come from the poses of the frames or, without poses, from the map.
"""

from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from semviz.runs.run import Observations, detector_model
from semviz.workspace.localization.localize import LocalizeOptions
from semviz.workspace.localization.simulated_measurements import prior_options
from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.detector_model import NOISE, SHIPPED_NOISE, DetectorModel, Noise, NoiseName
from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import check_replaceable
from semviz_core.localizability import route
from semviz_core.localizability.expected_error import Effect
from semviz_core.localizability.predict import Localizability, Stretch

STEP_M = 1.0
"""Minimum distance between positions."""
MIN_IN_VIEW = 20
"""Number of elements in view, near as well as far, from which recall is measured."""
RECALL_RANGE = (0.02, 0.98)
"""A measured recall is limited to this: a sample cannot prove 0 or 1."""


def conditions_of(options: LocalizeOptions) -> route.Conditions:
    """Return the conditions that a localization with these options assumes."""
    return route.Conditions(
        detector=detector_model(options.observations),
        noise=_noise(options.observations, options.noise),
        prior=prior_options(options),
        crop_radius_m=options.crop_radius_m,
        seed=options.seed,
    )


def _noise(observations: Observations, simulated: NoiseName) -> Noise:
    if observations == "labels":
        return route.LABEL_NOISE
    return SHIPPED_NOISE if observations == "detected" else NOISE[simulated]


def with_measured_recall(
    conditions: route.Conditions,
    semantic_map: SemanticMap,
    camera: Camera,
    observed: Iterable[tuple[Pose, IntArray]],
) -> route.Conditions:
    """Replace the recall by the one measured: ids (m,) of elements observed at poses T_map_camera.

    Return the same conditions if too few elements are in view, or none was observed.
    """
    depths, hits = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for T_map_camera, ids in observed:
        T_camera_map = T_map_camera.inverse()
        crop = semantic_map.crop(T_map_camera.translation, conditions.crop_radius_m)
        in_view = crop[route.visible_elements(crop, camera, T_camera_map, conditions).row]
        depths.append(T_camera_map.apply(in_view.anchor_m)[:, 2])
        hits.append(np.isin(in_view.id, ids))
    depth_m, is_hit, assumed = np.concatenate(depths), np.concatenate(hits), conditions.detector
    near, far = is_hit[depth_m <= assumed.near_m], is_hit[depth_m >= assumed.far_m]
    if min(len(near), len(far)) < MIN_IN_VIEW or not is_hit.any():
        return conditions
    low, high = RECALL_RANGE
    recall_near = float(np.clip(near.mean(), low, high))
    recall_far = float(np.clip(far.mean(), low, recall_near))
    detector = assumed._replace(recall_near=recall_near, recall_far=recall_far)
    return replace(conditions, detector=detector)


def options_of(recorded: dict[str, Any]) -> LocalizeOptions:
    """Return the options of a run; those not recorded have their defaults."""
    names = {field.name for field in fields(LocalizeOptions)}
    known = {name: value for name, value in recorded.items() if name in names}
    if "prior_distance_m" in known:
        known["prior_distance_m"] = tuple(known["prior_distance_m"])
    return LocalizeOptions(**known)


def positions(frames: Iterable[Frame], semantic_map: SemanticMap) -> tuple[Pose, ...]:
    """Return poses T_map_camera along the frames, or along the map's trajectory without poses.

    Raise SemvizError if there is neither.
    """
    poses = tuple(frame.T_map_camera for frame in frames if frame.T_map_camera is not None)
    if not poses:
        track_m = semantic_map.trajectory_m
        poses = route.poses_along(track_m[route.thinned(track_m, STEP_M)])
    if not poses:
        raise SemvizError(
            "no route: neither the frames have poses nor the map a trajectory; name other --frames"
        )
    rows = route.thinned(np.array([pose.translation for pose in poses]), STEP_M)
    return tuple(poses[row] for row in rows)


AMBIGUOUS_SHARE = 0.5
"""A place is ambiguous if at least this share of its frames is."""
LISTED = 10
"""Maximum number of stretches in the table."""
Json = dict[str, Any]


def localizability_text(
    predicted: Localizability, classes: ClassSet, detector: DetectorModel
) -> str:
    """Describe the worst stretches, ambiguous places, helpful additions, and critical elements."""
    stretches = predicted.stretches()
    lines = [
        f"{len(predicted.along_m)} positions on {predicted.along_m[-1]:.0f} m: expected error "
        f"{predicted.expected_m.mean():.2f} m, {predicted.lost.mean():.0%} of frames find too "
        f"little, {predicted.ambiguous.mean():.0%} are ambiguous",
        detector_text(detector),
        f"{'worst stretches':<16}{'expected':>10}{'sigma':>10}{'heading':>11}{'found':>7}"
        f"{'too little':>12}{'ambiguous':>11}",
        *(_stretch_line(stretch) for stretch in stretches[:LISTED]),
    ]
    if len(stretches) > LISTED:
        lines.append(f"and {len(stretches) - LISTED} better ones")
    for first_m, last_m in ambiguous_places(predicted):
        lines.append(f"ambiguous from {first_m:.0f} to {last_m:.0f} m")
    for effect in predicted.suggested:
        x, y, _ = effect.element.anchor_m[0]
        place = f"{new_element_text(effect, predicted, classes)}, at ({x:.1f}, {y:.1f})"
        lines.append(f"add a {place}: {effect_text(effect)}")
    for effect in predicted.critical:
        name = classes.element_name(int(effect.element.class_id[0]), int(effect.element.id[0]))
        lines.append(f"keep {name}: without it {effect_text(effect)}")
    return "\n".join(lines)


def localizability_json(
    predicted: Localizability, classes: ClassSet, detector: DetectorModel
) -> Json:
    """Return positions, stretches and elements as JSON values; null without a pose."""
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
                "first_m": stretch.first_m,
                "last_m": stretch.last_m,
                "found": stretch.found,
                "sigma_m": _finite(stretch.sigma_m),
                "sigma_deg": _finite(stretch.sigma_deg),
                "expected_m": stretch.expected_m,
                "too_little": stretch.lost,
                "ambiguous": stretch.ambiguous,
            }
            for stretch in predicted.stretches()
        ],
        "add": [_effect(effect, classes, None) for effect in predicted.suggested],
        "keep": [
            _effect(effect, classes, int(effect.element.id[0])) for effect in predicted.critical
        ],
    }


def detector_text(detector: DetectorModel) -> str:
    """``for a detector that finds 75% of the mapped elements in view up to 20 m, ...``."""
    return (
        f"for a detector that finds {detector.recall_near:.0%} of the mapped elements in view "
        f"up to {detector.near_m:.0f} m, {detector.recall_far:.0%} from {detector.far_m:.0f} m on"
    )


def ambiguous_places(predicted: Localizability) -> Iterator[tuple[float, float]]:
    """Yield start and end, along the route (m), of the stretches with mostly ambiguous frames."""
    inside = np.concatenate([[False], predicted.ambiguous >= AMBIGUOUS_SHARE, [False]])
    first = np.flatnonzero(inside[1:] & ~inside[:-1])
    last = np.flatnonzero(inside[:-1] & ~inside[1:]) - 1
    for begin, end in zip(first, last, strict=True):
        yield float(predicted.along_m[begin]), float(predicted.along_m[end])


def new_element_text(effect: Effect, predicted: Localizability, classes: ClassSet) -> str:
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


def effect_text(effect: Effect) -> str:
    """``0.62 to 0.31 m, from 30 to 55 m``."""
    return (
        f"{effect.before_m:.2f} to {effect.after_m:.2f} m, from {effect.first_m:.0f} to "
        f"{effect.last_m:.0f} m"
    )


def check_plot_path(path: Path) -> None:
    """Raise SemvizError if ``draw_localizability`` cannot write to ``path``."""
    if path.suffix != ".png":
        raise SemvizError(f"{path}: name a file that ends in .png")
    check_replaceable(path)


def draw_localizability(predicted: Localizability, path: Path) -> None:
    """Plot accuracy, number of detections and ambiguity along the route, as a PNG file."""
    from semviz.presentation.plots import COLORS, save_png

    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise SemvizError("--plot needs matplotlib: install it, or leave --plot out") from None
    figure = Figure(figsize=(10.0, 5.2), layout="constrained")
    accuracy, found, share = figure.subplots(3, 1, sharex=True, height_ratios=(2.0, 1.0, 1.0))
    x = predicted.along_m
    sigma_m = np.where(np.isfinite(predicted.sigma_m), predicted.sigma_m, np.nan)
    accuracy.plot(x, predicted.expected_m, color=COLORS[1], label="expected error")
    accuracy.plot(x, sigma_m, color=COLORS[0], linestyle="--", label="sigma, with a pose")
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
    figure.suptitle("Predicted localization of single frames; shaded: where a new element helps")
    save_png(figure, path, dpi=120)


def _stretch_line(stretch: Stretch) -> str:
    sigma = f"{stretch.sigma_m:.2f} m" if np.isfinite(stretch.sigma_m) else "none"
    heading = f"{stretch.sigma_deg:.2f} deg" if np.isfinite(stretch.sigma_deg) else "none"
    limits = f"{stretch.first_m:.0f} to {stretch.last_m:.0f} m"
    return (
        f"{limits:<16}{stretch.expected_m:>8.2f} m{sigma:>10}{heading:>11}{stretch.found:>7.1f}"
        f"{stretch.lost:>12.0%}{stretch.ambiguous:>11.0%}"
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
