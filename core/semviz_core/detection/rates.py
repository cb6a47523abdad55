"""How much the detector finds and invents, and how well: what is taken for granted of it."""

import numpy as np

from semviz_core.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.detector_model import DetectorModel
from semviz_core.sources.street.detector import Noise

DETECTOR_MODEL = DetectorModel(
    false_detections=0.5,
    recall_near=0.75,
    recall_far=0.42,
    near_m=20.0,
    far_m=40.0,
    reach_m=60.0,
    hidden_bottoms=0.02,
)
"""Until measured: those of the simulated detector."""
NOISE = Noise(0.5, 3.0, float(np.deg2rad(0.3)), {TRIANGULAR: 1.0, RECTANGULAR: 1.0, ROUNDED: 1.0})
"""Until measured."""
