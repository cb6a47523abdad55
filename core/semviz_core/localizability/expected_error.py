"""Bound the pose error from the elements in view, and rank elements by their effect on a route.

Each element's information times its recall would be optimistic: a pose that four elements
determine is not half determined by two. So the bound is averaged over drawn detection outcomes.

Suggested elements are chosen greedily, each given the previous ones. Critical elements are ranked
by the loss of each one alone.
"""

from collections.abc import Sequence
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
    information = _element_information(scene, *T_camera_map.writable())
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


MIN_TOTAL_M2 = 1.0
"""Changes with a smaller sum over the route are not reported."""
EFFECT_SHARE = 0.1
"""A change is reported over the stretch in which it is at least this share of its maximum."""
_CANDIDATES = 1
"""Part of the seed that separates draws for candidates from those for mapped elements."""


@dataclass(frozen=True, eq=False)
class Effect:
    """The effect of adding or losing an element, over the stretch that it affects."""

    element: Elements3D
    """(1,) the element."""
    first_m: float
    """Distance along the route to the begin of the stretch."""
    last_m: float
    before_m: float
    """Mean of ``Localizability.expected_m`` over the stretch."""
    after_m: float
    """The same with the change."""
    total_m2: float
    """Its change, integrated over the whole route."""


def suggest_elements(
    informations: Sequence[PositionInformation],
    along_m: FloatArray,
    candidates: Elements3D,
    camera: Camera,
    conditions: Conditions,
    count: int,
) -> tuple[Effect, ...]:
    """Return the up to ``count`` best candidates, chosen greedily, each given the previous ones.

    ``informations`` are those of the positions ``along_m`` (k,). Candidates that help less than
    MIN_TOTAL_M2 are left out.
    """
    positions = list(informations)
    in_view = [
        information_in_view(
            candidates, camera, position.T_map_camera, conditions,
            np.random.default_rng([conditions.seed, number, _CANDIDATES]),
        )
        for number, position in enumerate(positions)
    ]  # fmt: skip
    gains = [
        _gains(position, visible) for position, visible in zip(positions, in_view, strict=True)
    ]
    chosen: list[Effect] = []
    for _ in range(count):
        effect = _largest_effects(positions, along_m, in_view, gains, candidates, 1)
        if not effect:
            break
        chosen += effect
        for k, visible in enumerate(in_view):
            for i in np.flatnonzero(visible.id == effect[0].element.id[0]).tolist():
                positions[k] = positions[k].with_element(visible, i)
                in_view[k] = visible.without(i)
                gains[k] = _gains(positions[k], in_view[k])
    return tuple(chosen)


def critical_elements(
    positions: Sequence[PositionInformation], along_m: FloatArray, elements: Elements3D, count: int
) -> tuple[Effect, ...]:
    """Return the up to ``count`` mapped elements whose loss, each alone, costs most."""
    losses = [_losses(position) for position in positions]
    return _largest_effects(
        positions, along_m, [position.elements for position in positions], losses, elements, count
    )


def _gains(position: PositionInformation, candidates: ElementInformation) -> FloatArray:
    """Return (m,) the change of the expected error with each candidate: 0 or less."""
    after = [position.with_element(candidates, i).expected_m for i in range(len(candidates.id))]
    return np.array(after) - position.expected_m


def _losses(position: PositionInformation) -> FloatArray:
    """Return (m,) the change of the expected error without each element in view: 0 or more."""
    after = [position.without_element(i).expected_m for i in range(len(position.elements.id))]
    return np.array(after) - position.expected_m


def _largest_effects(
    positions: Sequence[PositionInformation],
    along_m: FloatArray,
    in_view: Sequence[ElementInformation],
    changes: Sequence[FloatArray],
    elements: Elements3D,
    count: int,
) -> tuple[Effect, ...]:
    """Return the effects of the ``count`` elements with the largest changes, largest first."""
    ids = np.concatenate([visible.id for visible in in_view])
    position_row = np.repeat(np.arange(len(in_view)), [len(visible.id) for visible in in_view])
    change = np.concatenate(changes)
    step_m = np.gradient(along_m) if len(along_m) > 1 else np.ones(1)
    unique, index = np.unique(ids, return_inverse=True)
    total = np.bincount(index, change * step_m[position_row], minlength=len(unique))
    order = np.argsort(-np.abs(total), kind="stable")[:count]
    before_m = np.array([information.expected_m for information in positions])
    effects = []
    for row in order[np.abs(total[order]) >= MIN_TOTAL_M2]:
        change_m = np.zeros(len(in_view))
        change_m[position_row[index == row]] = change[index == row]
        element = elements[elements.id == unique[row]]
        effects.append(_effect(element, along_m, before_m, change_m, float(total[row])))
    return tuple(effects)


def _effect(
    element: Elements3D,
    along_m: FloatArray,
    before_m: FloatArray,
    change_m: FloatArray,
    total_m2: float,
) -> Effect:
    """Return the effect over the stretch around its largest change (k,)."""
    stretch = _affected_stretch(np.abs(change_m))
    return Effect(
        element,
        first_m=float(along_m[stretch][0]),
        last_m=float(along_m[stretch][-1]),
        before_m=float(before_m[stretch].mean()),
        after_m=float((before_m + change_m)[stretch].mean()),
        total_m2=total_m2,
    )


def _affected_stretch(change: FloatArray) -> slice:
    """Return the positions around the largest change (k,) that reach ``EFFECT_SHARE`` of it."""
    unaffected = np.flatnonzero(change < EFFECT_SHARE * change.max())
    peak = int(change.argmax())
    first, last = unaffected[unaffected < peak], unaffected[unaffected > peak]
    return slice(first[-1] + 1 if len(first) else 0, last[0] if len(last) else len(change))
