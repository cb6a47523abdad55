"""Localizability under the settings of a drive: what is taken for granted, and the route."""

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from semviz.drive import DriveOptions, prior_options
from semviz.observing import Noise, Observations, detector_model
from semviz_core.arrays import IntArray
from semviz_core.camera import Camera
from semviz_core.detection.rates import NOISE as DETECTED_NOISE
from semviz_core.errors import SemvizError
from semviz_core.frame import Frame
from semviz_core.localizability.conditions import LABEL_NOISE, Conditions
from semviz_core.localizability.route import poses_along, thinned
from semviz_core.localizability.sight import look
from semviz_core.pose import Pose
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.street.detector import NOISE
from semviz_core.sources.street.detector import Noise as PixelNoise

STEP_M = 1.0
"""Between positions, at least."""
LEAST_IN_VIEW = 20
"""So many elements near, and far, tell a recall."""
RECALL_RANGE = (0.02, 0.98)
"""A measured recall of 0 or 1 would make chance out to be certainty."""


def conditions_of(options: DriveOptions) -> Conditions:
    """What a drive with these options takes for granted."""
    return Conditions(
        detector=detector_model(options.observations),
        noise=_noise(options.observations, options.noise),
        prior=prior_options(options),
        crop_radius_m=options.crop_radius_m,
        seed=options.seed,
    )


def _noise(observations: Observations, simulated: Noise) -> PixelNoise:
    if observations == "labels":
        return LABEL_NOISE
    return DETECTED_NOISE if observations == "detected" else NOISE[simulated]


def with_measured_recall(
    conditions: Conditions,
    semantic_map: SemanticMap,
    camera: Camera,
    seen: Iterable[tuple[Pose, IntArray]],
) -> Conditions:
    """With the recall that was had at poses T_map_camera, where map elements (m,) were seen.

    Unchanged where too few are in view to tell, or none is seen.
    """
    depths, founds = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for T_map_camera, ids in seen:
        T_camera_map = T_map_camera.inverse()
        crop = semantic_map.crop(T_map_camera.translation, conditions.crop_radius_m)
        in_view = crop[look(crop, camera, T_camera_map, conditions).row]
        depths.append(T_camera_map.apply(in_view.anchor_m)[:, 2])
        founds.append(np.isin(in_view.id, ids))
    depth_m, found, stated = np.concatenate(depths), np.concatenate(founds), conditions.detector
    near, far = found[depth_m <= stated.near_m], found[depth_m >= stated.far_m]
    if min(len(near), len(far)) < LEAST_IN_VIEW or not found.any():
        return conditions
    low, high = RECALL_RANGE
    recall_near = float(np.clip(near.mean(), low, high))
    recall_far = float(np.clip(far.mean(), low, recall_near))
    detector = stated._replace(recall_near=recall_near, recall_far=recall_far)
    return replace(conditions, detector=detector)


def options_of(recorded: dict[str, Any]) -> DriveOptions:
    """The options that a run was recorded with; the usual ones for what it does not say."""
    names = {one.name for one in fields(DriveOptions)}
    known = {name: value for name, value in recorded.items() if name in names}
    if "prior_distance_m" in known:
        known["prior_distance_m"] = tuple(known["prior_distance_m"])
    return DriveOptions(**known)


def positions(frames: Iterable[Frame], semantic_map: SemanticMap) -> tuple[Pose, ...]:
    """T_map_camera along the way of the frames, where their poses are known, else of the map.

    Raises SemvizError where neither tells a way.
    """
    poses = tuple(one.T_map_camera for one in frames if one.T_map_camera is not None)
    if not poses:
        track_m = semantic_map.trajectory_m
        poses = poses_along(track_m[thinned(track_m, STEP_M)])
    if not poses:
        raise SemvizError(
            "neither the frames have poses nor the map a trajectory: there is no route to look from"
        )
    rows = thinned(np.array([pose.translation for pose in poses]), STEP_M)
    return tuple(poses[row] for row in rows)
