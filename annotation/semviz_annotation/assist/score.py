"""Probability that a proposal is within 2 px, or a snap within 1 px.

Logistic functions of a few measures, fitted on simulated streets with seeds below 1000 by
``python bench/assist.py --fit``; those of followed and seen marks also on KITTI 02 (``--kitti``).
On other streets, ``python bench/assist.py`` measures their calibration. Detector proposals use
``python bench/detector_proposals.py --fit --streets 24`` with the shipped detector: the probability
that all marks are right, including every pole end marked as seen, and of each such end by itself.
"""

import numpy as np

from semviz_core.common.arrays import FloatArray

WEIGHTS: dict[str, tuple[float, ...]] = {
    "seen sign": (
        3.9,
        1.15,
        0.34,
        -1.3,
        0.21,
        -0.58,
        -2.81,
        0.27,
        -0.24,
        0.68,
        0.55,
        -0.02,
        0.05,
        -1.14,
        -0.89,
        -0.95,
        0.25,
        0,
        0.05,
        -0.63,
        -3.19,
    ),
    "followed sign": (
        7.97,
        4.93,
        -3.87,
        -2.11,
        -1.33,
        4.03,
        -0.93,
        8.07,
        -0.38,
        0,
        -1.33,
        -0.66,
        -6.17,
    ),
    "seen pole": (
        -0.5,
        1.72,
        1.81,
        -0.36,
        -0.76,
        -1.49,
        0.35,
        0.79,
        -0.25,
        2.87,
        0.17,
        1.77,
        -2.49,
        0.56,
        0.57,
        0.54,
        0.85,
        -0.17,
        -1.49,
        -0.09,
        -0.84,
        -0.63,
        -2.63,
    ),
    "followed pole": (
        2.39,
        -0.13,
        2.36,
        -1.43,
        5.91,
        1.9,
        -1.99,
        -0.54,
        -1.31,
        4.19,
        -0.7,
        0.82,
        -0.24,
        -0.09,
        -0.4,
        0,
        0,
        0,
        -0.68,
        -0.48,
        0.14,
        -0.08,
        -1.59,
    ),
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
