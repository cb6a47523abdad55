"""Compare a frame with a reference pose: the ground truth, or else the estimate."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.frame import Prior, vague_prior
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose, angle_between
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.diagnosis.fault import GroundTruth
from semviz_core.localization.association import NEAREST_M, associate
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import EXACT_POSE, PairResiduals, problem_residuals
from semviz_core.localization.search import APART_M, APART_RAD, REFINED_COVARIANCE
from semviz_core.tracking.association import pair_rows

NEARBY_M = 60.0
"""Map elements within this distance of the camera are considered."""


@dataclass(frozen=True, eq=False)
class FrameReference:
    """One frame, the map around it, and its ground truth as far as known."""

    localization: Localization
    semantic_map: SemanticMap
    detector: DetectorModel
    truth: Pose | None
    """T_camera_map."""
    ids: IntArray | None
    """(m,) as in ``GroundTruth``."""

    @classmethod
    def of(
        cls,
        localization: Localization,
        semantic_map: SemanticMap,
        truth: GroundTruth | None,
        detector: DetectorModel | None,
    ) -> "FrameReference":
        model = detector or DetectorModel()
        if truth is None:
            return cls(localization, semantic_map, model, None, None)
        return cls(localization, semantic_map, model, truth.T_camera_map, truth.element_id)

    @property
    def prior(self) -> Prior:
        """The frame's prior; a vague one without."""
        given = self.localization.prior
        return vague_prior(self.localization.around_m) if given is None else given

    @cached_property
    def reference(self) -> Pose | None:
        """T_camera_map: the true pose, or else the estimate."""
        return self.localization.T_camera_map if self.truth is None else self.truth

    @property
    def reference_covariance(self) -> FloatArray:
        """(6, 6) covariance of ``reference``."""
        covariance = self.localization.covariance
        return EXACT_POSE if self.truth is not None or covariance is None else covariance

    @cached_property
    def nearby(self) -> Elements3D:
        """(n) elements of the whole map around ``reference``, and further ones that are known to
        be observed."""
        if self.reference is None:
            return self.localization.submap
        near = self.semantic_map.crop(self.reference.inverse().translation, NEARBY_M)
        if self.ids is None:
            return near
        elements = self.semantic_map.elements
        far = np.isin(elements.id, np.setdiff1d(self.ids, near.id))
        return joined(near, elements[far]) if far.any() else near

    @cached_property
    def problem(self) -> PoseProblem:
        """The observed and the nearby elements as the solver takes them."""
        result = self.localization
        return PoseProblem.of(result.camera, result.observed, self.nearby, self.detector)

    @cached_property
    def pairs(self) -> IntArray:
        """(k, 2) correspondences (observed, nearby): by the ids, else by ``reference``."""
        if self.ids is not None:
            return np.argwhere(self.ids[:, None] == self.nearby.id)
        if self.reference is None:
            return np.empty((0, 2), dtype=np.int64)
        covariance = self.reference_covariance.copy()
        match, _ = associate(self.problem, *self.reference.writable(), covariance)
        rows = np.flatnonzero(match >= 0)
        return np.column_stack([rows, match[rows]])

    @cached_property
    def same_class(self) -> IntArray:
        """(k, 2) the ``pairs`` of equal class."""
        same = self.problem.compatible[self.pairs[:, 0], self.pairs[:, 1]]
        return np.asarray(self.pairs[same])

    @cached_property
    def in_view(self) -> BoolArray:
        """(n,) nearby elements that a detector may find, with their midpoint in the image."""
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
        """(n,) nearby elements in view without a detection: missed or occluded."""
        unseen = np.ones(len(self.nearby), dtype=bool)
        unseen[self.pairs[:, 1]] = False
        return np.asarray(self.in_view & unseen)

    @cached_property
    def in_submap(self) -> BoolArray:
        """(n,) nearby elements that are in the solver's submap."""
        return np.asarray(np.isin(self.nearby.id, self.localization.submap.id))

    def residuals(self, pairs: IntArray) -> PairResiduals:
        """Return the residuals of pairs (k, 2) of rows (observed, nearby) under ``reference``."""
        assert self.reference is not None
        return problem_residuals(self.problem, self.reference, pairs)

    def name(self, row: int) -> str:
        """Return the name of a nearby element, as people read it."""
        elements = self.nearby
        return self.semantic_map.classes.element_name(
            int(elements.class_id[row]), int(elements.id[row])
        )

    def is_true(self, T_camera_map: Pose) -> bool:
        """Whether a pose is the true one, up to the distance of separate modes."""
        return self.truth is not None and is_near(T_camera_map, self.truth)


