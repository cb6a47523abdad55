"""Pairs of landmarks that may be one, and the test whether their observations agree.

Candidates stand near each other. The test linearizes observations at the position of the other
landmark. That is accurate if the other position is the better known, so the vaguer of two is always
tested against the sharper. A landmark with too few observations does not enter the map.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.mapping.placement.landmarks import Landmarks
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_annotation.mapping.placement.reprojection import residuals
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

_REACH_SIGMAS = 6.0
_LEAST_REACH_M = 0.5
_MOST_REACH_M = 40.0
HARDLY_KNOWN_M = 20.0
"""A position with a larger sigma counts as unknown."""
_NOMINAL_M = 30.0
"""Assumed distance of a landmark without a position; it is searched within ``_MOST_REACH_M``."""
_KINDS_APART_M = 1e6


class MergeCandidates(NamedTuple):
    """p pairs of landmarks; the position of the first is less well known."""

    vague: IntArray
    """(p,)"""
    sharp: IntArray
    """(p,)"""

    def __len__(self) -> int:
        return len(self.vague)

    def where(self, rows: BoolArray | IntArray) -> "MergeCandidates":
        return MergeCandidates(self.vague[rows], self.sharp[rows])


@dataclass(frozen=True, eq=False)
class GroundPositions:
    """Positions of n landmarks on the ground plane."""

    at_m: FloatArray
    """(n, 2); without a position, the point to search around"""
    covariance_m2: FloatArray
    """(n, 2, 2)"""
    sigma_m: FloatArray
    """(n,) in the worst direction; infinite without a position"""

    @classmethod
    def of(
        cls, views: ViewArray, observations: ObservationArray, placed: Landmarks
    ) -> "GroundPositions":
        """Return the positions of ``placed``; a position with a large sigma counts as unknown."""
        n = observations.count
        ray, known = _on_rays(views, observations), _MOST_REACH_M**2 * np.eye(2)
        spots = cls(ray, np.tile(known, (n, 1, 1)), np.full(n, np.inf))
        spots.put(np.arange(n), placed)
        return spots

    def put(self, rows: IntArray, placed: Landmarks) -> None:
        """Update the rows (m,) that have a known position in ``placed``."""
        at_m, spread, sigma = ground_positions(placed)
        good = sigma < HARDLY_KNOWN_M
        self.at_m[rows[good]] = at_m[good]
        self.covariance_m2[rows[good]] = spread[good]
        self.sigma_m[rows[good]] = sigma[good]

    def pairs(
        self, landmarks: IntArray, level_m: float, kind: IntArray, pose_sigma_m: float
    ) -> MergeCandidates:
        """Return the pairs of ``landmarks`` (m,), ascending, of one class ``kind`` (n,), that are
        close.

        The sharper of each pair is known to ``level_m`` or better. So is the vaguer one, unless
        ``level_m`` is infinite: then it may have no position.
        """
        from scipy.spatial import cKDTree

        sigma = self.sigma_m[landmarks]
        sharp = landmarks[np.isfinite(sigma) & (sigma <= level_m)]
        vague = landmarks[sigma <= level_m]
        if not len(sharp):
            return MergeCandidates(sharp, sharp)
        points = np.column_stack([self.at_m, kind * _KINDS_APART_M])
        reach = 2.0 * _REACH_SIGMAS * (self.sigma_m[vague] + pose_sigma_m)
        near = cKDTree(points[sharp]).query_ball_point(
            points[vague], np.clip(reach, _LEAST_REACH_M, _MOST_REACH_M), return_sorted=True
        )
        counts = np.array([len(rows) for rows in near])
        other = sharp[np.concatenate([np.asarray(rows, dtype=np.int64) for rows in near])]
        pairs = MergeCandidates(np.repeat(vague, counts), other)
        pairs = pairs.where(self._is_sharper(pairs))
        return pairs.where(self._may_touch(pairs, pose_sigma_m))

    def _is_sharper(self, pairs: MergeCandidates) -> BoolArray:
        """Return whether the second of each pair (p,) is sharper; ties go by order."""
        first, second = self.sigma_m[pairs.vague], self.sigma_m[pairs.sharp]
        return np.asarray((second < first) | ((second == first) & (pairs.sharp < pairs.vague)))

    def _may_touch(self, pairs: MergeCandidates, pose_sigma_m: float) -> BoolArray:
        """Return whether pairs (p,) may coincide by their covariances, approximately."""
        x, y = (self.at_m[pairs.vague] - self.at_m[pairs.sharp]).T
        slack = (_LEAST_REACH_M / _REACH_SIGMAS + pose_sigma_m) ** 2 * np.eye(2)
        both = self.covariance_m2[pairs.vague] + self.covariance_m2[pairs.sharp] + slack
        a, b, d = both[:, 0, 0], both[:, 0, 1], both[:, 1, 1]
        squared = (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)
        return np.asarray(squared <= _REACH_SIGMAS**2)


def ground_positions(placed: Landmarks) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ground-plane positions (n, 2) m, their covariances (n, 2, 2), and the sigma (n,) in
    the worst direction, which is infinite without a position."""
    share = np.where(np.isfinite(placed.end_m[:, 0]), 0.5, 1.0)
    shares = np.stack([share, 1.0 - share], axis=1)
    ends = np.stack([placed.anchor_m, np.nan_to_num(placed.end_m)], axis=1)[:, :, :2]
    covariance = placed.covariance_m2.reshape(-1, 2, 3, 2, 3)[:, :, :2, :, :2]
    spread = np.einsum("ne,neifj,nf->nij", shares, covariance, shares)
    sigma = np.sqrt(np.linalg.eigvalsh(spread)[:, 1])
    at_m = np.einsum("ne,nei->ni", shares, ends)
    return at_m, spread, np.where(placed.ok, sigma, np.inf)


