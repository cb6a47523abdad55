"""Sightings that several things explain, and which of them each is of.

Linking never gives up what it has joined. So a thing can hold a few sightings of another that
stands behind it, and two pairs of labels that are wrong alike are a thing where nothing is. Here
each thing is placed by those sightings alone that nothing else explains. All others go to what
explains them clearly better than anything else does; where nothing does, they are not used.
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.mapping.linking.agreement import Places
from semviz_annotation.mapping.linking.claims import Claims, claims_near
from semviz_annotation.mapping.linking.enough import frames_of, too_little
from semviz_annotation.mapping.linking.nodes import LEFT_OUT
from semviz_annotation.mapping.linking.rounds import LinkOptions
from semviz_annotation.mapping.placing.place import place
from semviz_annotation.mapping.placing.placed import Placed, replaced
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import BoolArray, FloatArray, IntArray

_ROUNDS = 4
_CLEAR = float(np.log(10.0))
"""By how much more likely it must be, as a log of odds, that a sighting is of one thing than of
any other, or that of two sightings in one image it is this one."""
_RIVAL = 2.0 * _CLEAR
"""What explains a sighting this much worse than its owner is no rival, the owner's place being
biased by that sighting and perhaps by others."""
_NAMED = 4.0
"""Log of odds that a label is of the thing that others of its element are of: one in fifty is
not."""
_OWN_SIGHTINGS, _OWN_FRAMES = 3, 2
"""What it takes to be a thing: so many sightings that nothing else explains."""


@dataclass(frozen=True, eq=False)
class Owners:
    """Of which of n things k sightings are."""

    thing: IntArray
    """(k,) or ``LEFT_OUT``"""
    unclear: BoolArray
    """(k,) those that may be of another as well"""

    @property
    def used(self) -> IntArray:
        """(k,) the thing that each places, or ``LEFT_OUT``."""
        return np.where(self.unclear, LEFT_OUT, self.thing)

    def differ(self, other: "Owners") -> BoolArray:
        """(k,)"""
        return np.asarray((self.thing != other.thing) | (self.unclear != other.unclear))


class Contest:
    """k sightings of label elements, and the n things that linking gave them to."""

    def __init__(
        self,
        views: Views,
        sightings: Sightings,
        kind_of: IntArray,
        movable: BoolArray,
        kind: IntArray,
        apart: IntArray,
        options: LinkOptions,
    ) -> None:
        """Sightings are of kinds (k,), things of kinds (n,). Those not ``movable`` (k,) stay, and
        things that are known to be two, in pairs ``apart`` (a, 2), have nothing of each other."""
        self._views = views
        self._sightings = sightings
        self._kind_of = kind_of
        self._movable = movable
        self._kind = kind
        self._apart = np.concatenate([apart, apart[:, ::-1]]) @ (len(kind), 1)
        """Numbers of these pairs, both ways."""
        self._options = options

    def settled(self, thing: IntArray, placed: Placed) -> tuple[Owners, Placed]:
        """Of what sightings are, which were of things (k,) placed so; and these placed anew."""
        owners = Owners(thing, np.zeros(len(thing), dtype=bool))
        for _ in range(_ROUNDS):
            new = self._round(owners, placed)
            if not new.differ(owners).any():
                break
            placed = self._placed(placed, owners, new)
            owners = new
        return owners, placed

    def _round(self, owners: Owners, placed: Placed) -> Owners:
        failure = too_little(
            self._views, self._of_things(owners.used), placed, self._options.min_frames
        )
        placed = replace(placed, failure=failure)
        in_map = np.append(placed.ok, False)[owners.thing]
        rivals, contested = self._rivals(owners.thing, in_map, placed)
        if not contested.any():
            return replace(owners, unclear=owners.unclear & ~in_map)
        sure = np.where(in_map & ~contested, owners.thing, LEFT_OUT)
        own = Claims(np.flatnonzero(contested), owners.thing[contested])
        claims = own.and_(rivals)
        proven, places = self._by_what_is_sure(sure, np.unique(claims.thing), placed)
        fits, score = claims.tested(self._views, self._sightings, places, self._options)
        score += _NAMED * self._is_named(claims, sure)
        may_win = fits & self._is_candidate(claims, owners.thing, in_map, proven)
        nobody_else = ~np.isin(own.sighting, claims.sighting[may_win])
        may_win[: len(own)] |= nobody_else
        claims, score = claims.where(may_win), score[may_win]
        winners = claims.where(self._clearly_best(claims, score))
        return self._given(owners, winners, contested, in_map)

    def _rivals(
        self, owner: IntArray, in_map: BoolArray, placed: Placed
    ) -> tuple[Claims, BoolArray]:
        """Claims to sightings that are of another thing in the map now, or of none; and (k,) which
        sightings of things in the map are contested by them.

        A thing claims what is another's only where it has nothing else in that image, or the two
        had better be exchanged. What is of no thing can only replace what a thing has there.
        """
        claims = claims_near(
            self._views, self._sightings, self._kind_of, placed, self._kind, self._options
        )
        claims = claims.where(self._movable[claims.sighting])
        of = owner[claims.sighting]
        claims = claims.where((of != claims.thing) & ~self._are_apart(of, claims.thing))
        gain = self._gain(claims, in_map, owner, Places.of(placed))
        claims, gain = claims.where(gain > -_RIVAL), gain[gain > -_RIVAL]
        has_owner = in_map[claims.sighting]
        holder = self._holders(claims, np.where(in_map, owner, LEFT_OUT))
        better = self._better_exchanged(claims, gain, holder, owner)
        free = holder == LEFT_OUT
        counts = np.where(has_owner, free | better, ~free & self._movable[holder])
        contested = np.zeros(len(owner), dtype=bool)
        contested[claims.sighting[counts & has_owner]] = True
        contested[holder[counts & ~has_owner]] = True
        return claims.where(counts), contested

    def _are_apart(self, one: IntArray, other: IntArray) -> BoolArray:
        """(c,) things (c,), or ``LEFT_OUT``."""
        return np.isin(one * len(self._kind) + other, self._apart)

    def _cells(self, claims: Claims) -> IntArray:
        """(c,) numbers of thing and image: of one cell, one sighting at most can be."""
        return claims.thing * len(self._views) + self._sightings.view[claims.sighting]

    def _names(self, claims: Claims) -> IntArray:
        """(c,) numbers of sighting and thing."""
        return claims.sighting * len(self._kind) + claims.thing

    def _holders(self, claims: Claims, owner: IntArray) -> IntArray:
        """(c,) the sighting that has the claimed cell now, or ``LEFT_OUT``."""
        held = np.flatnonzero(owner != LEFT_OUT)
        row = _found(self._cells(Claims(held, owner[held])), self._cells(claims))
        return np.append(held, LEFT_OUT)[row]

    def _gain(
        self, claims: Claims, in_map: BoolArray, owner: IntArray, places: Places
    ) -> FloatArray:
        """(c,) by how much more likely each sighting would be of what claims it than of its owner,
        if that is in the map; where it does not fit, -infinity."""
        fits, score = claims.tested(self._views, self._sightings, places, self._options)
        rows = np.flatnonzero(in_map[claims.sighting] & fits)
        now = Claims(claims.sighting[rows], owner[claims.sighting[rows]])
        _, present = now.tested(self._views, self._sightings, places, self._options)
        score[rows] -= present
        return np.where(fits, np.where(in_map[claims.sighting], score, 0.0), -np.inf)

    def _better_exchanged(
        self, claims: Claims, gain: FloatArray, holder: IntArray, owner: IntArray
    ) -> BoolArray:
        """(c,) claims that would clearly gain if the sighting and the holder of its cell were
        exchanged."""
        back = Claims(holder, owner[claims.sighting])
        partner = _found(self._names(claims), self._names(back))
        return (partner >= 0) & (gain + gain[partner] >= _CLEAR)

    def _by_what_is_sure(
        self, sure: IntArray, things: IntArray, placed: Placed
    ) -> tuple[BoolArray, Places]:
        """(n,) which things are placed by their sure sightings (k,) alone; and where they are then,
        of ``things``. The others are as placed."""
        touched = np.zeros(len(self._kind), dtype=bool)
        touched[things] = True
        sightings = self._of_things(sure).only(touched)
        alone = place(self._views, sightings, self._options.place)
        few = sightings.seen < _OWN_SIGHTINGS
        few |= frames_of(self._views, sightings) < _OWN_FRAMES
        alone.failure[few] = "too few of its own"
        places = Places.of(placed)
        places.put(things, alone)
        proven = np.ones(len(self._kind), dtype=bool)
        proven[things] = alone.ok
        return proven, places

    def _is_named(self, claims: Claims, sure: IntArray) -> BoolArray:
        """(c,) whether another label of the same element surely is of the claiming thing."""
        rows = np.flatnonzero(sure != LEFT_OUT)
        element, count = self._sightings.thing, len(self._kind)
        said = element[rows] * count + sure[rows]
        return np.isin(element[claims.sighting] * count + claims.thing, said)

    def _is_candidate(
        self, claims: Claims, owner: IntArray, in_map: BoolArray, proven: BoolArray
    ) -> BoolArray:
        """(c,) whether the thing can have the sighting: it is proven; or neither it nor the owner
        is, and it is the one with more sightings."""
        seen = np.bincount(owner[in_map], minlength=len(self._kind))
        thing, of = claims.thing, owner[claims.sighting]
        larger = (seen[thing] > seen[of]) | ((seen[thing] == seen[of]) & (thing < of))
        return np.asarray(proven[thing] | (in_map[claims.sighting] & ~proven[of] & larger))

    def _clearly_best(self, claims: Claims, score: FloatArray) -> BoolArray:
        """(c,) claims that lead all others to the sighting, and all others of the cell."""
        return _leads(claims.sighting, score) & _leads(self._cells(claims), score)

    def _given(
        self, owners: Owners, winners: Claims, contested: BoolArray, in_map: BoolArray
    ) -> Owners:
        """Contested sightings to the winners; those whose cell another wins are of nothing."""
        thing, unclear = owners.thing.copy(), (owners.unclear & ~in_map) | contested
        rows = np.flatnonzero(contested)
        replaced_ = np.isin(self._cells(Claims(rows, thing[rows])), self._cells(winners))
        thing[rows[replaced_]] = LEFT_OUT
        thing[winners.sighting] = winners.thing
        unclear[winners.sighting] = False
        return Owners(thing, unclear)

    def _placed(self, placed: Placed, old: Owners, new: Owners) -> Placed:
        """Things whose sightings have changed, placed again."""
        moved = old.used != new.used
        touched = np.isin(np.arange(len(self._kind)), [old.used[moved], new.used[moved]])
        before, now = self._of_things(old.used), self._of_things(new.used)
        chi2_of = np.full(len(moved), np.nan)
        chi2_of[before.observation] = placed.chi2_of
        same = replace(placed, chi2_of=chi2_of[now.observation])
        again = place(self._views, now.only(touched), self._options.place)
        return replaced(same, now, touched, again)

    def _of_things(self, thing: IntArray) -> Sightings:
        return self._sightings.regrouped(thing, len(self._kind))


def _found(keys: IntArray, wanted: IntArray) -> IntArray:
    """(w,) the row of each in keys (k,), which are all different; -1 where it is none of them."""
    order = np.argsort(keys)
    row = np.append(order, -1)[np.searchsorted(keys[order], wanted)]
    return np.where(np.append(keys, -1)[row] == wanted, row, -1)


def _leads(group: IntArray, score: FloatArray) -> BoolArray:
    """(c,) whether each is clearly the best of its group."""
    order = np.lexsort((-score, group))
    group, score = group[order], score[order]
    again = group[1:] == group[:-1]
    close = again & (score[:-1] - score[1:] < _CLEAR)
    best = ~np.append(False, again) & ~np.append(close, False)
    result = np.empty(len(order), dtype=bool)
    result[order] = best[: len(order)]
    return result
