"""semviz map build --from detections: from a detector's file to a localized drive."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import call

from semviz.runs.reader import load_run
from semviz.workspace.localization.rebuild import rebuild_run
from semviz.workspace.observations import observe_detected, read_detections, read_labels_of
from semviz.workspace.workspace import Workspace
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.edits import DecideElements
from semviz_annotation.labels.labels import LabelElement, Labels
from semviz_annotation.labels.proposal import ProcessedImages
from semviz_annotation.labels.proposals import Proposals, save_proposals
from semviz_annotation.labels.rows import new_id, review_decision
from semviz_annotation.mapping.association.detected_drive import TRACK_NUMBER, as_observation
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.quality.check import leave_one_out
from semviz_core.base.frame import Side
from semviz_core.base.map_file import load_map
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.simulation.detector import SimulatedDetector
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

FRAMES = range(24)
NO_IMAGES = ("--images", "none")
SIDES: tuple[Side, Side] = ("left", "right")


def detected_street(folder: Path) -> Workspace:
    """A street with the detections of a simulated detector, and no label."""
    made = Workspace.create_street(folder, seed=3, frames=FRAMES)
    street = Street(3, StreetOptions(len(FRAMES)))
    detector = SimulatedDetector(street, "low", 3)
    rows = [
        row
        for index in FRAMES
        for side in SIDES
        for row in as_proposals(
            index,
            side,
            detector.detect(index, side).observed,
            street.rig.left,
            "simulated",
            "centroid",
        )
    ]
    images = frozenset((index, side) for index in FRAMES for side in SIDES)
    processed = ProcessedImages("simulated", images=images)
    save_proposals(Proposals.of(rows, processed), made.proposals_path)
    return made


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return detected_street(tmp_path_factory.mktemp("detected") / "town").path


def test_a_drive_is_mapped_and_localized_without_a_label(town, capsys):
    code, out, err = call(
        capsys, "map", "build", town, "--from", "detections", "--frames", "0:24:2"
    )
    assert (
        code,
        err.replace("compiling the search for tracks, once only: up to a minute\n", ""),
    ) == (0, "")
    assert " detections: " in out.splitlines()[0]
    built = load_map(town / "maps" / "from-detections.parquet")
    assert len(built) > 10
    assert (built.elements.id >= TRACK_NUMBER).all()
    arguments = (
        "--map",
        "from-detections",
        "--observations",
        "detected",
        "--frames",
        "7:13:2",
        *NO_IMAGES,
    )
    assert call(capsys, "localize", town, *arguments)[0] == 0
    run = load_run(town / "runs" / "search.rrd")
    good = [frame for frame in run.frames if frame.localization.status == "ok"]
    assert len(good) >= len(run.frames) - 1
    known = sum(int((frame.element_id >= TRACK_NUMBER).sum()) for frame in run.frames)
    assert known > 4 * len(run.frames)


def test_json_tells_what_became_of_the_detections(town, capsys):
    arguments = (town, "--from", "detections", "--name", "few", "--least-score", 0.3, "--json")
    said = json.loads(call(capsys, "map", "build", *arguments)[1])
    counts = said["detections"]
    assert counts["tracks"] == len(said["track_log_odds"]) > 10
    kinds = ("labelled", "rejected", "tracked", "alone", "no_landmark")
    assert sum(counts[kind] for kind in kinds) == counts["detections"]
    few = load_map(town / "maps" / "few.parquet")
    assert few.settings["tracking"] == {"least_score": 0.3}


def test_the_truth_of_mapped_detections_is_known(town):
    workspace = Workspace.open(town)
    built = load_map(town / "maps" / "from-detections.parquet")
    detections = read_detections(workspace, ())
    element_of = {name: id_ for id_, names in sources(built).items() for name in names}
    observe = observe_detected(workspace, built, detections)
    for frame in workspace.source.frames[4:6]:
        ids = observe(frame)[1].tolist()
        for row, element_id in zip(detections.in_frame(frame.index, "left"), ids, strict=True):
            assert element_of.get(row.id, element_id) == element_id


def test_the_map_is_checked_with_its_detections(town, capsys):
    code, out, _ = call(capsys, "map", "check", town, "--map", "from-detections")
    assert code == 0
    assert "pole" in out
    workspace = Workspace.open(town)
    built = load_map(town / "maps" / "from-detections.parquet")
    labels = read_labels_of(workspace, built).labels
    assert len(labels.elements) == len(built)
    used = sum(len(source.observation_ids) for source in built.provenance)
    assert len(labels.observations) == used


def test_a_run_is_rebuilt_without_what_was_rejected(tmp_path, capsys):
    workspace = detected_street(tmp_path / "town")
    town = workspace.path
    call(capsys, "map", "build", town, "--from", "detections")
    arguments = (
        "--map",
        "from-detections",
        "--observations",
        "detected",
        "--frames",
        "4:6",
        *NO_IMAGES,
    )
    assert call(capsys, "localize", town, *arguments)[0] == 0
    run = load_run(town / "runs" / "search.rrd")
    gone = run.semantic_map.provenance[0].observation_ids
    element = LabelElement(new_id(), 1, int(run.semantic_map.elements.class_id[0]))
    rows = tuple(
        replace(as_observation(row), element_id=element.id)
        for row in read_detections(workspace, ()).rows()
        if row.id in gone
    )
    with workspace.open_labels() as store:
        store.apply(ImportLabels((element,), rows), "ann")
        store.apply(DecideElements((review_decision(element.id, "leave out"),)), "ann")
    again = rebuild_run(run, town / "runs" / "again.rrd", workspace)
    old, new = sources(run.semantic_map), sources(again.semantic_map)
    assert len(new) == len(old) - 1
    assert not set().union(*new.values()) & set(gone)
    for before, after in zip(run.frames, again.frames, strict=True):
        for was, now in zip(before.element_id.tolist(), after.element_id.tolist(), strict=True):
            assert now < 0 or old[was] & new[now]


def sources(semantic_map: SemanticMap) -> dict[int, set[str]]:
    """The detections of each element, by its id."""
    ids = semantic_map.elements.id.tolist()
    return {
        element_id: set(source.observation_ids)
        for element_id, source in zip(ids, semantic_map.provenance, strict=True)
    }


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--least-score", 0.5), "--least-score is for --from detections"),
        (("--from", "detections", "--method", "paper"), "--from detections is for --method joint"),
        (("--from", "detections", "--least-score", 1.5), "score 1.5: give a number from 0 to 1"),
        (("--from", "detections", "--min-frames", 1), "min_frames 1: a track needs 2 frames"),
        (("--from", "detections", "--min-frames", 99), "show a landmark often enough"),
    ],
)
def test_what_makes_no_sense_is_refused(town, capsys, arguments, word):
    code, out, err = call(capsys, "map", "build", town, "--name", "none", *arguments)
    assert (code, out) == (2, "")
    assert word in err
    assert not (town / "maps" / "none.parquet").exists()


def test_without_detections_one_is_told_what_to_do(tmp_path, capsys):
    Workspace.create_street(tmp_path / "town", seed=3, frames=range(6))
    code, _, err = call(capsys, "map", "build", tmp_path / "town", "--from", "detections")
    assert code == 2
    assert "no detections yet; run 'semviz detect" in err


def test_the_check_does_not_blame_ends_that_building_gave_up(tmp_path):
    """One peak of a pole that many images show is said to be known, 60 px below where it is."""
    workspace = detected_street(tmp_path / "town")
    detections = read_detections(workspace, ())
    built, _ = build_map(Labels(), workspace.source, detections=detections)
    pole = max(
        (origin for origin, line in zip(built.provenance, built.elements.is_line, strict=True)
         if line),
        key=lambda origin: len(origin.observation_ids),
    )  # fmt: skip
    ours = [row for row in detections.rows() if row.id in pole.observation_ids]
    wrong = next(row for row in ours if row.anchor_known and row.end_px[1] > row.anchor_px[1] + 80)
    share = 60.0 / (wrong.end_px[1] - wrong.anchor_px[1])
    lower = tuple(a + share * (b - a) for a, b in zip(wrong.anchor_px, wrong.end_px, strict=True))
    rows = [replace(row, anchor_px=lower) if row is wrong or row.id == wrong.id else row
            for row in detections.rows()]  # fmt: skip
    planted = Proposals.of(rows, detections.processed)
    save_proposals(planted, workspace.proposals_path)
    built, report = build_map(Labels(), workspace.source, detections=planted)
    assert report.detections is not None
    assert report.detections.unknown_ends > 0
    labels, sigma_ratio = read_labels_of(workspace, built)
    assert not labels.observations[wrong.id].anchor_known
    worst = leave_one_out(built, labels, workspace.source, None, sigma_ratio)[0]
    assert worst.normalized < 6.0
