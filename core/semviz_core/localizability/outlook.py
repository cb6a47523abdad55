"""How well what is in view fixes a camera's pose, over what a detector may find of it.

Each element's information times its recall would be too good: a pose that four elements fix is not
half fixed by two. So outcomes are drawn, and each of them has a bound of its own.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.compiled import compiled
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.localizability.conditions import Conditions
from semviz_core.localizability.sight import look
from semviz_core.localize import NEEDED_ELEMENTS
from semviz_core.pose import Pose, heading_rad
from semviz_core.semantic_map import SemanticMap
from semviz_core.solving.least_squares import information
from semviz_core.solving.linear import inverse
from semviz_core.solving.refine import MOST_SIGMA_M
from semviz_core.solving.residuals import SURE, bottom_is_given, fill_rows, new_rows, whiten
from semviz_core.solving.scene import Scene

LOST_M = 1.0
"""A frame without an answer counts as one whose sigma is so much, and none counts as more."""
_NO_PAIRS: IntArray = np.zeros((0, 2), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Parts:
    """What each of m elements in view tells of a pose, where it is found."""

    id: IntArray
    """(m,) ids of the elements."""
    information: FloatArray
    """(m, 2, 6, 6) of all but a pole's bottom, and of its bottom."""
    found: BoolArray
    """(m, o) which outcomes have the element."""
    bottom: BoolArray
    """(m, o) which of them show its bottom."""

    def of(self, i: int) -> FloatArray:
        """(o, 6, 6) what element ``i`` tells in each outcome."""
        share = np.stack([self.found[i], self.found[i] & self.bottom[i]], axis=1)
        return np.tensordot(share.astype(np.float64), self.information[i], axes=1)

    def without(self, i: int) -> "Parts":
        """All but element ``i``."""
        kept = np.arange(len(self.id)) != i
        return Parts(self.id[kept], self.information[kept], self.found[kept], self.bottom[kept])


@dataclass(frozen=True, eq=False)
class Outlook:
    """What a camera at one pose has in view, and what o outcomes of detection come to."""

    T_map_camera: Pose
    parts: Parts
    total: FloatArray
    """(o, 6, 6) information of the left perturbation of T_camera_map: elements and prior."""
    count: IntArray
    """(o,) elements found."""

    def sigmas(self) -> FloatArray:
        """(o, 2) sigma of the camera centre (m) and of the heading (rad); inf where the elements
        found are too few or fix no pose."""
        found = _sigmas(self.total, self.T_map_camera.rotation[2].copy())
        found[(self.count < NEEDED_ELEMENTS) | (found[:, 0] > MOST_SIGMA_M)] = np.inf
        return found

    @property
    def expected_m(self) -> float:
        """Mean sigma of the camera centre over the outcomes, none counted as more than LOST_M."""
        return float(np.minimum(self.sigmas()[:, 0], LOST_M).mean())

    @property
    def lost(self) -> float:
        """Share of the outcomes that find too little to answer."""
        return float(np.isinf(self.sigmas()[:, 0]).mean())

    def with_part(self, parts: Parts, i: int) -> "Outlook":
        """With element ``i`` of ``parts``, which are others than those in view."""
        total, count = self.total + parts.of(i), self.count + parts.found[i]
        return Outlook(self.T_map_camera, self.parts, total, count)

    def without_part(self, i: int) -> "Outlook":
        """Without its own element ``i``."""
        total, count = self.total - self.parts.of(i), self.count - self.parts.found[i]
        return Outlook(self.T_map_camera, self.parts, total, count)


def look_out(
    semantic_map: SemanticMap,
    camera: Camera,
    T_map_camera: Pose,
    conditions: Conditions,
    number: int,
) -> Outlook:
    """From one pose; ``number`` tells its draws from those at other poses."""
    center = T_map_camera.translation
    crop = semantic_map.crop(center, conditions.crop_radius_m)
    rng = np.random.default_rng([conditions.seed, number])
    parts = parts_in_view(crop, camera, T_map_camera, conditions, rng)
    road_m = semantic_map.road_near(center, conditions.road_radius_m)
    known = _known(camera, _prior(T_map_camera, road_m, conditions), T_map_camera)
    total = np.tile(known, (conditions.outcomes, 1, 1))
    for i in range(len(parts.id)):
        total += parts.of(i)
    return Outlook(T_map_camera, parts, total, parts.found.sum(axis=0))


def parts_in_view(
    elements: Elements3D,
    camera: Camera,
    T_map_camera: Pose,
    conditions: Conditions,
    rng: np.random.Generator,
) -> Parts:
    """What of ``elements`` is in view, and drawn outcomes of finding it.

    Drawn one element after another: others that come after them change no draw.
    """
    T_camera_map = T_map_camera.inverse()
    sight = look(elements, camera, T_camera_map, conditions)
    chosen = elements[sight.row]
    scene = Scene.of(camera, sight.seen, chosen)
    parts = _informations(scene, T_camera_map.rotation, T_camera_map.translation)
    draws = rng.random((len(chosen), 2, conditions.outcomes))
    found = draws[:, 0] < sight.recall[:, None]
    return Parts(chosen.id, parts, found, draws[:, 1] >= conditions.hidden_bottoms)


def _known(camera: Camera, prior: Prior, T_map_camera: Pose) -> FloatArray:
    """(6, 6) information of the prior alone."""
    nothing = Scene.of(
        camera, Elements2D.from_ends([], [], []), Elements3D.from_ends([], [], [], [])
    )
    return information(nothing, prior, T_map_camera.inverse(), _NO_PAIRS)


def _prior(T_map_camera: Pose, road_m: FloatArray, conditions: Conditions) -> Prior:
    """What is known beforehand, centred at the truth."""
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
def _informations(scene: Scene, R: FloatArray, t: FloatArray) -> FloatArray:
    """(m, 2, 6, 6) as ``Parts.information``, of seen and mapped elements paired row by row."""
    m = len(scene.seen)
    parts = np.zeros((m, 2, 6, 6))
    rows = new_rows()
    for i in range(m):
        count = fill_rows(scene, R, t, i, i, rows)
        if count == 0:
            continue
        whiten(scene, i, i, count, SURE, rows)
        for row in range(count):
            part = 1 if row == count - 1 and bottom_is_given(scene, i, i, count) else 0
            for a in range(6):
                for b in range(6):
                    parts[i, part, a, b] += rows.jacobian[row, a] * rows.jacobian[row, b]
    return parts


@compiled
def _sigmas(total: FloatArray, up: FloatArray) -> FloatArray:
    """(o, 2) sigma of the camera centre and about ``up`` (3,), of information (o, 6, 6)."""
    sigma = np.empty((len(total), 2))
    for o in range(len(total)):
        covariance = inverse(total[o])
        place, turn = covariance[0, 0] + covariance[1, 1] + covariance[2, 2], 0.0
        for a in range(3):
            for b in range(3):
                turn += up[a] * covariance[3 + a, 3 + b] * up[b]
        is_fixed = place > 0.0
        sigma[o, 0] = np.sqrt(place) if is_fixed else np.inf
        sigma[o, 1] = np.sqrt(turn) if is_fixed else np.inf
    return sigma
