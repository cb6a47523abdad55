"""The workspace: made, opened, copied; and what is said where it is not one."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call

from semviz.commands.tools import find_runs
from semviz.workspace.settings import PLACES, SETTINGS, ImagesSettings, cameras_within, find_place
from semviz.workspace.workspace import Workspace
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.elements import Elements3D
from semviz_core.base.map_file import save_map
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.errors import SemvizError

KITTI = """version = 1
name = "town"

[source]
kind = "kitti"
root = "../kitti"
sequence = "05"
"""


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Two frames of sequence 05, stereo, no poses."""
    folder = tmp_path / "kitti" / "sequences" / "05"
    for camera in (2, 3):
        (folder / f"image_{camera}").mkdir(parents=True)
        for index in range(2):
            image = np.zeros((20, 30, 3), np.uint8)
            assert cv2.imwrite(str(folder / f"image_{camera}" / f"{index:06d}.png"), image)
    projection = "50 0 14.5 {} 0 50 9.5 0 0 0 1 0"
    (folder / "calib.txt").write_text(f"P2: {projection.format(0)}\nP3: {projection.format(-25)}\n")
    (folder / "times.txt").write_text("0.0\n0.1\n")
    return tmp_path / "kitti"


@pytest.fixture
def town(tmp_path: Path, kitti: Path) -> Workspace:
    return Workspace.create_kitti(tmp_path / "town", kitti, "05")


def test_what_was_created_is_opened(tmp_path: Path, kitti: Path) -> None:
    made = Workspace.create_kitti(tmp_path / "town", kitti, "05", (2,), range(1, 9, 2))
    opened = Workspace.open(tmp_path / "town")
    assert opened.settings == made.settings
    assert opened.name == "town"
    assert opened.classes is DEFAULT_CLASSES
    assert [frame.index for frame in opened.source.frames] == [1]
    assert opened.source.rig.right is None
    assert opened.source is opened.source


def test_a_street_is_opened_as_it_was_made(tmp_path: Path) -> None:
    from semviz_core.simulation.layout import Section

    sections = (Section("normal", 50.0), Section("row", 80.0))
    made = Workspace.create_street(tmp_path / "street", 7, range(12), 2.0, sections)
    opened = Workspace.open(tmp_path / "street")
    assert opened.settings == made.settings
    assert len(opened.source.frames) == 12
    assert opened.source.map_frame == made.source.map_frame
    assert opened.default_observations == "simulated"


def test_the_settings_keep_no_absolute_path(town: Workspace, tmp_path: Path) -> None:
    text = (town.path / SETTINGS).read_text()
    assert 'root = "../kitti"' in text
    assert str(tmp_path) not in text


def test_a_copy_beside_it_and_a_move_with_its_images_work(town: Workspace, tmp_path: Path) -> None:
    shutil.copytree(town.path, tmp_path / "copy")
    assert len(Workspace.open(tmp_path / "copy").source.frames) == 2
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("town", "kitti"):
        (tmp_path / name).rename(elsewhere / name)
    assert len(Workspace.open(elsewhere / "town").source.frames) == 2


def test_a_copy_at_another_depth_finds_its_images(town: Workspace, tmp_path: Path) -> None:
    deep = tmp_path / "a" / "b" / "copy"
    shutil.copytree(town.path, deep)
    assert len(Workspace.open(deep).source.frames) == 2
    (deep / PLACES).unlink()
    with pytest.raises(SemvizError, match="semviz relink"):
        _ = Workspace.open(deep).source


