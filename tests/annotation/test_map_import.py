"""Maps of others: read with a class map, or refused by the right line."""

import json
import random
import re
from pathlib import Path

import numpy as np
import pytest
from map_files import FRAME, KARLSRUHE, READING, feature, small_map
from mutations import mutated

from semviz_annotation.map_formats.conversion import ExchangeReport, MapImportContext
from semviz_annotation.map_formats.exchange import FileFormat, ImportFormat, export_map, import_map
from semviz_annotation.map_formats.georeference import Georeference
from semviz_core.base.classes import POLE, RECTANGULAR, TRIANGULAR
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.errors import SemvizError

HERE = Georeference(49.0, 8.0, 100.0)
AT_HERE = MapImportContext(FRAME, anchor=HERE)
NORTH = [8.0, 49.0001]
OSM = """<osm version="0.6">
 <node id="1" lat="49.0" lon="8.0001"><tag k="ele" v="102"/></node>
 <node id="2" lat="49.0" lon="8.0002"><tag k="ele" v="102"/></node>
 <node id="3" lat="49.0" lon="8.0"><tag k="ele" v="100"/></node>
 <node id="4" lat="49.0" lon="8.0"><tag k="ele" v="106"/></node>
 <way id="9"><nd ref="1"/><nd ref="2"/><tag k="type" v="traffic_sign"/>
  <tag k="subtype" v="de274_1"/><tag k="height" v="0.5"/></way>
 <way id="8"><nd ref="3"/><nd ref="4"/><tag k="type" v="pole"/></way>
 <way id="7"><nd ref="3"/><nd ref="4"/><tag k="type" v="fence"/></way>
 <way id="6"><nd ref="1"/><nd ref="2"/><tag k="type" v="traffic_sign"/><tag k="subtype" v="xx1"/></way>
</osm>"""  # noqa: E501


def geojson(folder: Path, *features: object, **members: object) -> Path:
    path = folder / "town.geojson"
    document = {"type": "FeatureCollection", "features": list(features), **members}
    path.write_text(json.dumps(document))
    return path


def read(path: Path, reading: MapImportContext = AT_HERE) -> tuple[SemanticMap, ExchangeReport]:
    return import_map(path, reading)


