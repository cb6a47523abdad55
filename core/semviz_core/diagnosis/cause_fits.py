"""Find the one cause that explains the residuals of all frames of a run at their true poses.

Every cause is fitted to all pairs of the run by reweighted least squares, and the likeliest is
named (BIC). Its gain must remain without the element that it helps most, so that one moved element
is no common cause. Runs without true poses are told by `joint_fit`.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.diagnosis.common_causes import (
    CALIBRATIONS,
    MISALIGNMENTS,
    CauseRows,
    CommonCause,
    FittedFrames,
    cause_rows,
)
from semviz_core.diagnosis.frame_causes import image_pose
from semviz_core.diagnosis.reference import (
    FrameReference,
    ProgressCallback,
    no_progress,
)

NEEDED_PAIRS = 8
LEAST_NATS = 20.0
"""Log-likelihood that a cause must add, beyond its parameters and without its best element."""
RIVAL_NATS = 6.0
"""Causes closer than this cannot be told apart."""
LEAST_HELPED = 0.5
"""Share of the frames that a common cause must make likelier."""
LEAST_OFFSET_M, LEAST_OFFSET_RAD = 0.1, float(np.deg2rad(0.2))
"""A smaller offset is within the accuracy of poses and maps."""
MOST_CHI2 = 25.0
"""Squared residuals of one detection (sigmas) count up to this, and as much without a pair."""
MEDIAN_OF_NORMAL = 0.6745
"""Of the absolute value of a normal number."""
_SCALES = (30.0, 15.0, 8.0, 4.0, 4.0, 4.0)
"""Sigmas beyond which rows are down-weighted, per iteration."""


@dataclass(frozen=True, eq=False)
class CauseFit:
    """A cause with its likeliest parameters."""

    cause: CommonCause
    value: FloatArray
    """(p,)"""
    frames: FittedFrames
    rows: tuple[CauseRows, ...]
    """Of each fitted frame."""

    @classmethod
    def of(cls, cause: CommonCause, frames: FittedFrames, value: FloatArray) -> "CauseFit":
        rows = (cause_rows(frames, row, cause, value) for row in frames.fitted)
        return cls(cause, value, frames, tuple(rows))

    @cached_property
    def scale(self) -> float:
        """Size of the residuals in sigmas, 1 or more: stated sigmas may be too small."""
        residual = np.concatenate([rows.residual for rows in self.rows])
        if not residual.size:
            return 1.0
        return max(1.0, float(np.median(np.abs(residual))) / MEDIAN_OF_NORMAL)

    @property
    def pairs(self) -> int:
        return sum(int((rows.element >= 0).sum()) for rows in self.rows)

    def costs(self, scale: float) -> list[FloatArray]:
        """Return the costs (m,) of the detections of each fitted frame, in nats."""
        return [_costs(rows, scale, self.frames.cases[0].ids is not None) for rows in self.rows]

    def total(self, scale: float) -> float:
        return float(sum(cost.sum() for cost in self.costs(scale)))

    def corrected(self, row: int) -> FrameReference:
        """Return a frame without the error: true pose, camera and gravity."""
        case = self.frames.cases[row]
        localization = case.localization
        if self.cause.camera is not None:
            camera = self.cause.camera(localization.camera, self.value)
            return replace(case, localization=replace(localization, camera=camera))
        assert self.cause.offset is not None
        offset = self.cause.offset(self.frames, row, self.value).T_true_reference
        prior = localization.prior
        if self.cause in CALIBRATIONS and prior is not None and prior.up_camera is not None:
            prior = replace(prior, up_camera=offset.rotation @ prior.up_camera)
            localization = replace(localization, prior=prior)
        truth = None if case.truth is None else offset @ case.truth
        return replace(case, localization=localization, truth=truth)


def _costs(rows: CauseRows, scale: float, with_ids: bool) -> FloatArray:
    """Return (m,) half of the squared residuals of each detection, up to a limit."""
    chi2 = np.bincount(rows.detection, rows.residual**2, minlength=len(rows.element))
    if not with_ids:  # the wrong pose leaves detections without a pair
        chi2 = np.where(rows.element < 0, np.inf, chi2)
    return np.asarray(0.5 * np.minimum(chi2 / scale**2, MOST_CHI2))


@dataclass(frozen=True)
class RatedCause:
    """A fitted cause, and how much likelier the run is with it."""

    fit: CauseFit
    nats: float
    """Log-likelihood above that without a cause, less half of p log n (BIC)."""
    nats_without_best: float
    """The same without the element that it helps most."""
    helped: float
    """Share of the frames that are likelier with it."""

    @property
    def is_fault(self) -> bool:
        if self.helped < LEAST_HELPED:
            return False
        return self.nats_without_best > LEAST_NATS and _is_large(self.fit)


def common_cause(
    cases: Sequence[FrameReference], watch: ProgressCallback = no_progress
) -> tuple[RatedCause, list[RatedCause]] | None:
    """Return the likeliest cause and its rivals of other names; None without a fault.

    Of rivals, a calibration comes first: it is one or two numbers.
    """
    rated = rated_causes(cases, watch)
    if not rated or not rated[0].is_fault:
        return None
    likely = [cause for cause in rated if cause.nats > rated[0].nats - RIVAL_NATS]
    simple = [cause for cause in likely if cause.fit.cause in CALIBRATIONS]
    best = (simple or likely)[0]
    rivals = {cause.fit.cause.name: cause for cause in likely}
    del rivals[best.fit.cause.name]
    return best, list(rivals.values())


def rated_causes(
    cases: Sequence[FrameReference], watch: ProgressCallback = no_progress
) -> list[RatedCause]:
    """Return all causes, fitted, the likeliest first; none if the run has few pairs."""
    frames = FittedFrames(cases)
    if not frames.fitted:
        return []
    nothing = CauseFit.of(CALIBRATIONS[-1], frames, np.zeros(1))
    seen = watch([cases[row] for row in frames.fitted], "testing common causes", len(frames.fitted))
    images = [image_pose(case) for case in seen]
    offsets = [None if image is None else image.offset for image in images]
    fits = [_best_fit(cause, frames, offsets) for cause in (*MISALIGNMENTS, *CALIBRATIONS)]
    scale = min(fit.scale for fit in fits)
    pairs = max(fit.pairs for fit in fits)
    if pairs < NEEDED_PAIRS:
        return []
    rated = [_rated(fit, nothing, scale, pairs) for fit in fits]
    return sorted(rated, key=lambda cause: -cause.nats)


def _best_fit(
    cause: CommonCause, frames: FittedFrames, offsets: Sequence[FloatArray | None]
) -> CauseFit:
    """Fit a cause from the best of its starts; one is from the poses of single images."""
    starts = [np.concatenate([[start], np.zeros(cause.parameters - 1)]) for start in cause.starts]
    if cause.offset is not None:
        zero = np.zeros(cause.parameters)
        values = [
            np.asarray(np.linalg.pinv(cause.offset(frames, row, zero).by_value) @ offset)
            for row, offset in zip(frames.fitted, offsets, strict=True)
            if offset is not None
        ]
        starts += [np.median(values, axis=0)] if values else []
    costs = [CauseFit.of(cause, frames, start).total(1.0) for start in starts]
    return _fit(cause, frames, starts[int(np.argmin(costs))])


def _fit(cause: CommonCause, frames: FittedFrames, value: FloatArray) -> CauseFit:
    """Fit a cause by reweighted least squares, from parameters (p,)."""
    for scale in _SCALES:
        information, gradient = 1e-9 * np.eye(len(value)), np.zeros(len(value))
        for row in frames.fitted:
            rows = cause_rows(frames, row, cause, value)
            root = 1.0 / (1.0 + (rows.residual / scale) ** 2)  # root of the Geman-McClure weight
            A = root[:, None] * rows.jacobian
            information += A.T @ A
            gradient -= A.T @ (root * rows.residual)
        value = np.asarray(value + np.linalg.solve(information, gradient))
    return CauseFit.of(cause, frames, value)


def _rated(fit: CauseFit, nothing: CauseFit, scale: float, pairs: int) -> RatedCause:
    gains: dict[int, float] = defaultdict(float)
    by_frame: list[float] = []
    for rows, before, after in zip(fit.rows, nothing.costs(scale), fit.costs(scale), strict=True):
        by_frame.append(float((before - after).sum()))
        for element, gain in zip(rows.element.tolist(), (before - after).tolist(), strict=True):
            gains[element] += gain
    nats = sum(gains.values()) - 0.5 * fit.cause.parameters * float(np.log(pairs))
    changed = [gain for gain in by_frame if gain]
    helped = sum(gain > 0.0 for gain in changed) / max(len(changed), 1)
    without_best = nats - max(gains.values(), default=0.0)
    return RatedCause(fit, nats, without_best, helped)


def _is_large(fit: CauseFit) -> bool:
    cause = fit.cause
    if cause in CALIBRATIONS:
        return float(np.abs(fit.value).max()) * cause.in_unit > cause.least
    assert cause.offset is not None
    offsets = np.array([
        cause.offset(fit.frames, row, fit.value).T_true_reference.log()
        for row in fit.frames.fitted
    ])  # fmt: skip
    size_m, angle = np.linalg.norm(offsets[:, :3], axis=1), np.linalg.norm(offsets[:, 3:], axis=1)
    return bool(np.median(size_m) > LEAST_OFFSET_M or np.median(angle) > LEAST_OFFSET_RAD)
