"""No command overwrites what it did not write: all commands, all their outputs, hostile targets.

Commands come from the argument parser, and each path among their options must be listed here as
read or written, so that a new one cannot be forgotten.
"""

import os
import re
import runpy
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest
from command_line import Call, call

from semviz.batch.batch import DriveBatch, DriveOutcome, Plan
from semviz.batch.evaluation import Tabulate
from semviz.cli import Command
from semviz.collection.collection import Collection, Drive
from semviz.runs.writer import RunWriter
from semviz.workspace import outputs, workspace
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.map_tiles.publish import publish_map

made_up: dict[str, Any] = runpy.run_path(str(Path(__file__).parents[2] / "bench" / "recording.py"))


def commands(kind: Any = Command, name: str = "") -> Iterator[tuple[str, type]]:
    """Every command by its words, from the union that the argument parser is made of."""
    if get_origin(kind) is Annotated:
        inner, *notes = get_args(kind)
        (word,) = (note.name for note in notes if hasattr(note, "constructor_factory"))
        yield from commands(inner, f"{name} {word}".strip())
    elif isinstance(kind, type):
        yield name, kind
    else:
        for choice in get_args(kind):
            yield from commands(choice, name)


@dataclass(frozen=True)
class Output:
    """A call that writes to TARGET, or to a file of this name in the folder TARGET."""

    arguments: str
    inner: str = ""
    is_cheap: bool = True
    """A call that succeeds takes little time."""
    again: bool = True
    """A second call recognizes what the first has written; else it refuses to replace it."""

    @property
    def name(self) -> str:
        return f"{self.arguments} {self.inner}".strip()


