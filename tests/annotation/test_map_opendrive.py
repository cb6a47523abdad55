"""OpenDRIVE: where signals and objects stand, by geometry worked out another way."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_files import READING
from scipy.integrate import quad
from scipy.special import fresnel

from semviz_annotation.map_formats.conversion import ExchangeReport, MapImportContext
from semviz_annotation.map_formats.exchange import import_map
from semviz_annotation.map_formats.georeference import Georeference
from semviz_annotation.map_formats.reference_line import Bend, ParamPoly3, Poly3
from semviz_core.base.classes import POLE, ROUNDED, TRIANGULAR
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError

LINE = '<geometry s="0" x="10" y="20" hdg="0.5" length="100"><line/></geometry>'
ENDLESS = '<object type="pole"><repeat s="0" length="1e9" distance="1e-9"/></object>'
POLE_AT_30 = '<object type="pole" id="5" s="30" t="-4" zOffset="0.5" height="6"/>'


def road(
    geometry: str = LINE, objects: str = "", signals: str = "", profile: str = "", id_: int = 1
) -> str:
    return (
        f'<road id="{id_}" length="100"><planView>{geometry}</planView>{profile}'
        f"<objects>{objects}</objects><signals>{signals}</signals></road>"
    )


def read(
    folder: Path, *roads: str, header: str = "", reading: MapImportContext = READING
) -> tuple[SemanticMap, ExchangeReport]:
    path = folder / "town.xodr"
    path.write_text(f"<OpenDRIVE><header>{header}</header>{''.join(roads)}</OpenDRIVE>")
    return import_map(path, reading)


def beside(s: float, t: float) -> FloatArray:
    """(x, y) beside ``LINE``."""
    ahead = np.array([np.cos(0.5), np.sin(0.5)])
    return np.array([10.0, 20.0]) + s * ahead + t * np.array([-ahead[1], ahead[0]])


def test_a_pole_beside_a_line(tmp_path: Path) -> None:
    town, _ = read(tmp_path, road(objects=POLE_AT_30))
    np.testing.assert_allclose(town.elements.end_m[0], [*beside(30, -4), 0.5], atol=1e-12)
    np.testing.assert_allclose(town.elements.anchor_m[0], [*beside(30, -4), 6.5], atol=1e-12)
    assert (town.elements.id[0], town.elements.class_id[0]) == (5, POLE)
    assert town.frame == READING.frame


def test_heights_of_the_road_and_its_tilt(tmp_path: Path) -> None:
    profile = (
        '<elevationProfile><elevation s="0" a="9" b="0" c="0" d="0"/>'
        '<elevation s="20" a="1" b="0.1" c="0.01" d="0.001"/></elevationProfile>'
        '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>'
    )
    town, _ = read(tmp_path, road(objects=POLE_AT_30, profile=profile))
    foot = [*beside(30, -4 * np.cos(0.1)), 1 + 1 + 1 + 1 - 4 * np.sin(0.1) + 0.5]
    np.testing.assert_allclose(town.elements.end_m[0], foot, atol=1e-12)


def test_roads_of_one_name_are_two(tmp_path: Path) -> None:
    other = road(LINE.replace('x="10"', 'x="1010"'), objects=POLE_AT_30)
    town, _ = read(tmp_path, road(objects=POLE_AT_30), other)
    np.testing.assert_allclose(np.diff(town.elements.end_m[:, 0]), [1000.0])


def test_a_tilted_pole(tmp_path: Path) -> None:
    """Pitch turns the top towards where the object looks, roll to its right."""
    for tilt, towards in (("pitch", 0.0), ("roll", -0.5 * np.pi)):
        pole = POLE_AT_30.replace("/>", f' hdg="0.2" {tilt}="0.1"/>')
        town, _ = read(tmp_path, road(objects=pole))
        lean = town.elements.anchor_m[0] - town.elements.end_m[0]
        heading = 0.5 + 0.2 + towards
        level = 6 * np.sin(0.1) * np.array([np.cos(heading), np.sin(heading)])
        np.testing.assert_allclose(lean, [*level, 6 * np.cos(0.1)], atol=1e-12)


def test_a_row_of_lamps(tmp_path: Path) -> None:
    lamps = (
        '<object type="streetLamp" id="1" s="0" t="5" height="8"><repeat s="10" length="60" '
        'distance="20" tStart="5" tEnd="8" zOffsetStart="0" zOffsetEnd="3"/></object>'
    )
    town, _ = read(tmp_path, road(objects=lamps))
    expected = [[*beside(10 + 20 * k, 5 + k), k] for k in range(4)]
    np.testing.assert_allclose(town.elements.end_m, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("signal", "class_id"),
    [
        ('country="DE" type="274" subtype="50"', ROUNDED),
        ('country="de" type="101" subtype="-1"', TRIANGULAR),
        ('country="SE" type="c" subtype="31"', ROUNDED),
        ('country="SE" type="a" subtype="20"', TRIANGULAR),
    ],
)
def test_a_sign_by_its_number(tmp_path: Path, signal: str, class_id: int) -> None:
    text = f'<signal id="3" s="40" t="3" zOffset="2" height="0.6" dynamic="no" {signal}/>'
    town, _ = read(tmp_path, road(signals=text))
    assert town.elements.class_id.tolist() == [class_id]
    np.testing.assert_allclose(town.elements.anchor_m[0], [*beside(40, 3), 2.3], atol=1e-12)
    assert not town.elements.is_line.any()


def test_a_signal_that_stands_elsewhere(tmp_path: Path) -> None:
    kind = 'country="de" type="274" height="0.6" zOffset="2" s="1" t="1"'
    here = f'<signal id="1" {kind}><positionInertial x="1" y="2" z="3" hdg="0"/></signal>'
    other = road(
        id_=2, geometry='<geometry s="0" x="0" y="0" hdg="0" length="9"><line/></geometry>'
    )
    there = f'<signal id="2" {kind}><positionRoad roadId="2" s="5" t="-3" zOffset="4"/></signal>'
    town, _ = read(tmp_path, road(signals=here + there), other)
    np.testing.assert_allclose(town.elements.anchor_m, [[1, 2, 3.3], [5, -3, 4.3]], atol=1e-12)


def test_what_is_neither_pole_nor_sign_is_listed(tmp_path: Path) -> None:
    objects = (
        '<object type="tree" id="1" s="1" t="1" height="4"/>'
        '<object type="tree" id="2" s="1" t="1"/>'
        '<object type="pole" id="3" s="1" t="1"/><object type="pole" id="4" s="200" t="1"/>'
    )
    signals = '<signal s="1" t="1" type="9" country="xx"/><signal s="1" t="1" dynamic="yes"/>'
    _, report = read(tmp_path, road(objects=objects + POLE_AT_30, signals=signals))
    assert report.dropped == {
        "objects of type 'tree': neither pole nor sign": 2,
        "poles without a height: a pole has two ends": 1,
        "objects beyond the end of their road": 1,
        "signals 'xx9': say --class-map xx9=CLASS": 1,
        "signals that change, such as traffic lights: no signs": 1,
    }
    mapped = MapImportContext(MapFrame("town"), class_map={"tree": "pole", "xx9": "rounded sign"})
    town, report = read(tmp_path, road(objects=objects, signals=signals), reading=mapped)
    assert town.elements.class_id.tolist() == [POLE, ROUNDED]


def test_a_file_that_is_on_earth(tmp_path: Path) -> None:
    """UTM and an offset, to the map's own axes, by way of longitude and latitude."""
    from pyproj import Transformer

    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(8.42, 49.01)
    header = (
        "<geoReference><![CDATA[+proj=utm +zone=32 +datum=WGS84 +geoidgrids=egm96_15.gtx]]>"
        f'</geoReference><offset x="{x - 7.0!r}" y="{y!r}" z="2" hdg="0"/>'
    )
    signal = (
        '<signal id="1" country="de" type="274" height="0" s="0" t="0">'
        '<positionInertial x="7" y="0" z="100" hdg="0"/></signal>'
    )
    place = Georeference(49.01, 8.42, 90.0, 120.0)
    town, report = read(
        tmp_path,
        road(signals=signal),
        header=header,
        reading=MapImportContext(READING.frame, anchor=place),
    )
    np.testing.assert_allclose(town.elements.anchor_m, [[0.0, 0.0, 12.0]], atol=1e-3)
    assert town.frame.origin == (49.01, 8.42, 90.0)
    town, report = read(tmp_path, road(signals=signal), header=header)
    np.testing.assert_allclose(town.elements.anchor_m, [[7.0, 0.0, 100.0]])
    assert any("give --anchor" in what for what in report.assumed)