def test_points_and_lines_of_others(tmp_path: Path) -> None:
    """Lines may run upwards; points of poles need a height; what has no height is on the ground."""
    path = geojson(
        tmp_path,
        feature("LineString", [[*NORTH, 101.0], [*NORTH, 107.0]], "lamp post", id=12),
        feature("Point", NORTH, "Street-Light", height=4.5, colour="grey"),
        feature("Point", NORTH, "mast"),
        feature("Point", [8.0, 49.0, 102.0], "give way"),
        feature("Polygon", [[NORTH, NORTH, NORTH]], "house"),
    )
    mapped = MapImportContext(FRAME, class_map={"give way": "triangular sign"}, anchor=HERE)
    town, report = read(path, mapped)
    elements = town.elements
    assert elements.class_id.tolist() == [POLE, POLE, TRIANGULAR]
    assert elements.id.tolist() == [12, 13, 14]
    np.testing.assert_allclose(elements.anchor_m[:, 2], [7.0, 4.5, 2.0], atol=1e-4)
    np.testing.assert_allclose(elements.end_m[:2, 2], [1.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(elements.anchor_m[0, :2], [0.0, 11.12], atol=0.01)
    assert report.dropped == {
        "properties 'colour'": 1,
        "poles that are points without a height: say --pole-height METRES": 1,
        "features that are 'Polygon', neither Point nor LineString": 1,
    }
    assert report.assumed == {
        "heights: that of the map's origin where a point has none": 2,
        "numbers: new ones where the file has none, or the same twice": 2,
        "standard deviations: 0.1 m where the file has none": 3,
    }
    np.testing.assert_allclose(elements.covariance_m2[2], np.diag([0.01] * 3 + [0.0] * 3))


def test_lanelet2_of_others(tmp_path: Path) -> None:
    path = tmp_path / "town.osm"
    path.write_text(OSM)
    town, report = read(path)
    assert town.elements.id.tolist() == [9, 8]
    assert town.elements.class_id.tolist() == [RECTANGULAR, POLE]  # 274.1 is a square plate
    sign, peak = town.elements.anchor_m
    np.testing.assert_allclose(sign, [10.97, 0.0, 2.25], atol=0.01)
    np.testing.assert_allclose([peak, town.elements.end_m[1]], [[0, 0, 6], [0, 0, 0]], atol=1e-5)
    assert report.dropped == {
        "ways of type 'fence': neither sign nor pole": 1,
        "signs 'xx1': say --class-map xx1=CLASS": 1,
    }
    mapped = MapImportContext(FRAME, class_map={"xx1": "round", "fence": "ignore"}, anchor=HERE)
    town, report = read(path, mapped)
    assert len(town) == 3
    assert report.assumed["middles of signs: their lower edge where they have no height"] == 1
    assert report.dropped == {"ways of a class that is ignored, as asked": 1}


@pytest.mark.parametrize(
    ("features", "words"),
    [
        ([feature("Point", [8.0, 49.0], "car")],
         "feature 1: class 'car' is not known; say --class-map car=CLASS, CLASS being one of p"),
        ([feature("Point", [8.0, 49.0], "pole"), feature("Point", [8.0], "pole")],
         r"feature 2: \[8.0\] is not longitude, latitude and height"),
        ([feature("Point", [456789.0, 5429000.0], "mast")], "are no degrees of WGS84; convert"),
        ([feature("Point", [49.0, 8.0], "round")], "km from the map's origin .*swapped"),
        ([feature("Point", ["8", "49"], "round")], "'8' is not a number"),
        ([feature("Point", [8.0, 49.0], "round", covariance_enu_m2=[[1, 2]])], "3 by 3 or 6 by 6"),
        ([feature("Point", [8.0, 49.0], "round", covariance_enu_m2=[[10**400] * 3] * 3)],
         "covariance_enu_m2 is not an array of numbers"),
        ([feature("Point", [8.0, 49.0], "round", anchor_known="no")], "neither true nor false"),
        ([feature("Point", [8.0, 49.0], None)], "a class name is expected, not None"),
        ([feature("Point", None, "round")], "no|is not longitude"),
        ([], "holds no pole and no sign that can be read"),
        ([feature("Point", NORTH, "mast")], "no pole and no sign that can be read: 1 x poles that"),
        ([3], "feature 1: an object is expected, not 3"),
    ],
)  # fmt: skip
def test_broken_geojson(tmp_path: Path, features: list[object], words: str) -> None:
    path = geojson(tmp_path, *features)
    with pytest.raises(SemvizError, match=words) as refused:
        read(path)
    message = str(refused.value)
    assert message.startswith(str(path))
    assert message.endswith("Nothing was imported.")
    assert "\n" not in message


def test_a_file_of_ours_that_an_editor_wrote_again(tmp_path: Path) -> None:
    """Its properties are there; what it said of itself, and so its anchor, is not."""
    path = tmp_path / "town.geojson"
    export_map(small_map(), path, None, HERE)
    document = json.loads(path.read_text())
    del document["semviz"]
    path.write_text(json.dumps(document))
    town, report = read(path)
    assert (report.dropped, report.assumed) == ({}, {})
    np.testing.assert_allclose(town.elements.anchor_m, small_map().elements.anchor_m, atol=1e-3)
    np.testing.assert_allclose(town.trajectory_m, small_map().trajectory_m, atol=1e-3)
    assert town.provenance == small_map().provenance


def test_other_reference_systems_and_frames(tmp_path: Path) -> None:
    sign = feature("Point", [8.0, 49.0, 100.0], "round")
    utm = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    with pytest.raises(SemvizError, match="not WGS84; convert the file to EPSG:4326 first"):
        read(geojson(tmp_path, sign, crs=utm))
    named = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    assert len(read(geojson(tmp_path, sign, crs=named))[0]) == 1
    with pytest.raises(SemvizError, match="of the frame 'moon', but this workspace's is 'town'"):
        read(geojson(tmp_path, sign, semviz={"frame": "moon"}))
    with pytest.raises(SemvizError, match=r"is not known; say --anchor LATITUDE,LONGITUDE\[,HEI"):
        read(geojson(tmp_path, sign), READING)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "not XML"),
        (OSM[:400], "not XML"),
        (OSM.replace("osm", "gpx"), "outermost element is 'gpx', not 'osm'"),
        ('<!DOCTYPE osm [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><osm>&b;</osm>', "document type"),
        ('<!DOCTYPE osm SYSTEM "file:///etc/passwd"><osm/>', "declares a document type"),
        (OSM.replace('ref="3"', 'ref="33"'), "way 8: node '33' is missing"),
        (OSM.replace('"8.0001"', '"NaN"'), "way 9: 'NaN' is not a number"),
        (OSM.replace('"8.0001"', '"1e400"'), "is too large"),
        (OSM.replace('lat="49.0" lon="8.0001"', 'lon="8.0001"'), "a node without 'lat'"),
        (re.sub("<nd [^>]*>", "", OSM), "a line without nodes"),
        (OSM.replace("49.0", "98.0"), "are no degrees of WGS84"),
        ('<osm semviz_frame="moon"/>', "a map of the frame 'moon'"),
        ('<osm semviz_frame="town"/>', "without 'semviz_anchor_latitude'"),
        ("<osm/>", "holds no pole and no sign"),
    ],
)
def test_broken_xml(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "town.osm"
    path.write_text(text)
    with pytest.raises(SemvizError, match=words) as refused:
        read(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("anchor_x_m", "x", "no column 'anchor_x_m'; the header is"),
        (",", ";", "no column 'class'; .*; columns are separated by ';', write ','"),
        ("pole", "tower", "line 2: class 'tower' is not known"),
        ("4.0,3.0,6.1", "4.0,nan,6.1", "line 2: 'nan' is not a number"),
        ("4.0,3.0,6.1", ",,", "no numbers in anchor_x_m"),
        (",4.1,3.0,0.1", ",,,", "'pole' without an end"),
        ("town", "moon", "line 2: a map of the frame 'moon'"),
        ("true,true", "true,yes", "end_known is neither true nor false but 'yes'"),
        ("true,true", "true", "more or fewer values"),
        ("4,pole", '"4,pole', "not a CSV table"),
    ],
)
def test_broken_csv(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "town.csv"
    export_map(small_map(), path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(SemvizError, match=words):
        read(path, READING)


def test_a_table_of_unknown_columns_is_refused_in_a_short_line(tmp_path: Path) -> None:
    path = tmp_path / "map.csv"
    path.write_text(",".join(f"column {number}" for number in range(500)) + "\n")
    with pytest.raises(SemvizError) as refused:
        read(path)
    assert len(str(refused.value)) < 1000 + len(str(path))


def test_a_plain_table(tmp_path: Path) -> None:
    path = tmp_path / "town.csv"
    path.write_bytes(b"\xef\xbb\xbfclass,anchor_x_m,anchor_y_m,anchor_z_m,note\nround,1,2,3,x\n")
    town, report = read(path)
    assert town.elements.anchor_m.tolist() == [[1.0, 2.0, 3.0]]
    assert town.frame.origin == HERE.origin
    assert report.dropped == {"columns 'note'": 1}
    assert len(report.assumed) == 2


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(SemvizError, match="cannot be read"):
        read(tmp_path / "town.csv")
    with pytest.raises(SemvizError, match="no format has this ending; say which with --format"):
        read(tmp_path / "town.dxf")
    empty = SemanticMap(Elements3D.from_ends([], [], [], []), MapFrame("town"))
    with pytest.raises(SemvizError, match="the map is empty"):
        export_map(empty, tmp_path / "town.csv")
    with pytest.raises(SemvizError, match="where the map's origin is on Earth is not known"):
        export_map(small_map(), tmp_path / "town.osm")
    with pytest.raises(SemvizError, match="csv is in the map's own metres"):
        export_map(small_map(), tmp_path / "town.csv", None, HERE)
    with pytest.raises(SemvizError, match="not within -90 and 90"):
        Georeference(98.4, 49.0)
    assert list(tmp_path.iterdir()) == []


XODR = """<OpenDRIVE><header/><road id="1" length="100"><planView>
<geometry s="0" x="1" y="2" hdg="0" length="50"><spiral curvStart="0" curvEnd="0.1"/></geometry>
<geometry s="50" x="9" y="9" hdg="1" length="50"><poly3 a="0" b="0" c="0.1" d="0"/></geometry>
</planView><elevationProfile><elevation s="0" a="0" b="0" c="0" d="0"/></elevationProfile>
<objects><object type="pole" id="1" s="60" t="3" zOffset="0" height="5" hdg="0.1">
<repeat s="1" length="50" distance="10" tStart="1" tEnd="2"/></object></objects><signals>
<signal id="2" s="20" t="1" zOffset="2" type="274" country="de" subtype="50" height="0.6"/>
</signals></road></OpenDRIVE>"""


@pytest.mark.parametrize("format_", ["geojson", "lanelet2", "csv", "opendrive"])
def test_only_a_line_comes_out_of_a_reader(tmp_path: Path, format_: ImportFormat) -> None:
    path, rng = tmp_path / "input", random.Random(1)
    if format_ == "opendrive":
        data = XODR.encode()
    else:
        written: FileFormat = format_
        place = None if written == "csv" else KARLSRUHE
        export_map(small_map(), path, written, place)
        data = path.read_bytes()
    whole, refused = 0, list[str]()
    for _ in range(200):
        path.write_bytes(mutated(data, rng))
        try:
            town, _ = import_map(path, MapImportContext(FRAME, anchor=KARLSRUHE), format_)
            assert len(town)
            whole += 1
        except SemvizError as error:
            refused.append(str(error))
    assert min(whole, len(refused)) > 10  # both ways were tried
    assert all("\n" not in message and message.encode() for message in refused)
