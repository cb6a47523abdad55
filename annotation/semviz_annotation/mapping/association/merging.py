"""Merging of nodes to landmarks in rounds, from well-located to poorly located ones.

Before, badly fitting observations of a node are set apart. If enough of them agree on another
position, over several frames, they are another landmark under the same name. The rest are outliers.

Then each node joins the better-located landmark that explains it best. Near views locate a landmark
well, far ones do not, so well-located nodes are linked first and others join the result. Nodes
without a position of their own (one image only) come last.
"""

from dataclasses import dataclass, field

import numpy as np

from semviz_annotation.mapping.association import candidates
from semviz_annotation.mapping.association.nodes import LEFT_OUT, CannotLink, spans
from semviz_annotation.mapping.placement import reprojection
from semviz_annotation.mapping.placement.landmarks import Landmarks, measure_landmarks
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_annotation.mapping.placement.reprojection import PlaceOptions, refine_positions
from semviz_annotation.mapping.placement.triangulation import best_of_pairs, triangulate_landmarks
from semviz_core.base.camera import MIN_DEPTH_M
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnCount

CHANCE = 1e-6
"""Probability that a good label counts as an outlier: the level of each chi2 test."""
_MOST_PARTS = 4
_PART_OBSERVATIONS, _PART_FRAMES = 3, 2
"""Least observations and frames of a separate landmark: more than a wrong pair, which always has
some position."""


def find_outliers(
    views: ViewArray,
    observations: ObservationArray,
    ends_m: FloatArray,
    options: reprojection.PlaceOptions,
    pose_sigma_m: float,
) -> BoolArray:
    """Return which observations (k,) do not fit their landmarks at ``ends_m`` (n, 6: anchor and
    end).

    The test allows for pose errors, which matter most in near views.
    """
    from scipy.special import chdtri

    at = reprojection.residuals(views, observations, ends_m[:, :3], ends_m[:, 3:])
    depth = views.depth_m(observations.view, ends_m[observations.landmark, :3])
    pose_px = views.K[observations.view, 0, 0] * pose_sigma_m / np.maximum(depth, MIN_DEPTH_M)
    variance_px2 = (options.sigma_px * at.sigma_ratio) ** 2 + pose_px[:, None] ** 2
    chi2 = (at.pixels_off**2 / variance_px2).sum(axis=1)
    return np.asarray(~at.ahead | (chi2 > chdtri(at.counts.sum(axis=1), CHANCE)))


def parts(
    views: ViewArray,
    observations: ObservationArray,
    placed: Landmarks,
    options: reprojection.PlaceOptions,
    pose_sigma_m: float,
) -> IntArray:
    """Return the part (k,) of its landmark that each observation belongs to.

    0 is the main part, ``LEFT_OUT`` none. Landmarks that are too far away for a position, or seen
    only twice, stay whole.
    """
    part = np.zeros(len(observations), dtype=np.int64)
    ends = np.concatenate([placed.anchor_m, np.nan_to_num(placed.end_m)], axis=1)
    torn = ~placed.ok & ~placed.too_narrow & (observations.seen >= _PART_OBSERVATIONS)
    open_ = torn[observations.landmark]
    rows = placed.ok[observations.landmark]
    open_[rows] = find_outliers(
        views, observations.where(rows), np.nan_to_num(ends), options, pose_sigma_m
    )
    part[open_] = LEFT_OUT
    for number in range(_MOST_PARTS):
        still = np.flatnonzero(open_)
        agreed = still[_agreeing(views, observations.where(open_), options, pose_sigma_m)]
        part[agreed] = number + 1
        open_[agreed] = False
    return main_first(observations, part)


def _agreeing(
    views: ViewArray,
    observations: ObservationArray,
    options: reprojection.PlaceOptions,
    pose_sigma_m: float,
) -> BoolArray:
    """Return which observations (k,) form a landmark of their own, the largest one per landmark."""
    result = np.zeros(len(observations), dtype=bool)
    enough = observations.seen >= _PART_OBSERVATIONS
    rows = np.flatnonzero(enough[observations.landmark])
    if not len(rows):
        return result
    chosen = observations.only(enough)
    X, cost = best_of_pairs(views, chosen, options)
    X, cost = reprojection.refine_positions(views, chosen, X, np.isfinite(cost), options)
    fits = ~find_outliers(views, chosen, X, options, pose_sigma_m)
    fits &= np.isfinite(cost)[chosen.landmark]
    agreed = chosen.where(fits)
    frames = np.unique(np.stack([agreed.landmark, views.frame_index[agreed.view]]), axis=1)[0]
    own = (agreed.seen >= _PART_OBSERVATIONS) & triangulate_landmarks(views, agreed, options).ok
    own &= np.bincount(frames, minlength=chosen.count) >= _PART_FRAMES
    result[rows] = fits & own[chosen.landmark]
    return result


