"""Which finds of two images are one thing: by epipolar lines and plausible depths alone."""

from collections.abc import Sequence
from dataclasses import dataclass

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
    for class_id in {one.class_id for one in ones} & {one.class_id for one in others}:
        rows, columns = (
            [n for n, one in enumerate(found) if one.class_id == class_id]
            for found in (ones, others)
        )
        mine, theirs = _Marks.of([ones[n] for n in rows]), _Marks.of([others[n] for n in columns])
        near = _pole_misfits if theirs.is_line else _sign_misfits
        result[np.ix_(rows, columns)] = near(mine, theirs, places[:, rows])
    return result


@dataclass(frozen=True, eq=False)
class _Marks:
    """Finds of one class in one image."""

    ends_px: FloatArray
    """(n, 2, 2); both ends of a sign are its middle."""
    known: BoolArray
    """(n, 2)"""
    sigma_px: FloatArray
    """(n, 2) across and along."""
    is_line: bool

    @classmethod
    def of(cls, found: Sequence[Proposal]) -> "_Marks":
        return cls(
            ends_px=np.array([_ends(one) for one in found]),
            known=np.array([(one.anchor_known, one.end_known) for one in found]),
            sigma_px=np.array(
                [(one.sigma_px, one.sigma_along_px or one.sigma_px) for one in found]
            ),
            is_line=found[0].end_px is not None,
        )


def _sign_misfits(mine: _Marks, theirs: _Marks, places: FloatArray) -> FloatArray:
    """(n, m) of places (d, n, 2, 2) of my finds at each depth in the image of theirs."""
    off_px = np.linalg.norm(places[:, :, None, 0] - theirs.ends_px[:, 0], axis=3)
    return _least(off_px / _tolerance_px(mine, theirs, 0, _LEAST_PX))


def _pole_misfits(mine: _Marks, theirs: _Marks, places: FloatArray) -> FloatArray:
    """As ``_sign_misfits``: across their lines and, for ends that both know, along them."""
    steps = theirs.ends_px[:, 1] - theirs.ends_px[:, 0]
    length = np.maximum(np.linalg.norm(steps, axis=1), 1e-9)
    along = steps / length[:, None]  # (m, 2)
    gaps = places[:, :, None] - theirs.ends_px[:, None, 0]  # (d, n, m, 2, 2)
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)[:, None]
    off_px = np.abs((gaps * across).sum(axis=4)).max(axis=3)  # (d, n, m)
    off = off_px / _tolerance_px(mine, theirs, 0, _LEAST_PX)
    reached = (gaps * along[:, None]).sum(axis=4)  # (d, n, m, 2) from their peaks
    both_known = mine.known[:, None] & theirs.known  # (n, m, 2)
    miss = np.abs(reached - np.stack([np.zeros_like(length), length], axis=1))
    miss = np.where(both_known, miss, 0.0).max(axis=3)
    off = np.maximum(off, miss / _tolerance_px(mine, theirs, 1, _LEAST_ALONG_PX))
    beside = np.minimum(reached.max(axis=3), length) > np.maximum(reached.min(axis=3), 0.0)
    return _least(np.where(beside, off, np.inf))


def _least(off: FloatArray) -> FloatArray:
    """(n, m) of (d, n, m), where NaN is behind a camera."""
    return np.asarray(np.where(np.isfinite(off), off, np.inf).min(axis=0))


def _tolerance_px(mine: _Marks, theirs: _Marks, axis: int, least_px: float) -> FloatArray:
    """(n, m)"""
    one, other = (np.clip(each.sigma_px[:, axis], least_px, _MOST_PX) for each in (mine, theirs))
    return _SIGMAS * np.hypot(one[:, None], other)


def _ends(one: Proposal) -> FloatArray:
    """(2, 2); both ends of a sign are its middle."""
    return np.array([one.anchor_px, one.end_px or one.anchor_px])
