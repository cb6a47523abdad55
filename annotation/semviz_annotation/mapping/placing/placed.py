"""Things in the map frame, with how certain their places are and how well they fit."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.mapping.placing.least_squares import PlaceOptions, information
from semviz_annotation.mapping.placing.residuals import Residuals, residuals
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray, IntArray


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
    """(k,) share of each sighting in ``chi2``: infinite where the thing is behind the camera, NaN
    where it has no place."""

    @classmethod
    def joined(cls, parts: Sequence["Placed"]) -> "Placed":
        """All of them, one after another."""
        return cls(*(np.concatenate([getattr(one, f.name) for one in parts]) for f in fields(cls)))

    @property
    def ok(self) -> BoolArray:
        """(n,) True where there is a place."""
        return np.asarray(self.failure == "")

    @property
    def anchor_and_end_m(self) -> FloatArray:
        """(n, 6); zero for the ends of points, and where there is no place."""
        places = np.concatenate([self.anchor_m, self.end_m], axis=1)
        return np.asarray(np.nan_to_num(places))


def measured(
    views: Views,
    sightings: Sightings,
    X: FloatArray,
    failure: NDArray[np.object_],
    too_narrow: BoolArray,
    angle_rad: FloatArray,
    options: PlaceOptions,
) -> Placed:
    """Things at X (n, 6: anchor and end) that have no ``failure``; the rest as in ``Placed``."""
    ok = failure == ""
    here, chosen = X[ok], sightings.only(ok)
    at = residuals(views, chosen, here[:, :3], here[:, 3:])
    chi2_of = (at.error_px**2).sum(axis=1) / options.sigma_px**2
    chi2_of[~at.ahead] = np.inf
    is_line = sightings.of(sightings.is_line)
    known = sightings.of(sightings.anchor_known), sightings.of(sightings.end_known)
    return Placed(
        anchor_m=spread(ok, here[:, :3], np.nan),
        end_m=np.where(is_line[:, None], spread(ok, here[:, 3:], np.nan), np.nan),
        covariance_m2=spread(ok, _covariance(chosen, at, options)),
        anchor_known=known[0] & ok,
        end_known=known[1] & ok,
        failure=failure,
        too_narrow=too_narrow,
        angle_rad=angle_rad,
        rms_px=spread(ok, rms_px(chosen, at)),
        chi2=spread(ok, chosen.per_thing(np.add, chi2_of)),
        rows=spread(ok, chosen.per_thing(np.add, at.counts.sum(axis=1))),
        parameters=np.where(is_line, 4 + known[0].astype(np.int64) + known[1], 3),
        chi2_of=spread(ok[sightings.thing], chi2_of, np.nan),
    )


def _covariance(sightings: Sightings, at: Residuals, options: PlaceOptions) -> FloatArray:
    """(n, 6, 6) inverse of the information of all rows; of outliers' rows, there is less."""
    weights = at.trust(options.sigma_px, options.outlier_sigmas)
    covariance = np.linalg.inv(information(sightings, at, weights, options.sigma_px))
    covariance[~sightings.of(sightings.is_line), 3:, 3:] = 0.0
    return np.asarray(covariance)


def replaced(placed: Placed, sightings: Sightings, things: BoolArray, others: Placed) -> Placed:
    """With ``others``, the new places of things (n,), of all of which there are ``sightings``."""

    def put(name: str) -> Any:
        values = getattr(placed, name).copy()
        rows = things[sightings.thing] if name == "chi2_of" else things
        values[rows] = getattr(others, name)
        return values

    return Placed(**{one.name: put(one.name) for one in fields(Placed)})


def rms_px(sightings: Sightings, at: Residuals) -> FloatArray:
    """(n,) of the clicks' distances from points, or of the ends' from lines."""
    squares = sightings.per_thing(np.add, at.squared_px2()[:, 0])
    values = sightings.per_thing(np.add, 1.0 + sightings.is_line)
    return np.asarray(np.sqrt(squares / np.maximum(values, 1.0)))


def spread(where: BoolArray, values: NDArray[Any], elsewhere: float = 0.0) -> NDArray[Any]:
    """(n, ...) with values (m, ...) where (n,) is True."""
    result = np.full((len(where), *values.shape[1:]), elsewhere, dtype=values.dtype)
    result[where] = values
    return result
