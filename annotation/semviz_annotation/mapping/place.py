"""All things placed at once: the places with the least reprojection error over all their views.

The linear start is improved by Levenberg-Marquardt on each thing, in steps of all things together.
A misplaced click loses its say the further off it is (Cauchy's loss).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.mapping.linear import (
    MIN_ANGLE_RAD,
    Start,
    along_lines,
    end_rays,
    linear_start,
    outermost,
)
from semviz_annotation.mapping.residuals import Residuals, residuals
from semviz_annotation.mapping.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.errors import SemvizError

_KINDS = [0, 0, 1, 2]
"""Which of ``Residuals.squared_px2`` each row belongs to."""
_STEPS = 40
_DONE = 1e-10
"""Converged when a step promises less than this, as a squared multiple of ``sigma_px``."""
_MISFIT = 5.0
"""Things are not placed where half of their sightings are further off, in multiples of sigma."""


@dataclass(frozen=True)
class PlaceOptions:
    """How things are placed."""

    sigma_px: float = 1.0
    """Standard deviation of an end in each direction."""
    min_angle_rad: float = MIN_ANGLE_RAD
    """Things whose rays or planes are all nearer to parallel have no place."""
    outlier_sigmas: float = 3.0
    """From about here on an error counts less than its square; infinite: never."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise SemvizError(f"{name} must be positive, not {value}")


@dataclass(frozen=True, eq=False)
class Placed:
    """n things in the map frame, as ``Elements3D``; NaN and zero where there is a failure."""

    anchor_m: FloatArray
    """(n, 3)"""
    end_m: FloatArray
    """(n, 3), NaN for points"""
    covariance_m2: FloatArray
    """(n, 6, 6) of (anchor, end), to first order, the poses taken as exact; zero in the rows of a
    point's end. An end that nobody saw is held along the line as if one view had shown it."""
    anchor_known: BoolArray
    """(n,)"""
    end_known: BoolArray
    """(n,)"""
    failure: NDArray[np.object_]
    """(n,) str: why there is no place, for people; empty where there is one."""
    too_narrow: BoolArray
    """(n,) The rays are sound but nearly parallel: views from elsewhere can help."""
    angle_rad: FloatArray
    """(n,) widest angle between two of the rays (signs) or planes (poles), or nearly."""
    rms_px: FloatArray
    """(n,) reprojection error: of a point, or of a pole's ends across its line."""
    chi2: FloatArray
    """(n,) sum of the squared residuals in multiples of sigma, outliers too."""
    rows: IntArray
    """(n,) number of these residuals."""
    parameters: IntArray
    """(n,) number of unknowns that they tell: 3 of a point, 4 of a line and 1 for each known end.
    ``rows - parameters`` are the degrees of freedom."""
    chi2_of: FloatArray
    """(k,) share of each sighting in ``chi2``; NaN for those of things without a place."""

    @property
    def ok(self) -> BoolArray:
        """(n,) True where there is a place."""
        return np.asarray(self.failure == "")


def place(views: Views, sightings: Sightings, options: PlaceOptions = PlaceOptions()) -> Placed:
    """The things of ``sightings`` from all their views."""
    start = linear_start(views, sightings, options.min_angle_rad)
    good = start.failure == ""
    chosen = sightings.only(good)
    X, settled = _settled(views, chosen, _as_rows(start, good), options)
    X = _stretched(views, chosen, X, options)
    is_line = chosen.of(chosen.is_line)[:, None]
    start.anchor_m[good] = X[:, :3]
    start.end_m[good] = np.where(is_line, X[:, 3:], np.nan)
    start.failure[good] = _misfits(views, chosen, X, settled, options)
    return _measured(views, sightings, start, options)


def place_linearly(
    views: Views, sightings: Sightings, options: PlaceOptions = PlaceOptions()
) -> Placed:
    """As ``place``, but from the rays and planes alone, whatever the fit: the paper's way."""
    start = linear_start(views, sightings, options.min_angle_rad)
    return _measured(views, sightings, start, replace(options, outlier_sigmas=np.inf))