def pairs_to_fit(case: FrameReference, problem: PoseProblem, T_camera_map: Pose) -> IntArray:
    """Return (k, 2) rows of observed and nearby elements: the true pairs if known, else those that
    fit a pose within a wide gate."""
    if case.ids is not None:
        return case.same_class
    match, _ = associate(problem, *T_camera_map.writable(), REFINED_COVARIANCE)
    rows = np.flatnonzero(match >= 0)
    return np.column_stack([rows, match[rows]])


class PairErrors(NamedTuple):
    """Residual rows of k pairs, without pole bottoms, which may be hidden.

    Rows that do not count are 0, with variance 1 and no correlation: they change nothing.
    """

    counted: BoolArray
    """(k, 4) no row of a pair behind the camera."""
    residual_px: FloatArray
    """(k, 4)"""
    by_pose: FloatArray
    """(k, 4, 6) by the left perturbation of T_camera_map."""
    covariance_px2: FloatArray
    """(k, 4, 4) of detection and map."""
    variance_px2: FloatArray
    """(k, 4) of the detection alone; 0 where no row counts."""


def pair_errors(problem: PoseProblem, T_camera_map: Pose, pairs: IntArray) -> PairErrors:
    """Return the residual rows of pairs (k, 2)."""
    rows = pair_rows(problem, T_camera_map, pairs)
    counted = rows.used & ~rows.is_bottom
    by_element = np.where(counted[..., None], rows.by_element, 0.0)
    mapped = problem.mapped["covariance_m2"][pairs[:, 1]]
    covariance = by_element @ mapped @ np.swapaxes(by_element, 1, 2)
    index = np.arange(4)
    covariance[:, index, index] += np.where(counted, rows.variance_px2, 1.0)
    return PairErrors(
        counted,
        np.where(counted, rows.residual_px, 0.0),
        np.where(counted[..., None], rows.by_pose, 0.0),
        covariance,
        np.where(counted, rows.variance_px2, 0.0),
    )


class WhitenedRows(NamedTuple):
    """Residuals of pairs in sigmas, without pole bottoms."""

    residual: FloatArray
    """(r,)"""
    jacobian: FloatArray
    """(r, 6) by the left perturbation of the pose."""


def whitened_rows(problem: PoseProblem, T_camera_map: Pose, pairs: IntArray) -> WhitenedRows:
    """Return the residuals of pairs (k, 2); none of those behind the camera."""
    errors = pair_errors(problem, T_camera_map, pairs)
    factor = np.linalg.cholesky(errors.covariance_px2)
    residual = np.linalg.solve(factor, errors.residual_px[..., None])[..., 0]
    jacobian = np.linalg.solve(factor, errors.by_pose)
    return WhitenedRows(residual[errors.counted], jacobian[errors.counted])


ProgressCallback = Callable[[Iterable[FrameReference], str, int], Iterable[FrameReference]]
"""Yields the frames it is given; also gets what is done with them and their number, to show it."""


def no_progress(cases: Iterable[FrameReference], what: str, total: int) -> Iterable[FrameReference]:
    """The ``ProgressCallback`` that shows nothing."""
    return cases


def is_healthy(localization: Localization, truth: Pose | None) -> bool:
    """Whether the status is ok and the pose right, as far as known; ``truth`` is T_camera_map."""
    estimate = localization.T_camera_map
    if localization.status != "ok" or estimate is None:
        return False
    return truth is None or is_near(estimate, truth)


def is_near(first: Pose, second: Pose) -> bool:
    """Whether two poses T_camera_map are closer than separate modes."""
    away_m, angle = pose_distance(first, second)
    return away_m <= APART_M and angle <= APART_RAD


def pose_distance(first: Pose, second: Pose) -> tuple[float, float]:
    """Return the distance of the camera centres (m) and the angle (rad) of two T_camera_map."""
    offset_m = first.inverse().translation - second.inverse().translation
    return float(np.linalg.norm(offset_m)), angle_between(first.rotation, second.rotation)