ENDINGS = ("png", "rrd", "parquet")
FORMATS = ("geojson", "lanelet2", "ply", "glb", "csv")
TRAININGS = ("checkpoint.safetensors", "losses.jsonl", "losses.png", "lock")
OUTPUTS: dict[str, dict[str, list[Output]]] = {
    "new": {"folder": [Output("TARGET --simulate 7 --frames 0:4", again=False)]},
    "map export": {
        "file": [
            *(
                Output(f"W TARGET --map truth --format {name}{anchor}")
                for name in FORMATS
                for anchor in [" --anchor=49,8" if name in ("geojson", "lanelet2") else ""]
            ),
            Output("W TARGET --map truth --format colmap", again=False),
        ]
    },
    "map backdrop": {
        "export": [
            Output(f"W --export TARGET --format {name} --frames 0:2 --max-points 1000", "", False)
            for name in ("ply", "pcd")
        ]
    },
    "map changes": {
        "geojson": [Output("W RUN --map truth --anchor 49,8 --geojson TARGET", is_cheap=False)]
    },
    "map localizability": {
        "plot": [Output("W --map truth --frames 0:1 --plot TARGET.png", is_cheap=False)]
    },
    "map merge": {
        "plot": [Output("W OTHER --write both --map truth --replace --plot TARGET.png", "", False)]
    },
    "poses check": {"plot": [Output("W --plot TARGET.png", is_cheap=False)]},
    "poses refine": {
        "out": [Output("W --out TARGET", is_cheap=False, again=False)],
        "plot": [Output("W --out not-written.tum --plot TARGET.png", is_cheap=False)],
    },
    "localize": {"out": [Output("W --map truth --out TARGET.rrd", is_cheap=False)]},
    "record": {
        "out": [
            Output("W --map truth --poses POSES --images none --out TARGET.rrd", is_cheap=False)
        ]
    },
    "detect rates": {"out": [Output("RUN --out TARGET", is_cheap=False)]},
    "evaluate": {"csv": [Output("RUN --csv TARGET")]},
    "batch evaluate": {"frames": [Output("CITY --frames TARGET")]},
    "collection export": {"file": [Output("CITY TARGET.parquet")]},
    "report": {
        "out": [
            Output(f"RUN --out TARGET --format {name} --pictures 0")
            for name in ("html", "md", "latex")
        ]
    },
    "repair": {"out": [Output("RUN --out TARGET")]},
    "trajectory": {
        "file": [Output(f"RUN TARGET --format {name}", again=False) for name in ("tum", "kitti")]
    },
    "labels export": {
        "file": [
            *(
                Output(f"W TARGET --format {name}")
                for name in ("log", "cvat", "cvat-video", "coco", "csv")
            ),
            Output("W TARGET --format labelme"),  # an empty folder, without labels
        ]
    },
    "labels backup": {"file": [Output("W TARGET")]},
    "detect evaluate": {
        "out": [Output("--streets 1 --frames-a-street 1 --out TARGET", "report.html", False)]
    },
    "detect choose": {"out": [Output("W --map truth --out TARGET", is_cheap=False)]},
    "detect train": {
        "out": [Output("--streets 1 --samples 8 --out TARGET", name, False) for name in TRAININGS]
    },
    "train": {
        "out": [Output("verifier --samples 12 --out TARGET", name, False) for name in TRAININGS]
    },
    "weights": {
        "out": [
            Output("TRAINING --out TARGET", f"verifier.{end}") for end in ("safetensors", "json")
        ]
    },
    "benchmark": {
        "out": [
            Output("--frames 1 --methods direct --out TARGET", name, False)
            for name in ("results.jsonl", "table.md", "table.json", "frames-low-time.png")
        ]
    },
}
INPUTS: dict[str, set[str]] = {
    "annotate": {"workspace"},
    "serve": {"paths"},
    "new": {
        "kitti",
        "images",
        "right",
        "calibration",
        "right_calibration",
        "poses",
        "times",
    },
    "detect run": {"workspace"},
    "detect train": {"workspaces", "segmentation", "boxes"},
    "detect choose": {"workspace"},
    "detect evaluate": {"workspaces"},
    "detect rates": {"run_file"},
    "map backdrop": {"workspace"},
    "map build": {"workspace"},
    **{f"batch {verb}": set() for verb in ("detect", "localize", "map")},
    **{f"collection {verb}": set() for verb in ("create", "add", "show")},
    "collection publish": {"source"},
    "map changes": {"workspace", "runs"},
    "map check": {"workspace"},
    "map diff": {"workspace"},
    "map merge": {"workspace", "others"},
    "map localizability": {"workspace"},
    "map export": {"workspace"},
    "map import": {"workspace", "file"},
    "poses check": {"workspace"},
    "poses refine": {"workspace"},
    "poses choose": {"workspace"},
    "localize": {"workspace", "weights"},
    "record": {"workspace", "poses", "matches"},
    "relink": {"workspace", "root", "images", "right", "poses"},
    "evaluate": {"runs"},
    "compare": {"base", "other"},
    "report": {"runs"},
    "open": {"run_file"},
    "repair": {"run_file"},
    "trajectory": {"source"},
    "labels export": {"workspace"},
    "labels import": {"workspace", "file"},
    "labels propose": {"workspace", "file"},
    "labels check": {"workspace"},
    "labels backup": {"workspace"},
    "labels restore": {"workspace", "file"},
    **{f"classes {verb}": {"workspace"} for verb in ("list", "add", "change", "remove")},
    "classes attribute": {"workspace"},
    "benchmark": {"kitti_poses", "pole_maps"},
    "train": {"workspace", "kitti_poses", "pole_maps"},
    "weights": {"training"},
}
ALL = [
    pytest.param(name, output, id=f"{name} {output.name}")
    for name, options in OUTPUTS.items()
    for listed in options.values()
    for output in listed
]


