"""A map in tiles gives what one map gives, to the last bit, in versions that stay."""

import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from equality import assert_same
from hypothesis import given, settings
from hypothesis import strategies as st
from tiled_maps import HALVES, MAPS, by_ids, made_map

from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.common.store import Store
from semviz_core.map_tiles import publish as publishing
from semviz_core.map_tiles.manifest import file_key, manifest_key, read_manifest, versions
from semviz_core.map_tiles.publish import publish_map
from semviz_core.map_tiles.tiled_map import TiledMap

CENTERS = st.tuples(HALVES, HALVES)
RADII = st.integers(0, 1200).map(lambda half: half / 2.0) | st.just(1e9)


@contextmanager
def tiled(semantic_map: SemanticMap) -> Iterator[TiledMap]:
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr("semviz_core.common.files._fsync", lambda path: None)
        store = Store.at(folder)
        publish_map(store, semantic_map, None, "ann")
        yield TiledMap.open(store)


@settings(max_examples=20)
@given(MAPS)
def test_the_whole_map_comes_back(semantic_map: SemanticMap) -> None:
    with tiled(semantic_map) as tiles:
        assert_same(tiles.whole(), by_ids(semantic_map))
        assert len(tiles) == len(semantic_map)


@settings(max_examples=40)
@given(MAPS, st.lists(st.tuples(CENTERS, RADII), min_size=1, max_size=4), st.booleans())
def test_a_crop_is_that_of_one_map(
    semantic_map: SemanticMap, circles: list[tuple[tuple[float, float], float]], tiny_cache: bool
) -> None:
    one = by_ids(semantic_map)
    with tiled(semantic_map) as tiles:
        if tiny_cache:
            tiles = TiledMap.open(tiles.store, cache_bytes=1)
        for center, radius_m in circles:
            assert_same(tiles.crop(center, radius_m), one.crop(center, radius_m))
            assert_same(tiles.road_near(center, radius_m), one.road_near(center, radius_m))


@settings(max_examples=20)
@given(MAPS, st.lists(CENTERS, max_size=4), st.integers(60, 400))
def test_the_map_along_a_way_has_all_that_frames_on_it_ask_for(
    semantic_map: SemanticMap, way: list[tuple[float, float]], radius_m: int
) -> None:
    one = by_ids(semantic_map)
    with tiled(semantic_map) as tiles:
        part = tiles.along(np.reshape(way, (-1, 2)), radius_m)
    for center in way:
        assert_same(part.crop(center, radius_m), one.crop(center, radius_m))
        assert_same(part.road_near(center, radius_m - 2), one.road_near(center, radius_m - 2))
    expected = {id_ for center in way for id_ in one.crop(center, radius_m).id.tolist()}
    assert part.elements.id.tolist() == sorted(expected)
    for row, id_ in enumerate(part.elements.id.tolist()):
        assert part.provenance[row] == one.provenance[one.elements.id.tolist().index(id_)]
    assert part.attributes == {k: v for k, v in one.attributes.items() if k in part}
    labels = {label for entry in part.provenance for label in entry.label_ids}
    assert part.decisions == tuple(d for d in one.decisions if labels & {*d.label_ids})


WRONG_CIRCLES = [([0.0], 1.0), ([0.0, 0.0], -1.0), ([0.0, np.nan], 1.0)]


@pytest.mark.parametrize(("center", "radius_m"), WRONG_CIRCLES)
def test_circles_that_are_none_are_refused(center: list[float], radius_m: float) -> None:
    with tiled(made_map(0, 3, 3)) as tiles:
        for method in (tiles.crop, tiles.road_near):
            with pytest.raises(SemvizError, match=r"radius_m is|center_m"):
                method(center, radius_m)


def test_only_tiles_that_differ_are_written(tmp_path: Path) -> None:
    store, first = Store.at(tmp_path), made_map(0, 60, 60)
    publish_map(store, first, None, "ann")
    files = set(store.keys("tiles/"))
    row = int(np.argmax(first.elements.id))
    moved = first.elements.anchor_m + np.eye(60)[:, [row]] * [0.0, 0.0, 0.25]
    second = replace(first, elements=replace(first.elements, anchor_m=moved))
    publish_map(store, second, 1, "bea")
    assert len(set(store.keys("tiles/")) - files) == 1
    assert_same(TiledMap.open(store, 1).whole(), by_ids(first))
    assert_same(TiledMap.open(store).whole(), by_ids(second))


