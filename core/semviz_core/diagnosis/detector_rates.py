"""Measure a detector on a run: false detections, recall by distance, hidden bottoms, sigmas.

Expectation-maximization: which map element a detection is of, if any, is a posterior under the
present rates; the rates are those that the posterior expects. Poses are the true ones, or else the
sure estimates. Elements that are known to be detected keep their detections.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_core.base.detector_model import CalibratedRates, DetectorModel, SigmaScale
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.fault import FALSE_POSITIVE, GroundTruth
from semviz_core.localization.association import NEAREST_M
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import EXACT_POSE
from semviz_core.metrics.detection_calibration import (
    LEAST_SCORES,
    PRIOR_ELEMENTS,
    REACH_M,
    RECALL_RANGE,
)
from semviz_core.tracking.association import PairRows, pair_rows

START = DetectorModel()
LEAST_FRAMES = 5
ITERATIONS = 40
CONVERGED = 0.01
"""Relative change of every rate below which the iteration ends."""
WITHIN_ONE_SIGMA = 0.6827
LEAST_ROWS = 10.0
"""Expected number of residuals from which a scale of sigma is measured."""
SCALES = (0.1, 20.0)
GATE_SIGMAS = 8.0
"""Pairs farther apart across the axis, under the present sigmas, are none."""
POSE_FREEDOM = 4.0
"""Degrees of freedom of a pose that its detections determine; the prior gives gravity."""
_ROOT_2PI = float(np.sqrt(2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class _Pairs:
    """One frame: its possible pairs and mapped elements in view."""

    observed: Elements2D
    pairs: IntArray
    """(k, 2) rows of observed and of mapped."""
    rows: PairRows
    map_variance_px2: FloatArray
    """(k, 4) that the map adds to the residuals."""
    pose_variance_px2: FloatArray
    """(k, 4) that the pose adds; 0 with a true pose."""
    is_line: BoolArray
    """(k,)"""
    distance_m: FloatArray
    """(n,) of mapped elements in view; NaN for others."""
    forced: IntArray
    """(m,) mapped row that is known to be detected, -1: unknown, -2: false."""

    @property
    def is_across(self) -> BoolArray:
        """(k, 4) rows across the axis of poles; all rows of signs."""
        return np.arange(4) < np.where(self.is_line, 2, 4)[:, None]


@dataclass(frozen=True, eq=False)
class _Posterior:
    """What one frame's detections are under the present rates."""

    probability: FloatArray
    """(k,) of each pair."""
    hidden: FloatArray
    """(k,) probability that a given bottom is hidden, if the pair is right."""
    is_right: FloatArray
    """(m,) probability that a detection is of any element."""
    found: FloatArray
    """(n,) probability that an element is detected."""


@dataclass(frozen=True, eq=False)
class MeasuredDetector:
    """What a run tells of its detector."""

    model: DetectorModel
    sigma_scale: SigmaScale
    rates: tuple[CalibratedRates, ...]
    """For each of ``LEAST_SCORES``."""
    least_score: float
    """The score that leaves most right detections minus false ones."""
    frames: int
    detections: int
    right: float
    """Expected number of right detections."""
    is_right: FloatArray
    """(detections,) probability of each, frame by frame."""


Frame = tuple[Localization, GroundTruth | None]


def measure_detector(frames: Sequence[Frame], semantic_map: SemanticMap) -> MeasuredDetector:
    """Return the rates of the detector that observed the frames.

    Frames without a true pose count if they are ``ok``. Raise SemvizError if too few are left.
    """
    cases = [case for frame in frames if (case := _case(*frame, semantic_map)) is not None]
    if len(cases) < LEAST_FRAMES:
        raise SemvizError(
            f"{len(cases)} frames have a true pose, or are sure of theirs; {LEAST_FRAMES} are "
            "needed: localize more frames"
        )
    model, scale = START, SigmaScale()
    for _ in range(ITERATIONS):
        found = [_expectation(case, model, scale) for case in cases]
        before, model = model, _rates(cases, found, 0.0)
        scale = _scales(cases, found)
        if _change(before, model) < CONVERGED:
            break
    found = [_expectation(case, model, scale) for case in cases]
    rates = tuple(
        CalibratedRates(least_score=least, **_rates(cases, found, least)._asdict())
        for least in LEAST_SCORES
    )
    is_right = np.concatenate([posterior.is_right for posterior in found])
    score = np.concatenate([case.observed.score for case in cases])
    surplus = [float((2.0 * is_right - 1.0)[score >= least].sum()) for least in LEAST_SCORES]
    return MeasuredDetector(
        model,
        scale,
        rates,
        LEAST_SCORES[int(np.argmax(surplus))],
        len(cases),
        len(is_right),
        float(is_right.sum()),
        is_right,
    )


