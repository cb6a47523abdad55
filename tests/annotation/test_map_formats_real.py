"""Maps that other tools wrote."""

from pathlib import Path

import numpy as np
import pytest
from conftest import skip_or_fail
from map_files import READING

from semviz_annotation.map_formats.conversion import MapImportContext
from semviz_annotation.map_formats.exchange import import_map
from semviz_annotation.map_formats.georeference import Georeference
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.errors import SemvizError

pytestmark = pytest.mark.realdata


@pytest.fixture
def maps(kitti_root: Path) -> Path:
    folder = kitti_root.parent / "maps"
    if not folder.is_dir():
        skip_or_fail(f"no maps of other tools in {folder}")
    return folder


def test_lanelet2_example(maps: Path) -> None:
    """All 11 signs, where the package itself has them."""
    path = maps / "lanelet2_mapping_example.osm"
    with pytest.raises(SemvizError, match="say --anchor LATITUDE,LONGITUDE"):
        import_map(path, READING)
    reading = MapImportContext(MapFrame("town"), anchor=Georeference(49.0, 8.4))
    town, report = import_map(path, reading)
    assert report.counts == {"poles": 0, "signs": 11}
    assert sorted(town.elements.class_id.tolist()) == [TRIANGULAR] * 10 + [RECTANGULAR]
    assert report.dropped["ways of type 'traffic_light': neither sign nor pole"] == 10
    try:
        import lanelet2
    except ImportError:
        skip_or_fail("lanelet2 is not installed; pip install '.[lanelet2]' brings it")
    projector = lanelet2.projection.LocalCartesianProjector(lanelet2.io.Origin(49.0, 8.4, 0.0))
    read = lanelet2.io.load(str(path), projector)
    ways = {way.id: np.array([[p.x, p.y, p.z] for p in way]) for way in read.lineStringLayer}
    for id_, anchor in zip(town.elements.id.tolist(), town.elements.anchor_m, strict=True):
        np.testing.assert_allclose(anchor, 0.5 * (ways[id_][0] + ways[id_][-1]), atol=1e-3)


def test_a_straight_road_of_esmini(maps: Path) -> None:
    """Poles and plates stand together; two Chinese signs and one without a number are listed."""
    town, report = import_map(maps / "esmini_straight_500m_signs.xodr", READING)
    assert report.counts == {"poles": 15, "signs": 16}
    elements = town.elements
    poles = elements.class_id == POLE
    np.testing.assert_allclose(elements.end_m[poles][:, 2], -0.2)
    np.testing.assert_allclose(elements.anchor_m[poles][:, 2], 2.15)
    np.testing.assert_allclose(elements.anchor_m[~poles][:, 2], 1.7 + 0.305)
    places = {tuple(row) for row in elements.anchor_m[poles][:, :2].tolist()}
    assert all(tuple(row) in places for row in elements.anchor_m[~poles][:, :2].tolist())
    assert report.dropped == {
        "signals 'cnshi': say --class-map cnshi=CLASS": 1,
        "signals 'cnjin': say --class-map cnjin=CLASS": 1,
        "signals 'de_274-50': say --class-map de_274-50=CLASS": 1,
    }
    mapped = dict.fromkeys(("cnshi", "cnjin", "de_274-50"), "rounded sign")
    town, report = import_map(
        maps / "esmini_straight_500m_signs.xodr",
        MapImportContext(MapFrame("town"), class_map=mapped),
    )
    assert (report.counts, report.dropped) == ({"poles": 15, "signs": 19}, {})


def test_other_roads_of_esmini(maps: Path) -> None:
    town, report = import_map(maps / "esmini_some_signs.xodr", READING)
    assert report.counts == {"poles": 8, "signs": 6}
    assert set(town.elements.class_id.tolist()) == {POLE, TRIANGULAR}
    town, report = import_map(maps / "esmini_stationary_objects.xodr", READING)
    assert report.counts == {"poles": 1, "signs": 1}
    assert town.elements.class_id.tolist() == [POLE, ROUNDED]
    c, s = np.cos(0.5), np.sin(0.5)  # the road's heading
    place = [5 * c - 0.5 * s, 5 * s + 0.5 * c]
    np.testing.assert_allclose(town.elements.anchor_m, [[*place, 2.15], [*place, 2.0]], atol=1e-12)
    assert report.dropped["objects of type 'building': neither pole nor sign"] == 3
