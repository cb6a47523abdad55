"""Association of labels with map elements, and the labels of an image as Elements2D.

Labels as Elements2D have score 1 and the order of the labels in the frame. A map and images in
different coordinate frames are refused.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from semviz_annotation.labels.labels import Labels, Observation
from semviz_annotation.mapping.placement.observations import (
    ObservationArray,
    ViewArray,
    collect_observations,
)
from semviz_core.base.classes import TRIANGULAR, describe_center, with_center
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Dataset, Side
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError


class LabelAssociation(NamedTuple):
    """The labels of a map's elements."""

    views: ViewArray
    observations: ObservationArray
    """Observations of map elements; landmark i is the element in row i."""
    label_rows: tuple[Observation, ...]
    """The labels that ``ObservationArray.label_row`` refers to."""


@dataclass(frozen=True)
class MapRows:
    """The map row of each label."""

    of_label: dict[str, int]
    """By id of label elements; for elements in several rows, the one with the smallest id."""
    of_observation: dict[str, int]
    """By id of the observations that the map was made from."""

    def row(self, observation: Observation) -> int:
        """Return the row of an observation; -1 if its label element is not in the map.

        A label element may have been split, so observations of the map have rows of their own.
        """
        main = self.of_label.get(observation.element_id, -1)
        return main if main < 0 else self.of_observation.get(observation.id, main)


@lru_cache(maxsize=4)
def map_rows(semantic_map: SemanticMap) -> MapRows:
    """Return the rows of a map with provenance; cached, as it is called for every frame."""
    provenance = semantic_map.provenance
    of_label: dict[str, int] = {}
    of_observation: dict[str, int] = {}
    for row in np.argsort(semantic_map.elements.id)[: len(provenance)].tolist():
        for label_id in provenance[row].label_ids:
            of_label.setdefault(label_id, row)
        of_observation.update(dict.fromkeys(provenance[row].observation_ids, row))
    return MapRows(of_label, of_observation)


def check_frame(semantic_map: SemanticMap, source: Dataset) -> None:
    """Raise SemvizError if map and images are in different map frames."""
    have, want = semantic_map.frame.name, source.map_frame.name
    if have != want:
        raise SemvizError(
            f"the map is of '{have}', the images of '{want}'; choose the map of this sequence"
        )


def associate_labels(
    semantic_map: SemanticMap,
    labels: Labels,
    source: Dataset,
    frames: Collection[int] | None = None,
    sigma_ratio: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> LabelAssociation | None:
    """Return the labels of the map's elements in ``frames`` (None: all).

    ``sigma_ratio`` is that of ``collect_observations``.

    Return None if no element of the map is labelled twice there. Raise SemvizError like
    ``collect_observations``, and if the map is of another frame.
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
    gathered = collect_observations(labels, source, frames, sigma_ratio)
    observations = gathered.observations
    landmark = np.array(
        [rows.row(observation) for observation in gathered.label_rows], dtype=np.int64
    )
    return LabelAssociation(
        gathered.views,
        observations.regrouped(landmark[observations.label_row], len(semantic_map)),
        gathered.label_rows,
    )


def check_triangles(semantic_map: SemanticMap, labels: Labels) -> None:
    """Raise SemvizError if labels of triangular signs mark another point than those of the map."""
    triangular = any(row.class_id == TRIANGULAR for row in labels.elements.values())
    if triangular and labels.triangle_center != semantic_map.triangle_center:
        raise SemvizError(
            f"the map has triangular signs at {describe_center(semantic_map.triangle_center)}, "
            f"the labels at {describe_center(labels.triangle_center)}; "
            "build the map from these labels"
        )


UNKNOWN = -1
"""Instead of the id of a map element, for labels that are not in the map."""


def observe(
    labels: Labels,
    frame_index: int,
    side: Side = "left",
    semantic_map: SemanticMap | None = None,
    sigma_px: float = 1.0,
) -> tuple[Elements2D, IntArray]:
    """Return the m labelled elements of an image and the ids (m,) of their map elements.

    Elements are in the order of ``labels.in_frame``, with score 1 and ``sigma_px`` in each
    direction. Ids follow from the map's provenance; ``UNKNOWN`` if there is none. Raise SemvizError
    if labels and map follow different definitions of triangular signs, and one is labelled here.
    """
    rows = labels.in_frame(frame_index, side)
    nothing = (np.nan, np.nan)
    m = len(rows)
    elements = Elements2D(
        anchor_px=np.array([row.anchor_px for row in rows], dtype=np.float64).reshape(m, 2),
        end_px=np.array([row.end_px or nothing for row in rows], dtype=np.float64).reshape(m, 2),
        class_id=np.array(
            [labels.element(row.element_id).class_id for row in rows], dtype=np.int64
        ),
        score=np.ones(m),
        sigma_px=np.full((m, 2), sigma_px),
        anchor_known=np.array([row.anchor_known for row in rows], dtype=np.bool_),
        end_known=np.array([row.end_known for row in rows], dtype=np.bool_),
    )
    if semantic_map is not None:
        center = semantic_map.triangle_center
        elements = with_center(elements, labels.triangle_center, center)
    return elements, _map_ids(rows, semantic_map)


def _map_ids(rows: Sequence[Observation], semantic_map: SemanticMap | None) -> IntArray:
    """Return the ids (m,) of the map elements of observations."""
    if semantic_map is None:
        return np.full(len(rows), UNKNOWN)
    of_map = map_rows(semantic_map)
    places = [of_map.row(row) for row in rows]
    ids = [UNKNOWN if place < 0 else semantic_map.elements.id[place] for place in places]
    return np.array(ids, dtype=np.int64)
