"""The stages of association: link label elements, improve the poses, triangulate the landmarks.

Parts of label elements are linked, and the poses optimized if they may move. Then each landmark is
triangulated from all observations that fit it and no other landmark.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.association import shared_observations
from semviz_annotation.mapping.association.candidates import insufficient_observations
from semviz_annotation.mapping.association.merging import (
    LinkOptions,
    TrackMerging,
    find_outliers,
    main_first,
    parts,
    placed_near,
)
from semviz_annotation.mapping.association.nodes import (
    LEFT_OUT,
    CannotLink,
    Reason,
    ReviewConstraints,
    TrackNodes,
    cannot_link_constraints,
)
from semviz_annotation.mapping.placement import triangulation
from semviz_annotation.mapping.placement.bundle_adjustment import RefineOptions, bundle_adjust
from semviz_annotation.mapping.placement.landmarks import Landmarks, replaced, uprighted
from semviz_annotation.mapping.placement.observations import (
    LabelObservations,
    ObservationArray,
    ViewArray,
)
from semviz_core.common.arrays import BoolArray, IntArray
from semviz_core.common.progress import OnCount, OnProgress


class ForbiddenMerge(NamedTuple):
    """Two nodes whose landmarks would merge if they did not exclude each other."""

    nodes: tuple[int, int]
    reason: Reason
    chi2: float
    freedom: int


@dataclass(frozen=True, eq=False)
class Tracks:
    """The labels as n landmarks, some of which have no position, and how they were found."""

    gathered: LabelObservations
    constraints: ReviewConstraints
    failure: NDArray[np.object_]
    """(n,) why a label element has no position as labelled; empty if it has one"""
    nodes: TrackNodes
    """The m parts of label elements."""
    alone: Landmarks
    """The landmarks of the nodes, each triangulated alone."""
    landmark: IntArray
    """(m,) landmark of each node"""
    observations: ObservationArray
    """The observations of the landmarks, without those left out."""
    placed: Landmarks
    """The landmarks; those that are not for the map have a failure, too."""
    apart: tuple[ForbiddenMerge, ...]
    unclear: BoolArray
    """(k,) whether a gathered observation is not used because it may be of another landmark"""
    unused: str = ""
    """Why observations of landmarks in the map are not used; default: they do not fit."""


def find_tracks(
    labels: Labels,
    gathered: LabelObservations,
    options: LinkOptions,
    poses: RefineOptions | None,
    on_progress: OnProgress,
) -> Tracks:
    """Return the tracks of all labels: nodes linked, poses optimized if ``poses`` is not None, and
    each landmark triangulated from the observations that fit it and no other landmark."""
    tracks = _link(labels, gathered, options, on_progress)
    if poses is not None:
        tracks = _adjust_poses(tracks, poses, on_progress)
        options = replace(options, pose_sigma_m=min(options.pose_sigma_m, LinkOptions.pose_sigma_m))
    return _select_for_map(_resolve_shared(tracks, options), options)


def _link(
    labels: Labels,
    gathered: LabelObservations,
    options: LinkOptions,
    on_progress: OnProgress,
) -> Tracks:
    views, observations = gathered.views, gathered.observations
    constraints = ReviewConstraints.of(labels, gathered.elements)
    whole = triangulation.triangulate_landmarks(
        views, observations, options.place, _named("placing labels", on_progress)
    )
    nodes, alone = _split_elements(views, observations, whole, constraints, options)
    cannot_link = cannot_link_constraints(labels, gathered, nodes, constraints)
    kind = _kinds(gathered)[nodes.element]
    merging = TrackMerging(views, nodes.observations, alone, kind, cannot_link, options)
    merging.run(_named("linking", on_progress))
    group, outlier = _without_poor_members(views, nodes, merging, options)
    roots, landmark = np.unique(group, return_inverse=True)
    of_observation = np.append(landmark, LEFT_OUT)[nodes.of_observation]
    of_observation[outlier & ~constraints.kept[observations.landmark]] = LEFT_OUT
    tracked = observations.regrouped(of_observation, len(roots))
    placed = triangulation.triangulate_landmarks(
        views, tracked, options.place, _named("placing landmarks", on_progress)
    )
    linked = np.bincount(landmark, minlength=len(roots)) > 1
    placed = _retriangulate_linked(views, tracked, placed, linked, merging, roots, options)
    return Tracks(
        gathered=gathered,
        constraints=constraints,
        failure=whole.failure,
        nodes=nodes,
        alone=alone,
        landmark=landmark,
        observations=tracked,
        placed=placed,
        apart=tuple(_forbidden_merges(merging, cannot_link)),
        unclear=np.zeros(len(observations), dtype=bool),
    )


def _resolve_shared(tracks: Tracks, options: LinkOptions) -> Tracks:
    """Assign observations that several landmarks explain to one of them, or to none."""
    views, observations, constraints = (
        tracks.gathered.views,
        tracks.gathered.observations,
        tracks.constraints,
    )
    kinds = _kinds(tracks.gathered)
    kind = np.zeros(tracks.observations.count, dtype=np.int64)
    kind[tracks.landmark] = kinds[tracks.nodes.element]
    movable = ~(constraints.kept | constraints.left_out)
    movable[constraints.apart] = False
    resolver = shared_observations.SharedObservationResolver(
        views,
        observations,
        kinds[observations.landmark],
        movable[observations.landmark],
        kind,
        _known_apart(tracks),
        options,
    )
    owner = np.full(len(observations), LEFT_OUT)
    owner[tracks.observations.label_row] = tracks.observations.landmark
    owners, placed = resolver.resolved(owner, tracks.placed)
    if np.array_equal(owners.used, owner):
        return tracks
    return _with_owners(tracks, owners, placed, options)


def _with_owners(
    tracks: Tracks,
    owners: shared_observations.ObservationOwners,
    placed: Landmarks,
    options: LinkOptions,
) -> Tracks:
    """Return the tracks with new owners of observations, whose landmarks are ``placed``.

    Nodes are split by landmark. A node that has lost all its observations becomes a landmark
    without a position.
    """
    views, observations = tracks.gathered.views, tracks.gathered.observations
    before = np.append(tracks.landmark, LEFT_OUT)[tracks.nodes.of_observation]
    owner = np.where(owners.used == LEFT_OUT, before, owners.used)
    nodes = TrackNodes.of(observations, main_first(observations, owner))
    landmark = owner[nodes.first_observation]
    idle = np.isin(
        np.arange(len(nodes)), nodes.of_observation[owners.used != LEFT_OUT], invert=True
    )
    count = tracks.observations.count + int(idle.sum())
    landmark[idle] = np.arange(tracks.observations.count, count)
    nothing = triangulation.triangulate_landmarks(
        views, observations.regrouped(np.full(len(observations), LEFT_OUT), int(idle.sum()))
    )
    nothing.failure[:] = "its labels are not clearly of one landmark"
    now = nodes.of_observation[tracks.nodes.first_observation].tolist()
    apart = (pair._replace(nodes=(now[pair.nodes[0]], now[pair.nodes[1]])) for pair in tracks.apart)
    return replace(
        tracks,
        nodes=nodes,
        alone=triangulation.triangulate_landmarks(views, nodes.observations, options.place),
        landmark=landmark,
        observations=observations.regrouped(owners.used, count),
        placed=Landmarks.joined([placed, nothing]),
        apart=tuple(apart),
        unclear=owners.unclear,
    )


def _known_apart(tracks: Tracks) -> IntArray:
    """Return pairs (a, 2) of landmarks that fit one position but differ: by a person's decision, or
    by an image outside the chosen frames. Pairs in one chosen image are excluded there already."""
    images = [
        set(tracks.observations.view[tracks.observations.landmark == landmark].tolist())
        for pair in tracks.apart
        for landmark in tracks.landmark[list(pair.nodes)]
    ]
    rows = [
        tracks.landmark[list(pair.nodes)]
        for row, pair in enumerate(tracks.apart)
        if pair.reason.by == "human" or not images[2 * row] & images[2 * row + 1]
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _select_for_map(tracks: Tracks, options: LinkOptions) -> Tracks:
    """Drop landmarks with too few observations, except those that a person keeps."""
    views, observations = tracks.gathered.views, tracks.observations
    kept = np.zeros(observations.count, dtype=bool)
    kept[tracks.landmark[tracks.constraints.kept[tracks.nodes.element]]] = True
    placed = _triangulate_kept(views, observations, tracks.placed, kept, options)
    failure = insufficient_observations(views, observations, placed, options.min_frames)
    placed = replace(placed, failure=np.where(kept, placed.failure, failure))
    return replace(tracks, placed=placed)


_LEAN_RAD = float(np.deg2rad(3.0))
"""How far poles lean; detections alone may not tell."""


def finish_detected(tracks: Tracks, element_ids: Collection[str], min_frames: int) -> Tracks:
    """Finish the landmarks of the label elements ``element_ids`` alone, which are of detections.

    Their poles stand upright, as far as the detections allow. Fragments, seen in fewer frames, are
    dropped: parts of a track that did not fit the rest of it.
    """
    views, observations, nodes = tracks.gathered.views, tracks.observations, tracks.nodes
    others = np.array([element.id not in element_ids for element in tracks.gathered.elements])
    detected = np.ones(observations.count, dtype=bool)
    detected[tracks.landmark[(others | tracks.constraints.kept)[nodes.element]]] = False
    failure = insufficient_observations(views, observations, tracks.placed, min_frames)
    failure = np.where(detected, failure, tracks.placed.failure)
    placed = uprighted(tracks.placed, detected, _LEAN_RAD)
    return replace(tracks, placed=replace(placed, failure=failure))


def _kinds(gathered: LabelObservations) -> IntArray:
    """Return the class id of each label element."""
    return np.array([element.class_id for element in gathered.elements], dtype=np.int64)


def _split_elements(
    views: ViewArray,
    observations: ObservationArray,
    whole: Landmarks,
    constraints: ReviewConstraints,
    options: LinkOptions,
) -> tuple[TrackNodes, Landmarks]:
    """Return the nodes and their positions: label elements, split if they hold several
    landmarks."""
    part = parts(views, observations, whole, options.place, options.pose_sigma_m)
    part[constraints.kept[observations.landmark]] = 0
    part[constraints.left_out[observations.landmark]] = LEFT_OUT
    nodes = TrackNodes.of(observations, part)
    return nodes, triangulation.triangulate_landmarks(
        views, nodes.observations, options.place
    ) if part.any() else whole


def _retriangulate_linked(
    views: ViewArray,
    observations: ObservationArray,
    placed: Landmarks,
    linked: BoolArray,
    merging: TrackMerging,
    roots: IntArray,
    options: LinkOptions,
) -> Landmarks:
    """Triangulate linked landmarks (n,) without a position again, near where they were linked.

    Labels of several passes may agree no better than the poses do.
    """
    lost = ~placed.ok & linked
    near = placed_near(views, observations.only(lost), merging.ends_m[roots[lost]], options.place)
    return replaced(placed, observations, lost, near)


def _adjust_poses(tracks: Tracks, options: RefineOptions, on_progress: OnProgress) -> Tracks:
    """Return the tracks after bundle adjustment of landmarks and poses."""
    refined = bundle_adjust(
        tracks.gathered.views,
        tracks.observations,
        tracks.placed,
        options,
        _named("refining poses", on_progress),
    )
    gathered = tracks.gathered._replace(views=refined.views)
    return replace(tracks, gathered=gathered, placed=refined.placed)


def _forbidden_merges(merging: TrackMerging, cannot_link: CannotLink) -> Iterator[ForbiddenMerge]:
    pairs, mark, result = merging.excluded()
    for row in range(len(pairs)):
        marked = cannot_link.marked(int(mark[row]))
        first, second = (
            int(marked[merging.group[marked] == root[row]][0])
            for root in (pairs.vague, pairs.sharp)
        )
        reason = cannot_link.reasons[mark[row]]
        nodes = min(first, second), max(first, second)
        yield ForbiddenMerge(nodes, reason, float(result.chi2[row]), int(result.freedom[row]))


def _named(stage: str, on_progress: OnProgress) -> OnCount:
    return lambda done, of: on_progress(stage, done, of)


def _without_poor_members(
    views: ViewArray, nodes: TrackNodes, merging: TrackMerging, options: LinkOptions
) -> tuple[IntArray, BoolArray]:
    """Detach nodes from their groups if half of their observations do not fit; return the groups
    (m,) and whether each remaining observation (k,) is an outlier."""
    several = np.bincount(merging.group, minlength=len(nodes)) > 1
    grouped = nodes.observations.regrouped(merging.group[nodes.observations.landmark], len(nodes))
    grouped = grouped.where(several[grouped.landmark])
    wrong = find_outliers(views, grouped, merging.ends_m, options.place, options.pose_sigma_m)
    outlier = np.zeros(len(nodes.of_observation), dtype=bool)
    outlier[grouped.label_row[wrong]] = True
    outliers_of = np.bincount(nodes.of_observation[outlier], minlength=len(nodes))
    detached = 2 * outliers_of >= np.maximum(nodes.observations.seen, 1)
    group = np.where(detached, len(nodes) + np.arange(len(nodes)), merging.group)
    outlier &= ~np.append(detached, False)[nodes.of_observation]
    return group, outlier


def _triangulate_kept(
    views: ViewArray,
    observations: ObservationArray,
    placed: Landmarks,
    kept: BoolArray,
    options: LinkOptions,
) -> Landmarks:
    """Triangulate the landmarks (n,) that a person keeps, wherever this is possible at all."""
    kept = kept & ~placed.ok
    narrow = replace(options.place, min_angle_rad=float(np.finfo(np.float64).tiny))
    return replaced(
        placed,
        observations,
        kept,
        triangulation.triangulate_linearly(views, observations.only(kept), narrow),
    )
