"""semviz collection: make one, publish maps, export parts, localize in tiles as in one map."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import call, call_on_a_full_disk
from equality import assert_same

from semviz.collection.collection import Collection
from semviz.runs.reader import load_run
from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping.drives.merged_map import in_frame
from semviz_core.base.elements import joined
from semviz_core.base.map_file import load_map, save_map
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.map_tiles.manifest import file_key

FRAMES = 12
FAR_M = 5000.0
AWAY_M = np.array([FAR_M, 0.0, 0.0])


def with_far_copy(semantic_map: SemanticMap) -> SemanticMap:
    """A map with all of its elements again, 5 km away."""
    elements, way_m = semantic_map.elements, semantic_map.trajectory_m
    far = elements.transformed(Pose.from_rotvec(np.zeros(3), AWAY_M))
    far = replace(far, id=elements.id + 10_000)
    way_m = np.concatenate([way_m, way_m + AWAY_M])
    return replace(semantic_map, elements=joined(elements, far), trajectory_m=way_m)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace of a street; its map ``main`` holds a second one far away."""
    path = tmp_path_factory.mktemp("drives") / "may"
    workspace = Workspace.create_street(path, 5, range(FRAMES))
    save_map(with_far_copy(workspace.read_map("truth")), workspace.map_path("main"))
    return path


@pytest.fixture
def city(street: Path, tmp_path: Path) -> Path:
    collection = Collection.create(tmp_path / "city", [street])
    assert collection.drives()
    return tmp_path / "city"


