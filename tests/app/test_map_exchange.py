"""Maps and trajectories out and in by commands; what is wrong costs one line, nothing else."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from command_line import Call, call

from semviz.cli import main
from semviz.runs.reader import load_run
from semviz.runs.writer import RunWriter
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_annotation.map_formats.georeference import Georeference

ANCHOR = "--anchor=-33.8,151.2,12"


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Call:
    """Exit status, output and error output of one command."""
    return partial(call, capsys)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A localized street of 3 frames."""
    folder = tmp_path_factory.mktemp("streets") / "street"
    for command in (
        ["new", folder, "--simulate", 3, "--frames", "0:3"],
        ["localize", folder, "--map", TRUTH],
    ):
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in command])
        assert ended.value.code == 0
    return folder


def refused(result: tuple[int, str, str], *words: str) -> None:
    status, output, errors = result
    assert (status, output) == (2, "")
    assert errors.startswith("semviz: ")
    assert errors.count("\n") == 1, errors
    for word in words:
        assert word in errors


def test_a_map_goes_out_and_comes_back(run: Call, made: Path, tmp_path: Path) -> None:
    made = Path(shutil.copytree(made, tmp_path / "town"))  # an import keeps the place
    workspace, file = Workspace.open(made), tmp_path / "back.geojson"
    status, output, _ = run(
        "map", "export", made, file, "--map", TRUTH, ANCHOR, "--anchor-heading", 33, "--json"
    )
    report = json.loads(output)
    assert status == 0
    assert set(report) == {"path", "format", "counts", "dropped", "assumed"}
    assert report["counts"]["poles"] > 5
    status, output, _ = run("map", "import", made, file)
    assert status == 0
    assert "back.parquet" in output
    truth, back = workspace.read_map(TRUTH), workspace.read_map("back")
    assert back.frame.name == truth.frame.name
    assert (back.frame.origin, back.frame.x_heading_deg) == ((-33.8, 151.2, 12.0), 33.0)
    np.testing.assert_allclose(back.elements.anchor_m, truth.elements.anchor_m, atol=1e-3)
    assert run("localize", made, "--map", "back", "--out", tmp_path / "back.rrd")[0] == 0

    before = workspace.map_path("back").read_bytes()
    refused(run("map", "import", made, file), "exists already", "--replace")
    assert workspace.map_path("back").read_bytes() == before
    assert run("map", "import", made, file, "--replace", "--json")[0] == 0


LAMP = """{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {},
 "geometry": {"type": "Point", "coordinates": [151.2001, -33.8001]}}]}"""


@pytest.mark.parametrize("ending", ["geojson", "osm"])
def test_a_workspace_keeps_where_it_is_on_earth(
    run: Call, made: Path, tmp_path: Path, ending: str
) -> None:
    """One import tells it; exports of all maps, also of older ones, and priors follow."""
    first, second = (Path(shutil.copytree(made, tmp_path / name)) for name in ("first", "second"))
    lamps, file = tmp_path / "lamps.geojson", tmp_path / f"town.{ending}"
    lamps.write_text(LAMP)
    refused(run("map", "export", first, file, "--map", TRUTH), "say --anchor")
    settings = first / "semviz.toml"
    settings.write_text(f"# mine\n{settings.read_text()}")
    pole = ("--all-of-class", "pole", "--pole-height", 6)
    imported = run("map", "import", first, lamps, *pole, ANCHOR, "--anchor-heading", 33)
    assert "keeps where its origin is on Earth" in imported[1]
    assert settings.read_text().startswith("# mine\n")
    again = run("map", "import", first, lamps, *pole, "--anchor=-33.8,151.3", "--name", "other")
    assert "keeps where" not in again[1]

    place = Georeference(-33.8, 151.2, 12.0, 33.0)
    assert Georeference.of(Workspace.open(first).map_frame) == place
    assert run("map", "export", first, file, "--map", TRUTH)[0] == 0
    truth = Workspace.open(first).read_map(TRUTH)
    assert Georeference.of(truth.frame) == place
    longitude, latitude, _ = place.to_wgs84(truth.elements.anchor_m)[truth.elements.is_line][0]
    assert f"{latitude:.11f}"[:-4] in file.read_text()
    assert f"{longitude:.11f}"[:-4] in file.read_text()
    assert run("map", "import", second, file)[0] == 0  # the file tells its place
    back = Workspace.open(second).read_map("town")
    np.testing.assert_allclose(
        place.to_wgs84(back.elements.anchor_m), place.to_wgs84(truth.elements.anchor_m), atol=1e-4
    )
    assert Georeference.of(Workspace.open(second).map_frame) == place


@pytest.mark.parametrize("ending", ["osm", "ply", "glb", "csv"])
def test_every_ending_has_its_format(run: Call, made: Path, tmp_path: Path, ending: str) -> None:
    place = [ANCHOR] if ending == "osm" else []
    file = tmp_path / f"town.{ending}"
    status, output, _ = run("map", "export", made, file, "--map", TRUTH, *place)
    assert status == 0
    assert "poles" in output.splitlines()[0]
    assert "  dropped: " in output
    assert file.stat().st_size > 1000


