"""semviz map changes: from runs of passes to what changed, and to the changed map."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from changing_street import ChangingStreet, drive
from command_line import call
from small_runs import saved

from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz.workspace.workspace import Workspace
from semviz_annotation.map_formats.georeference import Georeference
from semviz_core.base.map_file import load_map, save_map
from semviz_core.diagnosis.fault import UNKNOWN_ID

CHANGE, PASSES = 2, 7


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> tuple[Workspace, list[Path], str]:
    """A workspace with the map from before, runs in it, and the name of what vanished."""
    folder = tmp_path_factory.mktemp("passes")
    workspace = Workspace.create_street(folder / "town", seed=5)
    street = workspace.street
    still = ChangingStreet(street, {}, {}, {}, {})
    (gone, *_) = (id_ for id_ in street.truth_map.elements.id.tolist() if still.is_shown(id_))
    world = ChangingStreet(street, {gone: CHANGE}, {}, {}, {})
    save_map(world.first_map, workspace.map_path("main"))
    info = RunInfo("", "", "search", 0, "0", "2026-01-01T00:00:00", street.rig, "main")
    runs = []
    for number in range(PASSES):
        one = drive(world, number)
        records = tuple(
            FrameRecord(frame, result, np.full(len(result.observed), UNKNOWN_ID))
            for frame, result in zip(one.frames, one.localizations, strict=True)
        )
        run = Run(replace(info, name=f"pass-{number}"), world.first_map, records)
        runs.append(saved(run, folder / f"pass-{number}.rrd"))
    return workspace, runs, world.first_map.name_of(gone)


def test_what_vanished_is_told_and_taken_out_of_a_new_map(
    town: tuple[Workspace, list[Path], str], capsys: pytest.CaptureFixture[str]
) -> None:
    workspace, runs, gone = town
    before = workspace.map_path("main").read_bytes()
    command = ("map", "changes", workspace.path, *runs)
    status, output, _ = call(capsys, *command, "--write", "next")
    assert status == 0
    line = next(line for line in output.splitlines() if line.startswith(gone))
    assert f"not seen from pass-{CHANGE} on" in line
    names = load_map(workspace.map_path("next"))
    assert gone not in {names.name_of(id_) for id_ in names.elements.id.tolist()}
    assert workspace.map_path("main").read_bytes() == before
    status, output, _ = call(capsys, *command, "--json")
    told = json.loads(output)
    assert told["vanished"] == 1
    assert told["changes"][0]["name"] == gone
    status, _, errors = call(capsys, *command, "--write", "next")
    assert status == 2
    assert "exists already" in errors
    status, _, _ = call(capsys, *command, "--write", "next", "--replace", "--keep", gone)
    assert status == 0
    kept = load_map(workspace.map_path("next"))
    assert gone in {kept.name_of(id_) for id_ in kept.elements.id.tolist()}


def test_changes_are_written_for_other_tools_where_they_are_on_earth(
    town: tuple[Workspace, list[Path], str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    workspace, runs, gone = town
    path = tmp_path / "changes.geojson"
    command = ("map", "changes", workspace.path, *runs, "--geojson", path)
    status, _, errors = call(capsys, *command)
    assert (status, errors.count("\n")) == (2, 1)
    assert "GeoJSON is in longitude and latitude" in errors
    assert "--anchor" in errors
    anchor = ("--anchor", "49.01,8.42,115", "--anchor-heading", "30")
    status, output, _ = call(capsys, *command, *anchor)
    assert status == 0
    assert f"{path}: " in output
    file = json.loads(path.read_text())
    assert file["semviz"]["passes"] == [run.stem for run in runs]
    (feature,) = [one for one in file["features"] if one["properties"]["name"] == gone]
    told = feature["properties"]
    assert (told["change"], told["place"], told["since"]) == ("vanished", "mapped", "pass-2")
    assert told["existence"] < 0.05
    assert told["frames_in_view"][-1] > told["frames_seen"][-1] == 0
    mapped = load_map(workspace.map_path("main"))
    elements = mapped.elements
    (row,) = [k for k, id_ in enumerate(elements.id.tolist()) if mapped.name_of(id_) == gone]
    points = np.atleast_2d(feature["geometry"]["coordinates"])
    place = Georeference(49.01, 8.42, 115.0, 30.0)
    np.testing.assert_allclose(place.to_map(points)[0], elements.anchor_m[row], atol=1e-4)
    status, _, _ = call(capsys, *command, *anchor)  # a second call replaces its own file
    assert status == 0
    path.write_text("notes")
    status, _, errors = call(capsys, *command, *anchor)
    assert (status, errors.count("\n")) == (2, 1)


def test_what_cannot_be_answered_is_refused_in_one_line(
    town: tuple[Workspace, list[Path], str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    workspace, runs, _ = town
    status, _, errors = call(capsys, "map", "changes", workspace.path, runs[0])
    assert (status, errors.count("\n")) == (2, 1)
    assert "one pass cannot tell a miss from a change" in errors
    status, _, errors = call(capsys, "map", "changes", workspace.path, *runs, "--keep", "P-01")
    assert (status, errors.count("\n")) == (2, 1)
    assert "--keep is for --write" in errors
    Workspace.create_street(tmp_path / "other", seed=6, frames=range(4))
    status, _, errors = call(capsys, "map", "changes", tmp_path / "other", *runs, "--map", "truth")
    assert (status, errors.count("\n")) == (2, 1)
    assert "is in the frame street-5, the map in street-6" in errors