def test_every_path_of_every_command_is_listed_as_read_or_written() -> None:
    found = {
        name: {
            field.name for field in fields(kind) if "Path" in str(get_type_hints(kind)[field.name])
        }
        for name, kind in commands()
    }
    assert len(found) > 20
    listed = {
        name: set(OUTPUTS.get(name, {})) | INPUTS.get(name, set())
        for name in OUTPUTS.keys() | INPUTS.keys()
    }
    assert found == listed


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a workspace W, a run RUN, a collection CITY and a training TRAINING."""
    folder = tmp_path_factory.mktemp("home")
    Workspace.create_street(folder / "OTHER", 7, range(4))
    with Workspace.create_street(folder / "W", 7, range(4)).open_labels():
        pass
    (folder / "POSES").write_text("0 0 0 1.6 -0.5 0.5 -0.5 0.5\n")
    semantic_map = made_up["make_map"](length_m=60.0)
    with RunWriter(folder / "RUN.rrd", made_up["make_info"]("a run"), semantic_map) as writer:
        for record in made_up["make_records"](semantic_map, 2, None):
            writer.write(record)
    (folder / "W" / "runs" / "search.rrd").write_bytes((folder / "RUN.rrd").read_bytes())
    make_city(folder / "CITY", folder / "RUN.rrd", semantic_map)
    return folder


def make_city(folder: Path, run: Path, semantic_map: SemanticMap) -> None:
    """A collection with a map, and a batch whose only run is evaluated."""
    store = Collection.create(folder).store
    publish_map(store, semantic_map, None, "ann")
    batch = DriveBatch.begin(Collection.open(folder), "localize", Plan("localize"))
    batch.finish(DriveOutcome("may", printed={"run": str(run)}), {"runs": run})
    assert not Tabulate(str(folder), "localize")(Drive("may", "")).failure


@pytest.fixture(scope="module")
def training(home: Path) -> Path:
    torch = pytest.importorskip("torch")
    from semviz_core.research.training.checkpoint import Checkpoint, TrainingProgress

    identity = {"task": "verifier", "options": {}, "seed": 0, "batch": 1}
    progress = TrainingProgress(plans=[(0, 1)])
    tensors = {"network.a": torch.zeros(1)}
    Checkpoint(identity, progress, tensors).save(home / "TRAINING" / "checkpoint.safetensors")
    return home / "TRAINING"


def state(folder: Path) -> dict[str, tuple[int, str | bytes]]:
    """Every path in a folder, with its kind and content."""
    found: dict[str, tuple[int, str | bytes]] = {}
    for path in sorted(folder.rglob("*")):
        mode = path.lstat().st_mode
        content: str | bytes = ""
        if stat.S_ISLNK(mode):
            content = str(path.readlink())
        elif stat.S_ISREG(mode):
            content = path.read_bytes()
        if path.name.endswith("-shm") or (path.name.endswith("-wal") and not content):
            continue  # SQLite's own, beside labels that are open
        found[str(path.relative_to(folder))] = stat.S_IFMT(mode), content
    return found


def text_file(target: Path, home: Path) -> None:
    target.write_text("what somebody wrote\n")


def folder_with_a_file(target: Path, home: Path) -> None:
    target.mkdir()
    (target / "file").write_text("what somebody wrote\n")


HOSTILE: dict[str, Callable[[Path, Path], object]] = {
    "a link to the labels": lambda target, home: target.symlink_to(home / "W" / "labels.db"),
    "a relative link": lambda target, home: target.symlink_to(
        os.path.relpath(home / "W" / "labels.db", target.parent)
    ),
    "the labels by another name": lambda target, home: os.link(home / "W" / "labels.db", target),
    "a link to the settings": lambda target, home: target.symlink_to(home / "W" / "semviz.toml"),
    "a link to the map": lambda target, home: target.symlink_to(
        home / "W" / "maps" / f"{TRUTH}.parquet"
    ),
    "a device": lambda target, home: target.symlink_to("/dev/null"),
    "a pipe": lambda target, home: os.mkfifo(target),
    "a link to itself": lambda target, home: target.symlink_to(target),
    "a folder": folder_with_a_file,
    "a text": text_file,
}
FORCED = {"a text"}
"""May be replaced with --force."""


def arguments_of(name: str, output: Output, target: Path, home: Path) -> list[str]:
    known = {
        "TARGET": target,
        "W": home / "W",
        "OTHER": home / "OTHER",
        "POSES": home / "POSES",
        "RUN": home / "RUN.rrd",
        "CITY": home / "CITY",
        "TRAINING": home / "TRAINING",
    }
    words = [*name.split(), *output.arguments.split()]
    whole = {word: str(path) for word, path in known.items()}
    suffixed = {f"TARGET.{end}": f"{target}.{end}" for end in ENDINGS}
    return [(whole | suffixed).get(word, word) for word in words]


def file_of(output: Output, target: Path) -> Path:
    """The file that a call with this target writes."""
    for end in ENDINGS:
        if f"TARGET.{end}" in output.arguments.split():
            return target.with_name(f"{target.name}.{end}")
    return target / output.inner if output.inner else target


def can_force(name: str) -> bool:
    (kind,) = (kind for command, kind in commands() if command == name)
    return "force" in {field.name for field in fields(kind)}


@pytest.mark.parametrize(("name", "output"), ALL)
def test_hostile_targets_stay_as_they_are(
    name: str,
    output: Output,
    home: Path,
    training: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run: Call = partial(call, capsys)
    for number, (what, make) in enumerate(HOSTILE.items()):
        target = tmp_path / str(number)
        file = file_of(output, target)
        file.parent.mkdir(exist_ok=True)
        make(file, home)
        before = state(home), state(tmp_path)
        for force in ([], ["--force"]) if can_force(name) else ([],):
            if force and what in FORCED:
                continue
            status, _, error = run(*arguments_of(name, output, target, home), *force)
            assert (status, state(home), state(tmp_path)) == (2, *before), (what, force, error)
            *_notices, line = error.splitlines()
            assert line.startswith(f"semviz: {file}: "), (what, force, error)


@pytest.mark.parametrize(("name", "output"), [row for row in ALL if not row.values[1].inner])
@pytest.mark.parametrize(
    "own",
    [
        "labels.db",
        "semviz.toml",
        "maps/truth.parquet",
        "maps/new.parquet",
        "kept/x",
        "maps",
        "drive.json",
        "rectified",
        "rectified/left/000000.png",
        "image_motions.safetensors",
        "backdrop.safetensors",
        "proposals.parquet",
        "detector.calibration.toml",
    ],
)
def test_a_workspace_s_own_files_stay_even_by_force(
    name: str,
    output: Output,
    own: str,
    home: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Those that do not exist yet, too: no labels.db is made that holds a table of a map."""
    if name == "detect choose" and own == "detector.calibration.toml":
        pytest.skip("that is what it writes")
    run: Call = partial(call, capsys)
    target = home / "W" / own
    if file_of(output, target) != target:
        pytest.skip("the name needs another ending")
    before = state(home)
    for force in ([], ["--force"]) if can_force(name) else ([],):
        assert run(*arguments_of(name, output, target, home), *force)[0] == 2
        assert state(home) == before


