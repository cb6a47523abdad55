"""Tell maps so dense that detections fit wherever the camera looks."""

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.localization.association import associate
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import EXACT_POSE

CROWDED_MAP = 1000
"""In maps with fewer elements, chance fits too few to matter."""
CHANCE_SHARE = 0.15
"""Chance explains a pose if it fits more than this share of its pairs (right ones: up to 0.11)."""
_TURNS = 8


def pairs_by_chance(problem: PoseProblem, T_camera_map: Pose) -> float:
    """Return how many observed elements fit on average if the camera is turned away; 0 in a map
    with few elements, where it is not counted."""
    if len(problem.mapped) < CROWDED_MAP:
        return 0.0
    center = T_camera_map.inverse().translation
    fitting = []
    for turn in 2.0 * np.pi * np.arange(1, _TURNS + 1) / (_TURNS + 1):
        c, s = np.cos(turn), np.sin(turn)
        R = T_camera_map.rotation @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        match, _ = associate(problem, R, -R @ center, EXACT_POSE)
        fitting.append((match >= 0).sum())
    return float(np.mean(fitting))


def chance_explains(by_chance: float, fitting: int) -> bool:
    """Return whether so many of the ``fitting`` pairs of a pose may fit by chance that it may."""
    return by_chance > CHANCE_SHARE * fitting
