"""How well the elements of a submap are known: an ellipsoid at each end of each."""

import numpy as np

from semviz.web.scene import Scene
from semviz_core.elements import Elements3D

MAGNIFIED = 10.0
"""One sigma of an element is centimetres: it is drawn so many times longer."""
ELLIPSOIDS = "/ellipsoids"


def draw_ellipsoids(scene: Scene, elements: Elements3D) -> None:
    """1 sigma, magnified: at peak and bottom of poles, in the middle of signs."""
    lines = np.flatnonzero(elements.is_line)
    covariances = elements.covariance_m2
    scene.draw_ellipsoids(
        ELLIPSOIDS,
        np.concatenate([elements.anchor_m, elements.end_m[lines]]),
        np.concatenate([covariances[:, :3, :3], covariances[lines, 3:, 3:]]),
        MAGNIFIED,
        scene.palette.prior,
    )
