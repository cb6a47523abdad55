"""Nodes that are one thing, found in rounds: each joins the sharper one that explains it best.

Near views say well where a thing is, far ones do not. So the sharp nodes are linked first, and the
vaguer ones join what has come of them; what has no place of its own (one image only) comes last.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from semviz_annotation.mapping.linking.agreement import AT_ONCE, Agreement, Places, agreement
from semviz_annotation.mapping.linking.exclusion import Exclusion, spans
from semviz_annotation.mapping.linking.nearby import Pairs, Spots
from semviz_annotation.mapping.placing.least_squares import PlaceOptions, settled
from semviz_annotation.mapping.placing.placed import Placed, measured
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.errors import SemvizError

_LEVELS_M = (0.5, 1.0, 2.0, 4.0, 8.0, np.inf)
"""How well places must be known for their nodes to take part, level after level."""


@dataclass(frozen=True)
class LinkOptions:
    """When two nodes are one thing."""

    place: PlaceOptions = field(default_factory=PlaceOptions)
    pose_sigma_m: float = 0.05
    """By how much poses may differ between two passes, in each direction."""
    min_frames: int = 1
    """Things seen in fewer are not for the map. What a person drew is no noise, so 1; a machine's
    labels want 2 or 3."""
    chance: float = 1e-4
    """Of leaving apart what is one: the level of each chi2 test."""

    def __post_init__(self) -> None:
        if not (self.pose_sigma_m >= 0.0 and 0.0 < self.chance < 1.0 and self.min_frames >= 1):
            raise SemvizError(
                "pose_sigma_m must be 0 or more, chance between 0 and 1, min_frames 1 or more"
            )

    def fits(self, result: Agreement) -> BoolArray:
        """(p,) which pairs may be one thing."""
        from scipy.special import chdtri

        return np.asarray(result.chi2 <= chdtri(result.freedom, self.chance))


class Linking:
    """n nodes on their way to things, each in the group of one of them."""

    def __init__(
        self,
        views: Views,
        sightings: Sightings,
        placed: Placed,
        kind: IntArray,
        exclusion: Exclusion,
        options: LinkOptions,
    ) -> None:
        """Of the nodes of ``sightings``; those of two kinds (n,) are never one thing."""
        self.group = np.arange(sightings.count)
        """(n,) the node that stands for each one's group."""
        self._views = views
        self._sightings = sightings
        self._kind = kind
        self._exclusion = exclusion
        self._options = options
        self._spots = Spots.of(views, sightings, placed)
        self._places = Places.of(placed)

    @property
    def ends_m(self) -> FloatArray:
        """(n, 6) anchor and end of each group, in the row of the node that stands for it."""
        return self._places.ends_m

    def run(self, on_progress: Callable[[int, int], None]) -> None:
        """Until nothing more fits; ``on_progress`` counts levels."""
        for done, level_m in enumerate(_LEVELS_M):
            fresh = np.ones(len(self.group), dtype=bool)
            while fresh.any():
                fresh = self._round(level_m, fresh)
            on_progress(done + 1, len(_LEVELS_M))

    def excluded(self) -> tuple[Pairs, IntArray, Agreement]:
        """Groups (e pairs) that would be one thing if they did not exclude each other, and have
        places; (e,) the mark that they share; and how well they agree."""
        pairs = self._near(_LEVELS_M[-2])
        mark = self._exclusion.of_groups(self.group).shared(*pairs)
        pairs, mark = pairs.where(mark >= 0), mark[mark >= 0]
        result = self._test(pairs)
        fits = self._options.fits(result)
        return pairs.where(fits), mark[fits], result.where(fits)

    def _round(self, level_m: float, fresh: BoolArray) -> BoolArray:
        """Join what fits best; (n,) the nodes whose chances have changed."""
        pairs = self._near(level_m)
        pairs = pairs.where(fresh[pairs.vague] | fresh[pairs.sharp])
        pairs = pairs.where(~self._exclusion.of_groups(self.group).forbids(*pairs))
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

    def _near(self, level_m: float) -> Pairs:
        groups = np.flatnonzero(self.group == np.arange(len(self.group)))
        return self._spots.pairs(groups, level_m, self._kind, self._options.pose_sigma_m)

    def _clash(self, pairs: Pairs, score: FloatArray) -> BoolArray:
        """(p,) which vague ones exclude a better one that joins the same sharp one."""
        n = len(self.group)
        target = np.full(n, -1)
        target[pairs.sharp] = pairs.sharp
        target[pairs.vague] = pairs.sharp
        rank = np.full(n, -1)
        rank[pairs.vague[np.argsort(-score, kind="stable")]] = np.arange(len(pairs))
        return self._exclusion.of_groups(self.group).clashing(target, rank)[pairs.vague]

    def _join(self, pairs: Pairs) -> None:
        """The vague to the sharp, which are placed again from where they are."""
        if not len(pairs):
            return
        target = np.arange(len(self.group))
        target[pairs.vague] = pairs.sharp
        self.group = target[self.group]
        grown = np.unique(pairs.sharp)
        number = np.full(len(self.group), -1)
        number[grown] = np.arange(len(grown))
        sightings = self._sightings.regrouped(number[self.group][self._sightings.thing], len(grown))
        placed = placed_near(
            self._views, sightings, self._places.ends_m[grown], self._options.place
        )
        self._places.put(grown, placed)
        self._spots.put(grown, placed)

    def _test(self, pairs: Pairs) -> Agreement:
        """Each vague group's sightings at the place of the sharp one."""
        groups = self.group[self._sightings.thing]
        order = np.argsort(groups, kind="stable")
        first, last = (
            np.searchsorted(groups[order], pairs.vague, side=side) for side in ("left", "right")
        )
        parts = np.cumsum(last - first) // AT_ONCE
        results = []
        for number in np.unique(parts):
            some = parts == number
            rows, pair = spans(first[some], last[some])
            sightings = self._sightings.taken(order[rows], pair, int(some.sum()))
            places = self._places[pairs.sharp[some]]
            options = self._options
            results.append(
                agreement(
                    self._views, sightings, places, options.place.sigma_px, options.pose_sigma_m
                )
            )
        return Agreement.joined(results)


def _best_of_each(pairs: Pairs, score: FloatArray) -> IntArray:
    """Rows of the pairs (p,) with the highest score of each vague one."""
    order = np.lexsort((pairs.sharp, -score, pairs.vague))
    _, first = np.unique(pairs.vague[order], return_index=True)
    return np.asarray(order[first])


def placed_near(
    views: Views, sightings: Sightings, ends_m: FloatArray, options: PlaceOptions
) -> Placed:
    """Things from all their views, that are near ends_m (n, 6) already."""
    everything = np.ones(sightings.count, dtype=bool)
    ends_m, cost = settled(views, sightings, ends_m, everything, options)
    failure = np.where(np.isfinite(cost), "", "the views do not agree").astype(object)
    return measured(views, sightings, ends_m, failure, ~everything, np.zeros(len(cost)), options)
