"""One frame as a matcher's sample: rays, map points around the prior, and the target.

Coordinates are local: the map frame's, around ``origin_m``.
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

PRIOR_LENGTH = 9
FIX_UNIT_M = 10.0
_ROAD_REACH_M = 15.0
_BRIDGE_M = 0.5
_LEVEL = np.diag([1e-3, 300.0, 300.0])  # weight of a level road, against that of one place driven
_EXACT_RAD = 1e-3  # smaller sigmas make no difference to a network


@dataclass(frozen=True, eq=False)
class SampleTarget:
    """The ground truth of a sample."""

    rotation: FloatArray
    """(3, 3) of T_camera_local, from the sample's coordinates to the camera's."""
    translation: FloatArray
    """(3,) of the same, metres."""
    pairs: BoolArray
    """(m, n) True if observed i is mapped j; several j if the map holds the element twice."""


@dataclass(frozen=True, eq=False)
class Sample:
    """m observed and n mapped elements in local coordinates: the map's, about ``origin_m``.

    Point elements have their anchor as bottom, so that nothing is NaN.
    """

    ray: FloatArray
    """(m, 3) unit, camera axes: peak or middle."""
    bottom_ray: FloatArray
    """(m, 3) unit: the given lower end of a pole."""
    sigma_rad: FloatArray
    """(m, 2) standard deviation across and along, as an angle."""
    score: FloatArray
    """(m,)"""
    seen_class: IntArray
    """(m,) number of the class in the class set, from 0."""
    seen_known: BoolArray
    """(m, 2) whether peak (or middle) and bottom are known."""
    point_m: FloatArray
    """(n, 3) peak or middle."""
    bottom_m: FloatArray
    """(n, 3)"""
    mapped_class: IntArray
    """(n,)"""
    mapped_known: BoolArray
    """(n, 2)"""
    road: FloatArray
    """(3,) plane through the cameras of the map's drive: its height (m) at the local origin, and
    its slopes along x and y."""
    prior: FloatArray
    """(PRIOR_LENGTH,) the prior, scaled to about 1: up in camera axes (3, zeros if
    unknown), log of its sigma over 0.01 rad, sigma of the fix in tens of metres, cosine and sine of
    the heading (zeros if unknown), log of its sigma over 0.1 rad, sigma of the height (m)."""
    origin_m: FloatArray
    """(3,) of the local coordinates in the map: the prior's position."""
    truth: SampleTarget | None = None

    @classmethod
    def of(
        cls,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        classes: ClassSet = DEFAULT_CLASSES,
    ) -> "Sample":
        """Return a frame without ground truth. Raise SemvizError if ``classes`` lacks a class."""
        number = {class_.id: row for row, class_ in enumerate(classes)}
        seen_line, mapped_line = observed.is_line[:, None], submap.is_line[:, None]
        origin = prior.position_m
        return cls(
            ray=camera.bearing(observed.anchor_px),
            bottom_ray=camera.bearing(np.where(seen_line, observed.end_px, observed.anchor_px)),
            sigma_rad=observed.sigma_px / float(np.sqrt(camera.K[0, 0] * camera.K[1, 1])),
            score=observed.score,
            seen_class=_numbers(observed.class_id, number, classes),
            seen_known=np.column_stack([observed.anchor_known, observed.end_known]),
            point_m=submap.anchor_m - origin,
            bottom_m=np.where(mapped_line, submap.end_m, submap.anchor_m) - origin,
            mapped_class=_numbers(submap.class_id, number, classes),
            mapped_known=np.column_stack([submap.anchor_known, submap.end_known]),
            road=_road_plane(prior),
            prior=_prior_numbers(prior),
            origin_m=origin,
        )

    def with_truth(self, T_camera_map: Pose, pairs: IntArray) -> "Sample":
        """Return the sample with ground truth; ``pairs`` (k, 2) are rows of observed and submap."""
        true = np.zeros((len(self.ray), len(self.point_m)), dtype=bool)
        true[tuple(np.asarray(pairs).reshape(-1, 2).T)] = True
        truth = SampleTarget(T_camera_map.rotation, T_camera_map.apply(self.origin_m), true)
        return replace(self, truth=truth)


def _numbers(class_id: IntArray, number: dict[int, int], classes: ClassSet) -> IntArray:
    """Return the numbers (k,) of classes. Raise SemvizError if ``classes`` lacks one."""
    return np.array([number[classes[id].id] for id in class_id.tolist()], dtype=np.int64)


def _road_plane(prior: Prior) -> FloatArray:
    """Fit a plane to the road, weighted towards the fix; level without a road.

    The fit is reweighted (Cauchy), starting at a level plane through the fix, so that a bridge does
    not lift the street below it.
    """
    plane = np.zeros(3)
    if prior.road_m is None:
        return plane
    offset = prior.road_m - prior.position_m
    reach = max(_ROAD_REACH_M, prior.horizontal_sigma_m)
    near = np.exp(-0.25 * (offset[:, :2] ** 2).sum(axis=1) / reach**2)
    rows = np.column_stack([np.ones(len(offset)), offset[:, :2]])
    for _ in range(3):
        off = (offset[:, 2] - rows @ plane) / _BRIDGE_M
        weighted = (rows * (near / (1.0 + off**2))[:, None]).T
        plane = np.linalg.solve(weighted @ rows + _LEVEL, weighted @ offset[:, 2])
    return plane


def _prior_numbers(prior: Prior) -> FloatArray:
    numbers = np.zeros(PRIOR_LENGTH)
    if prior.up_camera is not None:
        numbers[:3] = prior.up_camera
        numbers[3] = np.log(max(prior.up_sigma_rad, _EXACT_RAD) / 0.01)
    numbers[4] = prior.horizontal_sigma_m / FIX_UNIT_M
    if prior.heading_rad is not None:
        numbers[5:7] = np.cos(prior.heading_rad), np.sin(prior.heading_rad)
        numbers[7] = np.log(max(prior.heading_sigma_rad, _EXACT_RAD) / 0.1)
    numbers[8] = prior.vertical_sigma_m
    return numbers
