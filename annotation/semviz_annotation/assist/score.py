"""Probability that a proposal is within 2 px, or a snap within 1 px.

Logistic functions of a few measures, fitted on simulated streets with seeds below 1000 by
``python bench/assist.py --fit``. On other streets, ``python bench/assist.py`` measures their
calibration. Detector proposals use ``python bench/detector_proposals.py --fit --streets 24`` with
the shipped detector: the probability that all marks are right, including every pole end marked as
seen, and of each such end by itself.
"""

import numpy as np

from semviz_core.common.arrays import FloatArray

WEIGHTS: dict[str, tuple[float, ...]] = {
    "propagated pole": (
        1.41,
        4.19,
        2.66,
        -1.85,
        2.07,
        0.31,
        2.11,
        -0.28,
        -2.21,
        1.72,
        -0.85,
        -3.08,
        4.52,
        -0.06,
        -2.06,
        1.25,
        -0.77,
    ),
    "propagated sign": (4.09, 5.59, 2.26, -3.89, -0.33, 10.58, -0.50, 0.46, 1.11, -0.33, -0.36),
    "found alone pole": (0.63, 0.97, 0.01),
    "found alone sign": (-0.93, 0.49, 0.1),
    "found end": (7.11, -2.4, -1.34),
    "found one pole": (0.03, 0.48, 0.2, 0.41),
    "found one sign": (-2.19, 1.25, 0.28, 0.49),
    "found pair pole": (4.44, -0.17, -0.78, 0.0, 0.16, 0.54, -3.51),
    "found pair sign": (1.12, 0.63, 0.29, 0.09, 0.2, 0.05, -1.46),
    "stereo pole": (
        2.30,
        -0.22,
        -0.11,
        -2.77,
        1.69,
        -0.37,
        4.33,
        0.30,
        0.00,
        5.99,
        -0.88,
        -0.23,
    ),
    "stereo sign": (0.45, 0.66, 0.84, -0.76, 0.99, 9.54, -0.93, 0.22),
    "snap pole": (-8.70, -1.16, 0.82, 0.84, -0.65, 7.27, 0.36, -2.67, -0.82, -1.35, 1.98),
    "snap sign": (3.16, 2.93, 1.26, 1.26, 0.36, -3.31, 0.55, 0.43, -5.87),
}


def probability(kind: str, evidence: FloatArray) -> float:
    """Return the probability for evidence (k,); the first of the k + 1 weights is the constant."""
    weights = WEIGHTS[kind]
    return float(1.0 / (1.0 + np.exp(-(weights[0] + evidence @ np.array(weights[1:])))))
