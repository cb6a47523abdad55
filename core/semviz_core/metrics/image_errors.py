"""Errors of poles and signs in images, per class, by the criteria of the paper's tables.

Signs: RMSE is over the distances; lateral and longitudinal are the image axes u and v. Poles: the
angle between the detected and the true line, and the distance of the detected line from the true
ends. Errors are detected minus true. SDE is the standard deviation around the mean error (ME),
with divisor n, so for signs RMSE^2 is the sum of all four squared.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_core.common.arrays import FloatArray

CRITERIA = {
    "RMSE (px)": "rmse_px",
    "lateral ME (px)": "lateral_me_px",
    "lateral SDE (px)": "lateral_sde_px",
    "lateral RMSE (px)": "lateral_rmse_px",
    "longitudinal ME (px)": "longitudinal_me_px",
    "longitudinal SDE (px)": "longitudinal_sde_px",
    "angular ME (deg)": "angular_me_deg",
    "angular SDE (deg)": "angular_sde_deg",
    "angular RMSE (deg)": "angular_rmse_deg",
}
"""Names in tables of the fields of ``ClassAccuracy``."""


@dataclass(frozen=True, eq=False)
class ImageErrors:
    """Errors of one pole or sign in an image."""

    lateral_px: FloatArray
    """(1,) of a sign, (2,) of a pole: one for each true end."""
    longitudinal_px: FloatArray
    """(1,) of a sign, (0,) of a pole."""
    angular_deg: FloatArray
    """(0,) of a sign, (1,) of a pole."""

    @classmethod
    def between(cls, found_px: FloatArray, true_px: FloatArray) -> "ImageErrors":
        """Return the errors of an anchor and end (2, 2); a sign's end is NaN."""
        if np.isnan(true_px[1, 0]):
            du, dv = found_px[0] - true_px[0]
            return cls(np.array([du]), np.array([dv]), np.zeros(0))
        true, estimate = true_px[1] - true_px[0], found_px[1] - found_px[0]
        sine = true[0] * estimate[1] - true[1] * estimate[0]
        angle = np.rad2deg(np.arctan2(sine, true @ estimate))
        return cls(across_px(found_px, true_px), np.zeros(0), np.array([angle]))


@dataclass(frozen=True)
class ClassAccuracy:
    """Errors of one class; None if not defined for the class, or without observations."""

    rmse_px: float | None
    """Signs only, as in the paper."""
    lateral_me_px: float | None
    """Poles: across the true line; positive to the right of a line that runs downwards."""
    lateral_sde_px: float | None
    lateral_rmse_px: float | None
    longitudinal_me_px: float | None
    longitudinal_sde_px: float | None
    angular_me_deg: float | None
    """Poles only: from the true to the detected direction, from u towards v."""
    angular_sde_deg: float | None
    angular_rmse_deg: float | None
    observations: int

    @classmethod
    def of(cls, errors: Sequence[ImageErrors]) -> "ClassAccuracy":
        lateral, longitudinal, angular = (
            np.concatenate([getattr(error, name) for error in errors] or [np.zeros(0)])
            for name in ("lateral_px", "longitudinal_px", "angular_deg")
        )
        return cls(
            rmse_px=rms(np.hypot(lateral, longitudinal)) if longitudinal.size else None,
            lateral_me_px=_mean(lateral),
            lateral_sde_px=_deviation(lateral),
            lateral_rmse_px=rms(lateral),
            longitudinal_me_px=_mean(longitudinal),
            longitudinal_sde_px=_deviation(longitudinal),
            angular_me_deg=_mean(angular),
            angular_sde_deg=_deviation(angular),
            angular_rmse_deg=rms(angular),
            observations=len(errors),
        )


def across_px(line_px: FloatArray, points_px: FloatArray) -> FloatArray:
    """Return (n,) signed distances of a line (2, 2: anchor, end) from points (n, 2).

    Positive if the line is to the right of the point, for a line that runs downwards.
    """
    along = line_px[1] - line_px[0]
    across = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    return np.asarray((line_px[0] - points_px) @ across)


def rms(values: FloatArray) -> float | None:
    """Return the root mean square; None without values."""
    return float(np.sqrt(np.square(values).mean())) if values.size else None


def _mean(values: FloatArray) -> float | None:
    return float(values.mean()) if values.size else None


def _deviation(values: FloatArray) -> float | None:
    return float(values.std()) if values.size else None
