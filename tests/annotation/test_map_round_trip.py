"""What a format holds comes back as it was; what it does not hold is listed."""

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from conftest import skip_or_fail
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from map_files import (
    FRAME,
    KARLSRUHE,
    READING,
    any_map,
    assert_near,
    georeferences,
    small_map,
)

from semviz_annotation.map_formats.exchange import FileFormat, export_map, import_map
from semviz_annotation.map_formats.georeference import Georeference
from semviz_core.base.semantic_map import MapFrame, SemanticMap

COUNT = settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])


def there_and_back(
    semantic_map: SemanticMap, path: Path, format_: FileFormat, place: Georeference | None = None
) -> SemanticMap:
    export_map(semantic_map, path, format_, place)
    return import_map(path, READING, format_)[0]


@COUNT
@given(any_map(), georeferences())
def test_geojson(tmp_path: Path, before: SemanticMap, place: Georeference) -> None:
    after = there_and_back(before, tmp_path / "map.geojson", "geojson", place)
    assert_near(before, after, 1e-3)
    scale = np.abs(before.elements.covariance_m2).max()
    np.testing.assert_allclose(
        after.elements.covariance_m2, before.elements.covariance_m2, atol=1e-12 * (1.0 + scale)
    )
    np.testing.assert_array_equal(after.elements.anchor_known, before.elements.anchor_known)
    np.testing.assert_array_equal(after.elements.end_known, before.elements.end_known)
    assert after.frame == MapFrame("town", place.origin, place.x_heading_deg)


@COUNT
@given(any_map(), georeferences())
def test_lanelet2(tmp_path: Path, before: SemanticMap, place: Georeference) -> None:
    after = there_and_back(before, tmp_path / "map.osm", "lanelet2", place)
    assert_near(before, after, 1e-3)
    np.testing.assert_array_equal(after.elements.anchor_known, before.elements.anchor_known)
    np.testing.assert_array_equal(after.elements.end_known, before.elements.end_known)
    assert after.frame == MapFrame("town", place.origin, place.x_heading_deg)


@COUNT
@given(any_map())
def test_csv_is_exact(tmp_path: Path, before: SemanticMap) -> None:
    after = there_and_back(before, tmp_path / "map.csv", "csv")
    assert_near(before, after, 0.0)
    again = there_and_back(after, tmp_path / "again.csv", "csv")
    assert again.digest == after.digest
    sigmas = (
        np.sqrt(np.diagonal(labels.elements.covariance_m2, axis1=1, axis2=2))
        for labels in (before, after)
    )
    np.testing.assert_array_equal(*sigmas)


def test_geojson_brings_back_all_but_the_decisions(tmp_path: Path) -> None:
    before, path = small_map(), tmp_path / "map.geojson"
    report = export_map(before, path, None, KARLSRUHE)
    assert report.as_dict() == {
        "path": str(path),
        "format": "geojson",
        "counts": {"poles": 2, "signs": 3},
        "dropped": {"decisions that the map was built by": 1},
        "assumed": {},
    }
    after, read = import_map(path, READING)
    assert (read.dropped, read.assumed) == ({}, {})
    assert after.provenance == before.provenance
    np.testing.assert_allclose(after.trajectory_m, before.trajectory_m, atol=1e-4)


def test_geojson_is_what_the_standard_says(tmp_path: Path) -> None:
    """Longitude first, height third; east is to the right of north; the ellipsoid is WGS84's."""
    export_map(small_map(), tmp_path / "map.json", None, Georeference(0.0, 8.0, 100.0, 0.0))
    document = json.loads((tmp_path / "map.json").read_text())
    assert document["type"] == "FeatureCollection"
    pole, *_, road = document["features"]
    longitude, latitude, height = pole["geometry"]["coordinates"][0]
    # on the equator a degree east is a * pi / 180; north, by the meridian's radius a (1 - e^2)
    a, e2 = 6378137.0, 0.00669437999014
    assert latitude == pytest.approx(np.rad2deg(4.0 / (a * (1 - e2))), rel=1e-4)  # x is north
    assert longitude - 8.0 == pytest.approx(np.rad2deg(-3.0 / a), rel=1e-4)  # y is west
    assert height == pytest.approx(106.1, abs=1e-4)
    assert pole["id"] == 4
    assert pole["properties"]["label_ids"] == ["label 0"]
    sign = document["features"][2]
    assert sign["geometry"]["type"] == "Point"
    assert np.shape(sign["properties"]["covariance_enu_m2"]) == (3, 3)
    assert road["properties"] == {"semviz": "road"}


