"""The simulated street stands where it should, and sections are furnished as they say."""

from typing import Any

import numpy as np
import pytest

from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.common.errors import SemvizError
from semviz_core.localizability.route import CAMERA_HEIGHT_M
from semviz_core.simulation.layout import ROW_SPACING_M, Section, StreetOptions, lay_out_street
from semviz_core.simulation.street import Street

SECTIONS = (
    Section("normal", 60.0),
    Section("sparse", 80.0),
    Section("row", 100.0),
    Section("normal", 60.0),
)


@pytest.fixture(scope="module")
def street() -> Street:
    return Street(7, StreetOptions(frames=240, sections=SECTIONS))


def seen_within_40_m(street: Street, index: int) -> int:
    _, ids = street.labels(index, "left")
    elements = street.truth_map.elements
    anchors = elements.anchor_m[np.searchsorted(elements.id, ids)]
    offset = anchors - street.view(index, "left").center_m
    return int((np.linalg.norm(offset[:, :2], axis=1) < 40.0).sum())


def test_the_same_seed_gives_the_same_street() -> None:
    first, same, other = Street(3), Street(3), Street(4)
    assert first.truth_map.digest == same.truth_map.digest
    assert first.truth_map.digest != other.truth_map.digest
    for a, b in zip(first.frames, same.frames, strict=True):
        assert a.T_map_camera is not None
        assert b.T_map_camera is not None
        assert np.array_equal(a.T_map_camera.as_matrix(), b.T_map_camera.as_matrix())


def test_sections_show_as_many_elements_as_they_say(street: Street) -> None:
    normal = [seen_within_40_m(street, i) for i in range(0, 20, 4)]
    sparse = [seen_within_40_m(street, i) for i in range(62, 98, 4)]
    assert 6 <= np.median(normal) <= 15
    assert all(1 <= count <= 3 for count in sparse)


def test_normal_streets_are_well_furnished() -> None:
    counts = [seen_within_40_m(Street(seed), i) for seed in range(12) for i in (5, 25, 45)]
    assert np.quantile(counts, 0.1) >= 6
    assert np.quantile(counts, 0.9) <= 16


def test_a_row_looks_the_same_from_the_next_pole(street: Street) -> None:
    """Shifted by the spacing, a row of poles falls onto itself: nothing tells the places apart."""
    road, elements = street.layout.road, street.truth_map.elements
    inside = [
        pole
        for pole in street.layout.poles
        if 145.0 < (pole.bottom_m - road.at(0.0, 0.0)) @ road.forward(190.0) < 1e9
    ]
    row = np.array([pole.id for pole in inside if pole.color == inside[0].color])
    begin, end = road.at(145.0, 0.0), road.at(235.0, 0.0)
    along = road.forward(190.0)
    s = (elements.anchor_m - begin) @ along
    in_row = (s > 0.0) & (s < (end - begin) @ along) & np.isin(elements.id, row)
    assert in_row.sum() >= 30
    assert (elements.class_id[in_row] == POLE).all()
    anchors, ends = elements.anchor_m[in_row], elements.end_m[in_row]
    assert np.allclose(anchors - ends, [0.0, 0.0, 3.0])
    step = ROW_SPACING_M * along
    step[2] = road.slope @ step[:2]
    shifted = anchors + step
    gaps = np.linalg.norm(shifted[:, None] - anchors[None], axis=2).min(axis=1)
    assert (np.sort(gaps)[:-2] < 1e-6).all()  # all but the last on each side


def test_poles_and_signs_have_the_benchmarks_figures() -> None:
    streets = [lay_out_street(seed, StreetOptions(frames=400)) for seed in range(6)]
    poles = [pole for made in streets for pole in made.poles]
    signs = [sign for made in streets for sign in made.signs]
    kinds = np.array([pole.kind for pole in poles])
    height = np.array([np.linalg.norm(pole.peak_m - pole.bottom_m) for pole in poles])
    for kind, share, low, high in (
        ("post", 0.4, 2.2, 3.4),
        ("lamp", 0.4, 4, 8),
        ("mast", 0.2, 3, 5),
    ):
        assert abs((kinds == kind).mean() - share) < 0.05
        assert (height[kinds == kind] >= low).all()
        assert (height[kinds == kind] <= high).all()
    expected = 0.75 * (kinds == "post").sum() + 0.15 * (kinds == "lamp").sum()
    assert len(signs) == pytest.approx(expected, rel=0.15)
    classes = np.array([sign.class_id for sign in signs])
    for class_id, share in ((TRIANGULAR, 0.25), (RECTANGULAR, 0.45), (ROUNDED, 0.30)):
        assert abs((classes == class_id).mean() - share) < 0.07
    tilt = np.array([(pole.peak_m - pole.bottom_m)[:2] for pole in poles]) / height[:, None]
    assert np.rad2deg(tilt.std()) == pytest.approx(0.7, rel=0.1)


def test_the_camera_drives_in_the_right_lane_at_its_height() -> None:
    for seed in range(4):
        street = Street(seed)
        road = street.layout.road
        for frame in street.frames:
            assert frame.T_map_camera is not None
            center, forward = frame.T_map_camera.translation, frame.T_map_camera.rotation[:, 2]
            s = float(frame.index)
            offset = center - road.at(s, 0.0)
            assert -3.3 < offset @ road.left(s) < -0.3
            assert abs(offset[2] - CAMERA_HEIGHT_M) < 0.2
            assert np.rad2deg(np.arccos(forward @ road.forward(s))) < 14.0


def test_signs_stand_in_front_of_their_poles_and_face_the_traffic() -> None:
    street = lay_out_street(1, StreetOptions())
    poles = {pole.id: pole for pole in street.poles}
    for sign in street.signs:
        facing = np.cross(sign.right_m, sign.up_m)
        pole = poles[sign.pole_id]
        assert pole.peak_m[2] > sign.middle_m[2] + sign.up_m[2]
        rise = pole.peak_m - pole.bottom_m
        share = (sign.middle_m - pole.bottom_m)[2] / rise[2]
        assert facing @ (sign.middle_m - pole.bottom_m - share * rise) > 0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"frames": 0}, "at least 1 frame"),
        ({"spacing_m": 0.0}, "spacing"),
        ({"sections": ()}, "section"),
    ],
)
def test_impossible_streets_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(SemvizError, match=words):
        StreetOptions(**values)


def test_frames_that_do_not_exist_are_named() -> None:
    with pytest.raises(SemvizError, match="street-2 has no frame 60; give 0 to 59"):
        Street(2).image(60, "left")
