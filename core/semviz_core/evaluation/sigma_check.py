"""Whether a detector's sigma is honest: errors held against it, in bins of what it says."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.elements import Elements2D
from semviz_core.evaluation.image_errors import rms

SIGMA_LIMITS_PX = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, np.inf)
"""Of the bins."""


@dataclass(frozen=True)
class SigmaBin:
    """Errors whose sigma is about the same."""

    sigma_px: float
    """Root mean square."""
    error_px: float
    """Root mean square; as large as sigma where that is honest."""
    ratio: float
    """Root mean square of error over sigma; 1 where sigma is honest."""
    errors: int


def check_sigma(found: Elements2D, true: Elements2D) -> dict[str, tuple[SigmaBin, ...]]:
    """Of k detections, each with what it truly is (k,); bins that hold nothing are left out.

    Of a sign both axes count, of a pole how far its ends are across the true line, and, where an
    end can be seen and was said to be, along it.
    """
    told = errors_and_sigmas(found, true)
    return {name: tuple(_bins(error, sigma)) for name, (error, sigma) in told.items()}


def errors_and_sigmas(
    found: Elements2D, true: Elements2D
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Errors and what sigma says of each, as ``check_sigma`` holds them against each other."""
    line, point = found.is_line, ~found.is_line
    offset = found.anchor_px[point] - true.anchor_px[point]
    across, along = _pole_errors(found[line], true[line])
    sigma = found.sigma_px[line]
    known = np.stack([_both_know("anchor", found, true), _both_know("end", found, true)], axis=1)
    return {
        "signs": (offset.ravel(), found.sigma_px[point].ravel()),
        "poles, across": (across.ravel(), np.repeat(sigma[:, 0], 2)),
        "poles, along": (
            along[known[line]],
            np.repeat(sigma[:, 1:], 2, axis=1)[known[line]],
        ),
    }


def _pole_errors(found: Elements2D, true: Elements2D) -> tuple[FloatArray, FloatArray]:
    """(k, 2) each: how far the ends found are from the true line, and along it from its ends."""
    axis = true.end_px - true.anchor_px
    unit = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    normal = np.stack([unit[:, 1], -unit[:, 0]], axis=1)
    offset = np.stack([found.anchor_px - true.anchor_px, found.end_px - true.end_px], axis=1)
    return np.einsum("kei,ki->ke", offset, normal), np.einsum("kei,ki->ke", offset, unit)


def _both_know(end: str, found: Elements2D, true: Elements2D) -> BoolArray:
    """(k,)"""
    return np.asarray(getattr(found, f"{end}_known") & getattr(true, f"{end}_known"))


def _bins(error_px: FloatArray, sigma_px: FloatArray) -> Iterator[SigmaBin]:
    place = np.searchsorted(SIGMA_LIMITS_PX, sigma_px, side="right")
    for one in np.unique(place):
        sigma, error = sigma_px[place == one], error_px[place == one]
        yield SigmaBin(rms(sigma) or 0.0, rms(error) or 0.0, rms(error / sigma) or 0.0, len(error))
