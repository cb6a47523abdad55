"""Find what all position priors of a run have in common, against the poses that its images support.

Without true poses, priors are the only other source. A shifted map (or fixes in another datum), a
mounting that differs from the extrinsic, and a time offset each leave a pattern in the innovations
of many frames that is too small for one. Only the pattern counts: an error that stays the same
for a whole drive is what a fix may have within its stated sigma.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from semviz_core.common.arrays import FloatArray, IntArray, unit_vectors
from semviz_core.diagnosis.assumptions import POSITION, solve_with_prior
from semviz_core.diagnosis.cause_fits import (
    LEAST_NATS,
    LEAST_OFFSET_M,
    MEDIAN_OF_NORMAL,
    RIVAL_NATS,
)
from semviz_core.diagnosis.common_causes import ELSEWHERE, OTHER_TIMES, SHIFTED
from semviz_core.diagnosis.fault import FaultKind
from semviz_core.diagnosis.reference import FrameReference, ProgressCallback, no_progress

NEEDED_FRAMES = 8
MOST_STEP = 3
"""Frames between two poses that still give a velocity."""
OWN_SHARE = 0.5
"""If the innovations vary with less than this share of the stated variance, the rest may be one
error for the whole run."""
OUTLIER_SIGMAS, ITERATIONS = 3.0, 5
LEAST_SIGMA_M = 0.02
"""Accuracy of the poses of images, at best."""
MOST_ALIKE = 0.98
"""Largest correlation of successive errors that can be told from one error for the whole run."""


@dataclass(frozen=True, eq=False)
class _Innovations:
    """The position priors of n frames less the camera centres of their images, horizontally."""

    row: IntArray
    """(n,) positions in the run."""
    offset_m: FloatArray
    """(n, 2) in the map's axes."""
    ahead: FloatArray
    """(n, 2) unit, where the camera looks."""
    step_m: FloatArray
    """(n, 2) motion per frame."""
    stated_m: float
    """Median stated sigma."""

    @cached_property
    def shift(self) -> FloatArray:
        """(2n, 2) columns of a shift in the map's axes."""
        return np.tile(np.eye(2), (len(self.row), 1))

    @cached_property
    def mounting(self) -> FloatArray:
        """(2n, 2) columns of a shift ahead and to the left."""
        left = np.column_stack([-self.ahead[:, 1], self.ahead[:, 0]])
        return np.stack([self.ahead, left], axis=2).reshape(-1, 2)


@dataclass(frozen=True)
class _Pattern:
    kind: FaultKind
    name: str
    columns: Callable[[_Innovations], FloatArray]
    """(2n, p)"""


PATTERNS = (
    _Pattern("time offset", OTHER_TIMES, lambda seen: -seen.step_m.reshape(-1, 1)),
    _Pattern("wrong extrinsic", ELSEWHERE, lambda seen: seen.mounting),
    _Pattern("misaligned map", SHIFTED, lambda seen: seen.shift),
)
"""Those with fewer parameters first."""


@dataclass(frozen=True, eq=False)
class PriorOffset:
    """A pattern with its likeliest parameters."""

    pattern: _Pattern
    value: FloatArray
    """(p,)"""
    offset_m: FloatArray
    """(n, 2) of the priors of the frames that it was fitted to."""
    row: IntArray
    """(n,) positions of these frames in the run."""
    nats: float
    """Log-likelihood above that without it, less half of p log n (BIC)."""

    @property
    def size_m(self) -> float:
        return float(np.median(np.linalg.norm(self.offset_m, axis=1)))


def solved_without_fixes(
    cases: Sequence[FrameReference], watch: ProgressCallback = no_progress
) -> list[FrameReference]:
    """Return all frames, those that are not ok solved far around their priors.

    Priors that are off by more than they state leave most frames without a pose.
    """
    watched = watch(cases, "solving with vague positions", len(cases))
    return [case if case.localization.status == "ok" else _solved_widely(case) for case in watched]


def _solved_widely(case: FrameReference) -> FrameReference:
    if case.localization.prior is None:
        return case
    (vague,) = POSITION.without(case.prior)
    found = replace(solve_with_prior(case, vague), prior=case.prior)
    return replace(case, localization=found)


def prior_offsets(cases: Sequence[FrameReference]) -> tuple[PriorOffset, ...]:
    """Return the likely patterns of the priors, that with the fewest parameters first.

    None without a fault. Frames count if they are ok, have a prior, and have others before and
    after.
    """
    seen = _innovations(cases)
    if seen is None:
        return ()
    found = _fitted(seen)
    best = max(found, key=lambda offset: offset.nats)
    if best.nats < LEAST_NATS or best.size_m < LEAST_OFFSET_M:
        return ()
    return tuple(offset for offset in found if offset.nats > best.nats - RIVAL_NATS)


def without_offset(cases: Sequence[FrameReference], offset: PriorOffset) -> list[FrameReference]:
    """Return all frames with their priors corrected; between the fitted ones, interpolated."""
    rows = np.arange(len(cases))
    by_m = [np.interp(rows, offset.row, offset.offset_m[:, axis]) for axis in range(2)]
    shift_m = np.column_stack([*by_m, np.zeros(len(cases))])
    return [_moved(case, -shift_m[row]) for row, case in enumerate(cases)]


