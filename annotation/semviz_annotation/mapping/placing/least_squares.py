"""The places of least reprojection error near given ones, of many things at once."""

from dataclasses import dataclass

import numpy as np

from semviz_annotation.mapping.placing.linear import MIN_ANGLE_RAD, beyond_horizon
from semviz_annotation.mapping.placing.residuals import Residuals, residuals
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.errors import SemvizError

_STEPS = 100
_DONE = 1e-8
"""Settled when a step promises less than this, as a squared multiple of sigma."""


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
        for name in ("sigma_px", "outlier_sigmas"):
            if not getattr(self, name) > 0.0:
                raise SemvizError(f"{name} must be positive, not {getattr(self, name)}")
        if not self.min_angle_rad >= 0.0:
            raise SemvizError(f"min_angle_rad must not be negative, but is {self.min_angle_rad}")


@dataclass(frozen=True, eq=False)
class _Normal:
    """The normal equations of n things at a place, in multiples of sigma."""

    cost: FloatArray
    """(n,) robust"""
    gradient: FloatArray
    """(n, 6)"""
    information: FloatArray
    """(n, 6, 6) as ``information`` says"""

    def chosen(self, things: BoolArray) -> "_Normal":
        return _Normal(self.cost[things], self.gradient[things], self.information[things])

    def put(self, things: BoolArray, others: "_Normal") -> None:
        """Those with True in things (n,) from ``others`` (n)."""
        self.cost[things] = others.cost[things]
        self.gradient[things] = others.gradient[things]
        self.information[things] = others.information[things]


def settled(
    views: Views, sightings: Sightings, X: FloatArray, where: BoolArray, options: PlaceOptions
) -> tuple[FloatArray, FloatArray]:
    """The best places (n, 6: anchor and end) near X, of things with True in where (n,), and their
    robust cost (n,), infinite where there is none.

    Levenberg-Marquardt (Madsen, Nielsen & Tingleff 2004, 3.2), each thing with its own damping.
    """
    X, cost = np.where(where[:, None], X, 0.0), np.full(len(X), np.inf)
    busy, things = np.flatnonzero(where), sightings.only(where)
    sightings = things
    damping = np.full(len(busy), 1e-4)
    here = _normal(views, sightings, X[busy], options)
    for _ in range(_STEPS):
        if not len(busy):
            break
        damped = here.information * (1.0 + damping[:, None, None] * np.eye(6))
        step = -np.linalg.solve(damped, here.gradient[:, :, None])[:, :, 0]
        promised = -(here.gradient * step).sum(axis=1)
        there = _normal(views, sightings, X[busy] + step, options)
        better = there.cost <= here.cost
        here.put(better, there)
        X[busy[better]] += step[better]
        damping = np.clip(damping * np.where(better, 0.1, 10.0), 1e-9, 1e9)
        done = promised < _DONE
        cost[busy[done]] = here.cost[done]
        sightings, here = sightings.only(~done), here.chosen(~done)
        busy, damping = busy[~done], damping[~done]
    anchor, is_line = X[where, :3], things.of(things.is_line)
    end = np.where(is_line[:, None], X[where, 3:], anchor)
    cost[where] = np.where(beyond_horizon(views, things, anchor, end), np.inf, cost[where])
    return X, cost


def information(
    sightings: Sightings, at: Residuals, weights: FloatArray, sigma_px: float
) -> FloatArray:
    """(n, 6, 6) of all rows with weights (k, 4); of points, 1 on the diagonal of the end that they
    don't have."""
    weighted = weights[:, :, None] * at.J / sigma_px**2
    total = sightings.per_thing(np.add, weighted.transpose(0, 2, 1) @ at.J)
    total[~sightings.of(sightings.is_line), 3:, 3:] = np.eye(3)
    return total


def _normal(views: Views, sightings: Sightings, X: FloatArray, options: PlaceOptions) -> _Normal:
    at = residuals(views, sightings, X[:, :3], X[:, 3:])
    cost, weights = at.robust(options.sigma_px, options.outlier_sigmas)
    pull = (at.J.transpose(0, 2, 1) @ (weights * at.error_px)[:, :, None])[:, :, 0]
    return _Normal(
        cost=sightings.per_thing(np.add, cost),
        gradient=sightings.per_thing(np.add, pull) / options.sigma_px**2,
        information=information(sightings, at, weights, options.sigma_px),
    )
