"""Which labels are of one physical thing: label elements, or parts of them, linked."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.labels import Labels
from semviz_annotation.mapping.linking.contest import Contest, Owners
from semviz_annotation.mapping.linking.enough import too_little
from semviz_annotation.mapping.linking.exclusion import Exclusion, Reason
from semviz_annotation.mapping.linking.misfits import main_first, misfits, parts
from semviz_annotation.mapping.linking.nodes import LEFT_OUT, Judged, Nodes, exclusion_of
from semviz_annotation.mapping.linking.rounds import Linking, LinkOptions, placed_near
from semviz_annotation.mapping.placing.place import place, place_linearly
from semviz_annotation.mapping.placing.placed import Placed, replaced
from semviz_annotation.mapping.placing.refine import RefineOptions, refine
from semviz_annotation.mapping.placing.sightings import Gathered, Sightings, Views
from semviz_core.arrays import BoolArray, IntArray

OnProgress: TypeAlias = Callable[[str, int, int], None]
"""What is done, how much of it, out of how much."""


class Apart(NamedTuple):
    """Two nodes whose things would be one, if these two did not exclude each other."""

    nodes: tuple[int, int]
    reason: Reason
    chi2: float
    freedom: int


@dataclass(frozen=True, eq=False)
class Tracks:
    """Labels as n things, some of which may have no place; and what led to them."""

    gathered: Gathered
    judged: Judged
    failure: NDArray[np.object_]
    """(n,) why a label element has no place as it was labelled; empty where it has one"""
    nodes: Nodes
    """m parts of label elements"""
    alone: Placed
    """The nodes, each by itself."""
    thing: IntArray
    """(m,) of each node"""
    sightings: Sightings
    """Of the things, without those left out."""
    placed: Placed
    """The things. Those that are not for the map have a failure, too."""
    apart: tuple[Apart, ...]
    unclear: BoolArray
    """(k,) gathered sightings that are not used because they may be of another thing as well"""
    unused: str = ""
    """Why labels of things in the map are not used, if it is not that they do not fit."""


def find_tracks(
    labels: Labels,
    gathered: Gathered,
    options: LinkOptions,
    poses: RefineOptions | None,
    on_progress: OnProgress,
) -> Tracks:
    """Parts of label elements are linked; the poses improved, where these may move; then each thing
    is placed by all its labels that fit it, and nothing else as well."""
    tracks = _linked(labels, gathered, options, on_progress)
    if poses is not None:
        tracks = _with_poses(tracks, poses, on_progress)
        options = replace(options, pose_sigma_m=min(options.pose_sigma_m, LinkOptions.pose_sigma_m))
    return _for_the_map(_contested(tracks, options), options)


def _linked(
    labels: Labels, gathered: Gathered, options: LinkOptions, on_progress: OnProgress
) -> Tracks:
    views, sightings = gathered.views, gathered.sightings
    judged = Judged.of(labels, gathered.elements)
    whole = place(views, sightings, options.place, _named("placing labels", on_progress))
    nodes, alone = _parted(views, sightings, whole, judged, options)
    exclusion = exclusion_of(labels, gathered, nodes, judged)
    kind = _kinds(gathered)[nodes.element]
    linking = Linking(views, nodes.sightings, alone, kind, exclusion, options)
    linking.run(_named("linking", on_progress))
    group, misfit = _without_strangers(views, nodes, linking, options)
    roots, thing = np.unique(group, return_inverse=True)
    of_sighting = np.append(thing, LEFT_OUT)[nodes.of_sighting]
    of_sighting[misfit & ~judged.kept[sightings.thing]] = LEFT_OUT
    tracked = sightings.regrouped(of_sighting, len(roots))
    placed = place(views, tracked, options.place, _named("placing things", on_progress))
    linked = np.bincount(thing, minlength=len(roots)) > 1
    placed = _linked_at_least_near(views, tracked, placed, linked, linking, roots, options)
    return Tracks(
        gathered=gathered,
        judged=judged,
        failure=whole.failure,
        nodes=nodes,
        alone=alone,
        thing=thing,
        sightings=tracked,
        placed=placed,
        apart=tuple(_apart(linking, exclusion)),
        unclear=np.zeros(len(sightings), dtype=bool),
    )


def _contested(tracks: Tracks, options: LinkOptions) -> Tracks:
    """With sightings that several things explain given to the right one, or to none."""
    views, sightings, judged = tracks.gathered.views, tracks.gathered.sightings, tracks.judged
    kinds = _kinds(tracks.gathered)
    kind = np.zeros(tracks.sightings.count, dtype=np.int64)
    kind[tracks.thing] = kinds[tracks.nodes.element]
    movable = ~(judged.kept | judged.left_out)
    movable[judged.apart] = False
    contest = Contest(
        views,
        sightings,
        kinds[sightings.thing],
        movable[sightings.thing],
        kind,
        _known_apart(tracks),
        options,
    )
    owner = np.full(len(sightings), LEFT_OUT)
    owner[tracks.sightings.observation] = tracks.sightings.thing
    owners, placed = contest.settled(owner, tracks.placed)
    if np.array_equal(owners.used, owner):
        return tracks
    return _with_owners(tracks, owners, placed, options)


def _with_owners(tracks: Tracks, owners: Owners, placed: Placed, options: LinkOptions) -> Tracks:
    """With the things that sightings are of now, which are ``placed`` already.

    Nodes are parts by things. One that has lost all its sightings is a thing without a place.
    """
    views, sightings = tracks.gathered.views, tracks.gathered.sightings
    before = np.append(tracks.thing, LEFT_OUT)[tracks.nodes.of_sighting]
    owner = np.where(owners.used == LEFT_OUT, before, owners.used)
    nodes = Nodes.of(sightings, main_first(sightings, owner))
    thing = owner[nodes.first_sighting]
    idle = np.isin(np.arange(len(nodes)), nodes.of_sighting[owners.used != LEFT_OUT], invert=True)
    count = tracks.sightings.count + int(idle.sum())
    thing[idle] = np.arange(tracks.sightings.count, count)
    nothing = place(views, sightings.regrouped(np.full(len(sightings), LEFT_OUT), int(idle.sum())))
    nothing.failure[:] = "its labels are not clearly of one thing"
    now = nodes.of_sighting[tracks.nodes.first_sighting].tolist()
    apart = (one._replace(nodes=(now[one.nodes[0]], now[one.nodes[1]])) for one in tracks.apart)
    return replace(
        tracks,
        nodes=nodes,
        alone=place(views, nodes.sightings, options.place),
        thing=thing,
        sightings=sightings.regrouped(owners.used, count),
        placed=Placed.joined([placed, nothing]),
        apart=tuple(apart),
        unclear=owners.unclear,
    )


def _known_apart(tracks: Tracks) -> IntArray:
    """(a, 2) things that fit one place and are two, as a person said, or an image that is not among
    the chosen ones. (Of what these show, each has its own.)"""
    images = [
        set(tracks.sightings.view[tracks.sightings.thing == thing].tolist())
        for pair in tracks.apart
        for thing in tracks.thing[list(pair.nodes)]
    ]
    rows = [
        tracks.thing[list(pair.nodes)]
        for row, pair in enumerate(tracks.apart)
        if pair.reason.by == "human" or not images[2 * row] & images[2 * row + 1]
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _for_the_map(tracks: Tracks, options: LinkOptions) -> Tracks:
    """Without what is known too little of, but with all that people want to keep."""
    views, sightings = tracks.gathered.views, tracks.sightings
    kept = np.zeros(sightings.count, dtype=bool)
    kept[tracks.thing[tracks.judged.kept[tracks.nodes.element]]] = True
    placed = _kept_at_any_price(views, sightings, tracks.placed, kept, options)
    failure = too_little(views, sightings, placed, options.min_frames)
    placed = replace(placed, failure=np.where(kept, placed.failure, failure))
    return replace(tracks, placed=placed)


def _kinds(gathered: Gathered) -> IntArray:
    """Classes of the label elements."""
    return np.array([one.class_id for one in gathered.elements], dtype=np.int64)


def _parted(
    views: Views, sightings: Sightings, whole: Placed, judged: Judged, options: LinkOptions
) -> tuple[Nodes, Placed]:
    """What is linked, and where each is by itself: label elements, those that are two in parts."""
    part = parts(views, sightings, whole, options.place, options.pose_sigma_m)
    part[judged.kept[sightings.thing]] = 0
    part[judged.left_out[sightings.thing]] = LEFT_OUT
    nodes = Nodes.of(sightings, part)
    return nodes, place(views, nodes.sightings, options.place) if part.any() else whole


def _linked_at_least_near(
    views: Views,
    sightings: Sightings,
    placed: Placed,
    linked: BoolArray,
    linking: Linking,
    roots: IntArray,
    options: LinkOptions,
) -> Placed:
    """``placed``, with linked things (n,) that have no place near where they were linked.

    Labels of several passes may agree no better than the poses do.
    """
    lost = ~placed.ok & linked
    near = placed_near(views, sightings.only(lost), linking.ends_m[roots[lost]], options.place)
    return replaced(placed, sightings, lost, near)


def _with_poses(tracks: Tracks, options: RefineOptions, on_progress: OnProgress) -> Tracks:
    """The same tracks, with things and poses improved together."""
    refined = refine(
        tracks.gathered.views,
        tracks.sightings,
        tracks.placed,
        options,
        _named("refining poses", on_progress),
    )
    gathered = tracks.gathered._replace(views=refined.views)
    return replace(tracks, gathered=gathered, placed=refined.placed)


def _apart(linking: Linking, exclusion: Exclusion) -> Iterator[Apart]:
    pairs, mark, result = linking.excluded()
    for row in range(len(pairs)):
        marked = exclusion.marked(int(mark[row]))
        one, other = (
            int(marked[linking.group[marked] == root[row]][0])
            for root in (pairs.vague, pairs.sharp)
        )
        reason = exclusion.reasons[mark[row]]
        nodes = min(one, other), max(one, other)
        yield Apart(nodes, reason, float(result.chi2[row]), int(result.freedom[row]))


def _named(what: str, on_progress: OnProgress) -> Callable[[int, int], None]:
    return lambda done, of: on_progress(what, done, of)


def _without_strangers(
    views: Views, nodes: Nodes, linking: Linking, options: LinkOptions
) -> tuple[IntArray, BoolArray]:
    """(m,) groups of nodes as they were linked, but those of which half does not fit by themselves;
    and (k,) the sightings of the other ones that do not fit."""
    several = np.bincount(linking.group, minlength=len(nodes)) > 1
    grouped = nodes.sightings.regrouped(linking.group[nodes.sightings.thing], len(nodes))
    grouped = grouped.where(several[grouped.thing])
    wrong = misfits(views, grouped, linking.ends_m, options.place, options.pose_sigma_m)
    misfit = np.zeros(len(nodes.of_sighting), dtype=bool)
    misfit[grouped.observation[wrong]] = True
    misfits_of = np.bincount(nodes.of_sighting[misfit], minlength=len(nodes))
    stranger = 2 * misfits_of >= np.maximum(nodes.sightings.seen, 1)
    group = np.where(stranger, len(nodes) + np.arange(len(nodes)), linking.group)
    misfit &= ~np.append(stranger, False)[nodes.of_sighting]
    return group, misfit


def _kept_at_any_price(
    views: Views, sightings: Sightings, placed: Placed, kept: BoolArray, options: LinkOptions
) -> Placed:
    """With things (n,) that a person wants in the map, wherever they can be placed at all."""
    kept = kept & ~placed.ok
    narrow = replace(options.place, min_angle_rad=float(np.finfo(np.float64).tiny))
    return replaced(placed, sightings, kept, place_linearly(views, sightings.only(kept), narrow))