@settings(max_examples=50)
@given(st.floats(-0.1, 0.1), st.floats(1e-5, 0.01), st.floats(0.0, 150.0))
def test_spirals_are_fresnel_s(curvature: float, rate: float, along: float) -> None:
    u, v, angle = Bend(curvature, rate).at(along)
    # theta = k s + r s^2 / 2 = r (s + k/r)^2 / 2 - k^2 / (2 r)
    scale, start = np.sqrt(np.pi / rate), curvature / rate
    (s0, c0), (s1, c1) = (fresnel(x / scale) for x in (start, start + along))
    turned = np.exp(-0.5j * curvature**2 / rate) * scale * (c1 - c0 + 1j * (s1 - s0))
    assert (u, v) == pytest.approx((turned.real, turned.imag), abs=1e-9)
    assert angle == pytest.approx(curvature * along + 0.5 * rate * along**2)


def test_arcs_and_lines() -> None:
    u, v, angle = Bend(-0.05).at(30.0)
    assert (u, v) == pytest.approx((20 * np.sin(1.5), -20 * (1 - np.cos(1.5))))
    assert angle == pytest.approx(-1.5)
    assert Bend(0.0).at(12.0) == pytest.approx((12.0, 0.0, 0.0))


def test_cubics() -> None:
    curve = np.array([0.0, 0.0, 0.01, -0.0001])
    u, v, angle = Poly3(curve).at(40.0)
    speed = quad(lambda x: np.hypot(1.0, 0.02 * x - 0.0003 * x**2), 0.0, u)[0]
    assert speed == pytest.approx(40.0, abs=1e-9)
    assert v == pytest.approx(0.01 * u**2 - 0.0001 * u**3)
    assert np.tan(angle) == pytest.approx(0.02 * u - 0.0003 * u**2)
    straight = np.array([0.0, 50.0, 0.0, 0.0])
    u, v, angle = ParamPoly3(straight, np.array([0.0, 0.0, 10.0, 0.0]), 1.0 / 50.0).at(25.0)
    assert (u, v, np.tan(angle)) == pytest.approx((25.0, 2.5, 10.0 / 50.0))


