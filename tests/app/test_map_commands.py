"""semviz map check and diff: what they print, and their exit status."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import call
from support.street_labels import careful, label_street

from semviz.workspace.workspace import Workspace
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.edits import DeleteObservation, MoveObservation
from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.quality.check import FINDINGS_LISTED
from semviz_annotation.storage.backup import import_operations
from semviz_core.base.elements import Elements3D
from semviz_core.base.map_file import save_map
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.research.evaluation.roads import move_element, remove_element
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

FRAMES = range(12)
OUR_LABELS = Path(__file__).parents[2] / "docs" / "kitti02" / "labels.jsonl"


@pytest.fixture(scope="module")
def labels() -> Labels:
    source = Street(3, StreetOptions(len(FRAMES)))
    drawn = label_street(careful(source, 0.4, 3), FRAMES, memory=1000).labels
    inside = [
        row
        for row in drawn.observations.values()
        if source.rig.left.contains(np.array([row.anchor_px, row.end_px or row.anchor_px])).all()
    ]
    seen = {row.element_id for row in inside}
    return Labels.from_rows([*(drawn.element(row) for row in seen), *inside])


@pytest.fixture
def town(tmp_path: Path, labels: Labels, capsys: pytest.CaptureFixture[str]) -> Workspace:
    """A street with labels and the map ``main`` built from them."""
    made = Workspace.create_street(tmp_path / "town", seed=3, frames=FRAMES)
    with made.open_labels() as store:
        rows = tuple(labels.elements.values()), tuple(labels.observations.values())
        store.apply(ImportLabels(*rows), "ann")
    assert run(capsys, "build", made.path)[0] == 0
    return made


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    return call(capsys, "map", *arguments)


def put(town: Workspace, name: str, semantic_map: SemanticMap) -> None:
    save_map(semantic_map, town.map_path(name))


def some_pole(semantic_map: SemanticMap) -> int:
    """Id of one whose ends were both seen."""
    elements = semantic_map.elements
    return int(elements.id[elements.anchor_known & elements.end_known][0])


def test_check_says_how_good_a_map_is(town, capsys):
    status, out, err = run(capsys, "check", town.path)
    assert (status, err) == (0, "")
    assert "RMSE (px)" in out
    assert "labels that agree least with the others of their element, of" in out
    assert "errors: 0" in out
    status, out, err = run(capsys, "check", town.path, "--json")
    said = json.loads(out)
    assert (status, err) == (0, "")
    assert said["elements"] == len(town.read_map("main"))
    assert set(said["classes"]["pole"]) >= {"rmse_px", "angular_sde_deg", "observations"}
    assert said["operations"] == {"map": 1, "labels": 1}
    assert {finding["severity"] for finding in said["lint"]} <= {"warning", "hint"}
    worst = said["leave_out"]
    assert len(worst) <= 100
    assert worst[0]["normalized"] == max(label["normalized"] for label in worst)
    assert set(worst[0]) == {
        "observation_id", "element_id", "frame_index", "side", "residual_px", "normalized",
        "pose_is_wrong",
    }  # fmt: skip


def test_the_gate_is_the_exit_status(town, capsys):
    assert run(capsys, "check", town.path, "--gate")[0] == 0
    status, out, err = run(capsys, "check", town.path, "--gate", "--max-rmse-px", "0.01")
    assert status == 1
    assert "RMSE (px)" in out
    lines = err.splitlines()
    assert lines[0].startswith("limit exceeded: pole: lateral RMSE 0.")
    assert len(lines) == sum(
        class_["observations"] > 0 for class_ in classes(capsys, town.path).values()
    )
    status, _, err = run(capsys, "check", town.path, "--gate", "--max-angle-deg", "0.01")
    assert (status, err.count("\n")) == (1, 1)
    assert run(capsys, "check", town.path, "--max-rmse-px", "0.01")[0] == 0


def classes(capsys: pytest.CaptureFixture[str], path: Path) -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, float]] = json.loads(run(capsys, "check", path, "--json")[1])[
        "classes"
    ]
    return found


def test_a_wrong_click_and_a_fault_are_named(town, labels, capsys):
    row = next(
        observation for observation in labels.observations.values() if observation.end_px is None
    )
    with town.open_labels() as store:
        u, v = row.anchor_px
        store.apply(MoveObservation(row.id, (u + 3.0, v - 4.0)), "ann")
    semantic_map = town.read_map("main")
    put(town, "sunk", move_element(semantic_map, some_pole(semantic_map), (0.0, 0.0, -9.0)))
    _, out, err = run(capsys, "check", town.path, "--map", "sunk")
    name = semantic_map.classes.element_name(
        labels.element(row.element_id).class_id, labels.element(row.element_id).number
    )
    worst = out.split("of their element")[1].splitlines()[1].split()
    assert worst[:4] == [name, "frame", f"{row.frame_index},", f"{row.side}:"]
    assert abs(float(worst[4]) - 5.0) < 1.5
    assert f"  below ground: P-{some_pole(semantic_map):02d} reaches" in out
    assert "[frame " in out
    assert err == "the map is older than its labels (operation 1, labels 2): rebuild it\n"


def test_many_findings_are_cut_short(town, capsys):
    elements = town.read_map("truth").elements
    poles = elements[elements.is_line]
    lower = Elements3D(**{**vars(poles), "anchor_m": poles.end_m + np.array([0.0, 0.0, 0.4])})
    put(town, "low", replace(town.read_map("truth"), elements=lower))
    _, out, _ = run(capsys, "check", town.path, "--map", "low")
    assert out.count("too short pole: P-") == FINDINGS_LISTED
    assert f"too short pole: {len(poles) - FINDINGS_LISTED} more; --json lists all" in out
    assert "the map was not made from labels" in out


def test_maps_without_labels_are_looked_over(town, capsys):
    status, out, _ = run(capsys, "check", town.path, "--map", "truth")
    assert status == 0
    assert out.startswith("the map was not made from labels: only rules apply")
    said = json.loads(run(capsys, "check", town.path, "--map", "truth", "--json")[1])
    assert (said["classes"], said["leave_out"]) == ({}, [])
    status, _, err = run(capsys, "check", town.path, "--map", "truth", "--gate")
    assert (status, "nothing was measured" in err) == (1, True)


def test_a_map_of_signs_alone_is_a_map(town, capsys):
    semantic_map = town.read_map("main")
    signs = ~semantic_map.elements.is_line
    provenance = tuple(
        entry for entry, keep in zip(semantic_map.provenance, signs, strict=True) if keep
    )
    put(town, "signs", replace(
        semantic_map, elements=semantic_map.elements[signs], provenance=provenance))  # fmt: skip
    status, out, _ = run(capsys, "check", town.path, "--map", "signs", "--gate")
    assert status == 0
    assert out.splitlines()[1].split()[2] == "-"
    assert "sign without post" not in out


def test_diff_of_names_and_files(town, labels, capsys, tmp_path):
    before = town.read_map("main")
    gone = remove_element(before, some_pole(before))
    put(town, "less", gone)
    status, out, err = run(capsys, "diff", town.path, "main", "less")
    assert (status, err) == (0, "")
    assert out.splitlines()[:2] == [
        "labels known up to operation: 1, 1",
        f"unchanged: {len(before) - 1}",
    ]
    assert f"gone: P-{some_pole(before):02d}" in out
    file = tmp_path / "elsewhere.parquet"
    save_map(move_element(before, some_pole(before), (0.0, 0.3, 0.4)), file)
    said = json.loads(run(capsys, "diff", town.path, "main", file, "--json")[1])
    assert [move["name"] for move in said["moved"]] == [f"P-{some_pole(before):02d}"]
    assert said["moved"][0]["distance_m"] == pytest.approx(0.5)
    assert said["operations"] == [1, 1]


def test_diff_after_more_was_labelled(town, labels, capsys):
    last = [
        observation
        for observation in labels.observations.values()
        if observation.frame_index == FRAMES[-1]
    ]
    with town.open_labels() as store:
        for row in last[:3]:
            store.apply(DeleteObservation(row.id), "ann")
    assert run(capsys, "build", town.path, "--name", "second")[0] == 0
    said = json.loads(run(capsys, "diff", town.path, "main", "second", "--json")[1])
    assert said["operations"] == [1, 4]
    assert run(capsys, "check", town.path, "--map", "second")[2] == ""


def bad_maps() -> dict[str, Callable[[SemanticMap], SemanticMap]]:
    """By what is said of them."""

    def scaled(semantic_map: SemanticMap, by: float) -> SemanticMap:
        arrays = dict(vars(semantic_map.elements))
        arrays.update({name: arrays[name] * by for name in ("anchor_m", "end_m")})
        return replace(semantic_map, elements=Elements3D(**arrays))

    return {
        "is empty": lambda built: replace(built, elements=built.elements[[]], provenance=()),
        "from the road: is the map in metres": lambda built: scaled(built, 1000.0),
        "m long: is the map in metres": lambda built: scaled(built, 0.001),
        "the map is of 'moon', the images of 'street-3'": lambda built: replace(
            built, frame=replace(built.frame, name="moon")
        ),
    }


@pytest.mark.parametrize("words", bad_maps())
@pytest.mark.parametrize("name", ["main", "truth"])
def test_what_is_no_map_of_these_images_is_refused(town, capsys, words, name):
    put(town, "bad", bad_maps()[words](town.read_map(name)))
    for flags in ([], ["--json"]):
        status, out, err = run(capsys, "check", town.path, "--map", "bad", *flags)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert words in err


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("anchor_m", [np.nan, 0.0, 0.0], "anchor_m holds NaN"),
        ("end_m", [np.nan] * 3, "has no end"),
        ("class_id", 99, "unknown classes"),
    ],
)
def test_broken_files_are_refused(town, capsys, column, value, words):
    """Neither check nor diff takes them for a map."""
    path = town.map_path("main")
    table = pq.read_table(path)
    values = table[column].to_pylist()
    values[table["class_id"].to_pylist().index(0)] = value
    place = table.schema.get_field_index(column)
    changed = pa.array(values, table[column].type)
    broken = town.path / "broken.parquet"
    pq.write_table(table.set_column(place, table.schema.field(place), changed), broken)
    broken.rename(town.map_path("broken"))
    for arguments in (["check", town.path, "--map", "broken"],
                      ["diff", town.path, "main", "broken"],
                      ["diff", town.path, town.map_path("broken"), "main"]):  # fmt: skip
        status, out, err = run(capsys, *arguments)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert words in err


def test_files_that_are_no_maps(town, capsys, tmp_path):
    whole = town.map_path("main").read_bytes()
    town.map_path("cut").write_bytes(whole[: len(whole) // 2])
    for arguments, words in (
        (["check", town.path, "--map", "cut"], "not a readable Parquet file"),
        (["check", town.path, "--map", "gone"], "no such map; choose from"),
        (["diff", town.path, "main", "gone"], "no such map; choose from"),
        (["diff", town.path, "main", tmp_path / "gone.parquet"], "no such map"),
        (["diff", town.path, "cut", "main"], "not a readable Parquet file"),
    ):
        status, out, err = run(capsys, *arguments)
        assert (status, out, err.count("\n")) == (2, "", 1)
        assert words in err


@pytest.mark.realdata
def test_real_labels_pass_the_gate_and_the_rules(kitti_root, tmp_path, capsys):
    """KITTI 02 from the even frames, measured in the odd ones; a stake leans, a delineator is
    short, and one sign is really far away."""
    town = Workspace.create_kitti(tmp_path / "town", kitti_root, "02", (2, 3), range(20))
    with town.open_labels() as store:
        import_operations(OUR_LABELS, store)
    assert run(capsys, "build", town.path, "--frames", "0:20:2")[0] == 0
    status, out, _ = run(capsys, "check", town.path, "--frames", "1:20:2", "--gate", "--json")
    assert status == 0
    said = json.loads(out)
    found = [
        (finding["severity"], finding["rule"])
        for finding in said["lint"]
        if finding["severity"] != "hint"
    ]
    assert found == [
        ("warning", "leaning pole"),
        ("warning", "too short pole"),
        ("warning", "ray angle too small"),
    ]
    assert len(said["lint"]) <= 5
    assert said["leave_out"][0]["residual_px"] < 5.0
