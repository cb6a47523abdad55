"""Where elements stand: to compare poles by, of which the ends may be unseen."""

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.elements import Elements3D


def stand_m(elements: Elements3D) -> FloatArray:
    """(n, 3) a sign's middle; a pole's on the ground plane, at height 0."""
    middle = (elements.anchor_m + elements.end_m) / 2.0 * [1.0, 1.0, 0.0]
    return np.where(elements.is_line[:, None], middle, elements.anchor_m)


def stand_covariance_m2(elements: Elements3D) -> FloatArray:
    """(n, 3, 3) of ``stand_m``."""
    middle = elements.covariance_m2.reshape(-1, 2, 3, 2, 3).sum(axis=(1, 3)) / 4.0
    middle[:, 2] = middle[:, :, 2] = 0.0
    is_line = elements.is_line[:, None, None]
    return np.where(is_line, middle, elements.covariance_m2[:, :3, :3])
