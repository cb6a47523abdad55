"""Measure what a detector's scores and sigmas mean, and its rates, on images with known elements.

Scores: isotonic regression of right and false detections on their score (pool adjacent
violators; Zadrozny and Elkan 2002), for poles and for signs. Sigmas: the factor at which 68 % of
the errors are within one sigma. False detections are counted in complete images only, where
everything that is there is known.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.detector_model import (
    CalibratedRates,
    DetectorModel,
    Kind,
    ScoreCurve,
    SigmaScale,
    calibrated,
)
from semviz_core.base.elements import Elements2D, joined
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.detection import (
    FALSE_POSITIVE,
    NEAREST_M,
    SHORTEST_PX,
    ImageGroundTruth,
    match_detections,
)
from semviz_core.metrics.detection_summary import errors_and_sigmas

LEAST_DETECTIONS = 20
"""Number of detections of a kind from which a curve of scores is fitted."""
KINDS: tuple[Kind, ...] = ("pole", "sign")
LEAST_ERRORS = 10
"""Number of errors from which a scale of sigma is measured."""
WITHIN_ONE_SIGMA = 0.6827
LEAST_SCORES = tuple(round(0.1 * step, 1) for step in range(10))
"""Minimum calibrated scores at which rates are measured."""
NEAR_M = 40.0
"""Recall is stated up to this distance, as in ``semviz detect evaluate``."""
REACH_M = 120.0
"""Elements up to here count for scores and rates: localization uses them."""
ASSUMED = DetectorModel()
PRIOR_ELEMENTS = 4.0
"""Weight of what is assumed, in elements: a few elements do not prove a rate of 0 or 1."""
RECALL_RANGE = 0.02, 0.98
HIDDEN_SIGMAS, HIDDEN_PX = 3.0, 3.0
"""A bottom is hidden if it is above the true one by more than both."""


@dataclass(frozen=True, eq=False)
class CalibrationImage:
    """The detections of an image, and what is there."""

    detections: Elements2D
    """(m,)"""
    truth: ImageGroundTruth
    """(n,) also elements that are probably hidden, which do not count but have a distance."""
    is_complete: bool
    """Whether a detection without an element is false; else it is unknown."""
    matches: IntArray
    """(m,) rows as ``match_detections``."""
    matches_in_view: IntArray
    """(m,) the same if every element in view counts, hidden or not."""

    @classmethod
    def of(
        cls, detections: Elements2D, truth: ImageGroundTruth, is_complete: bool
    ) -> "CalibrationImage":
        """Match detections with what is there."""
        expected = replace(truth, counts=_in_view(truth))
        matches = match_detections(detections, truth)
        return cls(detections, truth, is_complete, matches, match_detections(detections, expected))

    def calibrated(
        self, scores: Mapping[Kind, ScoreCurve], scale: SigmaScale
    ) -> "CalibrationImage":
        """Return the same with calibrated detections.

        Curves keep the order of scores, on which matches depend.
        """
        return replace(self, detections=calibrated(self.detections, scores, scale))

    def above(self, least_score: float) -> "CalibrationImage":
        """Return the same with the detections of at least this score.

        Matches of the others do not depend on lower scores.
        """
        kept = self.detections.score >= least_score
        return replace(
            self,
            detections=self.detections[kept],
            matches=self.matches[kept],
            matches_in_view=self.matches_in_view[kept],
        )


def _in_view(truth: ImageGroundTruth) -> BoolArray:
    """Return (n,) whether a mapped element would be expected in view, hidden or not."""
    length = np.linalg.norm(truth.elements.end_px - truth.elements.anchor_px, axis=1)
    near = (truth.distance_m >= NEAREST_M) & (truth.distance_m <= REACH_M)
    return np.asarray(near & ~(length < SHORTEST_PX))


def fitted_scores(images: Sequence[CalibrationImage]) -> dict[Kind, ScoreCurve]:
    """Return a curve for each kind; a kind with too few detections has that of both together.

    Raise SemvizError if there are too few of both.
    """
    complete = [image for image in images if image.is_complete]
    scored = {kind: _scored(complete, kind == "pole") for kind in KINDS}
    both = tuple(np.concatenate(values) for values in zip(*scored.values(), strict=True))
    if len(both[0]) < LEAST_DETECTIONS:
        raise SemvizError(
            f"{len(both[0])} detections are known to be right or false, {LEAST_DETECTIONS} are "
            "needed; review more images with 'semviz annotate', or name a map with --map"
        )
    return {
        kind: _isotonic(*(own if len(own[0]) >= LEAST_DETECTIONS else both))
        for kind, own in scored.items()
    }


def _scored(images: Sequence[CalibrationImage], is_line: bool) -> tuple[FloatArray, FloatArray]:
    """Return scores (k,) of detections of a kind, and 1 for right ones, 0 for false ones."""
    scores, right = [np.zeros(0)], [np.zeros(0)]
    for image in images:
        known = (image.matches >= 0) | (image.matches == FALSE_POSITIVE)
        rows = known & (image.detections.is_line == is_line)
        scores.append(image.detections.score[rows])
        right.append(np.asarray(image.matches[rows] >= 0, np.float64))
    return np.concatenate(scores), np.concatenate(right)


def _isotonic(score: FloatArray, is_right: FloatArray) -> ScoreCurve:
    """Return the isotonic regression, a point for each block of scores with one probability."""
    from scipy.optimize import isotonic_regression

    values, row, count = np.unique(np.round(score, 6), return_inverse=True, return_counts=True)
    share = np.bincount(row, is_right) / count
    fitted = isotonic_regression(share, weights=count)
    blocks = np.repeat(np.arange(len(fitted.blocks) - 1), np.diff(fitted.blocks))
    middle = np.bincount(blocks, values * count) / np.bincount(blocks, count)
    most = (len(score) + 1.0) / (len(score) + 2.0)  # Laplace: a sample cannot prove 0 or 1
    probability = np.clip(fitted.x[fitted.blocks[:-1]], 1.0 - most, most)
    return ScoreCurve(score=tuple(middle.tolist()), probability=tuple(probability.tolist()))


def fitted_sigma_scale(images: Sequence[CalibrationImage]) -> SigmaScale:
    """Return the scales of sigma; 1 where there are too few errors.

    Hidden bottoms are left out: they have a rate of their own.
    """
    empty = Elements2D.from_ends([], [], [])
    detections, true = empty, empty
    for image in images:
        known = image.detections.end_known & ~_hidden(image)
        rows = image.matches >= 0
        detections = joined(detections, replace(image.detections, end_known=known)[rows])
        true = joined(true, image.truth.elements[image.matches[rows]])
    groups = errors_and_sigmas(detections, true)
    return SigmaScale(
        pole_across=_scale(*groups["poles, across"]),
        pole_along=_scale(*groups["poles, along"]),
        sign=_scale(*groups["signs"]),
    )


def _scale(error_px: FloatArray, sigma_px: FloatArray) -> float:
    if len(error_px) < LEAST_ERRORS:
        return 1.0
    return float(np.clip(np.quantile(np.abs(error_px / sigma_px), WITHIN_ONE_SIGMA), 0.05, 50.0))


@dataclass(frozen=True)
class ThresholdFigures:
    """A minimum score with its recall, precision and rates."""

    rates: CalibratedRates
    recall: float
    """Share of the visible elements up to ``NEAR_M``."""
    right: float
    """Mean number of right detections per complete image."""
    false: float
    """Mean number of false ones."""

    @property
    def precision(self) -> float:
        return self.right / max(self.right + self.false, 1e-9)

    @property
    def surplus(self) -> float:
        """Right minus false detections per image: a false one costs what a right one brings."""
        return self.right - self.false


def threshold_figures(images: Sequence[CalibrationImage]) -> list[ThresholdFigures]:
    """Return figures for each of ``LEAST_SCORES``; detections have calibrated scores."""
    return [_figures([image.above(least) for image in images], least) for least in LEAST_SCORES]


def best_threshold(
    figures: Sequence[ThresholdFigures], most_false: float | None = None
) -> ThresholdFigures:
    """Return the minimum score with the largest surplus, or the lowest with ``most_false``."""
    if most_false is None:
        return max(figures, key=lambda row: row.surplus)
    within = [row for row in figures if row.false <= most_false]
    return within[0] if within else figures[-1]


@dataclass(frozen=True, eq=False)
class FittedCalibration:
    """What was measured of a detector, and the minimum score that it suggests."""

    scores: dict[Kind, ScoreCurve]
    sigma_scale: SigmaScale
    figures: tuple[ThresholdFigures, ...]
    """For each of ``LEAST_SCORES``."""
    best: ThresholdFigures


def fit_calibration(
    images: Sequence[CalibrationImage], most_false: float | None = None
) -> FittedCalibration:
    """Calibrate on one image or more: scores, minimum score, sigmas of what it leaves, rates.

    Raise SemvizError if too few detections are known to be right or false.
    """
    scores = fitted_scores(images)
    rescored = [image.calibrated(scores, SigmaScale()) for image in images]
    least = best_threshold(threshold_figures(rescored), most_false).rates.least_score
    scale = fitted_sigma_scale([image.above(least) for image in rescored])
    figures = threshold_figures([image.calibrated(scores, scale) for image in images])
    best = next(row for row in figures if row.rates.least_score == least)
    return FittedCalibration(scores, scale, tuple(figures), best)


def _figures(images: Sequence[CalibrationImage], least_score: float) -> ThresholdFigures:
    complete = [image for image in images if image.is_complete]
    false = sum(int((image.matches == FALSE_POSITIVE).sum()) for image in complete)
    right = sum(int((image.matches >= 0).sum()) for image in complete)
    found, there = np.sum([_near(image) for image in images], axis=0)
    recall_near, recall_far = _recall(images)
    rates = CalibratedRates(
        least_score=least_score,
        false_detections=max(false, 0.5) / max(len(complete), 1),
        recall_near=recall_near,
        recall_far=recall_far,
        near_m=ASSUMED.near_m,
        far_m=ASSUMED.far_m,
        reach_m=ASSUMED.reach_m,
        hidden_bottoms=_hidden_bottoms(images),
    )
    images_counted = max(len(complete), 1)
    recall = found / max(there, 1)
    return ThresholdFigures(rates, recall, right / images_counted, false / images_counted)


def _near(image: CalibrationImage) -> tuple[int, int]:
    """Return how many visible elements near or of unknown distance were found, and how many."""
    near = image.truth.counts & ~(image.truth.distance_m > NEAR_M)
    found = near & np.isin(np.arange(len(near)), image.matches)
    return int(found.sum()), int(near.sum())


def _recall(images: Sequence[CalibrationImage]) -> tuple[float, float]:
    """Return recall near and far: a least-squares fit of the model's line over distance."""
    distances, founds = [np.zeros(0)], [np.zeros(0)]
    for image in images:
        rows = np.flatnonzero(_in_view(image.truth))
        distances.append(image.truth.distance_m[rows])
        founds.append(np.isin(rows, image.matches_in_view).astype(np.float64))
    distance, found = np.concatenate(distances), np.concatenate(founds)
    far = np.clip((distance - ASSUMED.near_m) / (ASSUMED.far_m - ASSUMED.near_m), 0.0, 1.0)
    weight = np.sqrt(PRIOR_ELEMENTS)
    left = np.vstack([np.column_stack([1.0 - far, far]), weight * np.eye(2)])
    right = np.concatenate([found, weight * np.array([ASSUMED.recall_near, ASSUMED.recall_far])])
    recall = np.clip(np.linalg.lstsq(left, right, rcond=None)[0], *RECALL_RANGE)
    return float(recall[0]), float(recall.min())


