"""The labels of one image as the observations that a localizer takes."""

from collections.abc import Sequence

import numpy as np

from semviz_annotation.labels import Labels, Observation
from semviz_annotation.mapping.quality.labelled import map_rows
from semviz_core.arrays import IntArray
from semviz_core.elements import Elements2D
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.source import Side

UNKNOWN = -1
"""In place of the id of a map element, for labels that are not in the map."""


def observe(
    labels: Labels,
    frame_index: int,
    side: Side = "left",
    semantic_map: SemanticMap | None = None,
    sigma_px: float = 1.0,
) -> tuple[Elements2D, IntArray]:
    """The m labelled elements of an image, in the order of ``labels.in_frame``, with score 1.

    Beside them (m,) the id of the map element that each belongs to by the map's provenance, or
    ``UNKNOWN``. ``sigma_px`` is how well labels are placed, in each direction.
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
    return elements, _map_ids(rows, semantic_map)


def _map_ids(rows: Sequence[Observation], semantic_map: SemanticMap | None) -> IntArray:
    """(m,) of the map elements that observations belong to."""
    if semantic_map is None:
        return np.full(len(rows), UNKNOWN)
    of_map = map_rows(semantic_map)
    places = [of_map.row(row) for row in rows]
    ids = [UNKNOWN if place < 0 else semantic_map.elements.id[place] for place in places]
    return np.array(ids, dtype=np.int64)