def test_pieces_follow_one_another(tmp_path: Path) -> None:
    """A pole on the second piece stands beside that one; ``paramPoly3`` counts from 0 to 1."""
    pieces = (
        '<geometry s="50" x="50" y="0" hdg="0" length="50"><paramPoly3 aU="0" bU="50" cU="0" '
        'dU="0" aV="0" bV="0" cV="10" dV="0"/></geometry>'
        '<geometry s="0" x="0" y="0" hdg="0" length="50"><arc curvature="0"/></geometry>'
    )
    pole = '<object type="pole" id="1" s="75" t="0" height="3"/>'
    town, _ = read(tmp_path, road(pieces, pole))
    np.testing.assert_allclose(town.elements.end_m[0], [75.0, 2.5, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (road("", POLE_AT_30), "road 1: a road without geometry"),
        (road(LINE.replace("<line/>", "<bezier/>"), POLE_AT_30), "unknown shape, 'bezier'"),
        (road(LINE.replace("<line/>", ""), POLE_AT_30), "without a shape"),
        (road(LINE.replace('hdg="0.5"', ""), POLE_AT_30), "a geometry without 'hdg'"),
        (road(objects=POLE_AT_30.replace("30", "nan")), "'nan' is not a number"),
        (road(LINE.replace("<line/>", '<arc curvature="1e9"/>'), POLE_AT_30), "turns by 3e"),
        (road(objects=ENDLESS), "repeated too often"),
        (road(), "holds no pole and no sign"),
    ],
)  # fmt: skip
def test_broken_roads_are_named(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(SemvizError, match=words) as refused:
        read(tmp_path, text)
    assert "town.xodr" in str(refused.value)


def test_a_reference_that_nobody_understands(tmp_path: Path) -> None:
    reading = MapImportContext(READING.frame, anchor=Georeference(49.0, 8.4))
    with pytest.raises(SemvizError, match="geoReference 'nowhere' is not understood"):
        read(
            tmp_path, road(objects=POLE_AT_30), header="<geoReference>nowhere</geoReference>",
            reading=reading,
        )  # fmt: skip
