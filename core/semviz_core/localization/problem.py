"""Hold observed elements, mapped elements and the prior as records for compiled code.

A record (structured array) replaces one array a field: compiled functions then take three
arguments instead of sixty, and compile in a third of the time.
"""

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import LABELS, DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Belief, Prior
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled

CLUTTER_LEAN = 0.1
"""False poles lean evenly up to this slope to either side."""
ROAD_SIGMAS, ROAD_WIDER_M = 3.0, 10.0
"""The road is kept as far from the fix as this many of its sigmas, plus this margin."""
SIGHT_M = 150.0
"""Mapped elements further from the camera are neither paired nor missed."""
FEW = 256
"""Larger maps are ordered, so that what is near a position is found without looking at all."""
_TINY = 1e-9

Record: TypeAlias = Any
"""One record of the dtype that the docstring names; numpy has no better type for it."""
RecordArray: TypeAlias = NDArray[Any]

SETTING = np.dtype(
    [
        ("K", float, (3, 3)),
        ("K_inverse", float, (3, 3)),
        ("size_px", float, (2,)),  # width, height
        ("log_false_detections", float),
        ("recall_near", float),
        ("recall_far", float),
        ("near_m", float),
        ("far_m", float),
        ("reach_m", float),
        ("hidden_bottoms", float),
        ("log_hidden", float),
        ("log_visible", float),
    ]
)
"""Camera and detector; the latter as in ``DetectorModel``."""
SEEN = np.dtype(
    [
        ("anchor_px", float, (2,)),  # undistorted, as end_px
        ("end_px", float, (2,)),
        ("anchor_ray", float, (3,)),  # unit, camera axes
        ("end_ray", float, (3,)),
        ("plane", float, (3,)),  # unit normal of the plane through both rays; 0 for points
        ("direction", float, (2,)),  # unit, along the observed pole from peak to bottom
        ("variance_px2", float, (2,)),  # across, along
        ("clutter", float, (3,)),  # log density (per px) of a false detection's 1st, 2nd, 3rd row
        ("first", np.int64),  # compatible mapped rows: candidate[first:last]
        ("last", np.int64),
        ("is_line", np.bool_),
        ("known", np.uint8, (2,)),  # peak, bottom
        ("is_moved", np.bool_),  # whether turn and shift count
        ("turn", float, (2, 3, 3)),  # of anchor and end: from the axes of the pose that is sought
        ("shift_m", float, (2, 3)),  # to those of the camera that saw it, when it saw it
    ],
    align=True,
)
"""An observed element; the end of a point is its anchor. Rays and plane are in the axes of the pose
that is sought."""
MAPPED = np.dtype(
    [
        ("anchor_m", float, (3,)),
        ("end_m", float, (3,)),
        ("covariance_m2", float, (6, 6)),
        ("largest_m2", float),  # an upper bound of the anchor's variance in any direction
        ("known", np.uint8, (2,)),  # peak, bottom
    ],
    align=True,
)
"""A mapped element; the end of a point is its anchor."""
PRIOR = np.dtype(
    [
        ("position_m", float, (3,)),
        ("position_sigma_m", float, (3,)),
        ("up_camera", float, (3,)),
        ("across_up", float, (2, 3)),
        ("up_sigma_rad", float),
        ("heading_rad", float),
        ("heading_sigma_rad", float),
        ("belief_rotation", float, (3, 3)),
        ("belief_translation", float, (3,)),
        ("belief_white", float, (6, 6)),  # W with W C W^T = I
        ("has_position", np.bool_),
        ("has_up", np.bool_),
        ("has_heading", np.bool_),
        ("has_belief", np.bool_),
    ],
    align=True,
)
"""Prior and belief; the has_* flags switch off the parts that are missing."""


