"""Bound the pose error from the elements in view, averaged over detection outcomes.

Each element's information times its recall would be optimistic: a pose that four elements
determine is not half determined by two. So outcomes are drawn, and each has its own bound.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose, heading_rad
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.common.linalg import inverse
from semviz_core.localizability.route import Conditions, visible_elements
from semviz_core.localization.least_squares import information
from semviz_core.localization.localizer import NEEDED_ELEMENTS
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.refinement import MOST_SIGMA_M
from semviz_core.localization.residuals import (
    EXACT_POSE,
    bottom_is_given,
    fill_rows,
    new_rows,
    whiten,
)

LOST_M = 1.0
"""Sigma of a frame without a pose, and upper limit of all sigmas, in the expected error."""
_NO_PAIRS: IntArray = np.zeros((0, 2), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class ElementInformation:
    """The information on the pose of each of m elements in view, over o detection outcomes."""

    id: IntArray
    """(m,) ids of the elements."""
    information: FloatArray
    """(m, 2, 6, 6) without a pole's bottom, and of its bottom alone."""
    found: BoolArray
    """(m, o) the outcomes that detect the element."""
    bottom: BoolArray
    """(m, o) the outcomes that show its bottom."""

    def of(self, i: int) -> FloatArray:
        """Return (o, 6, 6) the information of element ``i`` in each outcome."""
        share = np.stack([self.found[i], self.found[i] & self.bottom[i]], axis=1)
        return np.tensordot(share.astype(np.float64), self.information[i], axes=1)

    def without(self, i: int) -> "ElementInformation":
        """Return all but element ``i``."""
        kept = np.arange(len(self.id)) != i
        return ElementInformation(
            self.id[kept], self.information[kept], self.found[kept], self.bottom[kept]
        )


@dataclass(frozen=True, eq=False)
class PositionInformation:
    """The information at one pose: elements in view, and its sum in o detection outcomes."""

    T_map_camera: Pose
    elements: ElementInformation
    total: FloatArray
    """(o, 6, 6) information of the left perturbation of T_camera_map: elements and prior."""
    count: IntArray
    """(o,) number of elements detected."""

    def sigmas(self) -> FloatArray:
        """Return (o, 2) sigma of the camera centre (m) and of the heading (rad).

        They are inf if too few elements are detected or they do not determine a pose.
        """
        sigmas = _sigmas(self.total, self.T_map_camera.rotation[2].copy())
        sigmas[(self.count < NEEDED_ELEMENTS) | (sigmas[:, 0] > MOST_SIGMA_M)] = np.inf
        return sigmas

    @property
    def expected_m(self) -> float:
        """Mean sigma of the camera centre over the outcomes, each at most LOST_M."""
        return float(np.minimum(self.sigmas()[:, 0], LOST_M).mean())

    @property
    def lost(self) -> float:
        """Share of the outcomes with too few elements for a pose."""
        return float(np.isinf(self.sigmas()[:, 0]).mean())

    def with_element(self, elements: ElementInformation, i: int) -> "PositionInformation":
        """Return this with element ``i`` of ``elements``, which are not yet counted."""
        total, count = self.total + elements.of(i), self.count + elements.found[i]
        return PositionInformation(self.T_map_camera, self.elements, total, count)

    def without_element(self, i: int) -> "PositionInformation":
        """Return this without element ``i`` in view."""
        total, count = self.total - self.elements.of(i), self.count - self.elements.found[i]
        return PositionInformation(self.T_map_camera, self.elements, total, count)


def expected_error(
    semantic_map: SemanticMap,
    camera: Camera,
    T_map_camera: Pose,
    conditions: Conditions,
    number: int,
) -> PositionInformation:
    """Return the information at one pose; ``number`` is part of its seed."""
    center = T_map_camera.translation
    crop = semantic_map.crop(center, conditions.crop_radius_m)
    rng = np.random.default_rng([conditions.seed, number])
    elements = information_in_view(crop, camera, T_map_camera, conditions, rng)
    road_m = semantic_map.road_near(center, conditions.road_radius_m)
    prior_information = _prior_information(
        camera, _prior(T_map_camera, road_m, conditions), T_map_camera
    )
    total = np.tile(prior_information, (conditions.outcomes, 1, 1))
    for i in range(len(elements.id)):
        total += elements.of(i)
    return PositionInformation(T_map_camera, elements, total, elements.found.sum(axis=0))


