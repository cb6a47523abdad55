"""Assignment of observations that several landmarks explain, and removal of false landmarks.

Merging never splits what it has joined. So a landmark may hold a few observations of another behind
it. Two equally wrong label pairs triangulate to a landmark that does not exist. Here a landmark is
placed by the observations that nothing else explains. Every other observation goes to the landmark
that explains it clearly better than any other; if none does, it is not used. Landmarks behind one
another look alike from some positions, so several may claim an observation.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.association import candidates
from semviz_annotation.mapping.association.merging import LinkOptions
from semviz_annotation.mapping.association.nodes import LEFT_OUT, spans
from semviz_annotation.mapping.placement.landmarks import Landmarks, replaced
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_annotation.mapping.placement.reprojection import projected
from semviz_annotation.mapping.placement.triangulation import triangulate_landmarks
from semviz_core.base.camera import MIN_DEPTH_M
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

_FURTHEST_M = 100.0
"""Largest distance from a camera at which landmarks are searched for."""
_REACH_SIGMAS = 6.0
_VIEWS_AT_ONCE = 1000
"""Number of views handled at once, which bounds the memory."""


@dataclass(frozen=True, eq=False)
class CandidateExplanations:
    """c candidate pairs of an observation and a landmark."""

    observation: IntArray
    """(c,) row"""
    landmark: IntArray
    """(c,)"""

    def __len__(self) -> int:
        return len(self.observation)

    def where(self, rows: BoolArray | IntArray) -> "CandidateExplanations":
        return CandidateExplanations(self.observation[rows], self.landmark[rows])

    def and_(self, others: "CandidateExplanations") -> "CandidateExplanations":
        return CandidateExplanations(
            np.concatenate([self.observation, others.observation]),
            np.concatenate([self.landmark, others.landmark]),
        )

    def tested(
        self,
        views: ViewArray,
        observations: ObservationArray,
        places: candidates.LandmarkPositions,
        options: LinkOptions,
    ) -> tuple[BoolArray, FloatArray]:
        """Return whether each observation, by itself, fits the landmark's position (c,), and its
        log-likelihood there (c,)."""
        results = []
        for start in range(0, len(self), candidates.AT_ONCE):
            some = self.where(np.arange(start, min(start + candidates.AT_ONCE, len(self))))
            alone = observations.taken(some.observation, np.arange(len(some)), len(some))
            positions = places[some.landmark]
            results.append(
                candidates.agreement(
                    views, alone, positions, options.place.sigma_px, options.pose_sigma_m
                )
            )
        result = candidates.Agreement.joined(results)
        return options.fits(result), result.log_likelihood


def nearby_explanations(
    views: ViewArray,
    observations: ObservationArray,
    kind_of: IntArray,
    placed: Landmarks,
    kind: IntArray,
    options: LinkOptions,
) -> CandidateExplanations:
    """Return pairs of observations and landmarks with a position that are near in an image.

    Only pairs of one class count: ``kind_of`` (k,) of observations, ``kind`` (n,) of landmarks.
    """
    from scipy.spatial import cKDTree

    ok = np.flatnonzero(placed.ok)
    at_m, _, sigma_m = candidates.ground_positions(placed)
    tree = cKDTree(at_m[ok])
    order = np.argsort(observations.view, kind="stable")
    begin = np.searchsorted(observations.view[order], np.arange(len(views) + 1))
    result = CandidateExplanations(ok[:0], ok[:0])
    for first in range(0, len(views), _VIEWS_AT_ONCE):
        some = np.arange(first, min(first + _VIEWS_AT_ONCE, len(views)))
        near = tree.query_ball_point(views.center_m[some, :2], _FURTHEST_M, return_sorted=True)
        view = np.repeat(some, [len(rows) for rows in near])
        landmark = ok[np.concatenate([np.asarray(rows, dtype=np.int64) for rows in near])]
        projections = _projected(views, placed, view, landmark, sigma_m, options)
        rows, pair = spans(begin[projections.view], begin[projections.view + 1])
        claims = CandidateExplanations(order[rows], projections.landmark[pair])
        alike = kind_of[claims.observation] == kind[claims.landmark]
        claims, pair = claims.where(alike), pair[alike]
        result = result.and_(
            claims.where(projections.are_near(observations, claims.observation, pair))
        )
    return result


class _Projections(NamedTuple):
    """p projections of landmarks in front of the camera."""

    view: IntArray
    """(p,)"""
    landmark: IntArray
    """(p,)"""
    anchor_px: FloatArray
    """(p, 2)"""
    end_px: FloatArray
    """(p, 2), the anchor for points"""
    reach_px: FloatArray
    """(p,) radius in which observations of the landmark may be"""
    sigma_px: float
    """The common sigma of observations."""

    def are_near(self, observations: ObservationArray, rows: IntArray, pair: IntArray) -> BoolArray:
        """Return whether observations in rows (c,) are near projections (c,): signs in u and v,
        poles along u at the middle of the observed line."""
        is_line = observations.is_line[rows]
        start_px = observations.anchor_px[rows]
        middle = np.where(is_line[:, None], (start_px + observations.end_px[rows]) / 2.0, start_px)
        anchor, along = self.anchor_px[pair], (self.end_px - self.anchor_px)[pair]
        down = np.where(along[:, 1] == 0.0, 1.0, along[:, 1])
        share = np.where(is_line, (middle[:, 1] - anchor[:, 1]) / down, 0.0)
        off = np.abs(anchor + share[:, None] * along - middle)
        ratio = observations.sigma_ratio[rows]
        vaguer = np.where(is_line, ratio[:, 0], ratio.max(axis=1)) - 1.0
        reach_px = self.reach_px[pair] + _REACH_SIGMAS * self.sigma_px * vaguer
        return np.asarray(off.max(axis=1) <= reach_px)


def _projected(
    views: ViewArray,
    placed: Landmarks,
    view: IntArray,
    landmark: IntArray,
    sigma_m: FloatArray,
    options: LinkOptions,
) -> _Projections:
    """Project landmarks (p,) with sigma_m (n,) into views (p,); drop those behind the camera."""
    depth_m = views.depth_m(view, placed.anchor_m[landmark])
    ahead = depth_m > MIN_DEPTH_M
    view, landmark, depth_m = view[ahead], landmark[ahead], depth_m[ahead]
    anchor, _, _ = projected(views, view, placed.anchor_m[landmark])
    end_m = np.where(np.isnan(placed.end_m), placed.anchor_m, placed.end_m)
    end, _, _ = projected(views, view, end_m[landmark])
    vague_px = views.K[view, 0, 0] * (sigma_m[landmark] + options.pose_sigma_m) / depth_m
    reach_px = _REACH_SIGMAS * (options.place.sigma_px + vague_px)
    return _Projections(view, landmark, anchor, end, reach_px, options.place.sigma_px)


_ROUNDS = 4
_CLEAR = float(np.log(10.0))
"""Log of the odds by which an observation must belong to one landmark rather than any other, and by
which it must be the right one of two observations in one image."""
_RIVAL = 2.0 * _CLEAR
"""An explanation this much worse than the owner's is no rival. The owner's position is biased by
the observation, and perhaps by others."""
_NAMED = 4.0
"""Prior log-odds that a label belongs to the landmark of its element's other labels: 1 of 50 does
not."""
_OWN_OBSERVATIONS, _OWN_FRAMES = 3, 2
"""Least number of observations and frames that nothing else explains, for a real landmark."""


@dataclass(frozen=True, eq=False)
class ObservationOwners:
    """The landmark of each of k observations."""

    landmark: IntArray
    """(k,) landmark or ``LEFT_OUT``"""
    unclear: BoolArray
    """(k,) whether the observation may also be of another landmark"""

    @property
    def used(self) -> IntArray:
        """(k,) the landmark that each observation is used for, or ``LEFT_OUT``."""
        return np.where(self.unclear, LEFT_OUT, self.landmark)

    def differ(self, other: "ObservationOwners") -> BoolArray:
        """Return which observations (k,) differ."""
        return np.asarray((self.landmark != other.landmark) | (self.unclear != other.unclear))


class SharedObservationResolver:
    """Resolves which of n landmarks own k observations of label elements."""

    def __init__(
        self,
        views: ViewArray,
        observations: ObservationArray,
        kind_of: IntArray,
        movable: BoolArray,
        kind: IntArray,
        apart: IntArray,
        options: LinkOptions,
    ) -> None:
        """Classes are ``kind_of`` (k,) of observations and ``kind`` (n,) of landmarks.

        Observations that are not ``movable`` (k,) stay. Landmarks known to differ, in pairs
        ``apart`` (a, 2), never own an observation of each other.
        """
        self._views = views
        self._observations = observations
        self._kind_of = kind_of
        self._movable = movable
        self._kind = kind
        self._apart = np.concatenate([apart, apart[:, ::-1]]) @ (len(kind), 1)
        """Numbers of these pairs, in both orders."""
        self._options = options

    def resolved(
        self, landmark: IntArray, placed: Landmarks
    ) -> tuple[ObservationOwners, Landmarks]:
        """Return new owners for observations of landmarks (k,), and the landmarks triangulated
        again."""
        owners = ObservationOwners(landmark, np.zeros(len(landmark), dtype=bool))
        for _ in range(_ROUNDS):
            new = self._round(owners, placed)
            if not new.differ(owners).any():
                break
            placed = self._placed(placed, owners, new)
            owners = new
        return owners, placed

    def _round(self, owners: ObservationOwners, placed: Landmarks) -> ObservationOwners:
        failure = candidates.insufficient_observations(
            self._views, self._of_landmarks(owners.used), placed, self._options.min_frames
        )
        placed = replace(placed, failure=failure)
        in_map = np.append(placed.ok, False)[owners.landmark]
        rivals, contested = self._rivals(owners.landmark, in_map, placed)
        if not contested.any():
            return replace(owners, unclear=owners.unclear & ~in_map)
        certain = np.where(in_map & ~contested, owners.landmark, LEFT_OUT)
        own = CandidateExplanations(np.flatnonzero(contested), owners.landmark[contested])
        claims = own.and_(rivals)
        proven, places = self._certain_positions(certain, np.unique(claims.landmark), placed)
        fits, score = claims.tested(self._views, self._observations, places, self._options)
        score += _NAMED * self._is_named(claims, certain)
        may_win = fits & self._is_candidate(claims, owners.landmark, in_map, proven)
        nobody_else = ~np.isin(own.observation, claims.observation[may_win])
        may_win[: len(own)] |= nobody_else
        claims, score = claims.where(may_win), score[may_win]
        winners = claims.where(self._clearly_best(claims, score))
        return self._assigned(owners, winners, contested, in_map)

    def _rivals(
        self, owner: IntArray, in_map: BoolArray, placed: Landmarks
    ) -> tuple[CandidateExplanations, BoolArray]:
        """Return claims on observations of other landmarks, or of none, and which observations (k,)
        of landmarks in the map are contested.

        A landmark claims another's observation only if it has none in that image, or if both would
        gain by an exchange. An observation without a landmark can only replace one in the same
        image.
        """
        claims = nearby_explanations(
            self._views, self._observations, self._kind_of, placed, self._kind, self._options
        )
        claims = claims.where(self._movable[claims.observation])
        of = owner[claims.observation]
        claims = claims.where((of != claims.landmark) & ~self._are_apart(of, claims.landmark))
        gain = self._gain(claims, in_map, owner, candidates.LandmarkPositions.of(placed))
        claims, gain = claims.where(gain > -_RIVAL), gain[gain > -_RIVAL]
        has_owner = in_map[claims.observation]
        holder = self._holders(claims, np.where(in_map, owner, LEFT_OUT))
        better = self._better_exchanged(claims, gain, holder, owner)
        free = holder == LEFT_OUT
        counts = np.where(has_owner, free | better, ~free & self._movable[holder])
        contested = np.zeros(len(owner), dtype=bool)
        contested[claims.observation[counts & has_owner]] = True
        contested[holder[counts & ~has_owner]] = True
        return claims.where(counts), contested

    def _are_apart(self, first: IntArray, second: IntArray) -> BoolArray:
        """Return whether first and second landmarks (c,), or ``LEFT_OUT``, are known to differ."""
        return np.isin(first * len(self._kind) + second, self._apart)

    def _cells(self, claims: CandidateExplanations) -> IntArray:
        """Return numbers (c,) of landmark and image; each such cell has at most one observation."""
        return claims.landmark * len(self._views) + self._observations.view[claims.observation]

    def _names(self, claims: CandidateExplanations) -> IntArray:
        """Return numbers (c,) of observation and landmark."""
        return claims.observation * len(self._kind) + claims.landmark

    def _holders(self, claims: CandidateExplanations, owner: IntArray) -> IntArray:
        """Return the present observation (c,) in each claimed cell, or ``LEFT_OUT``."""
        held = np.flatnonzero(owner != LEFT_OUT)
        row = _rows_of(self._cells(CandidateExplanations(held, owner[held])), self._cells(claims))
        return np.append(held, LEFT_OUT)[row]

    def _gain(
        self,
        claims: CandidateExplanations,
        in_map: BoolArray,
        owner: IntArray,
        places: candidates.LandmarkPositions,
    ) -> FloatArray:
        """Return the gain in log-likelihood (c,) of each claim over the owner in the map; -infinity
        if the observation does not fit."""
        fits, score = claims.tested(self._views, self._observations, places, self._options)
        rows = np.flatnonzero(in_map[claims.observation] & fits)
        now = CandidateExplanations(claims.observation[rows], owner[claims.observation[rows]])
        _, present = now.tested(self._views, self._observations, places, self._options)
        score[rows] -= present
        return np.where(fits, np.where(in_map[claims.observation], score, 0.0), -np.inf)

    def _better_exchanged(
        self, claims: CandidateExplanations, gain: FloatArray, holder: IntArray, owner: IntArray
    ) -> BoolArray:
        """Return which claims (c,) gain clearly if the observation and the one in its cell are
        exchanged."""
        back = CandidateExplanations(holder, owner[claims.observation])
        reverse = _rows_of(self._names(claims), self._names(back))
        return (reverse >= 0) & (gain + gain[reverse] >= _CLEAR)

    def _certain_positions(
        self, certain: IntArray, landmarks: IntArray, placed: Landmarks
    ) -> tuple[BoolArray, candidates.LandmarkPositions]:
        """Triangulate ``landmarks`` from their certain observations (k,) alone; return which
        landmarks (n,) that succeeds for, and all positions."""
        touched = np.zeros(len(self._kind), dtype=bool)
        touched[landmarks] = True
        observations = self._of_landmarks(certain).only(touched)
        alone = triangulate_landmarks(self._views, observations, self._options.place)
        few = observations.seen < _OWN_OBSERVATIONS
        few |= candidates.frames_of(self._views, observations) < _OWN_FRAMES
        alone.failure[few] = "too few of its own"
        places = candidates.LandmarkPositions.of(placed)
        places.put(landmarks, alone)
        proven = np.ones(len(self._kind), dtype=bool)
        proven[landmarks] = alone.ok
        return proven, places

    def _is_named(self, claims: CandidateExplanations, certain: IntArray) -> BoolArray:
        """Return whether another, certain label of the same element belongs to the claiming
        landmark (c,)."""
        rows = np.flatnonzero(certain != LEFT_OUT)
        element, count = self._observations.landmark, len(self._kind)
        named = element[rows] * count + certain[rows]
        return np.isin(element[claims.observation] * count + claims.landmark, named)

    def _is_candidate(
        self, claims: CandidateExplanations, owner: IntArray, in_map: BoolArray, proven: BoolArray
    ) -> BoolArray:
        """Return whether each claim (c,) may win: its landmark is proven; or neither it nor the
        owner is, and it has more observations."""
        counts = np.bincount(owner[in_map], minlength=len(self._kind))
        landmark, of = claims.landmark, owner[claims.observation]
        larger = (counts[landmark] > counts[of]) | (
            (counts[landmark] == counts[of]) & (landmark < of)
        )
        return np.asarray(proven[landmark] | (in_map[claims.observation] & ~proven[of] & larger))

    def _clearly_best(self, claims: CandidateExplanations, score: FloatArray) -> BoolArray:
        """Return the claims (c,) that clearly lead both their observation and their cell."""
        return _leads(claims.observation, score) & _leads(self._cells(claims), score)

    def _assigned(
        self,
        owners: ObservationOwners,
        winners: CandidateExplanations,
        contested: BoolArray,
        in_map: BoolArray,
    ) -> ObservationOwners:
        """Assign contested observations to the winners; those replaced in their cell get no
        landmark."""
        landmark, unclear = owners.landmark.copy(), (owners.unclear & ~in_map) | contested
        rows = np.flatnonzero(contested)
        replaced_ = np.isin(
            self._cells(CandidateExplanations(rows, landmark[rows])), self._cells(winners)
        )
        landmark[rows[replaced_]] = LEFT_OUT
        landmark[winners.observation] = winners.landmark
        unclear[winners.observation] = False
        return ObservationOwners(landmark, unclear)

    def _placed(
        self, placed: Landmarks, old: ObservationOwners, new: ObservationOwners
    ) -> Landmarks:
        """Triangulate the landmarks again whose observations have changed."""
        moved = old.used != new.used
        touched = np.isin(np.arange(len(self._kind)), [old.used[moved], new.used[moved]])
        before, now = self._of_landmarks(old.used), self._of_landmarks(new.used)
        chi2_of = np.full(len(moved), np.nan)
        chi2_of[before.label_row] = placed.chi2_of
        same = replace(placed, chi2_of=chi2_of[now.label_row])
        again = triangulate_landmarks(self._views, now.only(touched), self._options.place)
        return replaced(same, now, touched, again)

    def _of_landmarks(self, landmark: IntArray) -> ObservationArray:
        return self._observations.regrouped(landmark, len(self._kind))


def _rows_of(keys: IntArray, wanted: IntArray) -> IntArray:
    """Return the row (w,) of each wanted key among unique keys (k,); -1 if absent."""
    order = np.argsort(keys)
    row = np.append(order, -1)[np.searchsorted(keys[order], wanted)]
    return np.where(np.append(keys, -1)[row] == wanted, row, -1)


def _leads(group: IntArray, score: FloatArray) -> BoolArray:
    """Return whether each score (c,) is clearly the best of its group."""
    order = np.lexsort((-score, group))
    group, score = group[order], score[order]
    again = group[1:] == group[:-1]
    close = again & (score[:-1] - score[1:] < _CLEAR)
    best = ~np.append(False, again) & ~np.append(close, False)
    result = np.empty(len(order), dtype=bool)
    result[order] = best[: len(order)]
    return result
