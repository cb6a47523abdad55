"""Maps with elements on the borders of cells and circles, for tests of maps in tiles."""

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from semviz_core.base.classes import POLE, TRIANGULAR
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import Decision, MapFrame, Provenance, SemanticMap
from semviz_core.common.arrays import FloatArray

HALVES = st.integers(-1300, 1300).map(lambda half: half / 2.0)
"""Coordinates over seven cells of 200 m; in some of the maps points lie just below these."""


def made_map(seed: int, n: int, k: int, *, below: bool = False) -> SemanticMap:
    """A map of n elements and k points of a trajectory, without order."""
    rng = np.random.default_rng(seed)
    anchors = points(rng, n, below)
    is_line = rng.random(n) < 0.5
    ends = np.where(is_line[:, None], anchors - [0.0, 0.0, 4.0], np.nan)
    ids = rng.permutation(10 * n)[:n]
    elements = Elements3D.from_ends(ids, anchors, ends, np.where(is_line, POLE, TRIANGULAR))
    labels = [tuple(f"{id_}{letter}" for letter in "ab"[: id_ % 3]) for id_ in ids.tolist()]
    return SemanticMap(
        elements,
        MapFrame("town"),
        trajectory_m=points(rng, k, below),
        provenance=tuple(Provenance(labels_of, ("seen",), None) for labels_of in labels),
        decisions=tuple(
            Decision("leave out", labels_of, (1,), "machine", "It is blurred.")
            for labels_of in labels[::2]
        ),
        made_by="by hand",
        settings={"method": "none"},
        operation=7,
        attributes={id_: {"material": "steel"} for id_ in ids[::3].tolist()},
    )


def points(rng: np.random.Generator, count: int, below: bool) -> FloatArray:
    placed = rng.integers(-1200, 1201, (count, 3)) / 2.0
    return np.nextafter(placed, -np.inf) if below else placed


MAPS = st.builds(made_map, st.integers(0, 99), st.integers(0, 40), st.integers(0, 40),
                 below=st.booleans())  # fmt: skip


def by_ids(semantic_map: SemanticMap) -> SemanticMap:
    """The same map, its elements in the order of their ids."""
    order = np.argsort(semantic_map.elements.id)
    provenance, attributes = semantic_map.provenance, semantic_map.attributes
    elements = semantic_map.elements[order]
    return replace(
        semantic_map,
        elements=elements,
        provenance=tuple(provenance[row] for row in order.tolist()),
        attributes={id_: attributes[id_] for id_ in elements.id.tolist() if id_ in attributes},
    )
