"""Which labels are of which element of a map."""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from semviz_annotation.labels import Labels, Observation
from semviz_annotation.mapping.placing.sightings import Sightings, Views, gather
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.source import Source


class Labelled(NamedTuple):
    """What is labelled of a map."""

    views: Views
    sightings: Sightings
    """Thing i is the map's element in row i."""
    observations: tuple[Observation, ...]
    """What ``Sightings.observation`` counts."""


@dataclass(frozen=True)
class MapRows:
    """Which row of a map labels belong to."""

    of_label: dict[str, int]
    """By id of label elements; of those in several rows, the one with the smallest id."""
    of_observation: dict[str, int]
    """By id of the observations that the map was made from."""

    def row(self, one: Observation) -> int:
        """That of what was made from ``one``, as its label element may have been split, or else
        that of its label element; -1 where the map does not know that."""
        main = self.of_label.get(one.element_id, -1)
        return main if main < 0 else self.of_observation.get(one.id, main)


@lru_cache(maxsize=4)
def map_rows(semantic_map: SemanticMap) -> MapRows:
    """Of a map with provenance; cached, since frame by frame is asked for it."""
    provenance = semantic_map.provenance
    of_label: dict[str, int] = {}
    of_observation: dict[str, int] = {}
    for row in np.argsort(semantic_map.elements.id)[: len(provenance)].tolist():
        for label_id in provenance[row].label_ids:
            of_label.setdefault(label_id, row)
        of_observation.update(dict.fromkeys(provenance[row].observation_ids, row))
    return MapRows(of_label, of_observation)


def check_frame(semantic_map: SemanticMap, source: Source) -> None:
    """Raises SemvizError where map and images do not share their coordinates."""
    have, want = semantic_map.frame.name, source.map_frame.name
    if have != want:
        raise SemvizError(
            f"the map is of '{have}', the images of '{want}'; choose the map of this sequence"
        )


def labelled(
    semantic_map: SemanticMap,
    labels: Labels,
    source: Source,
    frames: Collection[int] | None = None,
) -> Labelled | None:
    """The labels of the map's elements in ``frames`` (None: all).

    None where no element of the map is labelled twice there. Raises SemvizError as ``gather``, and
    where the map is of another frame.
    """
    check_frame(semantic_map, source)
    rows = map_rows(semantic_map)
    views = Counter(
        row.element_id
        for index in labels.frames
        if frames is None or index in frames
        for row in labels.in_frame(index)
        if row.element_id in rows.of_label
    )
    if max(views.values(), default=0) < 2:
        return None
    gathered = gather(labels, source, frames)
    sightings = gathered.sightings
    thing = np.array([rows.row(one) for one in gathered.observations], dtype=np.int64)
    return Labelled(
        gathered.views,
        sightings.regrouped(thing[sightings.observation], len(semantic_map)),
        gathered.observations,
    )
