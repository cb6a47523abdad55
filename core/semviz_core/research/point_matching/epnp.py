"""The pose of matched points by EPnP in RANSAC, as 2D3D-MatchNet and DeepI2P find theirs."""

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.common.arrays import FloatArray

LEAST_MATCHES = 4
MOST_AWAY_M = 50.0
"""Of a pose from the local origin. DeepI2P's solver allows 14 m, from an origin without error."""


def epnp_ransac(
    pixel: FloatArray,
    point_m: FloatArray,
    camera: Camera,
    trials: int,
    threshold_px: float,
    seed: int = 0,
) -> Pose | str:
    """Return T_camera_local by pixels (k, 2) of points (k, 3), or the reason for none."""
    import cv2

    if len(pixel) < LEAST_MATCHES:
        return f"{len(pixel)} points are matched, {LEAST_MATCHES} needed."
    cv2.setRNGSeed(seed)
    try:
        found, turn, translation, inliers = cv2.solvePnPRansac(
            point_m, pixel, camera.K, None, iterationsCount=trials,
            reprojectionError=threshold_px, flags=cv2.SOLVEPNP_EPNP,
        )  # fmt: skip
    except cv2.error:  # degenerate points
        found = False
    is_finite = found and bool(np.isfinite([turn, translation]).all())
    if not is_finite or inliers is None or len(inliers) < LEAST_MATCHES:
        return f"No pose brings {LEAST_MATCHES} of the {len(pixel)} matches within the threshold."
    rotation = nearest_rotation(np.asarray(cv2.Rodrigues(turn)[0], np.float64))
    pose = Pose(rotation, np.asarray(translation, np.float64).ravel())
    is_ahead = (pose.apply(point_m[inliers.ravel()])[:, 2] > 0.0).all()
    is_upright = rotation[1, 2] < 0.0  # the map's up, in camera axes
    is_near = np.linalg.norm(pose.inverse().translation) < MOST_AWAY_M
    if is_ahead and is_upright and is_near:
        return pose
    return "The pose is behind its points, upside down or far away."
