"""What the writers of maps share: the plates that signs are drawn as, and what is lost."""

import json

import numpy as np

from semviz_annotation.map_formats.tally import Tally
from semviz_core.arrays import FloatArray
from semviz_core.semantic_map import SemanticMap

PLATE_M = 0.6
"""Width and height of the plate that a sign is drawn as; a map knows its middle only."""


def across_road(semantic_map: SemanticMap) -> FloatArray:
    """(n, 3) unit, level, to the right of who drives past each element; -y without a road.

    The direction is that of the step of ``trajectory_m`` that starts nearest to the anchor.
    """
    anchors, road = semantic_map.elements.anchor_m, semantic_map.trajectory_m
    steps = np.diff(road[:, :2], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    starts, steps = road[:-1][lengths > 0.0], steps[lengths > 0.0]
    if not len(steps):
        return np.tile([0.0, -1.0, 0.0], (len(anchors), 1))
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(starts[:, :2]).query(anchors[:, :2])
    ahead = steps[nearest] / lengths[lengths > 0.0][nearest, None]
    return np.column_stack([ahead[:, 1], -ahead[:, 0], np.zeros(len(anchors))])


def counts(semantic_map: SemanticMap) -> dict[str, int]:
    """How many poles and signs a map holds."""
    lines = int(semantic_map.elements.is_line.sum())
    return {"poles": lines, "signs": len(semantic_map) - lines}


def drop_all_but_places(semantic_map: SemanticMap, tally: Tally) -> None:
    """Note what a format loses that knows only where elements are, and of what class."""
    tally.drop("standard deviations and correlations", len(semantic_map))
    drop_history(semantic_map, tally)
    tally.drop("labels and observations that elements come from", len(semantic_map.provenance))


def drop_history(semantic_map: SemanticMap, tally: Tally) -> None:
    """Note the loss of how the map was made, and of the road."""
    drop_making(semantic_map, tally)
    tally.drop("points of the road that was driven", len(semantic_map.trajectory_m))


def drop_making(semantic_map: SemanticMap, tally: Tally) -> None:
    """Note the loss of what no other format holds."""
    tally.drop("decisions that the map was built by", len(semantic_map.decisions))
    tally.drop("method, settings and label operation of the map", bool(semantic_map.made_by))


def as_json(value: object) -> str:
    """JSON of plain values, numbers with all their digits."""
    return json.dumps(value, allow_nan=False)


def unseen_ends(semantic_map: SemanticMap) -> int:
    """How many ends of poles, and signs, nobody saw."""
    elements = semantic_map.elements
    return int((~elements.anchor_known).sum() + (elements.is_line & ~elements.end_known).sum())
