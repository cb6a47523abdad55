"""Landmarks in the map frame, with the covariance and fit of their positions.

A landmark with a failure has no position: NaN and zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.mapping.placement import reprojection
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

_LEAST_HEIGHT_M = 0.5
"""Of a pole, for its lean."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """n landmarks in the map frame, as in ``Elements3D``; NaN and zero if there is a failure."""

    anchor_m: FloatArray
    """(n, 3)"""
    end_m: FloatArray
    """(n, 3), NaN for points"""
    covariance_m2: FloatArray
    """(n, 6, 6) of (anchor, end), to first order, with exact poses; zero in the rows of a point's
    end. An end that nobody saw has the covariance along the line as if one view had shown it."""
    anchor_known: BoolArray
    """(n,)"""
    end_known: BoolArray
    """(n,)"""
    failure: NDArray[np.object_]
    """(n,) str: why there is no position; empty if there is one"""
    too_narrow: BoolArray
    """(n,) whether the rays are sound but nearly parallel: views from elsewhere can help"""
    angle_rad: FloatArray
    """(n,) approximate largest angle between two of the rays (signs) or planes (poles)"""
    rms_px: FloatArray
    """(n,) RMS reprojection error: of a point, or of a pole's ends across its line"""
    chi2: FloatArray
    """(n,) sum of the squared residuals in multiples of sigma, including outliers"""
    rows: IntArray
    """(n,) number of these residuals"""
    parameters: IntArray
    """(n,) number of estimated parameters: 3 of a point, 4 of a line and 1 for each known end.
    ``rows - parameters`` are the degrees of freedom."""
    chi2_of: FloatArray
    """(k,) share of each observation in ``chi2``: infinite if the landmark is behind the camera,
    NaN if it has no position"""

    @classmethod
    def joined(cls, parts: Sequence["Landmarks"]) -> "Landmarks":
        """Concatenate landmarks."""
        return cls(
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls))
        )

    @property
    def ok(self) -> BoolArray:
        """(n,) whether there is a position."""
        return np.asarray(self.failure == "")

    @property
    def anchor_and_end_m(self) -> FloatArray:
        """(n, 6) anchor and end; zero for the ends of points and without a position."""
        places = np.concatenate([self.anchor_m, self.end_m], axis=1)
        return np.asarray(np.nan_to_num(places))


def measure_landmarks(
    views: ViewArray,
    observations: ObservationArray,
    X: FloatArray,
    failure: NDArray[np.object_],
    too_narrow: BoolArray,
    angle_rad: FloatArray,
    options: reprojection.PlaceOptions,
) -> Landmarks:
    """Return landmarks at X (n, 6: anchor and end) with covariance and fit; those with a
    ``failure`` have no position."""
    ok = failure == ""
    placed_X, chosen = X[ok], observations.only(ok)
    at = reprojection.residuals(views, chosen, placed_X[:, :3], placed_X[:, 3:])
    chi2_of = (at.error_px**2).sum(axis=1) / options.sigma_px**2
    chi2_of[~at.ahead] = np.inf
    is_line = observations.of(observations.is_line)
    known = observations.of(observations.anchor_known), observations.of(observations.end_known)
    return Landmarks(
        anchor_m=spread(ok, placed_X[:, :3], np.nan),
        end_m=np.where(is_line[:, None], spread(ok, placed_X[:, 3:], np.nan), np.nan),
        covariance_m2=spread(ok, _covariance(chosen, at, options)),
        anchor_known=known[0] & ok,
        end_known=known[1] & ok,
        failure=failure,
        too_narrow=too_narrow,
        angle_rad=angle_rad,
        rms_px=spread(ok, rms_px(chosen, at)),
        chi2=spread(ok, chosen.per_landmark(np.add, chi2_of)),
        rows=spread(ok, chosen.per_landmark(np.add, at.counts.sum(axis=1))),
        parameters=np.where(is_line, 4 + known[0].astype(np.int64) + known[1], 3),
        chi2_of=spread(ok[observations.landmark], chi2_of, np.nan),
    )


def _covariance(
    observations: ObservationArray, at: reprojection.Residuals, options: reprojection.PlaceOptions
) -> FloatArray:
    """Return covariances (n, 6, 6): the inverse information of all rows, reduced for outliers."""
    weights = at.trust(options.sigma_px, options.outlier_sigmas)
    covariance = np.linalg.inv(
        reprojection.information(observations, at, weights, options.sigma_px)
    )
    covariance[~observations.of(observations.is_line), 3:, 3:] = 0.0
    return np.asarray(covariance)


def replaced(
    placed: Landmarks, observations: ObservationArray, landmarks: BoolArray, others: Landmarks
) -> Landmarks:
    """Return ``placed`` with the landmarks (n,) replaced by ``others``; ``observations`` are of all
    n."""

    def put(name: str) -> Any:
        values = getattr(placed, name).copy()
        rows = landmarks[observations.landmark] if name == "chi2_of" else landmarks
        values[rows] = getattr(others, name)
        return values

    return Landmarks(**{field.name: put(field.name) for field in fields(Landmarks)})


def uprighted(placed: Landmarks, landmarks: BoolArray, lean_sigma_rad: float) -> Landmarks:
    """Return ``placed`` with the poles among ``landmarks`` (n,) as they most likely stand, if poles
    lean by ``lean_sigma_rad`` in each direction.

    One update of a Kalman filter; without it, a pole seen from few directions may lie along them.
    """
    rows = np.flatnonzero(landmarks & placed.ok & np.isfinite(placed.end_m[:, 0]))
    X, P = placed.anchor_and_end_m[rows], placed.covariance_m2[rows]
    H = np.zeros((2, 6))
    H[:, :2], H[:, 3:5] = np.eye(2), -np.eye(2)
    height = np.maximum(np.abs(X[:, 2] - X[:, 5]), _LEAST_HEIGHT_M)
    allowed = (height * np.tan(lean_sigma_rad))[:, None, None] ** 2 * np.eye(2)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + allowed)
    X = X - (gain @ (X @ H.T)[:, :, None])[:, :, 0]
    P = P - gain @ H @ P
    anchor_m, end_m, covariance_m2 = (
        placed.anchor_m.copy(),
        placed.end_m.copy(),
        placed.covariance_m2.copy(),
    )
    anchor_m[rows], end_m[rows] = X[:, :3], X[:, 3:]
    covariance_m2[rows] = (P + P.transpose(0, 2, 1)) / 2.0
    return replace(placed, anchor_m=anchor_m, end_m=end_m, covariance_m2=covariance_m2)


def rms_px(observations: ObservationArray, at: reprojection.Residuals) -> FloatArray:
    """Return RMS errors (n,): distances of labels from points, or of their ends from lines."""
    squares = observations.per_landmark(np.add, (at.pixels_off[:, :2] ** 2).sum(axis=1))
    values = observations.per_landmark(np.add, 1.0 + observations.is_line)
    return np.asarray(np.sqrt(squares / np.maximum(values, 1.0)))


def spread(where: BoolArray, values: NDArray[Any], elsewhere: float = 0.0) -> NDArray[Any]:
    """Return (n, ...) with values (m, ...) where (n,) is True, and ``elsewhere`` otherwise."""
    result = np.full((len(where), *values.shape[1:]), elsewhere, dtype=values.dtype)
    result[where] = values
    return result