def test_a_reader_keeps_its_version(tmp_path: Path) -> None:
    store, first, second = Store.at(tmp_path), made_map(0, 60, 60), made_map(1, 60, 60)
    publish_map(store, first, None, "ann")
    reader = TiledMap.open(store)
    publish_map(store, second, 1, "bea")
    assert_same(reader.whole(), by_ids(first))
    assert TiledMap.open(store).version == 2
    assert versions(store) == [1, 2]


def test_of_two_publishers_one_is_told(tmp_path: Path) -> None:
    store, first = Store.at(tmp_path), made_map(0, 20, 20)
    publish_map(store, first, None, "ann")

    def publish(seed: int) -> str:
        try:
            return publish_map(store, made_map(seed, 20, 20), 1, str(seed)).by
        except SemvizError as error:
            return str(error)

    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(publish, range(1, 9)))
    (won,) = [answer for answer in answers if answer.isdigit()]
    assert_same(TiledMap.open(store).whole(), by_ids(made_map(int(won), 20, 20)))
    lost = {answer for answer in answers if answer != won}
    assert len(lost) == 1
    assert lost.pop().startswith(f"{tmp_path}: somebody has published version 2 meanwhile; make")


def test_the_last_moment_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other publisher comes between the check and the manifest."""
    store = Store.at(tmp_path)
    publish_map(store, made_map(0, 9, 9), None, "ann")
    checked, check = [], publishing._check_new

    def check_then_lose(store: Store, version: int) -> None:
        check(store, version)
        if not checked:
            checked.append(version)
            publish_map(store, made_map(1, 9, 9), 1, "bea")

    monkeypatch.setattr(publishing, "_check_new", check_then_lose)
    with pytest.raises(SemvizError, match="somebody has published version 2 meanwhile"):
        publish_map(store, made_map(2, 9, 9), 1, "ann")
    assert read_manifest(store).by == "bea"


def test_an_answer_of_the_store_that_was_lost_is_no_other_publisher(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store.at(tmp_path)
    write_new = type(store).write_new
    monkeypatch.setattr(
        type(store),
        "write_new",
        lambda store, key, data: write_new(store, key, data) and write_new(store, key, data),
    )
    assert publish_map(store, made_map(0, 9, 9), None, "ann").map_version == 1


PUBLISH = """
import os, sys
from semviz_core.common.store import FolderStore, Store
from semviz_core.map_tiles.publish import publish_map
from tiled_maps import made_map

left, write_new = int(sys.argv[2]), FolderStore.write_new

def write_or_die(store, key, data):
    global left
    left -= 1
    if left < 0:
        os.kill(os.getpid(), 9)
    return write_new(store, key, data)

