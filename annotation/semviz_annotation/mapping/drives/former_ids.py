"""Keep the ids of landmarks when a map of many drives is made again, with more drives."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from semviz_core.base.semantic_map import Provenance, SemanticMap
from semviz_core.common.arrays import IntArray


def with_former_ids(semantic_map: SemanticMap, former: SemanticMap) -> SemanticMap:
    """Return a map whose landmarks have the ids of those that they were in a former version.

    A landmark is the former one with which it shares most label elements and observations; each
    former one goes on as one landmark at most. Others get the numbers after all former ids, in
    their order. The result is sorted by id.
    """
    ids = _ids(semantic_map, former)
    order = np.argsort(ids)
    new_id = dict(zip(semantic_map.elements.id.tolist(), ids.tolist(), strict=True))
    attributes = {new_id[old]: values for old, values in semantic_map.attributes.items()}
    return replace(
        semantic_map,
        elements=replace(semantic_map.elements, id=ids)[order],
        provenance=tuple(semantic_map.provenance[row] for row in order)
        if semantic_map.provenance
        else (),
        attributes=dict(sorted(attributes.items())),
    )


def _ids(semantic_map: SemanticMap, former: SemanticMap) -> IntArray:
    """Return the new ids (n,) of the landmarks."""
    ids = np.zeros(len(semantic_map), np.int64)
    taken: set[int] = set()
    for _, id_, row in sorted(_shared(semantic_map, former)):
        if not ids[row] and id_ not in taken:
            ids[row] = id_
            taken.add(id_)
    fresh = ids == 0
    ids[fresh] = former.elements.id.max(initial=0) + 1 + np.arange(int(fresh.sum()))
    return ids


def _shared(semantic_map: SemanticMap, former: SemanticMap) -> Iterator[tuple[int, int, int]]:
    """Yield minus the number of sources that a landmark shares with a former one, the id of that,
    and the row of the landmark."""
    rows = zip(former.elements.id.tolist(), former.provenance, strict=False)
    id_of = {source: id_ for id_, origin in rows for source in _sources(origin)}
    for row, origin in enumerate(semantic_map.provenance):
        found = Counter(id_of[source] for source in _sources(origin) if source in id_of)
        for id_, count in found.items():
            yield -count, id_, row


def _sources(origin: Provenance) -> Iterator[str]:
    yield from origin.label_ids
    yield from origin.observation_ids