def information_in_view(
    elements: Elements3D,
    camera: Camera,
    T_map_camera: Pose,
    conditions: Conditions,
    rng: np.random.Generator,
) -> ElementInformation:
    """Return the information of the elements in view, with drawn detection outcomes.

    Elements are drawn in order, so appended elements do not change earlier draws.
    """
    T_camera_map = T_map_camera.inverse()
    visible = visible_elements(elements, camera, T_camera_map, conditions)
    chosen = elements[visible.row]
    scene = PoseProblem.of(camera, visible.seen, chosen)
    information = _element_information(scene, T_camera_map.rotation, T_camera_map.translation)
    draws = rng.random((len(chosen), 2, conditions.outcomes))
    found = draws[:, 0] < visible.recall[:, None]
    return ElementInformation(
        chosen.id, information, found, draws[:, 1] >= conditions.hidden_bottoms
    )


def _prior_information(camera: Camera, prior: Prior, T_map_camera: Pose) -> FloatArray:
    """Return the (6, 6) information of the prior alone."""
    empty = PoseProblem.of(
        camera, Elements2D.from_ends([], [], []), Elements3D.from_ends([], [], [], [])
    )
    return information(empty, prior, T_map_camera.inverse(), _NO_PAIRS)


def _prior(T_map_camera: Pose, road_m: FloatArray, conditions: Conditions) -> Prior:
    """Return the prior of the conditions, centred at the true pose."""
    options = conditions.prior
    with_heading = options.heading_sigma_rad is not None
    return Prior(
        position_m=T_map_camera.translation,
        horizontal_sigma_m=options.horizontal_sigma_m,
        vertical_sigma_m=options.vertical_sigma_m,
        up_camera=None if options.imu_sigma_rad is None else T_map_camera.rotation[2],
        up_sigma_rad=options.imu_sigma_rad or Prior.up_sigma_rad,
        heading_rad=heading_rad(T_map_camera) if with_heading else None,
        heading_sigma_rad=options.heading_sigma_rad or Prior.heading_sigma_rad,
        road_m=road_m,
    )


@compiled
def _element_information(problem: PoseProblem, R: FloatArray, t: FloatArray) -> FloatArray:
    """Return (m, 2, 6, 6) ``ElementInformation.information`` of elements paired row by row."""
    m = len(problem.seen)
    information = np.zeros((m, 2, 6, 6))
    rows = new_rows()
    for i in range(m):
        count = fill_rows(problem, R, t, i, i, rows)
        if count == 0:
            continue
        whiten(problem, i, i, count, EXACT_POSE, rows)
        for row in range(count):
            end = 1 if row == count - 1 and bottom_is_given(problem, i, i, count) else 0
            for a in range(6):
                for b in range(6):
                    information[i, end, a, b] += rows.jacobian[row, a] * rows.jacobian[row, b]
    return information


@compiled
def _sigmas(total: FloatArray, up: FloatArray) -> FloatArray:
    """Return (o, 2) sigma of the camera centre and about ``up`` (3,) of information (o, 6, 6)."""
    sigma = np.empty((len(total), 2))
    for o in range(len(total)):
        covariance = inverse(total[o])
        position_m2, heading_rad2 = covariance[0, 0] + covariance[1, 1] + covariance[2, 2], 0.0
        for a in range(3):
            for b in range(3):
                heading_rad2 += up[a] * covariance[3 + a, 3 + b] * up[b]
        is_fixed = position_m2 > 0.0
        sigma[o, 0] = np.sqrt(position_m2) if is_fixed else np.inf
        sigma[o, 1] = np.sqrt(heading_rad2) if is_fixed else np.inf
    return sigma
