"""Which labels are of which element of a map."""

from collections import Counter
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from semviz_annotation.labels import Labels, Observation
from semviz_annotation.mapping.sightings import Sightings, Views, gather
from semviz_annotation.observe import map_ids
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

    An observation belongs to the element that was made from it, or else from its label element.
    None where no element of the map is labelled twice there. Raises SemvizError as ``gather``, and
    where the map is of another frame.
    """
    check_frame(semantic_map, source)
    row_of_label, row_of_observation = _rows(semantic_map)
    views = Counter(
        row.element_id
        for index in labels.frames
        if frames is None or index in frames
        for row in labels.in_frame(index)
        if row.element_id in row_of_label
    )
    if max(views.values(), default=0) < 2:
        return None
    gathered = gather(labels, source, frames)
    thing = np.array(
        [
            row_of_observation.get(one.id, row_of_label.get(one.element_id, -1))
            for one in gathered.observations
        ],
        dtype=np.int64,
    )
    sightings = gathered.sightings
    return Labelled(
        gathered.views,
        sightings.regrouped(thing[sightings.observation], len(semantic_map)),
        gathered.observations,
    )


def _rows(semantic_map: SemanticMap) -> tuple[dict[str, int], dict[str, int]]:
    """The map's row of each label element, and of each observation, by id."""
    row_of_id = {int(one): row for row, one in enumerate(semantic_map.elements.id)}
    of_label = {label: row_of_id[number] for label, number in map_ids(semantic_map).items()}
    of_observation = {
        observation_id: row
        for row, one in enumerate(semantic_map.provenance)
        for observation_id in one.observation_ids
    }
    return of_label, of_observation
