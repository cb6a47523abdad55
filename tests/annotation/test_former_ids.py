"""Landmarks keep their ids when a map is made again."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tiled_maps import made_map

from semviz_annotation.mapping.drives.former_ids import with_former_ids
from semviz_core.base.semantic_map import Provenance, SemanticMap

Sources = list[set[str]]
SOURCES = st.lists(st.sets(st.sampled_from("abcdefgh")), min_size=1, max_size=8)


def map_of(sources: Sources, first_id: int) -> SemanticMap:
    """A map with one element for each set of labels that it was made from."""
    semantic_map = made_map(0, len(sources), 0)
    ids = first_id + np.arange(len(sources))
    return replace(
        semantic_map,
        elements=replace(semantic_map.elements, id=ids),
        provenance=tuple(Provenance(tuple(sorted(labels))) for labels in sources),
        attributes={int(id_): {"row": str(row)} for row, id_ in enumerate(ids)},
    )


def test_a_landmark_is_the_one_with_which_it_shares_most() -> None:
    former = map_of([{"a", "b", "c"}, {"d"}, {"e"}], first_id=10)
    again = with_former_ids(map_of([{"x"}, {"d", "a", "b"}, {"c"}, {"e"}], first_id=1), former)
    assert again.elements.id.tolist() == [10, 12, 13, 14]
    assert [origin.label_ids for origin in again.provenance] == [
        ("a", "b", "d"),
        ("e",),
        ("x",),
        ("c",),
    ]
    assert [again.attributes[id_]["row"] for id_ in (10, 12, 13, 14)] == ["1", "3", "0", "2"]


@given(SOURCES, SOURCES)
def test_ids_are_kept_once_and_new_ones_are_above(sources: Sources, others: Sources) -> None:
    former, new = map_of(sources, first_id=5), map_of(others, first_id=1)
    again = with_former_ids(new, former)
    ids = again.elements.id.tolist()
    assert ids == sorted(set(ids))
    sources_of = dict(zip(former.elements.id.tolist(), sources, strict=True))
    for id_, origin in zip(ids, again.provenance, strict=True):
        assert id_ not in sources_of or sources_of[id_] & set(origin.label_ids)
    anchors = {tuple(anchor) for anchor in again.elements.anchor_m.tolist()}
    assert anchors == {tuple(anchor) for anchor in new.elements.anchor_m.tolist()}


@given(SOURCES)
def test_the_same_map_keeps_all(sources: Sources) -> None:
    distinct = [
        {f"{row}{label}" for label in labels} | {str(row)} for row, labels in enumerate(sources)
    ]
    former = map_of(distinct, first_id=3)
    again = with_former_ids(map_of(distinct, first_id=1), former)
    assert again.elements.id.tolist() == former.elements.id.tolist()
