"""semviz map merge: the maps of two drives of one street become one."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from labelled_kitti import FRAMES, LABELS

from semviz.workspace.workspace import Workspace
from semviz_annotation.storage.backup import import_operations
from semviz_core.base.map_file import load_map, save_map


@pytest.fixture
def drives(tmp_path: Path) -> tuple[Path, Path]:
    """Two drives through one street; the poses of the second are 0.6 m off."""
    folders = tmp_path / "may", tmp_path / "june"
    for folder in folders:
        workspace = Workspace.create_street(folder, seed=5, frames=range(24))
        semantic_map = workspace.read_map("truth")
        elements, by_m = semantic_map.elements, np.array([0.5, -0.3, 0.1]) * (folder.name == "june")
        elements = replace(elements, anchor_m=elements.anchor_m + by_m, end_m=elements.end_m + by_m)
        way_m = semantic_map.trajectory_m + by_m
        save_map(
            replace(semantic_map, elements=elements, trajectory_m=way_m),
            workspace.map_path("main"),
        )
    return folders


def test_two_drives_become_one_map(
    drives: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    plot = drives[0].parent / "moved.png"
    arguments = (*drives, "--write", "town", "--keep-first", "--plot", plot)
    status, output, _ = call(capsys, "map", "merge", *arguments)
    assert status == 0
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert "may: " in output
    assert "moved by 0.58 m" in output.splitlines()[1]
    merged, first = (load_map(drives[0] / "maps" / f"{name}.parquet") for name in ("town", "main"))
    assert len(merged) == len(first)
    off_m = merged.elements.anchor_m - first.elements.anchor_m[np.argsort(first.elements.id)]
    assert np.abs(off_m[:, :2]).max() < 0.05


def test_the_summary_is_also_json(
    drives: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    other = drives[1] / "maps" / "main.parquet"
    arguments = ("map", "merge", drives[0], other, "--write", "town", "--json")
    status, output, _ = call(capsys, *arguments)
    said = json.loads(output)
    assert status == 0
    assert [drive["name"] for drive in said["drives"]] == [str(drives[0]), str(other)]
    assert said["shared"] > 0


def test_no_map_is_lost(drives: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    files = [drive / "maps" / "main.parquet" for drive in drives]
    before = [file.read_bytes() for file in files]
    cut = drives[0].parent / "cut.parquet"
    cut.write_bytes(before[1][:-100])
    for arguments, message in (
        ((*drives, "--write", "main"), "is a map to merge; choose another name"),
        ((*drives, "--write", "truth"), "exists already; choose another name or use --replace"),
        ((drives[0], drives[0], "--write", "town"), "is given twice; each drive counts once"),
        ((drives[0], drives[0].parent / "july", "--write", "town"), "july"),
        ((*drives, "--write", "town", "--pose-sigma-m", "0"), "must be above 0"),
        ((*drives, "--write", "town", "--pose-sigma-m", "inf"), "must be above 0 and finite"),
        ((*drives, "--write", "town", "--pose-sigma-deg", "nan"), "must be above 0 and finite"),
        ((drives[0], cut, "--write", "town"), "cut.parquet: "),
    ):
        status, output, errors = call(capsys, "map", "merge", *arguments)
        assert (status, output) == (2, "")
        assert message in errors
        assert errors.count("\n") == 1
    assert [file.read_bytes() for file in files] == before
    assert not (drives[0] / "maps" / "town.parquet").exists()


def test_elements_of_real_labels_are_found_again(
    kitti_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two stretches of KITTI 02 share labels, so elements with one number are one landmark."""
    workspace = Workspace.create_kitti(tmp_path / "town", kitti_root, "02", (2, 3), FRAMES)
    with workspace.open_labels() as store:
        import_operations(LABELS, store)
    for name, frames in (("first", "0:12"), ("second", "8:20")):
        assert (
            call(capsys, "map", "build", workspace.path, "--frames", frames, "--name", name)[0] == 0
        )
    second = workspace.map_path("second")
    arguments = ("map", "merge", workspace.path, second, "--map", "first", "--write", "both")
    assert call(capsys, *arguments)[0] == 0
    ids = [set(workspace.read_map(name).elements.id.tolist()) for name in ("first", "second")]
    merged = workspace.read_map("both")
    labels = [origin.label_ids for origin in merged.provenance]
    assert len(ids[0] & ids[1]) == 30
    assert sum(len(each) == 2 for each in labels) == 30
    assert all(len(set(each)) == 1 for each in labels), "two label elements in one landmark"
