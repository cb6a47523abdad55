"""A frame beside a pose to compare it with: the true one, or else the answer."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.detector_model import DetectorModel
from semviz_core.elements import Elements3D, joined
from semviz_core.explaining.told import Truth
from semviz_core.localization import Localization
from semviz_core.pose import Pose, angle_between
from semviz_core.semantic_map import SemanticMap
from semviz_core.solving.association import NEAREST_M, associate
from semviz_core.solving.residuals import SURE, PairResiduals, scene_residuals
from semviz_core.solving.scene import Scene
from semviz_core.solving.search import APART_M, APART_RAD

NEARBY_M = 60.0
"""Of the camera: so far around, elements of the map are looked at."""


@dataclass(frozen=True, eq=False)
class Case:
    """One frame, the map around it, and what is known of its truth."""

    localization: Localization
    semantic_map: SemanticMap
    detector: DetectorModel
    truth: Pose | None
    """T_camera_map."""
    ids: IntArray | None
    """(m,) as in ``Truth``."""

    @classmethod
    def of(
        cls,
        localization: Localization,
        semantic_map: SemanticMap,
        truth: Truth | None,
        detector: DetectorModel | None,
    ) -> "Case":
        model = detector or DetectorModel()
        if truth is None:
            return cls(localization, semantic_map, model, None, None)
        return cls(localization, semantic_map, model, truth.T_camera_map, truth.element_id)

    @cached_property
    def reference(self) -> Pose | None:
        """The truth, or else the answer."""
        return self.localization.T_camera_map if self.truth is None else self.truth

    @property
    def doubt(self) -> FloatArray:
        """(6, 6) covariance of ``reference``."""
        covariance = self.localization.covariance
        return SURE if self.truth is not None or covariance is None else covariance

    @cached_property
    def nearby(self) -> Elements3D:
        """(n) elements of the whole map around ``reference``, and those further off that are
        known to be seen."""
        if self.reference is None:
            return self.localization.submap
        near = self.semantic_map.crop(self.reference.inverse().translation, NEARBY_M)
        if self.ids is None:
            return near
        elements = self.semantic_map.elements
        far = np.isin(elements.id, np.setdiff1d(self.ids, near.id))
        return joined(near, elements[far]) if far.any() else near

    @cached_property
    def scene(self) -> Scene:
        """What is observed and what is nearby."""
        one = self.localization
        return Scene.of(one.camera, one.observed, self.nearby, self.detector)

    @cached_property
    def pairs(self) -> IntArray:
        """(k, 2) rows (observed, nearby) that are one thing: by the ids, else by ``reference``."""
        if self.ids is not None:
            return np.argwhere(self.ids[:, None] == self.nearby.id)
        if self.reference is None:
            return np.empty((0, 2), dtype=np.int64)
        pose = self.reference
        match, _ = associate(self.scene, pose.rotation, pose.translation, self.doubt)
        rows = np.flatnonzero(match >= 0)
        return np.column_stack([rows, match[rows]])

    @cached_property
    def same_class(self) -> IntArray:
        """(k, 2) those of ``pairs`` that are called the same."""
        same = self.scene.compatible[self.pairs[:, 0], self.pairs[:, 1]]
        return np.asarray(self.pairs[same])

    @cached_property
    def in_view(self) -> BoolArray:
        """(n,) nearby elements that a detector may find, their middle in the image."""
        if self.reference is None:
            return np.zeros(len(self.nearby), dtype=bool)
        camera, line = self.localization.camera, self.nearby.is_line[:, None]
        end_m = np.where(line, self.nearby.end_m, self.nearby.anchor_m)
        middle_c = self.reference.apply(0.5 * (self.nearby.anchor_m + end_m))
        depth = middle_c[:, 2]
        in_range = (depth > NEAREST_M) & (depth < self.detector.far_m)
        return np.asarray(camera.contains(camera.project(middle_c)) & in_range)

    @cached_property
    def missed(self) -> BoolArray:
        """(n,) nearby elements in view that are no row: not found, or hidden from the camera."""
        unseen = np.ones(len(self.nearby), dtype=bool)
        unseen[self.pairs[:, 1]] = False
        return np.asarray(self.in_view & unseen)

    @cached_property
    def in_submap(self) -> BoolArray:
        """(n,) nearby elements that the solver was given."""
        return np.asarray(np.isin(self.nearby.id, self.localization.submap.id))

    def residuals(self, pairs: IntArray) -> PairResiduals:
        """Of pairs (k, 2) of rows (observed, nearby) under ``reference``."""
        assert self.reference is not None
        return scene_residuals(self.scene, self.reference, pairs)

    def name(self, row: int) -> str:
        """Of a nearby element, for people."""
        elements = self.nearby
        return self.semantic_map.classes.element_name(
            int(elements.class_id[row]), int(elements.id[row])
        )

    def is_true(self, T_camera_map: Pose) -> bool:
        """Whether a pose is the true answer; another one is further away."""
        return self.truth is not None and is_near(T_camera_map, self.truth)


Watch = Callable[[Iterable[Case], str, int], Iterable[Case]]
"""Passes cases through, and tells people what is done with them and how many there are."""


def unwatched(cases: Iterable[Case], what: str, total: int) -> Iterable[Case]:
    """The ``Watch`` that tells nobody."""
    return cases


def is_healthy(localization: Localization, truth: Pose | None) -> bool:
    """Answered, sure, and right as far as known; ``truth`` is T_camera_map."""
    answer = localization.T_camera_map
    if localization.status != "ok" or answer is None:
        return False
    return truth is None or is_near(answer, truth)


def is_near(one: Pose, other: Pose) -> bool:
    """Whether two poses T_camera_map are one answer."""
    away_m, angle = apart(one, other)
    return away_m <= APART_M and angle <= APART_RAD


def apart(one: Pose, other: Pose) -> tuple[float, float]:
    """Distance of the camera centres (m) and angle (rad) between two poses T_camera_map."""
    offset_m = one.inverse().translation - other.inverse().translation
    return float(np.linalg.norm(offset_m)), angle_between(one.rotation, other.rotation)
