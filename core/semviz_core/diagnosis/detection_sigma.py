"""Measure how far the sigma of the detections is from what a frame shows.

The errors of the map are known and do not change, so the scale is that of the detections alone.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from semviz_core.base.elements import Elements3D
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.diagnosis.alignment import FREE_PARAMETERS, misalignment
from semviz_core.diagnosis.fault import EvidenceItem, Fault
from semviz_core.diagnosis.reference import FrameReference, whitened_rows
from semviz_core.localization.association import associate
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import EXACT_POSE

SCALES: FloatArray = np.geomspace(1.0, 8.0, 25)
LEAST_SCALE = 1.8
"""Smallest factor between true and stated sigma that is a fault."""
LEAST_NATS = 4.0
"""Log-likelihood ratio of the scale, without the pair that it helps most: one moved element is no
fault of the sigma."""
GATE_SCALE = 4.0
"""Pairs are sought with sigmas larger by this."""
LEAST_FIT = 0.8
"""Share of the residuals that must fit with the likeliest scale."""
MOST_CHI2 = 16.0
"""Squared residuals count up to this: a wrong pair is as wrong as it can be."""


def sigma_fault(case: FrameReference, localization: Localization) -> Fault | None:
    """Return the fault of sigmas that are too small, at the pose that the image supports.

    A map that is shifted as a whole is no fault of the sigmas. ``localization`` gives the pose if
    the true one is unknown.
    """
    scale, nats = _scale(case, localization)
    if scale < LEAST_SCALE or nats < LEAST_NATS:
        return None
    return Fault(
        "wrong detection sigma",
        f"The detections are about {scale:.1f} times less accurate than their sigma states.",
        (
            EvidenceItem("true over stated sigma", scale),
            EvidenceItem("log-likelihood ratio", nats, "nats"),
        ),
    )


def _scale(case: FrameReference, localization: Localization) -> tuple[float, float]:
    """Return the likeliest of ``SCALES``, and its log-likelihood ratio without the pair that it
    helps most."""
    image = misalignment(case)
    pose = image.T_camera_map if image else case.truth or localization.T_camera_map
    if pose is None:
        return 1.0, 0.0
    free = 0.0 if image is None and case.truth is not None else FREE_PARAMETERS
    mapped = localization.submap if case.truth is None else case.nearby
    pairs = case.same_class if case.ids is not None else _wide_pairs(case, mapped, pose)
    if len(pairs) < 2:
        return 1.0, 0.0
    table = np.array(list(_log_likelihoods(case, mapped, pose, pairs, free)))
    gain = table - table[0]
    best = int(np.argmax(gain.sum(axis=1)))
    if _fit_share(case, mapped, pose, pairs, float(SCALES[best])) < LEAST_FIT:
        return 1.0, 0.0  # what is off by many sigmas is no pair
    return float(SCALES[best]), float(gain[best].sum() - gain[best].max())


def _fit_share(
    case: FrameReference, mapped: Elements3D, pose: Pose, pairs: IntArray, scale: float
) -> float:
    """Return the share of the residuals that fit with sigmas larger by ``scale``."""
    residual = whitened_rows(_problem(case, mapped, scale), pose, pairs).residual
    return float((residual**2 < MOST_CHI2).mean())


def _log_likelihoods(
    case: FrameReference, mapped: Elements3D, pose: Pose, pairs: IntArray, free: float
) -> Iterator[FloatArray]:
    """Yield the log-likelihoods (k,) of the pairs, for each of ``SCALES``.

    ``free`` parameters of the pose were fitted to them.
    """
    for scale in SCALES:
        problem = _problem(case, mapped, float(scale))
        by_pair = [whitened_rows(problem, pose, pair[None]) for pair in pairs]
        count = sum(len(rows.residual) for rows in by_pair)
        left = max(count - free, 1.0) / count
        yield np.array(
            [
                -0.5 * np.minimum(rows.residual**2 / left, MOST_CHI2).sum() - rows.log_sigma.sum()
                for rows in by_pair
            ]
        )


def _wide_pairs(case: FrameReference, mapped: Elements3D, pose: Pose) -> IntArray:
    """Return the pairs (k, 2) that fit within a wide gate."""
    problem = _problem(case, mapped, GATE_SCALE)
    match, _ = associate(problem, pose.rotation, pose.translation, EXACT_POSE)
    rows = np.flatnonzero(match >= 0)
    return np.column_stack([rows, match[rows]])


def _problem(case: FrameReference, mapped: Elements3D, scale: float) -> PoseProblem:
    localization = with_sigma_scaled(case, scale).localization
    return PoseProblem.of(localization.camera, localization.observed, mapped, case.detector)


def with_sigma_scaled(case: FrameReference, scale: float) -> FrameReference:
    """Return the frame with the sigmas of all detections multiplied by ``scale``."""
    observed = case.localization.observed
    observed = replace(observed, sigma_px=scale * observed.sigma_px)
    return replace(case, localization=replace(case.localization, observed=observed))