def _on_rays(views: ViewArray, observations: ObservationArray) -> FloatArray:
    """Return ground-plane points (n, 2) on the ray of each landmark's first observation."""
    first = np.cumsum(observations.seen) - observations.seen
    view = observations.view[first]
    rays = views.rays(view, observations.anchor_px[first])
    return np.asarray(views.center_m[view, :2] + _NOMINAL_M * rays[:, :2])


def frames_of(views: ViewArray, observations: ObservationArray) -> IntArray:
    """Return the number of frames (n,) that see each landmark."""
    landmark_frames = np.stack([observations.landmark, views.frame_index[observations.view]])
    return np.bincount(np.unique(landmark_frames, axis=1)[0], minlength=observations.count)


def insufficient_observations(
    views: ViewArray, observations: ObservationArray, placed: Landmarks, min_frames: int
) -> NDArray[np.object_]:
    """Return why landmarks (n,) are not for the map, as str; empty for those that are."""
    failure = placed.failure.copy()
    failure[placed.ok & (frames_of(views, observations) < min_frames)] = (
        f"seen in fewer than {min_frames} frames"
    )
    _, _, sigma_m = ground_positions(placed)
    failure[placed.ok & ~(sigma_m < HARDLY_KNOWN_M)] = (
        f"where it stands is not known to {HARDLY_KNOWN_M:g} m"
    )
    return failure


_UNEVEN = 0.5
"""Pose errors move both ends of a pole together, and each end by this share of it alone."""
_LEAST_M = 1e-4
"""Lower bound of the standard deviation of a position."""
AT_ONCE = 50_000
"""Number of observations tested at once, which bounds the memory."""
_DIGITS = 1e-10
"""Relative to the largest information; less is rounding."""


class Agreement(NamedTuple):
    """The agreement of p pairs."""

    chi2: FloatArray
    """(p,) cost of one common landmark over two separate ones, in multiples of sigma squared;
    infinite where the position is behind a camera"""
    freedom: IntArray
    """(p,) number of quantities that both determine: the degrees of freedom of ``chi2`` if the two
    are one landmark"""
    log_likelihood: FloatArray
    """(p,) of the observations given the position, up to a common constant"""

    def where(self, rows: BoolArray) -> "Agreement":
        return Agreement(self.chi2[rows], self.freedom[rows], self.log_likelihood[rows])

    @classmethod
    def joined(cls, parts: Sequence["Agreement"]) -> "Agreement":
        """Concatenate agreements."""
        nothing = np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0)
        return cls(*(np.concatenate(column) for column in zip(nothing, *parts, strict=False)))


