"""What a camera sees of points, polygons and planes in the map."""

from dataclasses import dataclass, field

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.camera import Camera
from semviz_core.pose import Pose
from semviz_core.sources.street.things import FloatPicture

NEAR_M = 0.25
"""Polygons are cut off this close to the camera."""


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera without distortion at its place in the map."""

    camera: Camera
    T_map_camera: Pose
    T_camera_map: Pose = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_camera_map", self.T_map_camera.inverse())

    @property
    def center_m(self) -> FloatArray:
        """(3,) in the map frame."""
        return self.T_map_camera.translation

    def project(self, points_m: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points (n, 3) in the map frame; NaN for points behind."""
        return self.camera.project(self.T_camera_map.apply(points_m))

    def depth(self, points_m: FloatArray) -> FloatArray:
        """(...) metres along the optical axis of points (..., 3)."""
        return np.asarray(self.T_camera_map.apply(points_m)[..., 2])

    def distance(self, points_m: FloatArray) -> float:
        """Metres to the nearest of points (n, 3), or to a point (3,)."""
        return float(np.linalg.norm(points_m - self.center_m, axis=-1).min())

    def polygon(self, points_m: FloatArray) -> FloatArray | None:
        """(k, 2) pixels of a polygon (n, 3), cut at the near plane; None where out of sight."""
        points = self.T_camera_map.apply(points_m)
        depth = points[:, 2]
        if depth.min() <= NEAR_M:
            if depth.max() <= NEAR_M:
                return None
            points = _cut(points, depth > NEAR_M)
            depth = points[:, 2]
        camera = self.camera
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        pixels = np.empty((len(points), 2))
        u, v = pixels.T
        u[:] = points[:, 0] * (fx / depth) + cx
        v[:] = points[:, 1] * (fy / depth) + cy
        if u.max() < -1 or v.max() < -1 or u.min() > camera.width or v.min() > camera.height:
            return None
        return pixels

    def plane(self, origin_m: FloatArray, right_m: FloatArray, down_m: FloatArray) -> FloatArray:
        """(3, 3) homography to pixels from (u, v, 1), the point ``origin + u right + v down``."""
        axes = self.T_camera_map.rotation @ np.stack([right_m, down_m], axis=1)
        columns = np.column_stack([axes, self.T_camera_map.apply(origin_m)])
        homography: FloatArray = self.camera.K @ columns
        return homography

    def rays(self, direction: FloatArray) -> FloatPicture:
        """(height, width) of each pixel's ray, of depth 1, along a direction (3,) of the map."""
        weights = direction @ self.T_map_camera.rotation @ np.linalg.inv(self.camera.K)
        u = np.arange(self.camera.width) * weights[0] + weights[2]
        v = np.arange(self.camera.height)[:, None] * weights[1]
        return np.asarray(u + v, dtype=np.float32)


def _cut(points: FloatArray, ahead: BoolArray) -> FloatArray:
    """The part of a polygon (n, 3) in front of the near plane (Sutherland and Hodgman)."""
    kept: list[FloatArray] = []
    for i in range(len(points)):
        begin, end = points[i], points[(i + 1) % len(points)]
        if ahead[i]:
            kept.append(begin)
        if ahead[i] != ahead[(i + 1) % len(points)]:
            t = (NEAR_M - begin[2]) / (end[2] - begin[2])
            kept.append(begin + t * (end - begin))
    return np.array(kept)