def robust(squares: FloatArray, outlier_sigmas: float) -> tuple[FloatArray, FloatArray]:
    """Cost (k,) and weights (k, 4: of ``Residuals``' rows) of squared errors (k, 3): Cauchy's."""
    if np.isinf(outlier_sigmas):
        return squares.sum(axis=1), np.ones((len(squares), 4))
    scaled = squares / outlier_sigmas**2
    cost = outlier_sigmas**2 * np.log1p(scaled).sum(axis=1)
    return cost, 1.0 / (1.0 + scaled[:, _KINDS])


# -- the least reprojection error


@dataclass(frozen=True, eq=False)
class _Normal:
    """The normal equations of each thing at a place, in multiples of sigma."""

    cost: FloatArray
    """(n,) robust; infinite where a thing is behind a camera that saw it"""
    gradient: FloatArray
    """(n, 6)"""
    information: FloatArray
    """(n, 6, 6) as ``_filled``"""

    def chosen(self, things: BoolArray) -> "_Normal":
        return _Normal(self.cost[things], self.gradient[things], self.information[things])

    def put(self, things: BoolArray, others: "_Normal") -> None:
        """Those with True in things (n,) from ``others`` (n)."""
        self.cost[things] = others.cost[things]
        self.gradient[things] = others.gradient[things]
        self.information[things] = others.information[things]


def _normal(views: Views, sightings: Sightings, X: FloatArray, options: PlaceOptions) -> _Normal:
    at = residuals(views, sightings, X[:, :3], X[:, 3:])
    cost, weight = robust(at.squared_px2() / options.sigma_px**2, options.outlier_sigmas)
    cost[~at.ahead] = np.inf
    weighted = weight[:, :, None] * at.J / options.sigma_px**2
    return _Normal(
        cost=sightings.per_thing(np.add, cost),
        gradient=sightings.per_thing(np.add, np.einsum("kri,kr->ki", weighted, at.error_px)),
        information=_filled(sightings, weighted.transpose(0, 2, 1) @ at.J),
    )


def _filled(sightings: Sightings, information: FloatArray) -> FloatArray:
    """(n, 6, 6) sums of (k, 6, 6), with 1 on the diagonal of the ends that points don't have."""
    total = sightings.per_thing(np.add, information)
    points = ~sightings.of(sightings.is_line)
    total[points, 3:, 3:] = np.eye(3)
    return total


def _settled(
    views: Views, sightings: Sightings, X: FloatArray, options: PlaceOptions
) -> tuple[FloatArray, BoolArray]:
    """(n, 6) the best places near X, and (n,) whether they are found.

    Levenberg-Marquardt (Madsen, Nielsen & Tingleff 2004, 3.2), each thing with its own damping.
    """
    X = X.copy()
    damping = np.full(len(X), 1e-4)
    busy = np.arange(len(X))
    here = _normal(views, sightings, X, options)
    for _ in range(_STEPS):
        damped = here.information * (1.0 + damping[busy, None, None] * np.eye(6))
        step = -np.linalg.solve(damped, here.gradient[:, :, None])[:, :, 0]
        promised = -(here.gradient * step).sum(axis=1)
        there = _normal(views, sightings, X[busy] + step, options)
        better = there.cost <= here.cost
        here.put(better, there)
        X[busy[better]] += step[better]
        damping[busy] = np.clip(damping[busy] * np.where(better, 0.1, 10.0), 1e-9, 1e9)
        goes_on = ~(promised < _DONE)
        sightings, here, busy = sightings.only(goes_on), here.chosen(goes_on), busy[goes_on]
        if not len(busy):
            break
    return X, ~np.isin(np.arange(len(X)), busy)


def _stretched(
    views: Views, sightings: Sightings, X: FloatArray, options: PlaceOptions
) -> FloatArray:
    """X (n, 6) with the ends that nobody saw at the furthest point of the line that anybody saw.

    Sightings that lie beside the line say nothing about its length, unless all do.
    """
    lines = sightings.of(sightings.is_line)
    poles = sightings.only(lines)
    anchor, end = X[lines, :3], X[lines, 3:]
    unseen = [~poles.of(known)[:, None] for known in (poles.anchor_known, poles.end_known)]
    at = residuals(views, poles, anchor, end)
    on_line = at.squared_px2()[:, 0] <= (options.outlier_sigmas * options.sigma_px) ** 2
    poles = poles.where(on_line | ~poles.of(on_line)[poles.thing])
    direction = (end - anchor) / np.linalg.norm(end - anchor, axis=1, keepdims=True)
    along = along_lines(views, poles, end_rays(views, poles), anchor, direction)
    first, last = outermost(poles, along)
    X = X.copy()
    X[lines, :3] = np.where(unseen[0], anchor + first[:, None] * direction, anchor)
    X[lines, 3:] = np.where(unseen[1], anchor + last[:, None] * direction, end)
    return X


