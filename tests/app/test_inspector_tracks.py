"""A run in a map from detections: the inspector tells which elements nobody has accepted."""

from dataclasses import replace
from pathlib import Path

import pytest
from streets import street_workspace
from tracked_detections import FALSE, detect_and_map, track_id

from semviz.inspector.element_card import Origins
from semviz.inspector.elements import Findings, findings_view
from semviz.inspector.label_repair import RunLabels
from semviz.runs.run import Run, RunInfo
from semviz.workspace.workspace import MAIN, Workspace
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposal import Proposal
from semviz_core.diagnosis.element_statistics import ElementRecord
from semviz_core.diagnosis.run import RunDiagnosis

FRAMES = 4
Tracked = tuple[Run, Path, list[Proposal]]


@pytest.fixture
def tracked(tmp_path: Path) -> Tracked:
    """A run without frames, its file, and the detections of the false pole."""
    workspace = street_workspace(tmp_path / "street", 7, FRAMES)
    found = detect_and_map(workspace, range(FRAMES))
    workspace.open_labels().close()
    info = RunInfo("first", "", "search", 0, "0", "2026-01-01T00:00:00", workspace.source.rig, MAIN)
    run = Run(info, workspace.read_map(MAIN), ())
    return run, workspace.run_path("first"), found[FALSE]


def labels_at(path: Path) -> Labels:
    return Workspace.open(path.parent.parent).read_labels()


def test_an_element_of_a_track_says_so(tracked: Tracked) -> None:
    run, path, rows = tracked
    origins = Origins(run, path)
    assert origins.of(FALSE) == ()
    assert {row.id for row in origins.track(FALSE)} == {row.id for row in rows}
    assert origins.why_none(FALSE) == (
        f"A track of {len(rows)} detections in {FRAMES} frames, 0 to {FRAMES - 1}, which nobody "
        "has accepted."
    )


def test_the_list_of_elements_tells_how_sure_a_track_is(tracked: Tracked) -> None:
    run = tracked[0]
    unsure = replace(run.semantic_map.provenance[-1], log_odds=3.3)
    provenance = (*run.semantic_map.provenance[:-1], unsure)
    run = replace(run, semantic_map=replace(run.semantic_map, provenance=provenance))
    records = tuple(ElementRecord(int(id)) for id in run.semantic_map.elements.id)
    found = findings_view(run, Findings(RunDiagnosis(None, (), 0), records))
    last = found.rows[-1]
    assert (last.log_odds, last.existence) == (3.3, "96.4 %")


def test_the_link_to_annotate_names_the_track_and_its_nearest_frame(tracked: Tracked) -> None:
    run, path, rows = tracked
    assert RunLabels(run, path).place(FALSE, 2) == (track_id(rows), 2)
    assert RunLabels(run, path).place(FALSE, 99) == (track_id(rows), FRAMES - 1)


def test_a_track_is_rejected_from_the_inspector_and_back(tracked: Tracked) -> None:
    run, path, rows = tracked
    repair = RunLabels(run, path)
    repair.exclude(FALSE)
    labels = labels_at(path)
    assert labels.is_left_out(track_id(rows))
    assert {row.id for row in labels.of_element(track_id(rows))} == {row.id for row in rows}
    assert (repair.view().edits, repair.view().undoable) == (1, 1)
    repair.undo()
    assert labels_at(path) == Labels()
