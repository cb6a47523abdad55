"""Rates and noise of a detector of poles and signs.

Association scores follow from the rates: false positives per image, recall near and far, and the
share of pole bottoms that are hidden although the detector reports them as known. The rates were
measured on images with known elements. Noise and range are those of a simulated detection, and
are shared by simulation, localizability and evaluation.
"""

from typing import Literal, NamedTuple

import numpy as np

from semviz_core.base.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.common.errors import SemvizError

NoiseName = Literal["paper", "low"]


class DetectorModel(NamedTuple):
    """Rates of a detector of poles and signs, measured on images with known elements."""

    false_detections: float = 1.5
    """Mean number per image of detections without a map element."""
    recall_near: float = 0.6
    """Probability that a mapped element in view within ``near_m`` is detected. Lower than the
    recall of detectors, because buildings, hedges and cars hide elements."""
    recall_far: float = 0.1
    """The same at ``far_m``; linear in between, constant from there to ``reach_m``."""
    near_m: float = 20.0
    far_m: float = 45.0
    reach_m: float = 1000.0
    """Almost nothing is detected beyond."""
    hidden_bottoms: float = 0.0
    """Share of pole bottoms reported as known that are in truth the last visible point above a car
    or hedge. 0 for labels, where annotators flag hidden ends."""

    def checked(self) -> "DetectorModel":
        """Return self. Raise SemvizError if a rate is impossible."""
        if not 0.0 < self.false_detections < 1e3:
            raise SemvizError("detector model: false_detections must be above 0 and below 1000")
        if not 0.0 < self.recall_far <= self.recall_near < 1.0:
            raise SemvizError("detector model: 0 < recall_far <= recall_near < 1 does not hold")
        if not 0.0 <= self.near_m < self.far_m <= self.reach_m:
            raise SemvizError("detector model: 0 <= near_m < far_m <= reach_m does not hold")
        if not 0.0 <= self.hidden_bottoms < 1.0:
            raise SemvizError("detector model: hidden_bottoms must be in [0, 1)")
        return self


RANGE_M = (3.0, 40.0)
"""Distance of the nearest and the farthest element that the simulated detector finds."""
SIMULATED_DETECTOR = DetectorModel(
    false_detections=0.5,
    recall_near=0.75,
    recall_far=0.42,
    near_m=20.0,
    far_m=40.0,
    reach_m=RANGE_M[1] + 1.0,
    hidden_bottoms=0.0,
)
"""Model of ``SimulatedDetector``. Recall is measured over all mapped elements in view, hidden ones
included, on four streets of 60 frames. It flags the bottoms that it cannot see."""
SHIPPED_DETECTOR = DetectorModel(hidden_bottoms=0.06)
"""Model of the shipped detector: default recall and false detections, measured hidden bottoms.
On rendered streets it detects more (bench/images_to_poses.py: recall 0.9 or more up to 40 m, 0.3
false positives per image), on real images much less. The default rates cost nothing on the former
and give more correct poses on the latter."""


class Noise(NamedTuple):
    """Standard deviations of a detector's errors."""

    pole_across_px: float
    pole_along_px: float
    pole_angle_rad: float
    sign_px: dict[int, float]
    """Along each image axis, by class id."""


NOISE: dict[NoiseName, Noise] = {
    # Signs: root mean square errors of the paper's table, mean errors included.
    "paper": Noise(
        1.5, 4.0, float(np.deg2rad(1.32)), {TRIANGULAR: 1.81, RECTANGULAR: 4.10, ROUNDED: 3.17}
    ),
    "low": Noise(
        1.0, 1.0, float(np.deg2rad(0.3)), {TRIANGULAR: 1.0, RECTANGULAR: 1.0, ROUNDED: 1.0}
    ),
}
"""Noise of the simulated detector, by name."""
SHIPPED_NOISE = Noise(
    0.4, 3.0, float(np.deg2rad(0.5)), {TRIANGULAR: 0.3, RECTANGULAR: 0.3, ROUNDED: 0.3}
)
"""About the errors that ``semviz detect evaluate`` prints for rendered streets; along poles
rounded."""