class PoseProblem(NamedTuple):
    """m observed and n mapped elements."""

    setting: Record  # SETTING
    seen: RecordArray  # (m,) SEEN
    mapped: RecordArray  # (n,) MAPPED
    candidate: IntArray
    compatible: BoolArray  # (m, n) pairs allowed by class and kind, or by pair constraints
    order: IntArray  # (n,) mapped rows, in large maps by the first coordinate of their anchors
    anchor_m: FloatArray  # (2, n) coordinates on the ground of the anchors in this order

    @classmethod
    def of(
        cls,
        camera: Camera,
        observed: Elements2D,
        elements: Elements3D,
        detector: DetectorModel | None = None,
    ) -> "PoseProblem":
        compatible = (observed.class_id[:, None] == elements.class_id) & (
            observed.is_line[:, None] == elements.is_line
        )
        setting = _setting(camera, detector or LABELS)
        none = np.empty(0, dtype=np.int64)
        order = np.arange(len(elements))
        if len(elements) > FEW:
            order = np.argsort(elements.anchor_m[:, 0], kind="stable")
        anchor_m = np.ascontiguousarray(elements.anchor_m[order, :2].T)
        problem = cls(
            setting, _seen(camera, observed), _mapped(elements), none, compatible, order, anchor_m
        )
        return problem.only(compatible)

    def only(self, possible: BoolArray) -> "PoseProblem":
        """Return the problem that allows the pairs ``possible`` (m, n) and no others."""
        owner, candidate = np.nonzero(possible)
        first = np.searchsorted(owner, np.arange(len(possible) + 1))
        seen = self.seen.copy()
        seen["first"], seen["last"] = first[:-1], first[1:]
        return self._replace(seen=seen, candidate=candidate.copy(), compatible=possible)

    def moved(self, turn: FloatArray, shift_m: FloatArray) -> "PoseProblem":
        """Return the problem of a pose from which the camera was away when it saw the elements.

        ``turn`` (m, 2, 3, 3) and ``shift_m`` (m, 2, 3) take the axes of the pose to those of the
        camera, when it saw an element's anchor and end.
        """
        seen = self.seen.copy()
        seen["is_moved"], seen["turn"], seen["shift_m"] = True, turn, shift_m
        for end, ray in enumerate(("anchor_ray", "end_ray")):
            seen[ray] = np.einsum("mji,mj->mi", turn[:, end], seen[ray])
        normal = np.cross(seen["anchor_ray"], seen["end_ray"])
        length = np.sqrt((normal**2).sum(axis=1, keepdims=True))
        seen["plane"] = normal / np.maximum(length, _TINY)
        return self._replace(seen=seen)


@compiled
def rows_within(problem: PoseProblem, x: float, y: float, reach_m: float) -> IntArray:
    """Return the rows of the mapped elements whose anchors are within ``reach_m`` of (x, y).

    They ascend in maps of FEW elements, so that the order of elements decides between equals.
    """
    east_m, north_m = problem.anchor_m
    first, last = 0, len(east_m)
    if last > FEW:
        first = int(np.searchsorted(east_m, x - reach_m))
        last = int(np.searchsorted(east_m, x + reach_m))
    rows, count = np.empty(last - first, dtype=np.int64), 0
    for k in range(first, last):
        dx, dy = east_m[k] - x, north_m[k] - y
        if dx * dx + dy * dy <= reach_m * reach_m:
            rows[count] = problem.order[k]
            count += 1
    return rows[:count]


@compiled
def rows_in_sight(problem: PoseProblem, x: float, y: float) -> IntArray:
    """Return the rows of the mapped elements within SIGHT_M of a camera at (x, y)."""
    return rows_within(problem, x, y, SIGHT_M)


class PriorRecord(NamedTuple):
    """Prior and belief about the pose."""

    value: Record  # PRIOR
    road_m: FloatArray  # (k, 3) by the first coordinate, k = 0 without

    @classmethod
    def of(cls, prior: Prior | None, belief: Belief | None = None) -> "PriorRecord":
        value = np.zeros(1, PRIOR)[0]
        road = np.zeros((0, 3))
        if prior is not None:
            value["has_position"], value["position_m"] = True, prior.position_m
            value["position_sigma_m"] = (
                prior.horizontal_sigma_m, prior.horizontal_sigma_m, prior.vertical_sigma_m,
            )  # fmt: skip
            if prior.road_m is not None:
                road = _near_fix(prior.road_m, prior)
            if prior.up_camera is not None:
                value["has_up"], value["up_sigma_rad"] = True, prior.up_sigma_rad
                value["up_camera"] = prior.up_camera
                value["across_up"] = perpendicular(prior.up_camera)
            if prior.heading_rad is not None:
                value["has_heading"], value["heading_rad"] = True, prior.heading_rad
                value["heading_sigma_rad"] = prior.heading_sigma_rad
        if belief is not None:
            value["has_belief"] = True
            value["belief_rotation"] = belief.T_camera_map.rotation
            value["belief_translation"] = belief.T_camera_map.translation
            value["belief_white"] = np.linalg.inv(np.linalg.cholesky(belief.covariance))
        return cls(value, road)


def _near_fix(road_m: FloatArray, prior: Prior) -> FloatArray:
    """Return the part of the road near the prior's fix, or all of it where no part is near, ordered
    by the first coordinate.

    Always a copy: for a read-only array the whole search would be compiled once more.
    """
    off = road_m[:, :2] - prior.position_m[:2]
    reach = ROAD_SIGMAS * prior.horizontal_sigma_m + ROAD_WIDER_M
    near = (off * off).sum(axis=1) < reach * reach
    kept = road_m[near] if near.any() else road_m
    return np.array(kept[np.argsort(kept[:, 0], kind="stable")], order="C")


