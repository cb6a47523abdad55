"""Which finds of two images are one thing: by epipolar lines and plausible depths alone."""

from collections.abc import Sequence

import numpy as np

from semviz_annotation.assist.warp import inverse_depths, transfer
from semviz_annotation.proposals import Proposal
from semviz_annotation.stereo import PLAUSIBLE_DEPTH_M
from semviz_annotation.view import View
from semviz_core.arrays import BoolArray, FloatArray

_STEP_PX = 1.0
_SIGMAS = 3.0
_LEAST_PX, _LEAST_ALONG_PX = 1.0, 3.0
"""Standard deviations that nobody is below: poles lean, and their ends are not clear."""
_MOST_PX = 6.0
"""Nor above: what is worse marks nothing."""


def stereo_pairs(
    here: View, there: View, ones: Sequence[Proposal], others: Sequence[Proposal]
) -> list[tuple[int, int]]:
    """Places in ``ones``, of the image ``here``, and in ``others``, of ``there``, that are one.

    Of one class, within 3 sigma for some plausible depth, and with no other that would do as well
    for either of them. The views share one frame.
    """
    if not ones or not others:
        return []
    agree = misfits(here, there, ones, others) <= 1.0
    alone = agree & (agree.sum(axis=0) == 1) & (agree.sum(axis=1) == 1)[:, None]
    return [(int(one), int(other)) for one, other in np.argwhere(alone)]


def misfits(
    here: View, there: View, ones: Sequence[Proposal], others: Sequence[Proposal]
) -> FloatArray:
    """(n, m) by how much each two miss each other at the best depth, in units of 3 sigma.

    Infinite for two classes, and where no plausible depth brings one to the other.
    """
    starts = np.array([_ends(one) for one in ones])  # (n, 2, 2)
    middle = starts.mean(axis=(0, 1))
    depths = inverse_depths(here, there, middle, PLAUSIBLE_DEPTH_M, _STEP_PX)
    result = np.full((len(ones), len(others)), np.inf)
    if not len(depths):
        return result
    places = transfer(here, there, starts.reshape(-1, 2), depths)
    places = places.reshape(len(depths), len(ones), 2, 2)
    for row, one in enumerate(ones):
        for column, other in enumerate(others):
            if one.class_id == other.class_id:
                result[row, column] = _misfit(one, other, places[:, row])
    return result


def _misfit(one: Proposal, other: Proposal, places: FloatArray) -> float:
    """Of the places (d, 2, 2) of one's ends at each depth, in the image of the other."""
    if other.end_px is None:
        off = np.linalg.norm(places[:, 0] - np.array(other.anchor_px), axis=1)
        return _least(off / _tolerance_px(one.sigma_px, other.sigma_px, _LEAST_PX))
    ends = _ends(other)
    length = max(float(np.linalg.norm(ends[1] - ends[0])), 1e-9)
    along = (ends[1] - ends[0]) / length
    gaps = places - ends[0]
    across = np.abs(gaps @ np.array([along[1], -along[0]])).max(axis=1)
    off = across / _tolerance_px(one.sigma_px, other.sigma_px, _LEAST_PX)
    reached = gaps @ along  # (d, 2) of one's ends, from the other's peak
    for end, is_known in enumerate(_known(one, other)):
        if is_known:
            miss = np.abs(reached[:, end] - end * length)
            off = np.maximum(off, miss / _along_px(one, other))
    beside = np.minimum(reached.max(axis=1), length) > np.maximum(reached.min(axis=1), 0.0)
    return _least(np.where(beside, off, np.inf))


def _least(off: FloatArray) -> float:
    return float(np.nanmin(np.where(np.isfinite(off), off, np.inf)))


def _known(one: Proposal, other: Proposal) -> BoolArray:
    """(2,) whether an end is seen in both images."""
    return np.array([one.anchor_known and other.anchor_known, one.end_known and other.end_known])


def _along_px(one: Proposal, other: Proposal) -> float:
    sigma_px, other_px = (each.sigma_along_px or each.sigma_px for each in (one, other))
    return _tolerance_px(sigma_px, other_px, _LEAST_ALONG_PX)


def _tolerance_px(one_px: float, other_px: float, least_px: float) -> float:
    sigmas = np.clip([one_px, other_px], least_px, max(least_px, _MOST_PX))
    return _SIGMAS * float(np.hypot(*sigmas))


def _ends(one: Proposal) -> FloatArray:
    """(2, 2); both ends of a sign are its middle."""
    return np.array([one.anchor_px, one.end_px or one.anchor_px])
