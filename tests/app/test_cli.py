"""The command line: what people get wrong costs them one line, and nothing else."""

import csv
import json
import re
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from command_line import Call, call, call_on_a_full_disk

from semviz import cli
from semviz.cli import main
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord
from semviz.runs.writer import RunWriter
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.base.elements import Elements3D
from semviz_core.base.map_file import load_map, save_map
from semviz_core.base.semantic_map import MapFrame, SemanticMap


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Call:
    """Exit status, output and error output of one command."""
    return partial(call, capsys)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A localized street of 6 frames."""
    folder = tmp_path_factory.mktemp("streets") / "street"
    for command in (
        ["new", folder, "--simulate", 3, "--frames", "0:6"],
        ["localize", folder, "--map", TRUTH, "--out", folder / "runs" / "first.rrd"],
    ):
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in command])
        assert ended.value.code == 0
    return folder


def assert_refused(result: tuple[int, str, str], *words: str) -> None:
    """Exit status 2 and one line that holds ``words``."""
    status, output, errors = result
    assert status == 2
    assert output == ""
    assert errors.startswith("semviz: ")
    assert errors.count("\n") == 1, errors
    for word in words:
        assert word in errors


def test_help_is_quick_and_light() -> None:
    """Nothing heavy is imported before a command runs; the time itself is in bench/startup.py."""
    code = (
        "import sys\n"
        "from semviz.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'torch', 'open3d', 'viser', 'rerun', 'cv2', 'scipy', 'pyarrow'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "serve" in done.stdout
    assert done.stdout.rstrip().endswith("[]")


@pytest.mark.parametrize(
    "command", ["annotate", "localize", "serve", "map build", "map check", "labels export"]
)
def test_a_missing_workspace(run: Call, tmp_path: Path, command: str) -> None:
    extra = [tmp_path / "out.jsonl"] if command == "labels export" else []
    result = run(*command.split(), tmp_path / "nowhere", *extra)
    assert_refused(result, "nowhere", "no such workspace", "semviz new")


def test_a_folder_without_images(run: Call, tmp_path: Path) -> None:
    (tmp_path / "kitti").mkdir()
    result = run("new", tmp_path / "town", "--kitti", tmp_path / "kitti")
    assert_refused(result, "kitti")
    assert not (tmp_path / "town").exists()


def test_new_needs_one_source(run: Call, tmp_path: Path) -> None:
    assert_refused(run("new", tmp_path / "town"), "--kitti", "--simulate")
    both = run("new", tmp_path / "town", "--kitti", tmp_path, "--simulate", 1)
    assert_refused(both, "--kitti", "--simulate")


def test_new_never_overwrites(run: Call, street: Path) -> None:
    before = (street / "semviz.toml").read_bytes()
    assert_refused(run("new", street, "--simulate", 4), "not empty")
    assert (street / "semviz.toml").read_bytes() == before


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--frames", "3"),
        ("--frames", "5:2"),
        ("--frames", "a:b"),
        ("--frames", "100:200"),
        ("--prior-distance", "10:5"),
        ("--prior-distance", "far"),
        ("--method", "guess"),
        ("--map", "nowhere"),
        ("--map", "../escape"),
        ("--map", "x" * 300),
        ("--map", "two\nlines"),
        ("--seed", "-1"),
        ("--crop-radius", "0"),
        ("--crop-radius", "-5"),
        ("--crop-radius", "nan"),
        ("--prior-distance", "1e300:1e301"),
        ("--heading-sigma-deg", "0"),
        ("--heading-sigma-deg", "nan"),
        ("--heading-sigma-deg", "1e-300"),
    ],
)
def test_impossible_options(run: Call, street: Path, option: str, value: str) -> None:
    out = street / "runs" / "refused.rrd"
    options = {"--map": TRUTH, option: value}
    words = [word for pair in options.items() for word in pair]
    assert_refused(run("localize", street, *words, "--out", out))
    assert not list(out.parent.glob("refused*"))


@pytest.mark.parametrize("name", [".", "folder.rrd", "first.txt", "first.rrd/second.rrd"])
def test_a_run_takes_no_other_files_place(run: Call, street: Path, name: str) -> None:
    runs = street / "runs"
    (runs / "folder.rrd").mkdir(exist_ok=True)
    before = sorted(runs.iterdir())
    assert_refused(run("localize", street, "--map", TRUTH, "--out", runs / name))
    assert sorted(runs.iterdir()) == before
    (runs / "folder.rrd").rmdir()


def test_a_busy_port(run: Call, street: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        result = run("serve", street, "--port", port, "--no-open")
    assert_refused(result, str(port), "in use", "--port")


@pytest.mark.parametrize("tool", ["serve", "annotate"])
def test_no_token_for_other_machines_or_beside_one(run: Call, street: Path, tool: str) -> None:
    exposed = run(tool, street, "--no-token", "--host", "0.0.0.0", "--no-open")
    assert_refused(exposed, "--no-token", "loopback", "0.0.0.0")
    assert_refused(
        run(tool, street, "--no-token", "--token", "x", "--no-open"), "--token", "either"
    )


def test_a_map_of_another_frame(run: Call, street: Path) -> None:
    path = Workspace.open(street).map_path("foreign")
    save_map(replace(load_map(path.with_stem(TRUTH)), frame=MapFrame("elsewhere")), path)
    result = run("localize", street, "--map", "foreign")
    assert_refused(result, "elsewhere", "street-3")


def test_an_empty_map(run: Call, street: Path) -> None:
    workspace = Workspace.open(street)
    nothing = Elements3D.from_ends([], np.zeros((0, 3)), np.zeros((0, 3)), [])
    empty = SemanticMap(nothing, workspace.source.map_frame)
    save_map(empty, workspace.map_path("empty"))
    assert_refused(run("localize", street, "--map", "empty"), "empty")


def test_no_labels_to_build_from(run: Call, street: Path) -> None:
    assert_refused(run("map", "build", street), "label")
    assert not Workspace.open(street).map_path("main").exists()


@pytest.mark.parametrize("command", ["evaluate", "open", "serve"])
def test_a_broken_run(run: Call, tmp_path: Path, command: str) -> None:
    broken = tmp_path / "broken.rrd"
    broken.write_bytes(b"not a recording at all")
    options = ["--port", "0", "--no-open"] if command == "serve" else []
    assert_refused(run(command, broken, *options), "broken.rrd")


@pytest.mark.parametrize("command", ["evaluate", "open"])
def test_a_missing_run(run: Call, tmp_path: Path, command: str) -> None:
    assert_refused(run(command, tmp_path / "none.rrd"), "none.rrd", "semviz localize")


def test_a_run_from_street_to_numbers(run: Call, street: Path, tmp_path: Path) -> None:
    first = street / "runs" / "first.rrd"
    status, output, _ = run("evaluate", first, "--json", "--csv", tmp_path / "rows.csv")
    assert status == 0
    numbers = json.loads(output)
    assert numbers["run"] == str(first)
    assert numbers["frames"] == sum(numbers["status"].values()) == 6
    assert set(numbers["rte_m"]) == set(numbers["rre_deg"]) == {"mean", "q1", "q2", "q3"}
    assert {"share_below_1m", "share_below_1deg", "time_ms"} <= set(numbers)
    assert sum(numbers["diagnoses"].values()) == 6
    with (tmp_path / "rows.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert Counter(row["diagnosis"] for row in rows) == numbers["diagnoses"]
    for row, frame in zip(rows, load_run(first).frames, strict=True):
        pose = frame.localization.T_camera_map
        assert (pose is None) == (row["x_m"] == "")
        if pose is not None:
            center = [float(row[name]) for name in ("x_m", "y_m", "z_m")]
            assert center == pytest.approx(pose.inverse().translation.tolist())
    status, output, _ = run("evaluate", first)
    assert status == 0
    assert "RTE" in output
    assert "diagnoses: " in output


def test_the_same_seed_gives_the_same_run(run: Call, street: Path) -> None:
    rows = []
    for name in ("again", "once-more"):
        path = street / "runs" / f"{name}.rrd"
        run("localize", street, "--map", TRUTH, "--seed", 5, "--images", "none", "--out", path)
        numbers = json.loads(run("evaluate", path, "--json")[1])
        rows.append({key: numbers[key] for key in ("status", "rte_m", "rre_deg")})
    assert rows[0] == rows[1]


def test_a_street_too_long_leaves_nothing_behind(run: Call, tmp_path: Path) -> None:
    result = run("new", tmp_path / "town", "--simulate", 1, "--frames", "0:99999999999999999999")
    assert_refused(result, "frames")
    assert not (tmp_path / "town").exists()


def test_a_name_that_the_system_refuses(run: Call, tmp_path: Path) -> None:
    assert_refused(run("new", tmp_path / ("x" * 300), "--simulate", 1), "too long")


def test_a_reader_that_has_seen_enough(street: Path) -> None:
    """``semviz evaluate | head -0``: no traceback."""
    command = [sys.executable, "-m", "semviz.cli", "evaluate", street / "runs" / "first.rrd"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        child.stdout.close()
        assert child.stderr.read() == b""
    assert child.returncode == 141


def test_an_interrupted_run_leaves_the_earlier_one(
    run: Call, street: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C: status 130, the frames so far are readable, what was there before is untouched."""
    first = street / "runs" / "first.rrd"
    before = first.read_bytes()
    write = RunWriter.write

    def write_two(writer: RunWriter, record: FrameRecord) -> None:
        if record.frame.index == 2:
            raise KeyboardInterrupt
        write(writer, record)

    monkeypatch.setattr(RunWriter, "write", write_two)
    status, _, errors = run("localize", street, "--map", TRUTH, "--out", first)
    assert (status, errors) == (130, "semviz: interrupted\n")
    assert first.read_bytes() == before
    partial = first.with_name("first.partial.rrd")
    assert [frame.frame.index for frame in load_run(partial).frames] == [0, 1]
    partial.unlink()


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files as POSIX does")
def test_a_full_disk_ends_a_run_and_keeps_its_frames(street: Path) -> None:
    first = street / "runs" / "first.rrd"
    before = first.read_bytes()
    done = call_on_a_full_disk(len(before) // 2, "localize", street, "--map", TRUTH, "--out", first)
    assert done.returncode == 2
    (ours,) = (line for line in done.stderr.splitlines() if "compil" not in line)
    assert f"{first.with_name('first.partial.rrd')}: cannot be written" in ours
    assert first.read_bytes() == before
    partial = load_run(first.with_name("first.partial.rrd"))
    assert 0 < len(partial.frames) < 6
    Path(first.with_name("first.partial.rrd")).unlink()


def commands(kind: Any = cli.Command, name: str = "") -> Iterator[tuple[str, Any]]:
    """All commands with their classes."""
    if hasattr(kind, "__metadata__"):
        names = [part.name for part in kind.__metadata__ if hasattr(part, "name")]
        yield from commands(get_args(kind)[0], f"{name} {' '.join(names)}".strip())
    elif get_args(kind):
        for part in get_args(kind):
            yield from commands(part, name)
    else:
        yield name, kind


@pytest.mark.parametrize(("name", "kind"), list(commands()), ids=[name for name, _ in commands()])
def test_help_has_an_example_and_scripts_have_json(name: str, kind: Any) -> None:
    example = re.search(r"Examples?: '(semviz [^']*)'", " ".join(kind.__doc__.split()))
    assert example is not None
    assert example[1].startswith(f"semviz {name}".removesuffix(" run"))
    if name not in ("serve", "annotate", "open"):
        assert "json" in {field.name for field in fields(kind)}


def test_json_of_commands_that_make_files(run: Call, tmp_path: Path) -> None:
    town, copy = tmp_path / "town", tmp_path / "copy.db"
    made = json.loads(run("new", town, "--simulate", 3, "--frames", "0:2", "--json")[1])
    assert made == {"path": str(town), "frames": 2, "map_frame": "street-3", "stereo": True}
    Workspace.open(town).open_labels().close()
    backup = json.loads(run("labels", "backup", town, copy, "--json")[1])
    assert backup["path"] == str(copy)
    restored = json.loads(run("labels", "restore", town, copy, "--json")[1])
    assert restored["operations"] == backup["operations"]