def _moved(case: FrameReference, by_m: FloatArray) -> FrameReference:
    prior = case.localization.prior
    if prior is None:
        return case
    prior = replace(prior, position_m=prior.position_m + by_m)
    return replace(case, localization=replace(case.localization, prior=prior))


def _innovations(cases: Sequence[FrameReference]) -> _Innovations | None:
    known = {row: case.reference for row, case in enumerate(cases) if _counts(case)}
    poses = [pose.inverse() for pose in known.values() if pose is not None]
    rows = np.array(list(known), dtype=np.int64)
    if len(rows) < NEEDED_FRAMES:
        return None
    center_m = np.array([pose.translation[:2] for pose in poses])
    near = np.concatenate([[False], (np.diff(rows) <= MOST_STEP), [False]])
    moving = near[:-1] & near[1:]
    if moving.sum() < NEEDED_FRAMES:
        return None
    ahead = np.array([pose.rotation[:2, 2] for pose in poses])
    position_m = np.array([cases[row].prior.position_m[:2] for row in rows])
    return _Innovations(
        rows[moving],
        (position_m - center_m)[moving],
        (unit_vectors(ahead))[moving],
        np.gradient(center_m, rows, axis=0)[moving],
        float(np.median([cases[row].prior.horizontal_sigma_m for row in rows])),
    )


def _counts(case: FrameReference) -> bool:
    return case.localization.status == "ok" and case.localization.prior is not None


@dataclass(frozen=True)
class _Noise:
    """How position priors err beside a pattern."""

    sigma_m: float
    """From frame to frame."""
    drive_m: float
    """Sigma of an error that all frames share."""
    independent: float
    """Independent frames over all: successive errors are alike."""


def _fitted(seen: _Innovations) -> list[PriorOffset]:
    """Fit each pattern."""
    noise = _noise(seen)
    nothing, _ = _fit(seen, np.empty((2 * len(seen.row), 0)), noise)
    offsets = []
    for pattern in PATTERNS:
        columns = pattern.columns(seen)
        cost, value = _fit(seen, columns, noise)
        penalty = 0.5 * len(value) * np.log(len(seen.row) * noise.independent + 1.0)
        offset_m = (columns @ value).reshape(-1, 2)
        offsets.append(
            PriorOffset(pattern, value, offset_m, seen.row, float(nothing - cost - penalty))
        )
    return offsets


def _noise(seen: _Innovations) -> _Noise:
    """Return the noise that remains with all patterns together."""
    columns = np.concatenate([pattern.columns(seen) for pattern in PATTERNS], axis=1)
    first = _Noise(seen.stated_m, 0.0, 1.0)
    _, value = _fit(seen, columns, first)
    residual = (seen.offset_m.ravel() - columns @ value).reshape(-1, 2)
    sigma_m = max(float(np.median(np.abs(residual))) / MEDIAN_OF_NORMAL, LEAST_SIGMA_M)
    clipped = np.clip(residual, -OUTLIER_SIGMAS * sigma_m, OUTLIER_SIGMAS * sigma_m)
    alike = float((clipped[1:] * clipped[:-1]).sum() / max((clipped**2).sum(), 1e-12))
    rest = seen.stated_m**2 - sigma_m**2 if sigma_m**2 < OWN_SHARE * seen.stated_m**2 else 0.0
    alike = float(np.clip(alike, 0.0, MOST_ALIKE))
    return _Noise(sigma_m, float(np.sqrt(rest)), (1.0 - alike) / (1.0 + alike))


def _fit(seen: _Innovations, columns: FloatArray, noise: _Noise) -> tuple[float, FloatArray]:
    """Fit columns (2n, p) beside the error that all frames share, with outliers down-weighted.

    Return the cost in nats and the parameters (p,).
    """
    design = np.concatenate([columns, seen.shift], axis=1)
    shared = np.full(2, 1.0 / max(noise.drive_m, 1e-6) ** 2)
    precision = np.diag(np.concatenate([np.full(columns.shape[1], 1e-9), shared]))
    offset = seen.offset_m.ravel()
    value: FloatArray = np.zeros(design.shape[1])
    share = noise.independent / noise.sigma_m**2
    for _ in range(ITERATIONS):
        sigmas = (offset - design @ value) / noise.sigma_m
        weighted = design * (share / (1.0 + (sigmas / OUTLIER_SIGMAS) ** 2))[:, None]
        value = np.asarray(np.linalg.solve(design.T @ weighted + precision, weighted.T @ offset))
    sigmas = (offset - design @ value) / noise.sigma_m
    robust = 0.5 * OUTLIER_SIGMAS**2 * np.log1p((sigmas / OUTLIER_SIGMAS) ** 2)  # Cauchy
    cost = noise.independent * float(robust.sum()) + 0.5 * float(value @ precision @ value)
    return cost, value[: columns.shape[1]]
