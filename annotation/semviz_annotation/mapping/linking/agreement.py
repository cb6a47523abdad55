"""Whether what is seen of one thing may be another: the other's place tested by these sightings.

The sightings are linearized at the place of the other thing. That is good where the other is the
one whose place is known better; so the vaguer of two is always tested against the sharper.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.placing.placed import Placed
from semviz_annotation.mapping.placing.residuals import residuals
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray, IntArray

_UNEVEN = 0.5
"""Wrong poses move both ends of a pole alike, and each by this share of that by itself."""
_LEAST_M = 1e-4
"""No place is known better."""
AT_ONCE = 50_000
"""Sightings to be tested, so that memory does not grow with their number."""
_DIGITS = 1e-10
"""Of the largest information; less than that is rounding."""


class Agreement(NamedTuple):
    """Of p pairs."""

    chi2: FloatArray
    """(p,) how much worse sightings and place fit together than alone, squared and in multiples of
    sigma; infinite where the place is behind a camera."""
    freedom: IntArray
    """(p,) how many numbers both tell: the degrees of freedom of ``chi2`` if they are one thing."""
    log_likelihood: FloatArray
    """(p,) of the sightings given the place, up to what is the same for all places."""

    def where(self, rows: BoolArray) -> "Agreement":
        return Agreement(self.chi2[rows], self.freedom[rows], self.log_likelihood[rows])

    @classmethod
    def joined(cls, parts: Sequence["Agreement"]) -> "Agreement":
        """All of them, one after another."""
        nothing = np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0)
        return cls(*(np.concatenate(column) for column in zip(nothing, *parts, strict=False)))


@dataclass(frozen=True, eq=False)
class Places:
    """Where p things are, as ``Placed``."""

    ends_m: FloatArray
    """(p, 6) anchor and end; anything for points' ends"""
    covariance_m2: FloatArray
    """(p, 6, 6)"""
    known: BoolArray
    """(p, 2) anchor, end"""

    @classmethod
    def of(cls, placed: Placed) -> "Places":
        return cls(
            np.concatenate([placed.anchor_m, np.nan_to_num(placed.end_m)], axis=1),
            placed.covariance_m2.copy(),
            np.stack([placed.anchor_known, placed.end_known], axis=1),
        )

    def put(self, rows: IntArray, placed: Placed) -> None:
        """New places, of the things in rows (m,); those of ``placed`` that have one."""
        new, ok = Places.of(placed), placed.ok
        self.ends_m[rows[ok]] = new.ends_m[ok]
        self.covariance_m2[rows[ok]] = new.covariance_m2[ok]
        self.known[rows[ok]] = new.known[ok]

    def __getitem__(self, rows: IntArray) -> "Places":
        return Places(self.ends_m[rows], self.covariance_m2[rows], self.known[rows])


def agreement(
    views: Views, sightings: Sightings, places: Places, sigma_px: float, pose_sigma_m: float
) -> Agreement:
    """Thing i of ``sightings`` (p things) with place i. All poles, or all signs, or mixed.

    ``pose_sigma_m`` is by how much the poses may differ between views of one and of the other, in
    each direction.
    """
    known = places.known[sightings.thing]
    compared = replace(
        sightings,
        anchor_known=sightings.anchor_known & known[:, 0],
        end_known=sightings.end_known & known[:, 1],
    )
    at = residuals(views, compared, places.ends_m[:, :3], places.ends_m[:, 3:])
    J = at.J * at.counts[:, :, None] / sigma_px
    error = at.error_px / sigma_px
    total = sightings.per_thing
    information = total(np.add, J.transpose(0, 2, 1) @ J)
    gradient = total(np.add, np.einsum("kri,kr->ki", J, error))
    is_line = sightings.of(sightings.is_line)
    root = _root(places, is_line, pose_sigma_m)
    # in units of how well the place is known, so that nothing is singular
    values, axes = np.linalg.eigh(root.transpose(0, 2, 1) @ information @ root)
    pull = np.einsum("pia,pij,pj->pa", axes, root.transpose(0, 2, 1), gradient)
    told = values > _DIGITS * np.maximum(values[:, -1:], 1.0)
    safe = np.where(told, values, 1.0)
    chi2 = np.where(told, pull**2 / (safe * (1.0 + safe)), 0.0).sum(axis=1)
    spread = np.where(told, np.log1p(safe), 0.0).sum(axis=1)
    chi2[sightings.of(~at.ahead)] = np.inf
    return Agreement(chi2, _freedom(compared, is_line), -0.5 * (chi2 + spread))


def _root(places: Places, is_line: BoolArray, pose_sigma_m: float) -> FloatArray:
    """(p, 6, 6) roots of the covariances of places, wrong poses included; of points' ends, 1."""
    moved = np.tile(np.eye(3), (2, 2)) + _UNEVEN**2 * np.eye(6)
    covariance = places.covariance_m2 + pose_sigma_m**2 * moved
    covariance[~is_line, 3:] = covariance[~is_line, :, 3:] = 0.0
    covariance[~is_line, 3:, 3:] = np.eye(3)
    values, axes = np.linalg.eigh(covariance)  # of vague places, some are below 0 by rounding
    return np.asarray(axes * np.sqrt(np.maximum(values, _LEAST_M**2))[:, None])


def _freedom(sightings: Sightings, is_line: BoolArray) -> IntArray:
    """(p,) rank of what the sightings tell of a place."""
    views = np.minimum(sightings.seen, 2)
    ends = sightings.of(sightings.anchor_known).astype(np.int64) + sightings.of(sightings.end_known)
    return np.asarray(np.where(is_line, 2 * views + ends, np.minimum(2 * views, 3)))