def test_every_file_that_a_workspace_holds_is_its_own() -> None:
    """The list in the module's text; a file that is missing in the other could be overwritten."""
    held = re.findall(r"^    (\S+[./]\S*) ", f"{workspace.__doc__}\n".replace("\n", " \n"), re.M)
    assert {"labels.db", "pose_choices.json", "maps/NAME.parquet"} <= set(held)
    assert [name for name in held if not outputs._is_own(name, "")] == []


CHEAP = [row for row in ALL if row.values[1].is_cheap and not row.values[1].inner]


@pytest.mark.parametrize(("name", "output"), CHEAP)
def test_a_missing_folder_is_made_and_an_own_file_is_replaced(
    name: str, output: Output, home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run: Call = partial(call, capsys)
    before = state(home)
    target = tmp_path / "missing" / "target"
    arguments = arguments_of(name, output, target, home)
    status, _, error = run(*arguments)
    assert (status, error) == (0, "")
    assert run(*arguments)[0] == (0 if output.again else 2)
    if can_force(name) and target.is_file():
        target.write_text("what somebody wrote\n")
        assert run(*arguments)[0] == 2
        assert target.read_text() == "what somebody wrote\n"
        assert run(*arguments, "--force")[0] == 0
        assert target.read_bytes() != b"what somebody wrote\n"
    assert state(home) == before


def test_an_input_is_not_replaced_by_what_is_made_of_it(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = state(home)
    run: Call = partial(call, capsys)
    for arguments in (
        ("report", home / "RUN.rrd", "--out", home / "RUN.rrd", "--format", "html"),
        ("evaluate", home / "RUN.rrd", "--csv", home / "RUN.rrd"),
        ("trajectory", home / "RUN.rrd", home / "RUN.rrd"),
    ):
        assert run(*arguments, "--force")[0] == 2
    assert state(home) == before


@pytest.mark.parametrize("make", [text_file, HOSTILE["a link to the labels"]])
def test_an_unfinished_run_does_not_take_another_file_s_place(
    make: Callable[[Path, Path], object],
    home: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It is written beside the run, under a name that nobody gave."""
    make(tmp_path / "run.partial.rrd", home)
    before = state(home), state(tmp_path)
    arguments = ("localize", home / "W", "--map", TRUTH, "--out", tmp_path / "run.rrd", "--force")
    assert call(capsys, *arguments)[0] == 2
    assert (state(home), state(tmp_path)) == before