def _hidden_bottoms(images: Sequence[CalibrationImage]) -> float:
    """Return the share of bottoms given as known that are hidden, with the assumed one as a few."""
    hidden = sum(int(_hidden(image).sum()) for image in images)
    known = sum(int(_known_bottoms(image).sum()) for image in images)
    return (hidden + PRIOR_ELEMENTS * ASSUMED.hidden_bottoms) / (known + PRIOR_ELEMENTS)


def _known_bottoms(image: CalibrationImage) -> BoolArray:
    """Return (m,) which detections are right and give a bottom as known."""
    return np.asarray((image.matches >= 0) & image.detections.end_known)


def _hidden(image: CalibrationImage) -> BoolArray:
    """Return (m,) which bottoms are given as known, and are above the true ones or hidden there."""
    rows = _known_bottoms(image)
    detections, true = image.detections[rows], image.truth.elements[image.matches[rows]]
    axis = true.end_px - true.anchor_px
    unit = unit_vectors(axis)
    above_px = ((true.end_px - detections.end_px) * unit).sum(axis=1)
    limit_px = np.maximum(HIDDEN_SIGMAS * detections.sigma_px[:, 1], HIDDEN_PX)
    hidden = np.zeros(len(rows), bool)
    hidden[rows] = ~true.end_known | (above_px > limit_px)
    return hidden
