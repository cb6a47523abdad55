"""Residual of each label against its element, triangulated without that label.

A wrong label pulls its element towards itself, so its own residual hides it. Here each label is
predicted from its element as all other labels determine it. That is one Newton step from the joint
solution (deletion formulas of regression: Cook and Weisberg 1982, 2.2), so 100,000 labels take
seconds.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_annotation.mapping.placement.reprojection import Residuals, information, residuals
from semviz_annotation.mapping.placement.triangulation import PlaceOptions, triangulate_landmarks
from semviz_annotation.mapping.quality.label_links import associate_labels
from semviz_core.base.frame import Dataset, Side
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray

_FEWEST = 3
"""Least number of observations per landmark; fewer do not determine it without one."""


@dataclass(frozen=True)
class LeftOut:
    """The residual of an observation against the position from all others of its element."""

    observation_id: str
    element_id: int
    """Id of the map element."""
    frame_index: int
    side: Side
    residual_px: float
    """Distance of a sign's centre, or of the farther end of a pole."""
    normalized: float
    """Standard normal quantile of the residual, given the uncertainty of label and position: check
    values above 4."""


@dataclass(frozen=True, eq=False)
class LeaveOneOutErrors:
    """Leave-one-out errors of k observations; NaN if the others do not predict one."""

    residual_px: FloatArray
    """(k,)"""
    normalized: FloatArray
    """(k,)"""


def leave_one_out(
    semantic_map: SemanticMap,
    labels: Labels,
    source: Dataset,
    frames: Collection[int] | None = None,
    sigma_ratio: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> tuple[LeftOut, ...]:
    """Return the residuals of all labels of map elements in ``frames`` (None: all), worst first.

    Elements with fewer than three labels are left out. ``sigma_ratio`` is that of
    ``collect_observations``.
    """
    linked = associate_labels(semantic_map, labels, source, frames, sigma_ratio)
    if linked is None:
        return ()
    options, elements = PlaceOptions(), semantic_map.elements
    placed = triangulate_landmarks(linked.views, linked.observations, options)
    ok = placed.ok[:, None]
    anchor_m = np.where(ok, placed.anchor_m, elements.anchor_m)
    end_m = np.where(ok, placed.end_m, elements.end_m)
    deleted = delete_each(linked.views, linked.observations, anchor_m, end_m, options)
    known = np.flatnonzero(np.isfinite(deleted.normalized))
    result = []
    for row in known[np.argsort(-deleted.normalized[known], kind="stable")].tolist():
        label = linked.label_rows[linked.observations.label_row[row]]
        result.append(
            LeftOut(
                observation_id=label.id,
                element_id=int(semantic_map.elements.id[linked.observations.landmark[row]]),
                frame_index=label.frame_index,
                side=label.side,
                residual_px=float(deleted.residual_px[row]),
                normalized=float(deleted.normalized[row]),
            )
        )
    return tuple(result)


def delete_each(
    views: ViewArray,
    observations: ObservationArray,
    anchor_m: FloatArray,
    end_m: FloatArray,
    options: PlaceOptions,
) -> LeaveOneOutErrors:
    """Return the errors of k observations, each predicted from all others of its landmark.

    The n landmarks are at or near (n, 3) each, as determined by all observations.
    """
    at = residuals(views, observations, anchor_m, np.nan_to_num(end_m))
    rows = _predictable_rows(observations, at)
    error, covariance = _predicted(observations, at, rows, options)
    chi2 = np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    predicted = rows.any(axis=1)
    residual_px = options.sigma_px * np.sqrt(
        _by_end(observations, (error * at.sigma_ratio) ** 2).max(axis=1)
    )
    normalized = _as_normal(chi2, np.maximum(rows.sum(axis=1), 1))
    return LeaveOneOutErrors(
        np.where(predicted, residual_px, np.nan), np.where(predicted, normalized, np.nan)
    )


def _predictable_rows(observations: ObservationArray, at: Residuals) -> BoolArray:
    """Return which measurements (k, 4) other observations predict: not an end seen only once."""
    enough = at.ahead & (observations.seen >= _FEWEST)[observations.landmark]
    rows = at.counts & enough[:, None]
    for row in (2, 3):
        showing = observations.per_landmark(np.add, rows[:, row].astype(float))
        rows[:, row] &= showing[observations.landmark] > 1.0
    return rows


def _predicted(
    observations: ObservationArray, at: Residuals, rows: BoolArray, options: PlaceOptions
) -> tuple[FloatArray, FloatArray]:
    """Return leave-one-out errors (k, 4) in multiples of sigma, and their covariance (k, 4, 4).

    Rows that are no measurement have error 0 and variance 1.
    """
    error, J = at.error_px / options.sigma_px, at.J / options.sigma_px
    _, weight = at.robust(options.sigma_px, options.outlier_sigmas)
    weight[~at.ahead] = 0.0
    gradient = observations.per_landmark(np.add, _gradient(J, weight, error))
    of_all = information(observations, at, weight, options.sigma_px)
    error, J = np.where(rows, error, 0.0), np.where(rows[:, :, None], J, 0.0)
    covariance_of_others = np.linalg.pinv(
        of_all[observations.landmark] - _information(J, weight), hermitian=True
    )
    pull = gradient[observations.landmark] - _gradient(J, weight, error)
    moved = (J @ -covariance_of_others @ pull[:, :, None])[:, :, 0]
    return error + moved, J @ covariance_of_others @ J.transpose(0, 2, 1) + np.eye(4)


def _gradient(J: FloatArray, weight: FloatArray, error: FloatArray) -> FloatArray:
    """Return the gradient (k, 6) of rows (k, 4, 6) with weights and errors (k, 4)."""
    return np.asarray(np.einsum("kri,kr->ki", J, weight * error))


def _information(J: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the information (k, 6, 6) of rows (k, 4, 6) with weights (k, 4)."""
    return np.asarray(J.transpose(0, 2, 1) @ (weight[:, :, None] * J))


def _by_end(observations: ObservationArray, squares: FloatArray) -> FloatArray:
    """Return squared distances (k, 2) at anchor and end; of signs, the whole and 0."""
    anchor = np.where(
        observations.is_line, squares[:, 0] + squares[:, 2], squares[:, :2].sum(axis=1)
    )
    return np.stack([anchor, np.where(observations.is_line, squares[:, 1] + squares[:, 3], 0.0)], 1)


def _as_normal(chi2: FloatArray, freedom: FloatArray) -> FloatArray:
    """Return chi-squared values (k,) as standard normal ones (Wilson & Hilferty 1931)."""
    spread = 2.0 / (9.0 * freedom)
    return np.asarray((np.cbrt(chi2 / freedom) - (1.0 - spread)) / np.sqrt(spread))
