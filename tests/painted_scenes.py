"""Small scenes of flat patches of colour, painted by the projections of their corners."""

from itertools import pairwise

import cv2
import numpy as np

from semviz_annotation.assist import MarkedImage
from semviz_annotation.labels.views import PosedView
from semviz_core.base.camera import Camera
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray

K = np.array([[500.0, 0.0, 240.0], [0.0, 500.0, 160.0], [0.0, 0.0, 1.0]])
RAW = Camera(480, 320, K, np.array([-0.28, 0.09, 0.001, -0.0006]))
RECTIFIED = Camera(480, 320, K)
TURNED = Pose.from_rotvec([0.004, 0.012, -0.006], [-0.5, 0.01, 0.02])
Box = tuple[FloatArray, tuple[int, int, int]]
"""Corners (4, 3) m in the left camera's frame, and a colour; nearer ones last."""


def upright(x: float, z: float, width: float, top: float, bottom: float) -> FloatArray:
    half = width / 2.0
    return np.array(
        [[x - half, top, z], [x + half, top, z], [x + half, bottom, z], [x - half, bottom, z]]
    )


def scenery(seed: int) -> list[Box]:
    """Patches of colour far away."""
    rng = np.random.default_rng(seed)
    boxes = []
    for _ in range(160):
        z = rng.uniform(30, 60)
        x, y = rng.uniform(-0.6, 0.6) * z, rng.uniform(-0.4, 0.4) * z
        color = tuple(int(integer) for integer in rng.integers(90, 230, 3))
        boxes.append((upright(x, z, rng.uniform(1, 8), y, y + rng.uniform(1, 6)), color))
    return sorted(boxes, key=lambda box: -float(box[0][0, 2]))


def shot_of(camera: Camera, pose: Pose, boxes: list[Box]) -> MarkedImage:
    view = PosedView(camera, pose)
    picture = np.full((320 * 4, 480 * 4, 3), 170, np.uint8)
    for corners, color in boxes:
        edge = np.concatenate(
            [
                a + np.linspace(0, 1, 12)[:-1, None] * (b - a)
                for a, b in pairwise([*corners, corners[0]])
            ]
        )
        points = view.project(edge)
        if np.isfinite(points).all():
            fine = np.round(((points + 0.5) * 4 - 0.5) * 16).astype(np.int32)
            cv2.fillPoly(picture, [fine], color, cv2.LINE_AA, 4)
    return MarkedImage.of(view, cv2.resize(picture, (480, 320), interpolation=cv2.INTER_AREA))


# the map frame has z up, the camera's y down
T_CAMERA_MAP = Pose(np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), np.zeros(3))


def moved_by(x: float, z: float) -> Pose:
    return Pose(np.eye(3), np.array([-x, 0.0, -z])) @ T_CAMERA_MAP


def in_map(corners: FloatArray) -> FloatArray:
    return T_CAMERA_MAP.inverse().apply(corners)
