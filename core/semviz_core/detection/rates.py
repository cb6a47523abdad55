"""How much a detector finds and invents, and how well: what is taken for granted of it."""

import numpy as np

from semviz_core.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.detector_model import DetectorModel
from semviz_core.sources.street.detector import Noise

DETECTOR_MODEL = DetectorModel(hidden_bottoms=0.06)
"""Recall and false detections as for any detector whose images nobody has measured it on; bottoms
as measured. On rendered streets the shipped one finds more (bench/pixels.py: 0.9 and more of what
is in view up to 40 m, 0.3 false ones in an image), on real images much less; these rates cost
nothing on the former, and more answers are right on the latter."""
NOISE = Noise(0.4, 3.0, float(np.deg2rad(0.5)), {TRIANGULAR: 0.3, RECTANGULAR: 0.3, ROUNDED: 0.3})
"""About as ``semviz detect evaluate`` prints for rendered streets; along poles, a round number."""
