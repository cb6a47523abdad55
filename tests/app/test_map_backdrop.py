"""``semviz map backdrop``: whole or absent, made once, told where it is stale."""

import json
import os
import re
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import Call, call
from planted_backdrop import put_backdrop
from streets import street, street_workspace

from semviz.workspace.maps.backdrop import backdrop_path, find_backdrop
from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping.backdrop import load_backdrop
from semviz_core.datasets.trajectory import T_MAP_WORLD

FRAMES = 3
COUNT = ("--max-points", 20_000)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Call:
    """Exit status, output and error output of one command."""
    return partial(call, capsys)


@pytest.fixture(scope="module")
def made(open3d: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive with a backdrop."""
    folder = tmp_path_factory.mktemp("backdrops") / "street"
    Workspace.create_street(folder, 7, range(FRAMES))
    command = [sys.executable, "-m", "semviz.cli", "map", "backdrop", folder, *COUNT]
    subprocess.run([str(one) for one in command], check=True)
    return folder


def refused(result: tuple[int, str, str], *words: str) -> None:
    status, output, errors = result
    assert (status, output) == (2, "")
    assert errors.startswith("semviz: ")
    assert errors.count("\n") == 1, errors
    for word in words:
        assert word in errors


def test_what_is_up_to_date_is_not_made_again(run: Call, made: Path) -> None:
    file = backdrop_path(Workspace.open(made))
    before = file.stat()
    status, output, _ = run("map", "backdrop", made, *COUNT, "--json")
    told = json.loads(output)
    assert status == 0
    assert told["made"] is False
    assert told["backdrop"] == str(file)
    assert told["points"] == len(load_backdrop(file)) <= COUNT[1]
    assert told["frames"] == FRAMES
    assert (file.stat().st_mtime_ns, file.stat().st_ino) == (before.st_mtime_ns, before.st_ino)


def test_other_options_make_another_one(run: Call, made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "street"
    folder.mkdir()
    for one in ("semviz.toml", "backdrop.safetensors"):
        (folder / one).write_bytes((made / one).read_bytes())
    status, output, _ = run("map", "backdrop", folder, "--max-points", 9000, "--frames", "0:2")
    assert status == 0
    assert "up to date" not in output
    found = load_backdrop(folder / "backdrop.safetensors")
    assert found.source.frames.tolist() == [0, 1]
    assert len(found) <= 9000


@pytest.mark.parametrize("ending", ["ply", "pcd"])
def test_an_export_replaces_nothing_unasked(
    run: Call, made: Path, tmp_path: Path, ending: str
) -> None:
    file = tmp_path / f"cloud.{ending}"
    export = ("map", "backdrop", made, *COUNT, "--export", file)
    assert run(*export)[0] == 0
    content = file.read_bytes()
    assert len(content) > 15 * len(load_backdrop(made / "backdrop.safetensors"))
    file.write_text("a day's work")
    refused(run(*export), "is there already", "--force")
    assert file.read_text() == "a day's work"
    assert run(*export, "--force")[0] == 0
    assert file.read_bytes() == content


def test_an_export_that_cannot_be_is_refused_before_anything_is_made(
    run: Call, tmp_path: Path
) -> None:
    folder = tmp_path / "street"
    Workspace.create_street(folder, 7, range(FRAMES))
    refused(run("map", "backdrop", folder, "--export", tmp_path / "cloud.xyz"), "--format")
    refused(run("map", "backdrop", folder, "--export", tmp_path), "no format")
    refused(run("map", "backdrop", folder, "--format", "ply"), "--export")
    refused(run("map", "backdrop", folder, "--max-points", 3), "1000")
    assert not (folder / "backdrop.safetensors").exists()


def test_a_file_that_is_no_backdrop_stays(run: Call, made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "street"
    Workspace.create_street(folder, 7, range(FRAMES))
    file = folder / "backdrop.safetensors"
    file.write_text("weights of a friend")
    refused(run("map", "backdrop", folder, *COUNT), "no backdrop", "--force")
    assert file.read_text() == "weights of a friend"
    assert run("map", "backdrop", folder, *COUNT, "--force")[0] == 0
    assert file.read_bytes() == (made / "backdrop.safetensors").read_bytes()


def test_one_camera_is_refused_in_one_line(run: Call, tmp_path: Path) -> None:
    folder = one_camera(tmp_path / "kitti")
    result = run("new", tmp_path / "mono", "--kitti", folder, "--sequence", "07", "--cameras", "2")
    assert result[0] == 0, result
    refused(run("map", "backdrop", tmp_path / "mono"), "one camera", "left and right")
    assert not (tmp_path / "mono" / "backdrop.safetensors").exists()


def one_camera(root: Path) -> Path:
    """A KITTI folder with the left images of a street."""
    drive = street(7)
    images = root / "sequences" / "07" / "image_2"
    images.mkdir(parents=True)
    lines = []
    for frame in drive.frames[:FRAMES]:
        image = drive.image(frame.index, "left")
        assert cv2.imwrite(str(images / f"{frame.index:06d}.png"), image[..., ::-1])
        assert frame.T_map_camera is not None
        matrix = (T_MAP_WORLD.inverse() @ frame.T_map_camera).as_matrix()[:3]
        lines.append(" ".join(map(repr, matrix.ravel().tolist())))
    projection = np.column_stack([drive.rig.left.K, np.zeros(3)])
    numbers = " ".join(map(repr, projection.ravel().tolist()))
    (images.parent / "calib.txt").write_text(f"P2: {numbers}")
    times = "".join(f"{one.time_s}\n" for one in drive.frames[:FRAMES])
    (images.parent / "times.txt").write_text(times)
    (root / "poses").mkdir()
    (root / "poses" / "07.txt").write_text("\n".join(lines) + "\n")
    return root


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_who_stops_it_keeps_what_was_there(
    open3d: None, tmp_path: Path, environment: dict[str, str], how: signal.Signals
) -> None:
    folder = tmp_path / "street"
    Workspace.create_street(folder, 7, range(60))
    before = sorted(one.name for one in folder.iterdir())
    script = (
        "import signal, sys; from semviz.presentation.terminal import Steps; show = Steps.show\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # shells may ignore it
        "def said(self, *what):\n"
        "    print(*what, flush=True); show(self, *what)\n"
        "Steps.show = said\n"
        "from semviz.cli import main; main(sys.argv[1:])"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, "map", "backdrop", str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip
    assert process.stdout is not None
    assert any(line.startswith("matching 2") for line in process.stdout)
    os.kill(process.pid, how)
    _, errors = process.communicate(timeout=60)
    if how is signal.SIGINT:
        assert process.returncode == 130
        assert "interrupted" in errors
    assert sorted(one.name for one in folder.iterdir()) == before


def test_help_needs_no_open3d(environment: dict[str, str]) -> None:
    """And without it the command says which extra brings it."""
    hidden = "import sys; sys.modules['open3d'] = None\nfrom semviz.cli import main; main()"
    shown = subprocess.run(
        [sys.executable, "-c", hidden, "map", "backdrop", "--help"],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert shown.returncode == 0, shown.stderr
    assert "--max-points" in shown.stdout


def test_without_open3d_the_extra_is_named(
    run: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("semviz_core.common.errors.find_spec", lambda name: None)
    Workspace.create_street(tmp_path / "street", 7, range(FRAMES))
    refused(run("map", "backdrop", tmp_path / "street"), "open3d", "semviz[view3d]")


# What the tools find


def test_tools_find_it_or_say_what_to_do(tmp_path: Path) -> None:
    workspace = street_workspace(tmp_path / "street", 7, FRAMES)
    drive = (workspace.source.map_frame, workspace.source.rig, workspace.source.frames)
    command = f"semviz map backdrop {workspace.path}"
    none = find_backdrop(workspace, *drive)
    assert none.backdrop is None
    assert none.note.endswith(command)
    put_backdrop(workspace)
    found = find_backdrop(workspace, *drive)
    assert found.backdrop is not None
    assert found.note == ""
    assert find_backdrop(workspace, *drive).backdrop is found.backdrop  # not read again
    backdrop_path(workspace).write_text("nonsense")
    broken = find_backdrop(workspace, *drive)
    assert broken.backdrop is None
    assert broken.note.endswith(f"{command} --force")
    assert "not found" in find_backdrop(None, *drive).note


def test_a_stale_one_is_told_and_not_shown(tmp_path: Path) -> None:
    workspace = street_workspace(tmp_path / "street", 7, FRAMES)
    put_backdrop(workspace)
    other = street(8)
    found = find_backdrop(workspace, other.map_frame, other.rig, other.frames)
    assert found.backdrop is None
    assert "stale" in found.note
    assert "street-8" in found.note
    moved = street(8).frames  # of another drive under the same name
    found = find_backdrop(workspace, workspace.source.map_frame, other.rig, moved)
    assert found.backdrop is None
    assert re.search(r"pose of frame \d+ has changed", found.note)