def test_a_collection_from_first_to_last(
    street: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    city, june = tmp_path / "city", tmp_path / "june"
    shutil.copytree(street, june)
    assert call(capsys, "collection", "create", city, street)[1] == f"may: {street}\n"
    _, output, _ = call(capsys, "collection", "show", city)
    assert output == f"may: {street}\n1 drives; no map\n"
    assert call(capsys, "collection", "add", city, f"by night={june}")[0] == 0
    assert call(capsys, "collection", "publish", city, street)[0] == 0
    publish = ("collection", "publish", city, street, "--map", "truth", "--json")
    _, output, _ = call(capsys, *publish)
    truth = Workspace.open(street).read_map("truth")
    told = json.loads(output)
    assert (told["version"], told["parent"], told["elements"]) == (2, 1, len(truth))
    _, output, _ = call(capsys, "collection", "show", city, "--json")
    shown = json.loads(output)
    assert shown["drives"] == [
        {"name": "by night", "workspace": str(june)}, {"name": "may", "workspace": str(street)},
    ]  # fmt: skip
    assert (shown["versions"], shown["map"]) == ([1, 2], told)
    assert "map version 2 by " in call(capsys, "collection", "show", city)[1]


def test_exported_maps_are_those_published(
    street: Path, city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, whole = Workspace.open(street).read_map("truth"), tmp_path / "whole.parquet"
    map_path = Workspace.open(street).map_path("main")
    assert call(capsys, "collection", "publish", city, map_path)[0] == 0
    assert call(capsys, "collection", "publish", city, street, "--map", "truth")[0] == 0
    assert call(capsys, "collection", "export", city, whole)[0] == 0
    assert_same(load_map(whole).elements, truth.elements)
    near = tmp_path / "near.parquet"
    arguments = ("--version", 1, "--near", f"{FAR_M + 20},0", "--radius-m", 30)
    assert call(capsys, "collection", "export", city, near, *arguments)[0] == 0
    expected = load_map(map_path).crop([FAR_M + 20.0, 0.0], 30.0)
    assert 0 < len(expected) < len(truth)
    assert_same(load_map(near).elements, expected)


@pytest.mark.parametrize("options", [(), ("--track",), ("--jobs", "2")])
def test_poses_are_those_of_one_map(
    street: Path,
    city: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
) -> None:
    assert call(capsys, "collection", "publish", city, street)[0] == 0
    one, tiled = tmp_path / "one.rrd", tmp_path / "tiled.rrd"
    assert call(capsys, "localize", street, "--out", one, *options)[0] == 0
    assert call(capsys, "localize", street, "--collection", city, "--out", tiled, *options)[0] == 0
    expected, found = load_run(one), load_run(tiled)
    assert found.info.map_name == "city version 1"
    assert len(found.semantic_map) == len(expected.semantic_map) // 2
    for before, after in zip(expected.frames, found.frames, strict=True):
        was, now = before.localization, after.localization
        assert_same(now.T_camera_map, was.T_camera_map)
        assert_same(now.covariance, was.covariance)
        assert_same(now.prior, was.prior)
        assert_same(now.submap, was.submap)
        assert_same(after.element_id, before.element_id)
        assert now.status == was.status


def test_measured_fixes_say_what_is_around(
    street: Path, city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Fixes 5 km from the poses, without heights: the second street is read, too."""
    assert call(capsys, "collection", "publish", city, street)[0] == 0
    fixes, frames = tmp_path / "fixes.csv", Workspace.open(street).source.frames
    poses = [frame.T_map_camera for frame in frames if frame.T_map_camera is not None]
    places = [pose.translation + AWAY_M for pose in poses]
    rows = [f"{frame},{x},{y}" for frame, (x, y, _) in enumerate(places)]
    fixes.write_text("\n".join(["frame,x,y", *rows]) + "\n")
    runs = [tmp_path / "one.rrd", tmp_path / "tiled.rrd"]
    localize = ("localize", street, "--priors", fixes, "--out")
    assert call(capsys, *localize, runs[0])[0] == 0
    assert call(capsys, *localize, runs[1], "--collection", city)[0] == 0
    expected, found = map(load_run, runs)
    assert any(len(record.localization.submap) for record in found.frames)
    for before, after in zip(expected.frames, found.frames, strict=True):
        assert_same(after.localization.T_camera_map, before.localization.T_camera_map)
        assert_same(after.localization.prior, before.localization.prior)


def test_a_drive_in_a_frame_of_its_own_is_localized_by_georeferences(
    street: Path, city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The city's map has another origin and heading than the drive's poses."""
    june, out = tmp_path / "june", (tmp_path / "one.rrd", tmp_path / "tiled.rrd")
    shutil.copytree(street, june)
    own = Workspace.open(june).read_map("main")
    here = replace(own.frame, origin=(49.0005, 8.401, 100.0))
    there = MapFrame("city", (49.0, 8.4, 100.0), 60.0)
    save_map(in_frame(replace(own, frame=here), there, "june"), tmp_path / "city.parquet")
    assert call(capsys, "collection", "publish", city, tmp_path / "city.parquet")[0] == 0
    status, _, errors = call(capsys, "localize", june, "--collection", city)
    assert status == 2
    assert f"{june}: is in the frame street-5, not in city; give both a georeference" in errors
    Workspace.open(june).keep_georeference(here)
    assert call(capsys, "localize", june, "--out", out[0])[0] == 0
    assert call(capsys, "localize", june, "--out", out[1], "--collection", city)[0] == 0
    expected, found = map(load_run, out)
    assert found.semantic_map.frame == here
    for before, after in zip(expected.frames, found.frames, strict=True):
        was, now = before.localization.T_camera_map, after.localization.T_camera_map
        assert was is not None
        assert now is not None
        np.testing.assert_allclose(now.as_matrix(), was.as_matrix(), atol=1e-5)


def test_what_cannot_be_done_is_one_line(
    street: Path, city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere = replace(
        load_map(Workspace.open(street).map_path("truth")),
        elements=load_map(Workspace.open(street).map_path("main")).crop([FAR_M, 0.0], 900.0),
    )
    save_map(elsewhere, tmp_path / "far.parquet")
    assert call(capsys, "collection", "publish", city, tmp_path / "far.parquet")[0] == 0
    tile = Collection.open(city).tiled_map().manifest.tiles[-1]
    for arguments, line in [
        (("collection", "show", street), "no collection; make one with 'semviz collection create'"),
        (("collection", "add", city, street), "has a drive 'may' already; write NAME=WORKSPACE"),
        (("collection", "publish", city, street, "--parent", 7), "has versions 1 to 1"),
        (("collection", "export", city, "a.csv"), "a.csv: name a map file"),
        (("collection", "export", city, "a.parquet", "--near", "1"), "--near 1: write X,Y in"),
        (("collection", "export", city, street / "labels.db"), "name a map file"),
        (("localize", street, "--map-version", 1), "add --collection"),
        (("localize", street, "--collection", city, "--map", "truth"), "leave out --map or --coll"),
        (("localize", street, "--collection", city), "has no element within 220 m of the drive"),
    ]:
        status, _, errors = call(capsys, *arguments)
        assert (status, errors.count("\n")) == (2, 1), errors
        assert line in errors
    (city / file_key(tile.file)).write_bytes(b"damaged")
    status, _, errors = call(capsys, "collection", "export", city, tmp_path / "a.parquet")
    assert status == 2
    assert errors.startswith(f"semviz: tile {tile.cell[0]},{tile.cell[1]} of map version 1: {city}")


def test_a_full_disk_leaves_the_old_version(street: Path, city: Path) -> None:
    done = call_on_a_full_disk(3000, "collection", "publish", city, street)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "cannot be written (File too large)" in done.stderr
    assert not Collection.open(city).store.keys("manifests/")
