"""How far an answer is from the truth."""

from dataclasses import dataclass

import numpy as np

from semviz.recording.run import FrameRecord
from semviz_core.localization import Localization
from semviz_core.pose import Pose, angle_between

SURE_AND_WRONG_M = 1.0


@dataclass(frozen=True)
class Errors:
    """Against the truth: distance of camera centres, angle between rotations."""

    distance_m: float
    angle_deg: float


def errors_of(record: FrameRecord) -> Errors | None:
    """None without a truth or without a pose."""
    truth, estimate = record.frame.T_map_camera, record.localization.T_camera_map
    if truth is None or estimate is None:
        return None
    return difference(estimate.inverse(), truth)


def difference(a: Pose, b: Pose) -> Errors:
    """Between two poses T_map_camera."""
    angle_deg = float(np.rad2deg(angle_between(a.rotation, b.rotation)))
    return Errors(float(np.linalg.norm(a.translation - b.translation)), angle_deg)


def sure_and_wrong(localization: Localization, errors: Errors | None) -> bool:
    """The worst kind: status ok, and yet more than a metre off."""
    off_m = 0.0 if errors is None else errors.distance_m
    return localization.status == "ok" and off_m > SURE_AND_WRONG_M