def main_first(observations: ObservationArray, part: IntArray) -> IntArray:
    """Renumber parts (k,) of landmarks from 0, by the number of observations, then by the first.

    ``LEFT_OUT`` stays.
    """
    result = np.full(len(part), LEFT_OUT)
    rows = np.flatnonzero(part != LEFT_OUT)
    key = observations.landmark[rows] * (part.max(initial=0) + 1) + part[rows]
    _, first, index, count = np.unique(
        key, return_index=True, return_inverse=True, return_counts=True
    )
    landmark = observations.landmark[rows][first]
    order = np.lexsort((first, -count, landmark))
    start = np.searchsorted(landmark[order], landmark[order])
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - start
    result[rows] = rank[index]
    return result


_LEVELS_M = (0.5, 1.0, 2.0, 4.0, 8.0, np.inf)
"""Largest position sigma of the nodes that take part, level by level."""


@dataclass(frozen=True)
class LinkOptions:
    """When two nodes are one landmark."""

    place: PlaceOptions = field(default_factory=PlaceOptions)
    pose_sigma_m: float = 0.05
    """Pose error between two passes, in each direction."""
    min_frames: int = 1
    """Landmarks seen in fewer frames are not for the map: 1 for people, 2 or 3 for detectors."""
    chance: float = 1e-4
    """Probability of rejecting a correct merge: the level of each chi2 test."""

    def __post_init__(self) -> None:
        if not (self.pose_sigma_m >= 0.0 and 0.0 < self.chance < 1.0 and self.min_frames >= 1):
            raise SemvizError(
                "pose_sigma_m must be 0 or more, chance between 0 and 1, min_frames 1 or more"
            )

    def fits(self, result: candidates.Agreement) -> BoolArray:
        """Return which pairs (p,) may be one landmark."""
        from scipy.special import chdtri

        return np.asarray(result.chi2 <= chdtri(result.freedom, self.chance))