FolderStore.write_new = write_or_die
publish_map(Store.at(sys.argv[1]), made_map(1, 60, 60), 1, "bea")
"""


def test_a_publisher_that_is_killed_leaves_the_old_version(tmp_path: Path) -> None:
    store, first, second = Store.at(tmp_path), made_map(0, 60, 60), made_map(1, 60, 60)
    publish_map(store, first, None, "ann")
    for writes in (0, 5, 20):
        command = [sys.executable, "-c", PUBLISH, str(tmp_path), str(writes)]
        assert subprocess.run(command, cwd=Path(__file__).parents[1]).returncode == -9
        assert versions(store) == [1]
        assert_same(TiledMap.open(store).whole(), by_ids(first))
    publish_map(store, second, 1, "bea")
    assert_same(TiledMap.open(store).whole(), by_ids(second))


def test_a_damaged_or_missing_tile_is_named(tmp_path: Path) -> None:
    store = Store.at(tmp_path)
    manifest = publish_map(store, made_map(0, 60, 0), None, "ann")
    tile = manifest.tiles[0]
    center = (np.array(tile.cell) + 0.5) * manifest.cell_m
    path = tmp_path / file_key(tile.file)
    content = path.read_bytes()
    name = rf"^tile {tile.cell[0]},{tile.cell[1]} of map version 1: {path}"
    path.write_bytes(content[:100] + b"\0" + content[101:])
    with pytest.raises(SemvizError, match=rf"{name}: damaged; restore it from a copy$"):
        TiledMap.open(store).crop(center, 1.0)
    path.unlink()
    with pytest.raises(SemvizError, match=rf"{name}: no such file; restore it from a copy$"):
        TiledMap.open(store).whole()


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        (b'"version":1', b'"version":2', "version: Input should be 1"),
        (b'"map_version":1', b'"map_version":2', "holds version 2"),
        (b'"road":[[', b'"road":[[0,1],[', "the road's stretches are not those of the tiles"),
        (b'"cell_m":200', b'"cell_m":0', "cell_m: Input should be greater than or equal to 1"),
        (b'"tiles"', b'"tile"', "tiles: Field required"),
        (b"}", b"", "Invalid JSON"),
    ],
)
def test_a_damaged_manifest_is_named(tmp_path: Path, old: bytes, new: bytes, fault: str) -> None:
    store = Store.at(tmp_path)
    publish_map(store, made_map(0, 20, 20), None, "ann")
    path = tmp_path / manifest_key(1)
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(SemvizError, match=rf"^{path}: .*{fault}"):
        TiledMap.open(store)


def test_versions_that_are_not_there_are_named(tmp_path: Path) -> None:
    store = Store.at(tmp_path)
    with pytest.raises(SemvizError, match=f"^{tmp_path}: has no map yet; run 'semviz collection"):
        TiledMap.open(store)
    with pytest.raises(SemvizError, match=f"^{tmp_path}: has no map yet"):
        publish_map(store, made_map(0, 1, 1), 3, "ann")
    publish_map(store, made_map(0, 1, 1), None, "ann")
    with pytest.raises(SemvizError, match=f"^{tmp_path}: has versions 1 to 1; choose one of them"):
        TiledMap.open(store, 2)
    with pytest.raises(SemvizError, match="somebody has published version 1 meanwhile"):
        publish_map(store, made_map(0, 1, 1), None, "ann")
    elsewhere = replace(made_map(0, 1, 1), frame=MapFrame("village"))
    with pytest.raises(SemvizError, match=r"the map is in frame 'village', that of .* in 'town'"):
        publish_map(store, elsewhere, 1, "ann")


def test_memory_is_bounded(tmp_path: Path) -> None:
    store, semantic_map = Store.at(tmp_path), made_map(0, 6000, 0)
    publish_map(store, semantic_map, None, "ann")
    most = 200_000  # of 2.3 MB
    tiles = TiledMap.open(store, cache_bytes=most)
    tracemalloc.start()
    for center in semantic_map.elements.anchor_m[:60]:
        tiles.crop(center, 120.0)
        assert tiles.cache_bytes <= most
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 2 * most


def test_threads_share_a_map(tmp_path: Path) -> None:
    semantic_map = made_map(0, 600, 600)
    publish_map(Store.at(tmp_path), semantic_map, None, "ann")
    tiles, one = TiledMap.open(Store.at(tmp_path), cache_bytes=100_000), by_ids(semantic_map)
    centers = semantic_map.elements.anchor_m[:100]
    with ThreadPoolExecutor(4) as pool:
        crops = pool.map(lambda center: tiles.crop(center, 120.0), centers)
        for center, crop in zip(centers, crops, strict=True):
            assert_same(crop, one.crop(center, 120.0))


def test_an_object_store_holds_the_same(s3_place: str) -> None:
    store, semantic_map = Store.at(s3_place), made_map(0, 30, 30)
    publish_map(store, semantic_map, None, "ann")
    assert_same(TiledMap.open(Store.at(s3_place)).whole(), by_ids(semantic_map))
    with pytest.raises(SemvizError, match=f"^{s3_place}: somebody has published version 1 mean"):
        publish_map(store, semantic_map, None, "ann")