def test_colmap_takes_frames_and_labels(run: Call, made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "model"
    assert run("map", "export", made, folder, "--map", TRUTH, "--format", "colmap")[0] == 0
    assert len((folder / "images.txt").read_text().splitlines()) == 2 * 2 * 3
    again = run("map", "export", made, folder, "--map", TRUTH, "--format", "colmap")
    refused(again, "already exists")
    placed = run("map", "export", made, folder, "--map", TRUTH, "--format", "colmap", ANCHOR)
    refused(placed, "--anchor")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<osm>", ["town.osm: not XML", "Nothing was imported."]),
        ('<!DOCTYPE osm [<!ENTITY a "a">]><osm>&a;</osm>', ["document type"]),
        ("<osm/>", ["holds no pole and no sign"]),
        ('<osm semviz_frame="kitti-02"/>', ["'kitti-02'", "'street-3'"]),
    ],
)
def test_bad_files(run: Call, made: Path, tmp_path: Path, text: str, words: list[str]) -> None:
    file, maps = tmp_path / "town.osm", set(Workspace.open(made).maps())
    file.write_text(text)
    refused(run("map", "import", made, file, "--anchor", "49,8"), *words)
    assert set(Workspace.open(made).maps()) == maps


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["out.geojson"], ["say --anchor LATITUDE,LONGITUDE"]),
        (["out.osm", "--anchor", "north"], ["--anchor north: write LATITUDE,LONGITUDE[,HEIGHT]"]),
        (["out.osm", "--anchor", "151.2,33.8"], ["latitude 151.2 is not within -90 and 90"]),
        (["out.osm", "--anchor", "nan,33.8"], ["latitude nan"]),
        (["out.osm", "--anchor-heading", "20"], ["--anchor-heading needs --anchor"]),
        (["out.csv", ANCHOR], ["--anchor: csv is in the map's own metres"]),
        (["out.dxf"], ["no format has this ending"]),
    ],
)
def test_bad_exports(
    run: Call, made: Path, tmp_path: Path, options: list[str], words: list[str]
) -> None:
    file, *rest = options
    (tmp_path / file).write_text("precious")
    refused(run("map", "export", made, tmp_path / file, "--map", TRUTH, *rest), *words)
    assert (tmp_path / file).read_text() == "precious"


def test_estimates_and_true_poses_for_evo(run: Call, made: Path, tmp_path: Path) -> None:
    recording = made / "runs" / "search.rrd"
    status, output, _ = run("trajectory", recording, tmp_path / "estimate.tum", "--json")
    assert status == 0
    assert json.loads(output)["counts"] == {"poses": 3}
    assert json.loads(output)["dropped"]["covariances"] == 3
    assert run("trajectory", recording, tmp_path / "truth.tum", "--truth")[0] == 0
    assert run("trajectory", made, tmp_path / "given.tum")[0] == 0
    estimate, truth, given = (
        np.loadtxt(tmp_path / f"{name}.tum") for name in ("estimate", "truth", "given")
    )
    np.testing.assert_array_equal(truth, given)
    np.testing.assert_array_equal(estimate[:, 0], truth[:, 0])
    assert 1e-6 < np.abs(estimate[:, 1:4] - truth[:, 1:4]).max() < 1.0
    status, output, _ = run("trajectory", made, tmp_path / "given.txt", "--format", "kitti")
    assert "dropped: 3 x times" in output
    refused(run("trajectory", made, tmp_path / "x.tum", "--truth"), "--truth is for runs")
    refused(run("trajectory", tmp_path / "none.rrd", tmp_path / "x.tum"), "no such run")
    poses = run("new", tmp_path / "other", "--simulate", 1, "--poses", tmp_path / "given.tum")
    refused(poses, "--poses", "needs --kitti ROOT")


def test_frames_that_were_not_localized(run: Call, made: Path, tmp_path: Path) -> None:
    whole = load_run(made / "runs" / "search.rrd")
    lost = replace(
        whole.frames[1].localization, status="cannot", T_camera_map=None, covariance=None
    )
    path, file = tmp_path / "holed.rrd", tmp_path / "poses.txt"
    with RunWriter(path, whole.info, whole.semantic_map) as writer:
        for frame in whole.frames:
            writer.write(replace(frame, localization=lost) if frame.frame.index == 1 else frame)
    refused(
        run("trajectory", path, file, "--format", "kitti"),
        "frame 1 has no pose",
        "use --format tum",
    )
    status, output, _ = run("trajectory", path, file)
    assert status == 0
    assert "dropped: 1 x frames without a pose: 1" in output
    assert len(file.read_text().splitlines()) == 2


@pytest.mark.realdata
@pytest.mark.parametrize("format_", ["tum", "kitti"])
def test_poses_of_another_make_a_workspace(
    run: Call, tmp_path: Path, kitti_root: Path, format_: str
) -> None:
    """Poses that went out come in again, in a frame of their own; without them it says so."""
    poses = tmp_path / "slam.txt"
    sequence = ["--kitti", kitti_root, "--frames", "0:6"]
    assert run("new", tmp_path / "town", *sequence)[0] == 0
    assert run("trajectory", tmp_path / "town", poses, "--format", format_)[0] == 0
    assert run("new", tmp_path / "slam", *sequence, "--poses", poses)[0] == 0
    town, slam = (Workspace.open(tmp_path / name).source for name in ("town", "slam"))
    assert slam.map_frame.name == "kitti-02-slam"
    for frame, other in zip(town.frames, slam.frames, strict=True):
        assert frame.T_map_camera is not None
        assert other.T_map_camera is not None
        np.testing.assert_allclose(
            frame.T_map_camera.as_matrix(), other.T_map_camera.as_matrix(), atol=1e-9
        )
    poses.unlink()
    refused(run("trajectory", tmp_path / "slam", tmp_path / "x.tum"), "semviz relink")
