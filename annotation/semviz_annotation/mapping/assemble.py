"""Things as the elements of a map: their ids, and where they come from."""

from collections.abc import Iterator

import numpy as np

from semviz_annotation.mapping.linking.tracks import Tracks
from semviz_core.arrays import IntArray
from semviz_core.elements import Elements3D
from semviz_core.semantic_map import Provenance

PART_ID = 1_000_000
"""The id of what was split off a label element is this, times its part, and the number."""


def elements_of(tracks: Tracks) -> tuple[Elements3D, tuple[Provenance, ...]]:
    """The things that have a place, by id, and the labels of each.

    An id is the smallest number among the label elements in a thing, so it stays when labels are
    added; where only parts of label elements are in it, it counts from ``PART_ID``.
    """
    ids, placed = _ids(tracks), tracks.placed
    rows = np.flatnonzero(placed.ok)
    rows = rows[np.argsort(ids[rows])]
    kind = np.zeros(len(ids), dtype=np.int64)
    kind[tracks.thing] = [
        tracks.gathered.elements[row].class_id for row in tracks.nodes.element.tolist()
    ]
    elements = Elements3D(
        id=ids[rows],
        anchor_m=placed.anchor_m[rows],
        end_m=placed.end_m[rows],
        class_id=kind[rows],
        covariance_m2=placed.covariance_m2[rows],
        anchor_known=placed.anchor_known[rows],
        end_known=placed.end_known[rows],
    )
    provenance = list(_provenance(tracks))
    return elements, tuple(provenance[row] for row in rows.tolist())


def _ids(tracks: Tracks) -> IntArray:
    """(n,)"""
    nodes = tracks.nodes
    number = np.array([one.number for one in tracks.gathered.elements], dtype=np.int64)
    ids = np.full(tracks.sightings.count, np.iinfo(np.int64).max)
    np.minimum.at(ids, tracks.thing, number[nodes.element] + PART_ID * nodes.part)
    return ids


def _provenance(tracks: Tracks) -> Iterator[Provenance]:
    """Of each thing: label elements whose main part is in it, or else all, and observations."""
    gathered, nodes, sightings = tracks.gathered, tracks.nodes, tracks.sightings
    order = np.lexsort((nodes.element, tracks.thing))
    members = np.split(order, np.searchsorted(tracks.thing[order], np.arange(1, sightings.count)))
    rows = np.split(sightings.observation, np.cumsum(sightings.seen)[:-1])
    for some, observations in zip(members, rows, strict=True):
        main = some[nodes.part[some] == 0]
        named = main if len(main) else some
        yield Provenance(
            tuple(gathered.elements[row].id for row in nodes.element[named].tolist()),
            tuple(gathered.observations[row].id for row in observations.tolist()),
        )
