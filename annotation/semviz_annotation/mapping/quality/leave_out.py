"""How well each label agrees with the others of its element: the residual when it is left out.

A wrong click pulls its element towards itself, so its own residual hides it. Here each label is
predicted from its element as all other labels place it. That is one Newton step away from where
all labels place it (the deletion formulas of regression: Cook & Weisberg 1982, 2.2), so 100,000
labels are left out one by one in seconds.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from semviz_annotation.labels import Labels
from semviz_annotation.mapping.placing.least_squares import information
from semviz_annotation.mapping.placing.place import PlaceOptions, place
from semviz_annotation.mapping.placing.residuals import Residuals, residuals
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_annotation.mapping.quality.labelled import labelled
from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.source import Side, Source

_FEWEST = 3
"""Sightings of a thing, with fewer of which the others do not place it."""


@dataclass(frozen=True)
class LeftOut:
    """One observation against the place that all others of its element give."""

    observation_id: str
    element_id: int
    """In the map."""
    frame_index: int
    side: Side
    residual_px: float
    """How far off it is; of a pole, the end that is further off."""
    normalized: float
    """As rare as a standard normal number of this size, given how well both click and place are
    known: above 4, it is worth a look."""


@dataclass(frozen=True, eq=False)
class Deleted:
    """Of k sightings, each left out in turn; NaN where the others do not tell."""

    residual_px: FloatArray
    """(k,)"""
    normalized: FloatArray
    """(k,)"""


def leave_one_out(
    semantic_map: SemanticMap,
    labels: Labels,
    source: Source,
    frames: Collection[int] | None = None,
) -> tuple[LeftOut, ...]:
    """Every label of the map's elements in ``frames`` (None: all), the worst first.

    Elements with fewer than three labels say nothing, so they are not in it.
    """
    given = labelled(semantic_map, labels, source, frames)
    if given is None:
        return ()
    options, elements = PlaceOptions(), semantic_map.elements
    placed = place(given.views, given.sightings, options)
    ok = placed.ok[:, None]
    anchor_m = np.where(ok, placed.anchor_m, elements.anchor_m)
    end_m = np.where(ok, placed.end_m, elements.end_m)
    deleted = delete_each(given.views, given.sightings, anchor_m, end_m, options)
    known = np.flatnonzero(np.isfinite(deleted.normalized))
    result = []
    for row in known[np.argsort(-deleted.normalized[known], kind="stable")].tolist():
        one = given.observations[given.sightings.observation[row]]
        result.append(
            LeftOut(
                observation_id=one.id,
                element_id=int(semantic_map.elements.id[given.sightings.thing[row]]),
                frame_index=one.frame_index,
                side=one.side,
                residual_px=float(deleted.residual_px[row]),
                normalized=float(deleted.normalized[row]),
            )
        )
    return tuple(result)


def delete_each(
    views: Views,
    sightings: Sightings,
    anchor_m: FloatArray,
    end_m: FloatArray,
    options: PlaceOptions,
) -> Deleted:
    """Each of the k sightings, predicted from its thing as all others place it.

    The n things are at or near (n, 3) each, where all their sightings place them.
    """
    at = residuals(views, sightings, anchor_m, np.nan_to_num(end_m))
    rows = _told_by_others(sightings, at)
    error, covariance = _predicted(sightings, at, rows, options)
    chi2 = np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    told = rows.any(axis=1)
    residual_px = options.sigma_px * np.sqrt(_by_end(sightings, error**2).max(axis=1))
    normalized = _as_normal(chi2, np.maximum(rows.sum(axis=1), 1))
    return Deleted(np.where(told, residual_px, np.nan), np.where(told, normalized, np.nan))


def _told_by_others(sightings: Sightings, at: Residuals) -> BoolArray:
    """(k, 4) measurements of ``at`` that others predict: not an end that is seen here alone."""
    enough = at.ahead & (sightings.seen >= _FEWEST)[sightings.thing]
    rows = at.counts & enough[:, None]
    for row in (2, 3):
        showing = sightings.per_thing(np.add, rows[:, row].astype(float))
        rows[:, row] &= showing[sightings.thing] > 1.0
    return rows


def _predicted(
    sightings: Sightings, at: Residuals, rows: BoolArray, options: PlaceOptions
) -> tuple[FloatArray, FloatArray]:
    """(k, 4) errors in multiples of sigma, of each sighting from where the others have its thing.

    Beside them (k, 4, 4) their covariance; 1 for what is no measurement, with error 0.
    """
    error, J = at.error_px / options.sigma_px, at.J / options.sigma_px
    _, weight = at.robust(options.sigma_px, options.outlier_sigmas)
    weight[~at.ahead] = 0.0
    gradient = sightings.per_thing(np.add, _pulled(J, weight, error))
    of_all = information(sightings, at, weight, options.sigma_px)
    error, J = np.where(rows, error, 0.0), np.where(rows[:, :, None], J, 0.0)
    others = np.linalg.pinv(of_all[sightings.thing] - _squared(J, weight), hermitian=True)
    pull = gradient[sightings.thing] - _pulled(J, weight, error)
    moved = (J @ -others @ pull[:, :, None])[:, :, 0]
    return error + moved, J @ others @ J.transpose(0, 2, 1) + np.eye(4)


def _pulled(J: FloatArray, weight: FloatArray, error: FloatArray) -> FloatArray:
    """(k, 6) gradient of rows (k, 4, 6) with weights and errors (k, 4)."""
    return np.asarray(np.einsum("kri,kr->ki", J, weight * error))


def _squared(J: FloatArray, weight: FloatArray) -> FloatArray:
    """(k, 6, 6) information of rows (k, 4, 6) with weights (k, 4)."""
    return np.asarray(J.transpose(0, 2, 1) @ (weight[:, :, None] * J))


def _by_end(sightings: Sightings, squares: FloatArray) -> FloatArray:
    """(k, 2) squared distances at the anchor and at the end; for signs, in all and nothing."""
    anchor = np.where(sightings.is_line, squares[:, 0] + squares[:, 2], squares[:, :2].sum(axis=1))
    return np.stack([anchor, np.where(sightings.is_line, squares[:, 1] + squares[:, 3], 0.0)], 1)


def _as_normal(chi2: FloatArray, freedom: FloatArray) -> FloatArray:
    """(k,) chi-squared numbers as standard normal ones (Wilson & Hilferty 1931)."""
    spread = 2.0 / (9.0 * freedom)
    return np.asarray((np.cbrt(chi2 / freedom) - (1.0 - spread)) / np.sqrt(spread))
