"""semviz map build: what it prints, and what it refuses."""

import json
from pathlib import Path

import pytest
from command_line import call
from support.street_labels import label_street

from semviz.workspace.workspace import Workspace
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_core.base.map_file import load_map
from semviz_core.simulation.detector import SimulatedDetector
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

FRAMES = range(20)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street as a detector labels it."""
    folder = tmp_path_factory.mktemp("build") / "town"
    made = Workspace.create_street(folder, seed=3, frames=FRAMES)
    street = Street(3, StreetOptions(len(FRAMES)))
    labels = label_street(SimulatedDetector(street, "low", 3).detect, FRAMES).labels
    with made.open_labels() as store:
        rows = tuple(labels.elements.values()), tuple(labels.observations.values())
        store.apply(ImportLabels(*rows), "ann")
    return folder


def build(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    return call(capsys, "map", "build", *arguments)


def test_what_was_decided_is_told_in_words(town, capsys):
    code, out, err = build(capsys, town, "--sigma-px", 1.3, "--min-frames", 2)
    assert (code, err) == (0, "")
    first, *lines, last = out.splitlines()
    assert " merged, " in first
    assert any(line.startswith("merged P-") for line in lines)
    assert any(line.startswith("left out ") and line.endswith(" more") for line in lines)
    assert last.startswith(f"{town / 'maps' / 'main.parquet'}: ")
    assert len(lines) < 100


def test_json_has_every_decision_of_the_map(town, capsys):
    code, out, err = build(capsys, town, "--name", "all", "--json")
    said = json.loads(out)
    built = load_map(town / "maps" / "all.parquet")
    assert (code, err) == (0, "")
    assert said["elements"] == len(built)
    assert len(said["decisions"]) == len(built.decisions) > 20
    assert said["decisions"][0]["kind"] == "merge"
    assert said["decisions"][0]["evidence"]["frames"] >= 2


@pytest.mark.usefixtures("open3d")
def test_poses_are_refined_and_the_paper_is_at_hand(town, capsys):
    assert build(capsys, town, "--name", "refined", "--sigma-px", 1.3, "--refine-poses")[0] == 0
    assert build(capsys, town, "--name", "paper", "--method", "paper", "--eps-m", 0.5)[0] == 0
    plain, refined, paper = (
        load_map(town / "maps" / f"{name}.parquet") for name in ("all", "refined", "paper")
    )
    assert "RefineOptions(" in refined.made_by
    assert "eps_m=0.5" in paper.made_by
    assert (refined.trajectory_m != plain.trajectory_m).any()
    assert (paper.trajectory_m == plain.trajectory_m).all()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--eps-m", 2.0), "--eps-m is for --method paper"),
        (("--method", "paper", "--refine-poses"), "--refine-poses is for --method joint"),
        (("--sigma-px", 0.0), "sigma_px must be positive"),
        (("--min-frames", 0), "min_frames 1 or more"),
        (("--min-frames", 50), "nothing can be placed"),
        (("--method", "paper", "--min-points", 0), "min_points must be positive"),
        (("--frames", "90:95"), "no element is labelled in two images"),
    ],
)
def test_what_cannot_be_is_one_line_and_overwrites_nothing(town, capsys, arguments, word):
    build(capsys, town, "--name", "kept")
    path = town / "maps" / "kept.parquet"
    written = path.read_bytes()
    code, out, err = build(capsys, town, "--name", "kept", *arguments)
    assert (code, out) == (2, "")
    assert word in err
    assert len(err.splitlines()) == 1
    assert path.read_bytes() == written


def test_an_interrupted_build_overwrites_nothing(town, capsys, monkeypatch):
    build(capsys, town, "--name", "kept")
    path = town / "maps" / "kept.parquet"
    written = path.read_bytes()

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("semviz.presentation.terminal.Steps.show", interrupt)
    code, out, _ = build(capsys, town, "--name", "kept")
    assert (code, out) == (130, "")
    assert path.read_bytes() == written