def test_relink_changes_the_places_and_nothing_else(
    town: Workspace, kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (town.path / SETTINGS).open("a") as settings:
        settings.write("# a remark of ours\n")
    moved = kitti.rename(tmp_path / "disk")
    elsewhere = tmp_path / "a" / "town"
    elsewhere.parent.mkdir()
    town.path.rename(elsewhere)
    before = (elsewhere / SETTINGS).read_bytes()

    other = tmp_path / "other"
    shutil.copytree(moved, other)
    (other / "sequences" / "05" / "image_3" / "000001.png").unlink()
    small = tmp_path / "small"
    shutil.copytree(moved, small)
    for image in (small / "sequences" / "05" / "image_3").iterdir():
        assert cv2.imwrite(str(image), np.zeros((20, 28, 3), np.uint8))
    for place, message in (
        (tmp_path / "none", "no such folder"),
        (other, "are missing"),
        (small, "28x20"),
    ):
        status, _, errors = call(capsys, "relink", elsewhere, "--root", place)
        assert status == 2
        assert message in errors
        assert (elsewhere / SETTINGS).read_bytes() == before

    status, output, _ = call(capsys, "relink", elsewhere, "--root", moved)
    assert status == 0
    assert "2 frames" in output
    assert len(Workspace.open(elsewhere).source.frames) == 2
    text = (elsewhere / SETTINGS).read_text()
    assert 'root = "../../disk"' in text
    _, _, kept = before.decode().partition("\n")  # after the checksum of the old paths
    assert text.replace("../../disk", "../kitti") == kept


def test_a_link_to_a_workspace_finds_the_same_images(town: Workspace, tmp_path: Path) -> None:
    deep = tmp_path / "a" / "b"
    deep.mkdir(parents=True)
    (deep / "link").symlink_to(town.path)
    assert len(Workspace.open(deep / "link").source.frames) == 2


def test_a_relative_path_is_fine(
    town: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(town.path)
    assert len(Workspace.open(Path()).source.frames) == 2
    made = Workspace.create_kitti(Path("inner"), Path("../kitti"), "05")
    assert made.settings.name == "inner"
    monkeypatch.chdir(tmp_path)
    assert len(Workspace.open(Path("town/inner")).source.frames) == 2


def test_images_gone_says_what_to_edit(town: Workspace, kitti: Path) -> None:
    town.open_labels().close()
    kitti.rename(kitti.with_name("moved"))
    opened = Workspace.open(town.path)  # labels and maps stay within reach
    assert opened.maps() == ()
    assert opened.read_labels() == town.read_labels()
    with pytest.raises(SemvizError, match=r"kitti: 'root' of the workspace.*relink .*--root"):
        _ = opened.source


def test_wrong_input_leaves_no_folder(tmp_path: Path, kitti: Path) -> None:
    with pytest.raises(SemvizError, match="no such sequence; there are 05"):
        Workspace.create_kitti(tmp_path / "town", kitti, "77")
    with pytest.raises(SemvizError, match="start at 0"):
        Workspace.create_street(tmp_path / "town", 1, range(5, 9))
    with pytest.raises(SemvizError, match="seed -1"):
        Workspace.create_street(tmp_path / "town", -1)
    assert not (tmp_path / "town").exists()


def test_nothing_is_overwritten(town: Workspace, tmp_path: Path) -> None:
    before = (town.path / SETTINGS).read_bytes()
    with pytest.raises(SemvizError, match="not empty; choose another name"):
        Workspace.create_street(town.path, 3)
    assert (town.path / SETTINGS).read_bytes() == before
    (tmp_path / "file").write_text("x")
    with pytest.raises(SemvizError, match="not empty; choose another name"):
        Workspace.create_street(tmp_path / "file", 3)
    (tmp_path / "empty").mkdir()
    assert Workspace.create_street(tmp_path / "empty", 3).name == "empty"


def test_a_missing_workspace_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(SemvizError, match=r"town: no such workspace; .*semviz new .*--kitti"):
        Workspace.open(tmp_path / "town")
    with pytest.raises(SemvizError, match=r"not a workspace \(no semviz\.toml\)"):
        Workspace.open(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("version = 1", "version = 2", "version 2; this semviz reads up to 1: update"),
        ("version = 1", 'version = "1"', "version: "),
        ("version = 1", "", "version: Field required"),
        ("version = 1", "version =", "not readable as TOML"),
        ("version = 1", "version = 1\ncolour = 2", "colour: Extra inputs"),
        ('"kitti"', '"camera"', "source: .*'camera'"),
        ("root =", "folder =", "source.kitti.root: Field required"),
        ("root =", "cameras = [1, 2, 3]\nroot =", "source.kitti.cameras: "),
        ('"05"', '"../05"', "source.kitti.sequence: "),
        ("root =", "frames = { first = 0, end = nan }\nroot =", "frames.end: "),
        ("root =", "frames = { first = 0, end = 2, step = 0 }\nroot =", "frames.step: "),
    ],
)
def test_broken_settings_are_named_in_one_line(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    (tmp_path / SETTINGS).write_text(KITTI)
    Workspace.open(tmp_path)  # right before it is spoiled
    assert old in KITTI
    (tmp_path / SETTINGS).write_text(KITTI.replace(old, new, 1))
    with pytest.raises(SemvizError, match=message) as caught:
        Workspace.open(tmp_path)
    assert "\n" not in str(caught.value)


def test_settings_that_are_no_text_are_named(tmp_path: Path) -> None:
    (tmp_path / SETTINGS).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SemvizError, match="not readable as TOML"):
        Workspace.open(tmp_path)


def test_maps_are_listed_and_read(town: Workspace) -> None:
    assert town.maps() == ()
    with pytest.raises(SemvizError, match="run 'semviz map build "):
        town.read_map("main")
    nothing = SemanticMap(Elements3D.from_ends([], [], [], []), MapFrame("kitti-05"))
    for name in ("main", "even"):
        save_map(nothing, town.map_path(name))
    assert set(town.maps()) == {"main", "even"}
    assert town.read_map("even").digest == nothing.digest
    with pytest.raises(SemvizError, match="no such map; choose from"):
        town.read_map("odd")


@pytest.mark.parametrize("name", ["", "../main", "a/b", ".hidden", "a\\b", "nul\0"])
def test_names_cannot_lead_out_of_the_workspace(town: Workspace, name: str) -> None:
    with pytest.raises(SemvizError, match="cannot be a file name"):
        town.map_path(name)
    with pytest.raises(SemvizError, match="cannot be a file name"):
        town.run_path(name)


def test_runs_are_found_in_workspaces_and_as_files(town: Workspace, tmp_path: Path) -> None:
    with pytest.raises(SemvizError, match="no runs yet; run 'semviz localize"):
        find_runs([town.path])
    paths = [town.run_path(name) for name in ("b", "a")]
    for path in paths:
        path.write_bytes(b"RRF")
    (town.path / "runs" / ".half.rrd").write_bytes(b"")
    single = tmp_path / "single.rrd"
    single.write_bytes(b"RRF")
    assert set(town.runs()) == {"a", "b"}
    found = find_runs([single, town.path])
    assert found[0] == single
    assert set(found[1:]) == set(paths)
    assert find_runs([town.path / "runs"]) == tuple(town.run_path(name) for name in ("a", "b"))
    with pytest.raises(SemvizError, match="no such run"):
        find_runs([tmp_path / "none.rrd"])


def test_a_workspace_without_labels_has_none_and_makes_no_file(town: Workspace) -> None:
    assert not town.read_labels().observations
    assert not town.labels_path.exists()
    assert town.default_observations == "labels"
    with town.open_labels():
        assert town.labels_path.exists()
    assert not town.read_labels().observations


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_another_calibration_is_refused_and_can_be_accepted(town: Workspace, kitti: Path) -> None:
    town.open_labels().close()
    calib = kitti / "sequences" / "05" / "calib.txt"
    change(calib, "50 0 14.5", "51 0 14.5")
    changed = Workspace.open(town.path)
    with pytest.raises(SemvizError, match=r"focal length 50 -> 51, 50 px.* Nothing was") as caught:
        changed.open_labels()
    assert r"delete [calibration]" in str(caught.value)
    assert "baseline" in str(caught.value)  # it comes out of P3 by the focal length
    assert changed.read_labels() == town.read_labels()  # labels stay within reach
    settings = town.path / SETTINGS
    text = settings.read_text()
    settings.write_text(text[: text.index("[calibration]")])
    accepted = Workspace.open(town.path)
    accepted.open_labels().close()
    again = Workspace.open(town.path)
    assert again.settings.calibration is not None
    assert again.settings.calibration == accepted.settings.calibration
    assert again.settings.calibration != town.settings.calibration
    again.open_labels().close()
    change(calib, "51 0 14.5", "50 0 14.5")
    with pytest.raises(SemvizError, match="focal length 51, 50 -> 50 px"):
        Workspace.open(town.path).open_labels()


def test_an_older_workspace_keeps_its_calibration_once_it_is_labelled(
    tmp_path: Path, kitti: Path
) -> None:
    written = "# ours\n" + KITTI
    (tmp_path / "town").mkdir()
    (tmp_path / "town" / SETTINGS).write_text(written)
    assert kitti.name == "kitti"
    older = Workspace.open(tmp_path / "town")
    assert len(older.source.frames) == 2
    assert older.settings.calibration is None  # looking changes nothing
    assert (older.path / SETTINGS).read_text() == written
    older.open_labels().close()
    assert (older.path / SETTINGS).read_text().startswith(written)
    kept = Workspace.open(older.path).settings
    assert kept == older.settings
    assert kept.calibration is not None
    assert kept.calibration.right_position_m == (0.5, 0.0, 0.0)


def test_poses_that_cannot_be_right_are_refused_but_can_be_trusted(
    tmp_path: Path, kitti: Path
) -> None:
    folder = kitti / "sequences" / "05"
    for index in range(2, 12):
        for camera in (2, 3):
            shutil.copy(
                folder / f"image_{camera}" / "000000.png",
                folder / f"image_{camera}" / f"{index:06d}.png",
            )
    (folder / "times.txt").write_text("".join(f"{0.1 * i}\n" for i in range(12)))
    (kitti / "poses").mkdir()
    backwards = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {-i}\n" for i in range(12))
    (kitti / "poses" / "05.txt").write_text(backwards)
    with pytest.raises(SemvizError, match=r"moves backwards .*--trust-poses.*trust_poses = true"):
        Workspace.create_kitti(tmp_path / "town", kitti, "05")
    assert not (tmp_path / "town").exists()
    made = Workspace.create_kitti(tmp_path / "town", kitti, "05", trust_poses=True)
    assert len(made.source.frames) == 12
    change(made.path / SETTINGS, "trust_poses = true", "trust_poses = false")
    with pytest.raises(SemvizError, match=r"kitti-05: the camera moves backwards"):
        _ = Workspace.open(made.path).source


def test_swapped_image_folders_and_wrong_sizes_are_refused(tmp_path: Path) -> None:
    """A pair of a simulated street, as files."""
    street = Workspace.create_street(tmp_path / "street", 1, range(5)).street
    folder = tmp_path / "kitti" / "sequences" / "05"
    K = street.rig.left.K
    P = "{} 0 {} {} 0 {} {} 0 0 0 1 0"
    for camera, side, shift in ((2, "left", 0.0), (3, "right", -K[0, 0] * street.rig.baseline_m)):
        (folder / f"image_{camera}").mkdir(parents=True)
        image = street.image(2, "left" if side == "left" else "right")[..., ::-1]
        assert cv2.imwrite(str(folder / f"image_{camera}" / "000000.png"), image)
        line = P.format(K[0, 0], K[0, 2], shift, K[1, 1], K[1, 2])
        with (folder / "calib.txt").open("a") as file:
            file.write(f"P{camera}: {line}\n")
    (folder / "times.txt").write_text("0.0\n")
    root = tmp_path / "kitti"
    Workspace.create_kitti(tmp_path / "right", root, "05")
    for first, second in ((2, "x"), (3, 2), ("x", 3)):
        (folder / f"image_{first}").rename(folder / f"image_{second}")
    with pytest.raises(
        SemvizError, match=r"left and right images are swapped: baseline is -0\.54 m"
    ):
        Workspace.create_kitti(tmp_path / "town", root, "05")
    with pytest.raises(SemvizError, match="left and right images are swapped"):
        _ = Workspace.open(tmp_path / "right").source
    for camera in (2, 3):
        path = folder / f"image_{camera}" / "000000.png"
        image = cv2.imread(str(path))
        assert image is not None
        assert cv2.imwrite(str(path), cv2.resize(image, (620, 188)))
    with pytest.raises(SemvizError, match="left images are 620x188, but the calibration is for"):
        Workspace.create_kitti(tmp_path / "town", root, "05")
    with pytest.raises(SemvizError, match="left images 1241x376 -> 620x188 px"):
        _ = Workspace.open(tmp_path / "right").source
    assert not (tmp_path / "town").exists()


def test_a_sequence_that_is_a_path_is_refused(tmp_path: Path, kitti: Path) -> None:
    with pytest.raises(SemvizError, match=r"town: source\.kitti\.sequence"):
        Workspace.create_kitti(tmp_path / "town", kitti, "../sequences/05")
    assert not (tmp_path / "town").exists()


def test_a_folder_of_all_cameras_of_a_rig_is_enough(tmp_path: Path) -> None:
    kept = {name: f"../old/{name}" for name in ("front", "right")}
    rig = ImagesSettings(images="../old/front", cameras=kept)
    given = {"images": tmp_path}
    assert cameras_within(rig, given) == {}
    assert given == {"images": tmp_path}  # the first camera's own folder
    for name in kept:
        (tmp_path / name).mkdir()
    places = {"front": tmp_path / "front", "right": tmp_path / "right"}
    assert cameras_within(rig, given) == places | {"images": tmp_path / "front"}
    with pytest.raises(SemvizError, match="--images PLACE, the folder of all cameras"):
        find_place(tmp_path, "right", "../nowhere", is_camera=True)
