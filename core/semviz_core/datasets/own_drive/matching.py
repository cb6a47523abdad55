"""Match points between two images, for checks of calibration and poses."""

import numpy as np

from semviz_core.common.arrays import ByteImage, FloatArray

_FEATURES = 2000
_RATIO = 0.8
"""Largest ratio of the best to the second best distance (Lowe 2004)."""


def matched_pixels(first: ByteImage, second: ByteImage) -> FloatArray:
    """Return (n, 2, 2): the pixel of each match in both images. Some matches are wrong."""
    import cv2

    sift = cv2.SIFT.create(_FEATURES)  # to a fraction of a pixel, unlike ORB
    (points, features), (others, candidates) = (
        sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
        for image in (first, second)
    )
    if features is None or candidates is None or len(candidates) < 2:
        return np.zeros((0, 2, 2))
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(features, candidates, k=2)
    clear = [a for a, b in pairs if a.distance < _RATIO * b.distance]
    places = np.array([[points[m.queryIdx].pt, others[m.trainIdx].pt] for m in clear])
    return np.asarray(places.reshape(-1, 2, 2), dtype=np.float64)