# -- what is known of the places


def _as_rows(start: Start, things: BoolArray) -> FloatArray:
    """(m, 6) of the things with True in (n,); zero for points' ends."""
    return np.concatenate([start.anchor_m, np.nan_to_num(start.end_m)], axis=1)[things]


def _misfits(
    views: Views,
    sightings: Sightings,
    X: FloatArray,
    settled: BoolArray,
    options: PlaceOptions,
) -> NDArray[np.object_]:
    """(n,) why things at X (n, 6) are refused though they have a place, or nothing."""
    at = residuals(views, sightings, X[:, :3], X[:, 3:])
    off = (at.error_px**2).sum(axis=1) / at.counts.sum(axis=1)
    far_off = off > (_MISFIT * options.sigma_px) ** 2
    refused = 2.0 * sightings.per_thing(np.add, far_off.astype(float)) >= sightings.seen
    words = np.full(len(X), "", dtype=object)
    for thing in np.flatnonzero(refused):
        words[thing] = (
            f"the views disagree by {_rms_px(sightings, at)[thing]:.1f} px: "
            "are these different things?"
        )
    words[~settled] = "the views do not agree on a place: are these different things?"
    return words


def _measured(views: Views, sightings: Sightings, start: Start, options: PlaceOptions) -> Placed:
    """The places of ``start`` with how certain they are and how well they fit."""
    good = start.failure == ""
    for ends in (start.anchor_m, start.end_m):
        ends[~good] = np.nan
    chosen, X = sightings.only(good), _as_rows(start, good)
    at = residuals(views, chosen, X[:, :3], X[:, 3:])
    chi2_of = (at.error_px**2).sum(axis=1) / options.sigma_px**2
    known = sightings.of(sightings.anchor_known), sightings.of(sightings.end_known)
    is_line = sightings.of(sightings.is_line)
    return Placed(
        anchor_m=start.anchor_m,
        end_m=start.end_m,
        covariance_m2=spread(good, _covariance(chosen, at, options)),
        anchor_known=known[0] & good,
        end_known=known[1] & good,
        failure=start.failure,
        too_narrow=start.too_narrow,
        angle_rad=start.angle_rad,
        rms_px=spread(good, _rms_px(chosen, at)),
        chi2=spread(good, chosen.per_thing(np.add, chi2_of)),
        rows=spread(good, chosen.per_thing(np.add, at.counts.sum(axis=1))),
        parameters=np.where(is_line, 4 + known[0].astype(int) + known[1], 3),
        chi2_of=spread(good[sightings.thing], chi2_of, np.nan),
    )


def _covariance(sightings: Sightings, at: Residuals, options: PlaceOptions) -> FloatArray:
    """(n, 6, 6) inverse of the information of all rows; outliers have less."""
    squares = at.squared_px2() / options.sigma_px**2
    _, weight = robust(squares, options.outlier_sigmas)
    weight[(squares <= options.outlier_sigmas**2)[:, _KINDS]] = 1.0
    weighted = weight[:, :, None] * at.J / options.sigma_px**2
    covariance = np.linalg.inv(_filled(sightings, weighted.transpose(0, 2, 1) @ at.J))
    covariance[~sightings.of(sightings.is_line), 3:, 3:] = 0.0
    return covariance


def _rms_px(sightings: Sightings, at: Residuals) -> FloatArray:
    """(n,) of the clicks' distances from points, or of the ends' from lines."""
    squares = sightings.per_thing(np.add, at.squared_px2()[:, 0])
    values = sightings.per_thing(np.add, 1.0 + sightings.is_line)
    return np.sqrt(squares / values)


def spread(things: BoolArray, values: NDArray[Any], elsewhere: float = 0) -> NDArray[Any]:
    """(n, ...) with values (m, ...) where things (n,) is True."""
    result = np.full((len(things), *values.shape[1:]), elsewhere, dtype=values.dtype)
    result[things] = values
    return result