def test_lanelet2_lists_what_it_loses(tmp_path: Path) -> None:
    report = export_map(small_map(), tmp_path / "map.osm", None, KARLSRUHE)
    assert report.dropped == {
        "standard deviations and correlations": 5,
        "decisions that the map was built by": 1,
        "points of the road that was driven": 3,
        "labels and observations that elements come from": 5,
    }
    assert set(report.assumed.values()) == {3}


def test_lanelet2_itself_reads_it(tmp_path: Path) -> None:
    """By the package: a sign's way is its lower edge, across the road, as high as it says."""
    try:
        import lanelet2
    except ImportError:
        skip_or_fail("lanelet2 is not installed; pip install '.[lanelet2]' brings it")
    before, path = small_map(), tmp_path / "map.osm"
    place = Georeference(49.01, 8.42, 115.0)
    export_map(before, path, None, place)
    origin = lanelet2.io.Origin(49.01, 8.42, 115.0)
    projector = lanelet2.projection.LocalCartesianProjector(origin)
    read, errors = lanelet2.io.loadRobust(str(path), projector)
    assert not list(errors)
    ways = {int(way.attributes["semviz:id"]): way for way in read.lineStringLayer}
    assert sorted(ways) == [4, 7, 9, 12, 1_000_004]
    ends = {id_: np.array([[p.x, p.y, p.z] for p in way]) for id_, way in ways.items()}
    assert {way.attributes["type"] for way in ways.values()} == {"pole", "traffic_sign"}
    for row, id_ in enumerate(before.elements.id.tolist()):
        anchor = before.elements.anchor_m[row]
        if before.elements.is_line[row]:
            np.testing.assert_allclose(ends[id_], [anchor, before.elements.end_m[row]], atol=1e-3)
            continue
        left, right = ends[id_]
        height = float(ways[id_].attributes["height"])
        np.testing.assert_allclose(0.5 * (left + right) + [0, 0, 0.5 * height], anchor, atol=1e-3)
        assert np.linalg.norm(right - left) == pytest.approx(0.6, abs=1e-3)
        assert (right - left)[1] < -0.5  # who drives along x has -y to the right


def test_osm_ids_are_those_of_one_kind_only(tmp_path: Path) -> None:
    export_map(small_map(), tmp_path / "map.osm", None, KARLSRUHE)
    root = ElementTree.parse(tmp_path / "map.osm").getroot()
    ids = [node.get("id") for node in root if node.tag in ("node", "way")]
    assert len(ids) == len(set(ids)) == 15


def test_csv_lists_what_it_loses(tmp_path: Path) -> None:
    report = export_map(small_map(), tmp_path / "map.csv")
    assert report.dropped == {
        "correlations of coordinates": 5,
        "decisions that the map was built by": 1,
        "points of the road that was driven": 3,
        "labels and observations that elements come from": 5,
    }


def test_what_the_map_knows_of_its_place_needs_no_anchor(tmp_path: Path) -> None:
    known = SemanticMap(small_map().elements, MapFrame("town", (49.0, 8.4, 100.0), 12.0))
    export_map(known, tmp_path / "map.osm")
    after, _ = import_map(tmp_path / "map.osm", READING)
    assert after.frame == known.frame
    assert FRAME.origin is None


@given(georeferences(), st.floats(-50_000.0, 50_000.0), st.floats(-50_000.0, 50_000.0))
@settings(max_examples=25)
def test_places_on_earth_come_back(place: Georeference, x: float, y: float) -> None:
    points = np.array([[x, y, 3.0]])
    np.testing.assert_allclose(place.to_map(place.to_wgs84(points)), points, atol=1e-6)