def _case(
    result: Localization, truth: GroundTruth | None, semantic_map: SemanticMap
) -> _Pairs | None:
    """Return a frame with its possible pairs; None without a pose that is sure."""
    pose, covariance = result.T_camera_map, result.covariance
    if truth is not None:
        pose, covariance = truth.T_camera_map, EXACT_POSE
    elif result.status != "ok":
        return None
    if pose is None:
        return None
    covariance = EXACT_POSE if covariance is None else covariance
    nearby = semantic_map.crop(pose.inverse().translation, REACH_M)
    problem = PoseProblem.of(result.camera, result.observed, nearby)
    depth_m = pose.apply(_middle(nearby))[:, 2]
    pairs = np.argwhere(problem.compatible & (depth_m > NEAREST_M))
    rows = pair_rows(problem, pose, pairs)
    J, E = rows.by_pose, rows.by_element
    mapped = np.einsum("kri,kij,krj->kr", E, nearby.covariance_m2[pairs[:, 1]], E)
    posed = np.zeros_like(mapped)
    if truth is None:
        posed = np.einsum("kri,ij,krj->kr", J, covariance, J)
    return _Pairs(
        result.observed,
        pairs,
        rows,
        mapped,
        posed,
        result.observed.is_line[pairs[:, 0]],
        _distances_in_view(nearby, pose, result),
        _known(truth, nearby, len(result.observed)),
    )


def _middle(elements: Elements3D) -> FloatArray:
    end_m = np.where(elements.is_line[:, None], elements.end_m, elements.anchor_m)
    return np.asarray(0.5 * (elements.anchor_m + end_m))


def _distances_in_view(elements: Elements3D, pose: Pose, result: Localization) -> FloatArray:
    """Return (n,) distances of elements whose middle is in the image, hidden or not; else NaN."""
    middle = pose.apply(_middle(elements))
    distance_m = np.linalg.norm(middle, axis=1)
    ahead = np.asarray(middle[:, 2] > NEAREST_M)
    shown = result.camera.contains(result.camera.project(middle)) & ahead
    return np.where(shown & (distance_m <= REACH_M), distance_m, np.nan)


def _known(truth: GroundTruth | None, nearby: Elements3D, m: int) -> IntArray:
    """Return (m,) the mapped row of each detection as far as the ids tell; -1: unknown."""
    forced = np.full(m, -1)
    if truth is None or truth.element_id is None:
        return forced
    row_of = {int(id_): row for row, id_ in enumerate(nearby.id)}
    for row, id_ in enumerate(truth.element_id.tolist()):
        forced[row] = -2 if id_ == FALSE_POSITIVE else row_of.get(id_, -1)
    return forced


def _variance(case: _Pairs, scale: SigmaScale) -> FloatArray:
    """Return (k, 4) of the residuals, with scaled sigmas of the detection."""
    of_line = np.where(case.is_across, scale.pole_across, scale.pole_along)
    factor = np.where(case.is_line[:, None], of_line, scale.sign)
    own = case.rows.variance_px2 * factor**2
    return np.asarray(own + case.map_variance_px2 + case.pose_variance_px2)


def _expectation(case: _Pairs, model: DetectorModel, scale: SigmaScale) -> _Posterior:
    """Return the posterior of a frame: each detection is of one element at most, or false."""
    rows, m, n = case.rows, len(case.observed), len(case.distance_m)
    sigma = np.sqrt(_variance(case, scale))
    white = rows.residual_px / sigma
    nats = -0.5 * white**2 - np.log(_ROOT_2PI * sigma) - rows.clutter
    visible = (1.0 - model.hidden_bottoms) * np.exp(-0.5 * white**2) / (_ROOT_2PI * sigma)
    above = white < 2.0  # a hidden bottom is not below the true one
    behind = np.where(above, model.hidden_bottoms / rows.length_px[:, None], 1e-300)
    bottom = np.log(np.maximum(visible + behind, 1e-300)) - rows.clutter
    nats = np.where(rows.is_bottom, bottom, nats)
    near = rows.used[:, 0] & (np.abs(white[:, 0]) < GATE_SIGMAS)
    gain = np.where(rows.used, nats, 0.0).sum(axis=1)
    chance = _recall(case.distance_m, model)[case.pairs[:, 1]]
    gain += np.log(np.maximum(chance, 1e-3)) - np.log(model.false_detections)
    odds = np.where(near, np.exp(np.clip(gain, -700.0, 200.0)), 0.0)

    forced = case.forced[case.pairs[:, 0]]
    odds = np.where(forced == -1, odds, np.where(forced == case.pairs[:, 1], 1e12, 0.0))
    total = np.bincount(case.pairs[:, 0], odds, minlength=m)
    probability = odds / (1.0 + total[case.pairs[:, 0]])
    # one detection of an element only: share it among those that could be
    of_element = np.bincount(case.pairs[:, 1], probability, minlength=n)
    probability = probability / np.maximum(of_element, 1.0)[case.pairs[:, 1]]
    share = np.where(rows.is_bottom, behind / np.maximum(visible + behind, 1e-300), 0.0)
    return _Posterior(
        probability,
        share.sum(axis=1),
        np.bincount(case.pairs[:, 0], probability, minlength=m).astype(np.float64),
        np.minimum(of_element, 1.0),
    )


