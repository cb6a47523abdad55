"""Files of cities, OpenStreetMap, Autoware and OpenDRIVE that were refused or misread."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semviz_annotation.map_formats.conversion import MapImportContext, parse_length_m
from semviz_annotation.map_formats.exchange import import_map
from semviz_annotation.map_formats.georeference import Georeference
from semviz_annotation.map_formats.sign_codes import sign_class
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.errors import SemvizError

HERE = Georeference(49.0, 8.4, 115.0)
READING = MapImportContext(MapFrame("town"))
AT_HERE = replace(READING, anchor=HERE)


def point(**properties: object) -> dict[str, object]:
    geometry = {"type": "Point", "coordinates": [8.4001, 49.0001]}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def geojson(tmp_path: Path, *features: object) -> Path:
    path = tmp_path / "town.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def osm(tmp_path: Path, content: str) -> Path:
    path = tmp_path / "town.osm"
    path.write_text(f'<?xml version="1.0"?><osm version="0.6">{content}</osm>')
    return path


def xodr(tmp_path: Path, signals: str, header: str = "") -> Path:
    path = tmp_path / "town.xodr"
    path.write_text(
        f"<OpenDRIVE><header>{header}</header><road id='1' length='100'><planView>"
        "<geometry s='0' x='0' y='0' hdg='0' length='100'><line/></geometry></planView>"
        f"<signals>{signals}</signals></road></OpenDRIVE>"
    )
    return path


def signal(country: str, kind: str = "205") -> str:
    return (
        f"<signal s='10' t='3' id='1' zOffset='2' height='0.6' country='{country}' type='{kind}' "
        "subtype='-1' dynamic='no'/>"
    )


@pytest.mark.parametrize(
    "text",
    ["8", "8 m", "8m", "8.0", "8,0 m", "26.247 ft", 8, "8 metres", "800 cm", "26' 3\"", "8 M."],
)
def test_lengths_as_cities_write_them(text: object) -> None:
    assert parse_length_m(text) == pytest.approx(8.0, abs=2e-3)


@pytest.mark.parametrize("text", ["high", "8 km", "", "-3"])
def test_unclear_lengths_are_refused(text: str) -> None:
    with pytest.raises(SemvizError, match="is not a length"):
        parse_length_m(text)


def test_lamps_of_a_city_by_a_property_or_as_a_constant(tmp_path: Path) -> None:
    lamps = geojson(tmp_path, point(kind="Laterne", height="8 m"), point(kind="Baum"))
    mapped = replace(AT_HERE, class_property="kind", class_map={"Laterne": "pole"})
    town, report = import_map(lamps, mapped)
    assert town.elements.class_id.tolist() == [POLE]
    assert (town.elements.anchor_m - town.elements.end_m)[0] == pytest.approx([0, 0, 8])
    assert any("--class-map Baum=CLASS" in what for what in report.dropped)

    constant = replace(AT_HERE, all_of_class="pole", pole_height_m=6.0)
    town, report = import_map(lamps, constant)
    assert (town.elements.anchor_m - town.elements.end_m)[:, 2] == pytest.approx([8.0, 6.0])
    assert report.assumed["heights of poles: 6 m where there is none"] == 1


def test_heights_that_cities_do_not_know_are_the_default(tmp_path: Path) -> None:
    heights = [None, "", "unbekannt", "8-10 m", 0, 4711, "7,5", 9.25]
    lamps = geojson(tmp_path, *(point(Masthoehe=height) for height in heights))
    asked = replace(AT_HERE, all_of_class="pole", height_property="Masthoehe", pole_height_m=6.0)
    town, report = import_map(lamps, asked)
    lengths = (town.elements.anchor_m - town.elements.end_m)[:, 2]
    assert lengths == pytest.approx([6.0] * 6 + [7.5, 9.25])
    assert report.dropped == {
        "heights such as 'unbekannt': no length, such as 8 or '8 m'": 1,
        "heights such as '8-10 m': no length, such as 8 or '8 m'": 1,
        "heights such as 0 m: no pole is that high": 1,
        "heights such as 4711 m: no pole is that high": 1,
    }


def test_openstreetmap_as_gdal_and_overpass_write_it(tmp_path: Path) -> None:
    """Empty columns, tags within ``other_tags``, ids as texts, points in lists of one."""
    columns = {"name": None, "barrier": None, "highway": None, "man_made": None}
    hidden = '"power"=>"pole","height"=>"9 m","note"=>"a \\"b\\", \\"c\\""'
    pole = point(osm_id="10054740829", other_tags=hidden, **columns)
    lamp = point(osm_id="7", other_tags=None, **columns | {"highway": "street_lamp", "height": "5"})
    sign = point(**{"@id": "node/42", "traffic_sign": "GB:602"})
    sign["geometry"] = {"type": "MultiPoint", "coordinates": [[8.4, 49.0, 117.0]]}
    hydrant = point(osm_id="8", other_tags='"emergency"=>"fire_hydrant"', **columns)
    town, report = import_map(geojson(tmp_path, pole, lamp, sign, hydrant), AT_HERE)
    assert town.elements.class_id.tolist() == [POLE, POLE, TRIANGULAR]
    assert town.elements.id.tolist() == [10054740829, 7, 42]
    assert (town.elements.anchor_m - town.elements.end_m)[:2, 2] == pytest.approx([9.0, 5.0])
    assert town.elements.anchor_m[2] == pytest.approx([0.0, 0.0, 2.0], abs=1e-6)
    assert sum("say --class-property" in what for what in report.dropped) == 1


def test_tags_of_openstreetmap_in_geojson(tmp_path: Path) -> None:
    path = geojson(
        tmp_path,
        point(highway="street_lamp"),
        point(power="pole", height="9 m"),
        point(traffic_sign="DE:205"),
        point(traffic_sign="DE:274[30],1040"),
        point(traffic_sign="city_limit"),
        point(amenity="bench"),
    )
    town, report = import_map(path, replace(AT_HERE, pole_height_m=7.0, sign_height_m=2.2))
    assert town.elements.class_id.tolist() == [POLE, POLE, TRIANGULAR, ROUNDED, RECTANGULAR]
    assert town.elements.anchor_m[2, 2] - town.elements.end_m[0, 2] == pytest.approx(2.2)
    assert any(what.startswith("features without 'class'") for what in report.dropped)
    with pytest.raises(SemvizError, match="--pole-height"):
        import_map(geojson(tmp_path, point(highway="street_lamp")), AT_HERE)


def test_an_extract_of_openstreetmap(tmp_path: Path) -> None:
    path = osm(
        tmp_path,
        '<node id="5" lat="49.0001" lon="8.4001"><tag k="highway" v="street_lamp"/></node>'
        '<node id="6" lat="49.0001" lon="8.4002"><tag k="traffic_sign" v="DE:206"/></node>'
        '<node id="7" lat="49.0001" lon="8.4003"><tag k="traffic_sign" v="XX:9"/></node>'
        '<node id="8" lat="49.0" lon="8.4"/><node id="9" lat="49.001" lon="8.4"/>'
        '<way id="1"><nd ref="8"/><nd ref="9"/><tag k="highway" v="residential"/></way>',
    )
    town, report = import_map(path, replace(AT_HERE, pole_height_m=7.0))
    assert town.elements.id.tolist() == [5, 6]
    assert town.elements.class_id.tolist() == [POLE, ROUNDED]
    assert any("--class-map XX:9=CLASS" in what for what in report.dropped)


def test_local_coordinates_of_autoware(tmp_path: Path) -> None:
    def node(id_: int, x: float, y: float, ele: float) -> str:
        tags = {"local_x": x, "local_y": y, "ele": ele}
        inner = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        return f'<node id="{id_}" lat="" lon="">{inner}</node>'

    nodes = node(1, 10, 5, 2) + node(2, 10.6, 5, 2) + node(3, 20, 5, 0) + node(4, 20, 5, 6)
    ways = (
        '<way id="7"><nd ref="1"/><nd ref="2"/><tag k="type" v="traffic_sign"/>'
        '<tag k="subtype" v="stop_sign"/><tag k="height" v="0.6"/></way>'
        '<way id="8"><nd ref="3"/><nd ref="4"/><tag k="type" v="pole"/></way>'
    )
    town, report = import_map(osm(tmp_path, nodes + ways), READING)
    assert town.elements.class_id.tolist() == [ROUNDED, POLE]
    assert town.elements.anchor_m == pytest.approx(np.array([[10.3, 5, 2.3], [20, 5, 6]]))
    assert any("local_x, local_y" in what for what in report.assumed)


@pytest.mark.parametrize("scale", [1.0, 0.99])
def test_autoware_tells_where_its_map_is(tmp_path: Path, scale: float) -> None:
    """Nodes with both coordinates fix the origin, if the two agree; a wrong scale does not."""
    place = Georeference(35.9, 139.93, 12.0, 81.0)
    local = np.array([[500.0, -300.0, 2.0], [500.0, -300.0, 8.0], [900.0, 40.0, 1.0]])
    nodes = ""
    for id_, ((x, y, z), (lon, lat, ele)) in enumerate(
        zip(local, place.to_wgs84(local), strict=True)
    ):
        tags = {"local_x": scale * x, "local_y": y, "ele": ele}
        inner = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
        nodes += f'<node id="{id_}" lat="{lat:.11f}" lon="{lon:.11f}">{inner}</node>'
        assert ele == pytest.approx(z + 12.0, abs=0.1)
    way = '<way id="8"><nd ref="0"/><nd ref="1"/><tag k="type" v="pole"/></way>'
    town, _ = import_map(osm(tmp_path, nodes + way), READING)
    assert town.elements.end_m[0, :2] == pytest.approx([scale * 500.0, -300.0])
    if scale != 1.0:
        assert town.frame.origin is None
        return
    assert town.frame.origin is not None
    assert town.frame.origin[:2] == pytest.approx((35.9, 139.93), abs=1e-5)
    assert town.frame.origin[2] == pytest.approx(0.0, abs=0.1)  # of the curvature in between
    assert town.frame.x_heading_deg == pytest.approx(81.0, abs=0.01)


def test_an_extract_without_heights_is_at_the_height_of_the_origin(tmp_path: Path) -> None:
    lamp = '<node id="5" lat="49.0" lon="8.4"><tag k="highway" v="street_lamp"/></node>'
    town, _ = import_map(osm(tmp_path, lamp), replace(AT_HERE, pole_height_m=7.0))
    assert town.elements.end_m[0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("country", ["de", "DE", "DEU", "Germany", "OpenDRIVE", ""])
def test_countries_of_opendrive(tmp_path: Path, country: str) -> None:
    town, report = import_map(xodr(tmp_path, signal(country)), READING)
    assert town.elements.class_id.tolist() == [TRIANGULAR]
    is_guess = country in ("OpenDRIVE", "")
    assert any("as in Germany" in what for what in report.assumed) == is_guess


def test_signs_of_other_countries(tmp_path: Path) -> None:
    signs = signal("USA", "R1-1") + signal("SWE", "c") + signal("FRA", "AB4") + signal("XX", "8")
    town, report = import_map(xodr(tmp_path, signs), READING)
    assert town.elements.class_id.tolist() == [ROUNDED, ROUNDED, ROUNDED]
    assert any("xx8" in what for what in report.dropped)
    assert not any("Vienna" in what for what in report.assumed)

    town, report = import_map(xodr(tmp_path, signal("HU", "A") + signal("Hungary", "B2")), READING)
    assert town.elements.class_id.tolist() == [TRIANGULAR, ROUNDED]
    assert report.assumed["signs of 'HU': by the Vienna Convention's letters"] == 1


T, Q, O = TRIANGULAR, RECTANGULAR, ROUNDED  # noqa: E741  as in the catalogues


@pytest.mark.parametrize(
    ("code", "class_id"),
    [
        ("de205", T), ("de274-50", O), ("de274_1", Q), ("de274.1", Q), ("de341", None),
        ("de1040-30", Q), ("dea", None), ("at52.24", O), ("at52.23", T), ("beb15b", T),
        ("brr-1", O), ("brr-2", T), ("bra-18", Q), ("cara-2", T), ("ch3.02", T), ("ch2.59.1", Q),
        ("ch1.22", None), ("czp6", O), ("dkb13", O), ("esr-1", T), ("esr-301", O), ("fib5", T),
        ("frab4", O), ("frab3a", T), ("frb14", O), ("frb30", Q), ("gb602", T), ("gb515.1", Q),
        ("gb600", None), ("jp330", T), ("nlb06", T), ("nlb6", T), ("nlc3", Q), ("no202", T),
        ("no138", None), ("plb-20", O), ("pla-7", T), ("ru1.11.1", T), ("ru1.3.1", None),
        ("ru3.24", O), ("seb-4", Q), ("sec-31", O), ("ua2.1", T), ("usr1-1", O), ("usr1-10", Q),
        ("usw3-1", Q), ("usR1-2", T), ("stop_sign", O), ("stop_line", None), ("segment", None),
        ("", None), ("de", None), ("traffic_sign", None),
    ],
)  # fmt: skip
def test_the_shape_of_a_sign_by_its_catalogue(code: str, class_id: int | None) -> None:
    assert sign_class(code) == class_id


UTM = "<geoReference>+proj=utm +zone=32 +datum=WGS84</geoReference>"
OFFSET = "<offset x='458000' y='5428000' z='110' hdg='0'/>"


def test_an_offset_in_utm_is_the_origin_of_the_map(tmp_path: Path) -> None:
    town, report = import_map(xodr(tmp_path, signal("DE"), UTM + OFFSET), READING)
    assert town.elements.anchor_m[0, :2] == pytest.approx([10, 3])
    assert town.frame.origin == pytest.approx((49.00347, 8.42574, 110.0), abs=1e-4)
    assert town.frame.x_heading_deg == pytest.approx(89.567, abs=0.01)  # the grid's convergence
    assert any(what.startswith("origin: that of the file") for what in report.assumed)


def test_coordinates_in_utm_are_moved_near_the_origin(tmp_path: Path) -> None:
    path = xodr(tmp_path, signal("DE"), UTM)
    path.write_text(path.read_text().replace("x='0' y='0'", "x='458123' y='5428456'"))
    town, report = import_map(path, READING)
    assert town.elements.anchor_m[0, :2] == pytest.approx([133, 459])
    assert any("moved by -458000, -5428000 m" in what for what in report.assumed)