@dataclass(frozen=True, eq=False)
class LandmarkPositions:
    """Positions of p landmarks."""

    ends_m: FloatArray
    """(p, 6) anchor and end; the ends of points are arbitrary"""
    covariance_m2: FloatArray
    """(p, 6, 6)"""
    known: BoolArray
    """(p, 2) anchor, end"""

    @classmethod
    def of(cls, placed: Landmarks) -> "LandmarkPositions":
        return cls(
            np.concatenate([placed.anchor_m, np.nan_to_num(placed.end_m)], axis=1),
            placed.covariance_m2.copy(),
            np.stack([placed.anchor_known, placed.end_known], axis=1),
        )

    def put(self, rows: IntArray, placed: Landmarks) -> None:
        """Update the rows (m,) that have a position in ``placed``."""
        new, ok = LandmarkPositions.of(placed), placed.ok
        self.ends_m[rows[ok]] = new.ends_m[ok]
        self.covariance_m2[rows[ok]] = new.covariance_m2[ok]
        self.known[rows[ok]] = new.known[ok]

    def __getitem__(self, rows: IntArray) -> "LandmarkPositions":
        return LandmarkPositions(self.ends_m[rows], self.covariance_m2[rows], self.known[rows])


def agreement(
    views: ViewArray,
    observations: ObservationArray,
    places: LandmarkPositions,
    sigma_px: float,
    pose_sigma_m: float,
) -> Agreement:
    """Test landmark i of ``observations`` (p landmarks) at position i, for poles, signs or both.

    ``pose_sigma_m`` is the pose error in each direction between the views of one and of the other.
    """
    known = places.known[observations.landmark]
    compared = replace(
        observations,
        anchor_known=observations.anchor_known & known[:, 0],
        end_known=observations.end_known & known[:, 1],
    )
    at = residuals(views, compared, places.ends_m[:, :3], places.ends_m[:, 3:])
    J = at.J * at.counts[:, :, None] / sigma_px
    error = at.error_px / sigma_px
    total = observations.per_landmark
    information = total(np.add, J.transpose(0, 2, 1) @ J)
    gradient = total(np.add, np.einsum("kri,kr->ki", J, error))
    is_line = observations.of(observations.is_line)
    root = _root(places, is_line, pose_sigma_m)
    # in units of how well the place is known, so that nothing is singular
    values, axes = np.linalg.eigh(root.transpose(0, 2, 1) @ information @ root)
    pull = np.einsum("pia,pij,pj->pa", axes, root.transpose(0, 2, 1), gradient)
    observable = values > _DIGITS * np.maximum(values[:, -1:], 1.0)
    safe = np.where(observable, values, 1.0)
    chi2 = np.where(observable, pull**2 / (safe * (1.0 + safe)), 0.0).sum(axis=1)
    spread = np.where(observable, np.log1p(safe), 0.0).sum(axis=1)
    chi2[observations.of(~at.ahead)] = np.inf
    return Agreement(chi2, _freedom(compared, is_line), -0.5 * (chi2 + spread))


def _root(places: LandmarkPositions, is_line: BoolArray, pose_sigma_m: float) -> FloatArray:
    """Return roots (p, 6, 6) of the covariances, pose errors included; 1 for the ends of points."""
    moved = np.tile(np.eye(3), (2, 2)) + _UNEVEN**2 * np.eye(6)
    covariance = places.covariance_m2 + pose_sigma_m**2 * moved
    covariance[~is_line, 3:] = covariance[~is_line, :, 3:] = 0.0
    covariance[~is_line, 3:, 3:] = np.eye(3)
    values, axes = np.linalg.eigh(covariance)  # of vague places, some are below 0 by rounding
    return np.asarray(axes * np.sqrt(np.maximum(values, _LEAST_M**2))[:, None])


def _freedom(observations: ObservationArray, is_line: BoolArray) -> IntArray:
    """Return the rank (p,) of the observations' information about a position."""
    views = np.minimum(observations.seen, 2)
    ends = observations.of(observations.anchor_known).astype(np.int64) + observations.of(
        observations.end_known
    )
    return np.asarray(np.where(is_line, 2 * views + ends, np.minimum(2 * views, 3)))