def _recall(distance_m: FloatArray, model: DetectorModel) -> FloatArray:
    """Return (n,) the recall by distance; 0 where it is NaN."""
    far = _share_far(distance_m)
    return np.nan_to_num(model.recall_near + far * (model.recall_far - model.recall_near))


def _share_far(distance_m: FloatArray) -> FloatArray:
    """Return (n,) 0 up to ``near_m``, 1 from ``far_m`` on."""
    return np.clip((distance_m - START.near_m) / (START.far_m - START.near_m), 0.0, 1.0)


def _rates(cases: Sequence[_Pairs], found: Sequence[_Posterior], least: float) -> DetectorModel:
    """Return the rates that the posterior expects, for detections of a minimum score."""
    false, known = 0.0, PRIOR_ELEMENTS
    hidden = known * START.hidden_bottoms  # few bottoms do not prove that none is hidden
    distances, founds = [np.zeros(0)], [np.zeros(0)]
    for case, posterior in zip(cases, found, strict=True):
        kept = case.observed.score >= least
        of_kept = np.where(kept[case.pairs[:, 0]], posterior.probability, 0.0)
        false += float((1.0 - posterior.is_right)[kept].sum())
        bottoms = case.rows.is_bottom.any(axis=1)
        known += float(of_kept[bottoms].sum())
        hidden += float((of_kept * posterior.hidden)[bottoms].sum())
        shown = np.isfinite(case.distance_m)
        detected = np.bincount(case.pairs[:, 1], of_kept, minlength=len(case.distance_m))
        distances.append(case.distance_m[shown])
        founds.append(np.minimum(detected[shown], 1.0))
    near, far = _recall_line(np.concatenate(distances), np.concatenate(founds))
    return START._replace(
        false_detections=max(false, 0.5) / len(cases),
        recall_near=near,
        recall_far=min(near, far),
        hidden_bottoms=hidden / known,
    )


def _recall_line(distance_m: FloatArray, found: FloatArray) -> tuple[float, float]:
    """Return recall near and far: least squares, with the assumed recall as a few elements."""
    far = _share_far(distance_m)
    weight = np.sqrt(PRIOR_ELEMENTS)
    left = np.vstack([np.column_stack([1.0 - far, far]), weight * np.eye(2)])
    right = np.concatenate([found, weight * np.array([START.recall_near, START.recall_far])])
    line = np.clip(np.linalg.lstsq(left, right, rcond=None)[0], *RECALL_RANGE)
    return float(line[0]), float(line[1])


def _scales(cases: Sequence[_Pairs], found: Sequence[_Posterior]) -> SigmaScale:
    """Return the factors of sigma at which 68 % of the expected residuals are within one sigma.

    What the map explains is no error of the detector. An estimated pose fits its own detections:
    their residuals count as much more as it has degrees of freedom.
    """
    errors: dict[str, list[FloatArray]] = {"pole_across": [], "pole_along": [], "sign": []}
    for case, posterior in zip(cases, found, strict=True):
        rows, weight = case.rows, np.repeat(posterior.probability[:, None], 4, axis=1)
        weight = np.where(rows.is_bottom, weight * (1.0 - posterior.hidden[:, None]), weight)
        freedom = 1.0
        if case.pose_variance_px2.any():
            expected = float(weight[rows.used].sum())
            freedom = expected / max(expected - POSE_FREEDOM, 1.0)
        values = freedom * rows.residual_px**2, rows.variance_px2, case.map_variance_px2, weight
        line = case.is_line[:, None]
        for name, chosen in (
            ("pole_across", line & case.is_across),
            ("pole_along", line & ~case.is_across),
            ("sign", np.broadcast_to(~line, weight.shape)),
        ):
            errors[name].append(np.array([value[rows.used & chosen] for value in values]))
    return SigmaScale(**{name: _scale(np.hstack(parts)) for name, parts in errors.items()})


def _scale(errors: FloatArray) -> float:
    """Return the factor for columns (4, r): squared residual, variances of detector and map,
    weight."""
    squared, own, of_map, weight = errors
    if weight.sum() < LEAST_ROWS:
        return 1.0
    low, high = np.log(SCALES)
    for _ in range(30):
        middle = 0.5 * (low + high)
        inside = squared <= np.exp(2.0 * middle) * own + of_map
        if weight[inside].sum() < WITHIN_ONE_SIGMA * weight.sum():
            low = middle
        else:
            high = middle
    return float(np.exp(0.5 * (low + high)))


def _change(before: DetectorModel, after: DetectorModel) -> float:
    """Return the largest relative change of a rate."""
    names = "false_detections", "recall_near", "recall_far", "hidden_bottoms"
    old = np.array([getattr(before, name) for name in names])
    new = np.array([getattr(after, name) for name in names])
    return float((np.abs(new - old) / np.maximum(old, 0.01)).max())
