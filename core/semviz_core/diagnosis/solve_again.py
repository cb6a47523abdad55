"""Solve a frame again with other assumptions, to see whether it is healthy then."""

import numpy as np

from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization
from semviz_core.diagnosis.detection_sigma import with_sigma_scaled
from semviz_core.diagnosis.reference import FrameReference
from semviz_core.localization.localizer import Localizer

SEEN_M = 40.0
"""Range of detections beyond the possible positions of the camera."""


def solve_with_prior(case: FrameReference, prior: Prior) -> Localization:
    """Return the frame solved with another prior, in the submap around that prior."""
    result = case.localization
    moved_m = float(np.linalg.norm((prior.position_m - case.prior.position_m)[:2]))
    submap = result.submap
    if moved_m > 0.0 or prior.horizontal_sigma_m > case.prior.horizontal_sigma_m:
        submap = _around(case, prior)
    return Localizer(detector=case.detector).localize(result.observed, submap, result.camera, prior)


def solve_with_sigma(case: FrameReference, factor: float) -> Localization:
    """Return the frame solved with larger sigmas of the detections."""
    result = with_sigma_scaled(case, factor).localization
    return Localizer(detector=case.detector).localize(
        result.observed, result.submap, result.camera, case.prior
    )


def solve_with_more_effort(case: FrameReference) -> Localization:
    """Return the frame solved by the widest search."""
    result = case.localization
    return Localizer("wide", detector=case.detector).localize(
        result.observed, result.submap, result.camera, case.prior
    )


def solve_in_wide_submap(case: FrameReference) -> Localization:
    """Return the frame solved in a submap with all that it may have detected."""
    result = case.localization
    return Localizer(detector=case.detector).localize(
        result.observed, _around(case, case.prior), result.camera, case.prior
    )


def _around(case: FrameReference, prior: Prior) -> Elements3D:
    return case.semantic_map.crop(prior.position_m, 3.0 * prior.horizontal_sigma_m + SEEN_M)
