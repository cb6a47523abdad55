"""Which labels are of one physical thing: label elements, or parts of them, linked."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.labels import Labels
from semviz_annotation.mapping.linking.exclusion import Exclusion, Reason
from semviz_annotation.mapping.linking.misfits import misfits, parts
from semviz_annotation.mapping.linking.nearby import HARDLY_KNOWN_M, stands
from semviz_annotation.mapping.linking.nodes import LEFT_OUT, Judged, Nodes, exclusion_of
from semviz_annotation.mapping.linking.rounds import Linking, LinkOptions, placed_near
from semviz_annotation.mapping.placing.place import place, place_linearly
from semviz_annotation.mapping.placing.placed import Placed
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
    unused: str = ""
    """Why labels of things in the map are not used, if it is not that they do not fit."""


def find_tracks(
    labels: Labels, gathered: Gathered, options: LinkOptions, on_progress: OnProgress
) -> Tracks:
    """Parts of label elements are linked; each thing is then placed by all its labels that fit."""
    views, sightings = gathered.views, gathered.sightings
    judged = Judged.of(labels, gathered.elements)
    whole = place(views, sightings, options.place, _named("placing labels", on_progress))
    nodes, alone = _parted(views, sightings, whole, judged, options)
    exclusion = exclusion_of(labels, gathered, nodes, judged)
    kind = np.array([one.class_id for one in gathered.elements], dtype=np.int64)[nodes.element]
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
    kept = np.zeros(len(roots), dtype=bool)
    kept[thing[judged.kept[nodes.element]]] = True
    placed = _kept_at_any_price(views, tracked, placed, kept, options)
    _refuse_rare(views, tracked, placed, ~kept, options)
    _refuse_vague(placed, ~kept)
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
    )


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
    return _with(placed, sightings, lost, near)


def with_poses(tracks: Tracks, options: RefineOptions, on_progress: OnProgress) -> Tracks:
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


def _with(placed: Placed, sightings: Sightings, things: BoolArray, others: Placed) -> Placed:
    """With other places of things (n,), of all of which there are ``sightings``."""

    def put(name: str) -> Any:
        values = getattr(placed, name).copy()
        rows = things[sightings.thing] if name == "chi2_of" else things
        values[rows] = getattr(others, name)
        return values

    return Placed(**{one.name: put(one.name) for one in fields(Placed)})


def _kept_at_any_price(
    views: Views, sightings: Sightings, placed: Placed, kept: BoolArray, options: LinkOptions
) -> Placed:
    """With things (n,) that a person wants in the map, wherever they can be placed at all."""
    kept = kept & ~placed.ok
    narrow = replace(options.place, min_angle_rad=float(np.finfo(np.float64).tiny))
    return _with(placed, sightings, kept, place_linearly(views, sightings.only(kept), narrow))


def _refuse_rare(
    views: Views, sightings: Sightings, placed: Placed, things: BoolArray, options: LinkOptions
) -> None:
    """Those of ``things`` (n,) that are seen in too few frames."""
    seen = np.stack([sightings.thing, views.frame_index[sightings.view]])
    frames = np.bincount(np.unique(seen, axis=1)[0], minlength=sightings.count)
    rare = things & placed.ok & (frames < options.min_frames)
    placed.failure[rare] = f"seen in fewer than {options.min_frames} frames"


def _refuse_vague(placed: Placed, things: BoolArray) -> None:
    """Those of ``things`` (n,) whose places are hardly known."""
    _, _, sigma_m = stands(placed)
    vague = things & placed.ok & ~(sigma_m < HARDLY_KNOWN_M)
    placed.failure[vague] = f"where it stands is not known to {HARDLY_KNOWN_M:g} m"