def perpendicular(unit: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) perpendicular to ``unit`` (3,) and to each other."""
    x, y, z = unit
    first = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))[int(np.argmin(np.abs(unit)))]
    length = np.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2)
    a, b, c = first[0] / length, first[1] / length, first[2] / length
    return np.array([[a, b, c], [y * c - z * b, z * a - x * c, x * b - y * a]])


def _setting(camera: Camera, detector: DetectorModel) -> Record:
    setting = np.zeros(1, SETTING)[0]
    setting["K"], setting["K_inverse"] = camera.K, np.linalg.inv(camera.K)
    setting["size_px"] = camera.width, camera.height
    setting["log_false_detections"] = np.log(detector.false_detections)
    for name in ("recall_near", "recall_far", "near_m", "far_m", "reach_m", "hidden_bottoms"):
        setting[name] = getattr(detector, name)
    hidden = detector.hidden_bottoms
    setting["log_hidden"] = np.log(hidden) if hidden else -np.inf
    setting["log_visible"] = np.log1p(-hidden)
    return setting


def _seen(camera: Camera, observed: Elements2D) -> RecordArray:
    seen = np.zeros(len(observed), SEEN)
    line = observed.is_line
    seen["anchor_px"] = _ideal(camera, observed.anchor_px)
    end = np.where(line[:, None], observed.end_px, observed.anchor_px)
    seen["end_px"] = _ideal(camera, end)
    seen["variance_px2"] = (
        observed.sigma_px * _stretch(camera, 0.5 * (observed.anchor_px + end))
    ) ** 2
    seen["is_line"] = line
    seen["known"][:, 0], seen["known"][:, 1] = observed.anchor_known, observed.end_known
    K_inverse = np.asarray(np.linalg.inv(camera.K), dtype=np.float64)
    _complete(seen, K_inverse, float(camera.width), float(camera.height))
    return seen


def _stretch(camera: Camera, pixels_px: FloatArray) -> FloatArray | float:
    """Return by how much errors (m, 2) of columns and rows grow at ``pixels_px`` (m, 2) where
    distortion is taken out: at the border of a wide view twice and more."""
    if not camera.distortion.size:
        return 1.0
    steps = [
        _ideal(camera, pixels_px + half) - _ideal(camera, pixels_px - half)
        for half in 0.5 * np.eye(2)
    ]
    return np.asarray(np.linalg.norm(np.stack(steps, axis=1), axis=2))


@compiled
def _complete(seen: RecordArray, K_inverse: FloatArray, width: float, height: float) -> None:
    """Fill in the fields derived from pixels: rays, plane, direction and density of clutter."""
    for i in range(len(seen)):
        element = seen[i]
        _fill_ray(K_inverse, element.anchor_px, element.anchor_ray)
        _fill_ray(K_inverse, element.end_px, element.end_ray)
        normal = np.cross(element.anchor_ray, element.end_ray)
        element.plane[:] = normal / max(np.sqrt((normal**2).sum()), _TINY)
        du, dv = element.end_px[0] - element.anchor_px[0], element.end_px[1] - element.anchor_px[1]
        length = np.hypot(du, dv)
        is_long = length > _TINY
        element.direction[0] = du / length if is_long else 0.0
        element.direction[1] = dv / length if is_long else 1.0
        element.clutter[0], element.clutter[2] = -np.log(width), -np.log(height)
        lean = np.log(max(2.0 * CLUTTER_LEAN * length, 1.0))
        element.clutter[1] = -lean if element.is_line else -np.log(height)


@compiled
def _fill_ray(K_inverse: FloatArray, pixel_px: FloatArray, ray: FloatArray) -> None:
    for axis in range(3):
        ray[axis] = (
            K_inverse[axis, 0] * pixel_px[0] + K_inverse[axis, 1] * pixel_px[1] + K_inverse[axis, 2]
        )
    ray /= np.sqrt((ray**2).sum())


def _mapped(elements: Elements3D) -> RecordArray:
    mapped = np.zeros(len(elements), MAPPED)
    mapped["anchor_m"] = elements.anchor_m
    mapped["end_m"] = np.where(elements.is_line[:, None], elements.end_m, elements.anchor_m)
    mapped["covariance_m2"] = elements.covariance_m2
    of_anchor = np.abs(elements.covariance_m2[:, :3, :3])
    mapped["largest_m2"] = of_anchor.sum(axis=2).max(axis=1)  # Gershgorin
    mapped["known"][:, 0], mapped["known"][:, 1] = elements.anchor_known, elements.end_known
    return mapped


def _ideal(camera: Camera, pixels_px: FloatArray) -> FloatArray:
    """Return ``pixels_px`` (m, 2) as the same camera would see them without distortion."""
    if not camera.distortion.size:
        return pixels_px
    plane = camera.normalize(pixels_px)
    return plane @ camera.K[:2, :2].T + camera.K[:2, 2]
