"""Streets with worn signs: everything but the signs is as on the street with new ones."""

import numpy as np

from semviz_core.base.classes import RECTANGULAR
from semviz_core.simulation.layout import StreetOptions, lay_out_street
from semviz_core.simulation.street import Street

WORN = StreetOptions(frames=3, signs="worn")


def test_worn_signs_stand_where_the_new_ones_do_and_nothing_else_changes() -> None:
    new, worn = lay_out_street(5, StreetOptions(frames=3)), lay_out_street(5, WORN)
    assert [sign.id for sign in worn.signs] == [sign.id for sign in new.signs]
    for before, after in zip(new.signs, worn.signs, strict=True):
        assert np.array_equal(before.middle_m, after.middle_m)
    assert [pole.id for pole in worn.poles] == [pole.id for pole in new.poles]
    assert len({sign.look for sign in worn.signs}) > 3
    assert sum(sign.class_id == RECTANGULAR for sign in worn.signs) > len(worn.signs) / 3


def test_worn_signs_are_painted_the_same_each_time_and_differ_from_new_ones() -> None:
    first, again = Street(5, WORN).image(1, "left"), Street(5, WORN).image(1, "left")
    assert np.array_equal(first, again)
    changed = (first != Street(5, StreetOptions(frames=3)).image(1, "left")).any(axis=2)
    assert 0 < changed.mean() < 0.1


def test_labels_of_worn_signs_are_the_middles_of_their_plates() -> None:
    street = Street(5, WORN)
    seen, ids = street.labels(1, "left")
    signs = {sign.id: sign for sign in street.layout.signs}
    rectangular = seen.class_id == RECTANGULAR
    assert rectangular.any()
    for middle, id_ in zip(seen.anchor_px[rectangular], ids[rectangular].tolist(), strict=True):
        assert np.allclose(street.view(1, "left").project(signs[id_].middle_m[None])[0], middle)
