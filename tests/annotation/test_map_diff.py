"""Two maps compared."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_annotation.labels.labels import Labels, new_id
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.quality.diff import diff_maps, match_elements
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import MapFrame, Provenance, SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.research.evaluation.roads import duplicate_element, move_element, remove_element

NOTHING = [np.nan] * 3
LABELS = {number: new_id() for number in range(1, 9)}


def a_map(labels: dict[int, tuple[int, ...]] | None = None, **values: object) -> SemanticMap:
    """Two poles and two signs, 5 m apart, ids 1 to 4, each of its own label unless told."""
    of = labels or {number: (number,) for number in (1, 2, 3, 4)}
    rows = {1: (0.0, 0), 2: (5.0, 0), 3: (10.0, 1), 4: (15.0, 2), 5: (20.0, 2), 6: (25.0, 0)}
    x = [rows[number][0] for number in of]
    classes = [rows[number][1] for number in of]
    elements = Elements3D.from_ends(
        id=list(of),
        anchor_m=[[x_m, 4.0, 3.0] for x_m in x],
        end_m=[
            [x_m, 4.0, 0.0] if kind == 0 else NOTHING for x_m, kind in zip(x, classes, strict=True)
        ],
        class_id=classes,
        sigma_m=0.1,
    )
    provenance = tuple(
        Provenance(tuple(LABELS[number] for number in numbers)) for numbers in of.values()
    )
    return SemanticMap(elements, MapFrame("here"), provenance=provenance, **values)


def nameless(semantic_map: SemanticMap) -> SemanticMap:
    return replace(semantic_map, provenance=())


def renumbered(semantic_map: SemanticMap, by: int) -> SemanticMap:
    arrays = vars(semantic_map.elements)
    elements = Elements3D(**{**arrays, "id": arrays["id"] + by})
    return replace(semantic_map, elements=elements, provenance=())


def test_a_map_is_as_itself():
    for value in (a_map(), nameless(a_map())):
        diff = diff_maps(value, value)
        assert diff.unchanged == 4
        for name in ("moved", "new", "gone", "merged", "split", "class_changed", "renumbered"):
            assert getattr(diff, name) == ()


@pytest.mark.parametrize("base", [a_map(), nameless(a_map())], ids=["labels", "ids"])
def test_what_moved(base):
    """3 cm and 4 cm are 5 cm, half a sigma of 10 cm; 8 m are 80 sigma; 5 mm are no move."""
    other = move_element(move_element(base, 1, (0.03, 0.0, 0.04)), 3, (0.0, 8.0, 0.0))
    other = move_element(other, 2, (0.005, 0.0, 0.0))
    diff = diff_maps(base, other)
    assert [move.name for move in diff.moved] == ["T-03", "P-01"]
    assert [change.distance_m for change in diff.moved] == pytest.approx([8.0, 0.05])
    assert [move.sigmas for move in diff.moved] == pytest.approx([80.0, 0.5])
    assert diff.unchanged == 2


def test_where_an_unseen_end_is_means_nothing():
    """A pole whose bottom nobody saw is no other pole when it reaches further down."""
    base = a_map()
    arrays = {name: value.copy() for name, value in vars(base.elements).items()}
    arrays["end_m"][0, 2] -= 0.5
    lower = replace(base, elements=Elements3D(**arrays))
    assert [change.distance_m for change in diff_maps(base, lower).moved] == pytest.approx([0.5])
    arrays["end_known"][0] = False
    unseen = replace(base, elements=Elements3D(**arrays))
    assert diff_maps(base, unseen).moved == ()
    assert diff_maps(unseen, base).moved == ()
    arrays["end_m"][0, 0] += 0.3
    aside = replace(base, elements=Elements3D(**arrays))
    (across,) = diff_maps(base, aside).moved
    assert (across.name, across.distance_m) == ("P-01", pytest.approx(0.3))
    assert across.sigmas == pytest.approx(3.0, rel=0.05)


def test_sigmas_need_a_covariance():
    base = a_map()
    exact = Elements3D(**{**vars(base.elements), "covariance_m2": np.zeros((4, 6, 6))})
    diff = diff_maps(replace(base, elements=exact), move_element(base, 1, (1.0, 0.0, 0.0)))
    assert [(change.distance_m, change.sigmas) for change in diff.moved] == [
        (pytest.approx(1.0), None)
    ]


@pytest.mark.parametrize(
    "strip", [lambda semantic_map: semantic_map, nameless], ids=["labels", "ids"]
)
def test_new_and_gone(strip):
    base, other = a_map(), a_map({1: (1,), 3: (3,), 4: (4,), 5: (5,)})
    diff = diff_maps(strip(base), strip(other))
    assert (diff.new, diff.gone, diff.unchanged) == (("R-05",), ("P-02",), 3)
    assert diff_maps(strip(other), strip(base)).new == ("P-02",)


def test_merged_and_split():
    apart, together = a_map(), a_map({1: (1, 2), 3: (3,), 4: (4,)})
    diff = diff_maps(apart, together)
    assert [(merge.one, merge.several) for merge in diff.merged] == [("P-01", ("P-01", "P-02"))]
    assert (diff.split, diff.gone, diff.new) == ((), (), ())
    back = diff_maps(together, apart)
    assert [(split.one, split.several) for split in back.split] == [("P-01", ("P-01", "P-02"))]
    assert (back.merged, back.gone, back.new) == ((), (), ())
    assert diff.unchanged == back.unchanged == 3


def test_labels_that_change_hands():
    """One label element goes from one map element to another: no merge, no split of all."""
    base = a_map({1: (1, 5), 2: (2,)})
    other = a_map({1: (1,), 2: (2, 5)})
    diff = diff_maps(base, other)
    assert (diff.unchanged, diff.merged, diff.split, diff.new, diff.gone) == (2, (), (), (), ())


GROUPS = st.dictionaries(
    st.integers(1, 6), st.frozensets(st.integers(1, 8), max_size=3).map(sorted).map(tuple)
)
"""Labels by id of the map element."""


@given(GROUPS, GROUPS, st.booleans())
def test_every_element_is_told_of_once(mine, theirs, by_place):
    base, other = a_map(mine or {1: ()}), a_map(theirs or {1: ()})
    if by_place:
        base, other = nameless(base), renumbered(other, 3)
    same = match_elements(base, other)
    merged = [row for rows in same.merged.values() for row in rows[1:]]
    split = [row for rows in same.split.values() for row in rows[1:]]
    assert sorted([i for i, _ in same.pairs] + merged + same.gone) == list(range(len(base)))
    assert sorted([j for _, j in same.pairs] + split + same.new) == list(range(len(other)))
    pairs = dict(same.pairs)
    assert all(pairs[rows[0]] == j for j, rows in same.merged.items())
    assert all(pairs[i] == rows[0] for i, rows in same.split.items())


def test_class_changed():
    base = a_map()
    arrays = {**vars(base.elements), "class_id": np.array([0, 0, 1, 3])}
    diff = diff_maps(base, replace(base, elements=Elements3D(**arrays)))
    assert [(change.base, change.other) for change in diff.class_changed] == [("R-04", "O-04")]
    assert (diff.unchanged, diff.renumbered) == (3, ())


def test_maps_without_names_in_common_are_matched_by_place():
    base = a_map()
    diff = diff_maps(base, renumbered(move_element(base, 2, (0.0, 0.5, 0.0)), 100))
    assert [move.name for move in diff.moved] == ["P-102"]
    assert len(diff.renumbered) == 4
    assert (diff.new, diff.gone) == ((), ())
    shifted = renumbered(base, 1)  # P-02 is where P-01 was: their ids mean other landmarks
    assert diff_maps(nameless(base), shifted).moved == ()
    far = renumbered(move_element(base, 1, (0.0, 30.0, 0.0)), 100)
    diff = diff_maps(base, far)
    assert (diff.gone, diff.new) == (("P-01",), ("P-101",))


def test_a_relabelled_element_is_the_same_by_place():
    base, other = a_map(), a_map()
    fresh = (*other.provenance[:3], Provenance((new_id(),)))
    arrays = {**vars(other.elements), "id": np.array([1, 2, 3, 44])}
    diff = diff_maps(base, replace(other, elements=Elements3D(**arrays), provenance=fresh))
    assert [(change.base, change.other) for change in diff.renumbered] == [("R-04", "R-44")]
    assert (diff.new, diff.gone) == ((), ())


def test_maps_built_from_growing_labels(world):
    """Rebuilt after more was labelled: nothing new or gone, each map knows its operation."""
    labels = replace(world.labels(sigma_px=0.5), operation=57)
    first = [row for row in labels.observations.values() if row.frame_index < 3]
    before = replace(Labels.from_rows([*labels.elements.values(), *first]), operation=40)
    base, other = build_map(before, world)[0], build_map(labels, world)[0]
    diff = diff_maps(base, other)
    assert diff.operations == (40, 57)
    assert (diff.new, diff.gone, diff.merged, diff.split) == ((), (), (), ())
    assert diff.unchanged + len(diff.moved) == len(world.landmarks)
    assert all(move.sigmas is not None and move.sigmas < 6.0 for move in diff.moved)


def test_planted_changes_of_a_street(world):
    labels = world.labels()
    base, _ = build_map(labels, world)
    diff = diff_maps(base, remove_element(duplicate_element(base, 4, (0.0, 9.0, 0.0)), 9))
    assert (diff.gone, diff.unchanged) == (("O-09",), 3)
    assert [(split.one, split.several) for split in diff.split] == [("P-04", ("P-04", "P-10"))]
    text = diff.as_text().splitlines()
    assert "gone: O-09" in text
    assert "split: P-04 into P-04, P-10" in text


def test_other_places_are_not_compared():
    with pytest.raises(SemvizError, match="of 'here' and of 'moon'"):
        diff_maps(a_map(), replace(a_map(), frame=MapFrame("moon")))


def test_empty_maps():
    nothing = SemanticMap(Elements3D.from_ends([], [], [], []), MapFrame("here"))
    assert diff_maps(nothing, nothing).unchanged == 0
    assert len(diff_maps(nothing, a_map()).new) == 4
    assert len(diff_maps(a_map(), nothing).gone) == 4
