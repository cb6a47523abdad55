"""Whether a camera knows where it is: made-up frames, localized by the localizer itself.

No formula tells as well how often another place looks alike: that is a matter of chance, of what is
missed, invented and hidden, and of the localizer's own care.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semviz_core.camera import Camera
from semviz_core.elements import Elements3D
from semviz_core.localizability.conditions import Conditions
from semviz_core.localizability.outlook import LOST_M
from semviz_core.localizability.sight import detect
from semviz_core.localization import Localization
from semviz_core.localize import Localizer
from semviz_core.pose import Pose
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.priors import simulate_prior

_LEAST_VARIANCE_M2 = 1e-12  # of a map without errors; its covariance has no factor


class Shares(NamedTuple):
    """Of the frames tried at one pose."""

    ok: float
    ambiguous: float
    """With those that were answered ``ok`` and are LOST_M off or more."""
    cannot: float


def try_out(
    semantic_map: SemanticMap,
    camera: Camera,
    T_map_camera: Pose,
    conditions: Conditions,
    number: int,
) -> Shares:
    """Localize ``conditions.trials`` made-up frames at one pose.

    What stands there is drawn from the map and its covariances, so the map is as wrong as it says.
    """
    localizer = Localizer(classes=semantic_map.classes, detector=conditions.detector)
    nearby = semantic_map.crop(T_map_camera.translation, conditions.crop_radius_m)
    counts = dict.fromkeys(Shares._fields, 0)
    for trial in range(conditions.trials):
        rng = np.random.default_rng([conditions.seed, number, trial])
        observed = detect(_standing(nearby, rng), camera, T_map_camera.inverse(), conditions, rng)
        prior = simulate_prior(T_map_camera, conditions.prior, int(rng.integers(2**63)))
        road_m = semantic_map.road_near(prior.position_m, conditions.road_radius_m)
        submap = semantic_map.crop(prior.position_m, conditions.crop_radius_m)
        found = localizer.localize(observed, submap, camera, replace(prior, road_m=road_m))
        counts[_outcome(found, T_map_camera)] += 1
    return Shares(*(count / conditions.trials for count in counts.values()))


def _standing(mapped: Elements3D, rng: np.random.Generator) -> Elements3D:
    """Where the elements may really stand."""
    factor = np.linalg.cholesky(mapped.covariance_m2 + _LEAST_VARIANCE_M2 * np.eye(6))
    error = np.einsum("nij,nj->ni", factor, rng.standard_normal((len(mapped), 6)))
    return replace(
        mapped, anchor_m=mapped.anchor_m + error[:, :3], end_m=mapped.end_m + error[:, 3:]
    )


def _outcome(found: Localization, T_map_camera: Pose) -> str:
    if found.status != "ok" or found.T_camera_map is None:
        return found.status
    center = found.T_camera_map.inverse().translation
    off_m = np.linalg.norm(center - T_map_camera.translation)
    return "ok" if off_m < LOST_M else "ambiguous"