class TrackMerging:
    """n nodes that are merged to landmarks; each group is named by one of its nodes."""

    def __init__(
        self,
        views: ViewArray,
        observations: ObservationArray,
        placed: Landmarks,
        kind: IntArray,
        cannot_link: CannotLink,
        options: LinkOptions,
    ) -> None:
        """Start with one group per node of ``observations``; classes ``kind`` (n,) never mix."""
        self.group = np.arange(observations.count)
        """(n,) the node that names each node's group"""
        self._views = views
        self._observations = observations
        self._kind = kind
        self._cannot_link = cannot_link
        self._options = options
        self._spots = candidates.GroundPositions.of(views, observations, placed)
        self._places = candidates.LandmarkPositions.of(placed)

    @property
    def ends_m(self) -> FloatArray:
        """(n, 6) anchor and end of each group, in the row of the node that names it."""
        return self._places.ends_m

    def run(self, on_progress: OnCount) -> None:
        """Merge until nothing more fits; ``on_progress`` counts levels."""
        for done, level_m in enumerate(_LEVELS_M):
            fresh = np.ones(len(self.group), dtype=bool)
            while fresh.any():
                fresh = self._round(level_m, fresh)
            on_progress(done + 1, len(_LEVELS_M))

    def excluded(self) -> tuple[candidates.MergeCandidates, IntArray, candidates.Agreement]:
        """Return e pairs of groups that would merge if they did not exclude each other, the mark
        (e,) that they share, and their agreement."""
        pairs = self._near(_LEVELS_M[-2])
        mark = self._cannot_link.of_groups(self.group).shared(*pairs)
        pairs, mark = pairs.where(mark >= 0), mark[mark >= 0]
        result = self._test(pairs)
        fits = self._options.fits(result)
        return pairs.where(fits), mark[fits], result.where(fits)

    def _round(self, level_m: float, fresh: BoolArray) -> BoolArray:
        """Merge the best pairs; return the nodes (n,) whose candidates have changed."""
        pairs = self._near(level_m)
        pairs = pairs.where(fresh[pairs.vague] | fresh[pairs.sharp])
        pairs = pairs.where(~self._cannot_link.of_groups(self.group).forbids(*pairs))
        result = self._test(pairs)
        fits = self._options.fits(result)
        pairs, score = pairs.where(fits), result.log_likelihood[fits]
        best = _best_of_each(pairs, score)
        pairs, score = pairs.where(best), score[best]
        fresh = np.zeros(len(self.group), dtype=bool)
        stays = np.ones(len(self.group), dtype=bool)
        stays[pairs.vague] = False
        ready = stays[pairs.sharp]  # the others wait for what they join to join
        fresh[pairs.vague[~ready]] = True
        pairs, score = pairs.where(ready), score[ready]
        clash = self._clash(pairs, score)
        fresh[pairs.vague[clash]] = True
        pairs = pairs.where(~clash)
        self._join(pairs)
        fresh[pairs.sharp] = True
        return fresh

    def _near(self, level_m: float) -> candidates.MergeCandidates:
        groups = np.flatnonzero(self.group == np.arange(len(self.group)))
        return self._spots.pairs(groups, level_m, self._kind, self._options.pose_sigma_m)

    def _clash(self, pairs: candidates.MergeCandidates, score: FloatArray) -> BoolArray:
        """Return which vague groups (p,) exclude a better one that joins the same sharp group."""
        n = len(self.group)
        target = np.full(n, -1)
        target[pairs.sharp] = pairs.sharp
        target[pairs.vague] = pairs.sharp
        rank = np.full(n, -1)
        rank[pairs.vague[np.argsort(-score, kind="stable")]] = np.arange(len(pairs))
        return self._cannot_link.of_groups(self.group).clashing(target, rank)[pairs.vague]

    def _join(self, pairs: candidates.MergeCandidates) -> None:
        """Merge the vague groups into the sharp ones, and refine their positions."""
        if not len(pairs):
            return
        target = np.arange(len(self.group))
        target[pairs.vague] = pairs.sharp
        self.group = target[self.group]
        grown = np.unique(pairs.sharp)
        number = np.full(len(self.group), -1)
        number[grown] = np.arange(len(grown))
        observations = self._observations.regrouped(
            number[self.group][self._observations.landmark], len(grown)
        )
        placed = placed_near(
            self._views, observations, self._places.ends_m[grown], self._options.place
        )
        self._places.put(grown, placed)
        self._spots.put(grown, placed)

    def _test(self, pairs: candidates.MergeCandidates) -> candidates.Agreement:
        """Test each vague group's observations at the position of the sharp one."""
        groups = self.group[self._observations.landmark]
        order = np.argsort(groups, kind="stable")
        first, last = (
            np.searchsorted(groups[order], pairs.vague, side=side) for side in ("left", "right")
        )
        parts = np.cumsum(last - first) // candidates.AT_ONCE
        results = []
        for number in np.unique(parts):
            some = parts == number
            rows, pair = spans(first[some], last[some])
            observations = self._observations.taken(order[rows], pair, int(some.sum()))
            places = self._places[pairs.sharp[some]]
            options = self._options
            results.append(
                candidates.agreement(
                    self._views, observations, places, options.place.sigma_px, options.pose_sigma_m
                )
            )
        return candidates.Agreement.joined(results)


def _best_of_each(pairs: candidates.MergeCandidates, score: FloatArray) -> IntArray:
    """Return the rows of the pairs (p,) with the highest score of each vague group."""
    order = np.lexsort((pairs.sharp, -score, pairs.vague))
    _, first = np.unique(pairs.vague[order], return_index=True)
    return np.asarray(order[first])


def placed_near(
    views: ViewArray, observations: ObservationArray, ends_m: FloatArray, options: PlaceOptions
) -> Landmarks:
    """Refine landmarks from all their views, starting at ``ends_m`` (n, 6)."""
    everything = np.ones(observations.count, dtype=bool)
    ends_m, cost = refine_positions(views, observations, ends_m, everything, options)
    failure = np.where(np.isfinite(cost), "", "the views do not agree").astype(object)
    return measure_landmarks(
        views, observations, ends_m, failure, ~everything, np.zeros(len(cost)), options
    )
