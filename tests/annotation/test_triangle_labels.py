"""Labels, logs, proposals and map files tell what the point of a triangular sign is."""

import json
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_shapes import background, drawn
from hypothesis import given
from hypothesis import strategies as st
from support.street_labels import label_street

from semviz_annotation.assist import Mark, MarkedImage, snap
from semviz_annotation.label_formats.exchange import import_labels
from semviz_annotation.labels.detections import as_elements, as_proposals
from semviz_annotation.labels.edits import AddObservation
from semviz_annotation.labels.labels import Labels, new_id
from semviz_annotation.labels.proposals import (
    Proposals,
    load_proposals,
    read_proposals,
    save_proposals,
)
from semviz_annotation.labels.views import PosedView
from semviz_annotation.map_formats.conversion import MapImportContext
from semviz_annotation.map_formats.exchange import export_map, import_map
from semviz_annotation.map_formats.georeference import Georeference
from semviz_annotation.mapping.build import BuildOptions, build_map
from semviz_annotation.mapping.quality.check import check_map
from semviz_annotation.mapping.quality.diff import diff_maps
from semviz_annotation.mapping.quality.label_links import observe
from semviz_annotation.storage.backup import (
    backup_labels,
    check_labels,
    export_operations,
    import_operations,
    restore_labels,
)
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, POLE, TRIANGULAR, TriangleCenter
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.simulation.detector import Detection
from semviz_core.simulation.street import Street

VIEW = PosedView(
    Camera(200, 160, np.array([[700.0, 0, 80], [0, 700.0, 90], [0, 0, 1]])), Pose.identity()
)
UPRIGHT = np.array([[0.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
KITTI02 = Path(__file__).parents[2] / "docs" / "kitti02" / "labels.jsonl"


def triangle(frame: int = 0, v: float = 50.0) -> AddObservation:
    return AddObservation(new_id(), new_id(), frame, "left", (40.0, v), None, class_id=TRIANGULAR)


def version_of(path: Path) -> tuple[int, list[tuple[str, int]]]:
    """The version of a label file, and what it says of triangles."""
    with sqlite3.connect(path) as file:
        (version,) = file.execute("PRAGMA user_version").fetchone()
        says = "SELECT * FROM counters WHERE name LIKE '%triangle%'"
        return version, file.execute(says).fetchall()


def old_file(path: Path) -> Path:
    """A label file as it was before there was a choice, with one triangle."""
    with LabelStore.open(path, triangle_center="box") as store:
        store.apply(triangle(), "ann")
    assert version_of(path) == (7, [])
    return path


def test_an_old_file_is_of_the_box_and_nothing_moves(tmp_path: Path) -> None:
    path = old_file(tmp_path / "old.db")
    with LabelStore.open(path) as store:
        before = store.labels
        assert before.triangle_center == "box"
        store.apply(triangle(3), "ann")
        assert store.labels.triangle_center == "box"
        assert store.labels_at(1).triangle_center == "box"
    with LabelStore.open(path, triangle_center="centroid") as store:
        first = next(iter(before.observations.values()))
        assert store.labels.observations[first.id] == first
        assert store.labels.triangle_center == "box"
    assert version_of(path)[0] == 7


def test_a_new_file_follows_the_centroid_and_older_programs_refuse_it(tmp_path: Path) -> None:
    path = tmp_path / "new.db"
    with LabelStore.open(path) as store:
        store.apply(triangle(), "ann")
        assert store.labels.triangle_center == "centroid"
        store.undo("ann")
        assert store.labels_at(0).triangle_center == "centroid"
        assert store.labels.without_left_out().triangle_center == "centroid"
    assert version_of(path) == (8, [("triangle centroid", 1)])


def test_a_log_carries_it_and_two_are_not_mixed(tmp_path: Path) -> None:
    logs: dict[TriangleCenter, Path] = {}
    centers: tuple[TriangleCenter, ...] = ("box", "centroid")
    for center in centers:
        with LabelStore.open(tmp_path / f"{center}.db", triangle_center=center) as store:
            store.apply(triangle(), "ann")
            logs[center] = tmp_path / f"{center}.jsonl"
            export_operations(store, logs[center])
        assert json.loads(logs[center].read_text().split("\n")[0])["triangle_center"] == center
    for center in centers:
        for new in centers:  # whatever an empty file was made for
            with LabelStore.open(tmp_path / f"{center}-{new}.db", triangle_center=new) as store:
                assert import_operations(logs[center], store) == 1
                assert store.labels.triangle_center == center
            with LabelStore.open(tmp_path / f"{center}-{new}.db") as store:
                assert store.labels.triangle_center == center
                other = logs["box" if center == "centroid" else "centroid"]
                before = store.labels
                with pytest.raises(SemvizError):
                    import_operations(other, store)
                assert store.labels == before


def test_a_longer_log_of_the_other_definition_is_refused(tmp_path: Path) -> None:
    with LabelStore.open(tmp_path / "a.db") as store:
        store.apply(triangle(), "ann")
        export_operations(store, tmp_path / "short.jsonl")
        store.apply(triangle(1), "ann")
        export_operations(store, tmp_path / "long.jsonl")
    text = (tmp_path / "long.jsonl").read_text()
    forged = text.replace('"triangle_center": "centroid"', '"triangle_center": "box"')
    forged = forged.replace('"version": 8', '"version": 7')
    (tmp_path / "forged.jsonl").write_text(forged)
    with LabelStore.open(tmp_path / "b.db") as store:
        import_operations(tmp_path / "short.jsonl", store)
        with pytest.raises(SemvizError, match="marks triangular signs at the middle of its box"):
            import_operations(tmp_path / "forged.jsonl", store)
        assert store.last_operation == 1


def test_a_backup_brings_its_definition_back(tmp_path: Path) -> None:
    old = old_file(tmp_path / "old.db")
    backup_labels(old, tmp_path / "copy.db")
    with LabelStore.open(tmp_path / "live.db") as live:
        live.apply(triangle(), "bea")
        restore_labels(tmp_path / "live.db", tmp_path / "copy.db")
        assert live.labels.triangle_center == "box"
    assert version_of(tmp_path / "live.db")[0] == 7


def test_the_shipped_labels_of_kitti_02_are_of_the_box(tmp_path: Path) -> None:
    with LabelStore.open(tmp_path / "kitti.db") as store:
        import_operations(KITTI02, store)
        labels = store.labels
        assert labels.triangle_center == "box"
        kinds = [element.class_id for element in labels.elements.values()]
        assert kinds.count(TRIANGULAR) == 1  # give way
        lines = map(json.loads, KITTI02.read_text().split("\n")[1:-1])
        marked = {
            tuple(change["after"]["anchor_px"])
            for line in lines
            for change in line["changes"]
            if change["after"] is not None and "anchor_px" in change["after"]
        }
        assert {row.anchor_px for row in labels.observations.values()} <= marked  # none moves


@given(st.lists(st.tuples(st.floats(5.0, 90.0), st.floats(-9.0, 9.0)), min_size=1, max_size=5))
def test_proposals_keep_it_and_convert_there_and_back(values: list[tuple[float, float]]) -> None:
    m = len(values)
    rows, shift = (np.array(part) for part in zip(*values, strict=True))
    seen = Elements2D.from_ends(
        np.column_stack([np.arange(m) + 9.0, rows]), np.full((m, 2), np.nan), [TRIANGULAR] * m
    )
    found = as_proposals(0, "left", replace(seen, to_centroid_px=shift), VIEW.camera, "net")
    assert {row.triangle_center for row in found} == {"box"}
    moved = as_elements(found, "centroid")
    np.testing.assert_allclose(moved.anchor_px[:, 1], rows + shift)
    there = Proposals.of(found).following("centroid")
    assert there.id == tuple(row.id for row in found)  # ids stay
    back = there.following("box")
    np.testing.assert_allclose(back.anchor_px, seen.anchor_px, atol=1e-9)


def test_proposals_of_before_are_of_the_box(tmp_path: Path) -> None:
    file = tmp_path / "found.json"
    rows = [
        {"frame_index": 1, "side": "left", "class": "triangular sign", "anchor_px": [7.0, 9.0],
         "score": 0.5},
        {"frame_index": 1, "side": "left", "class": "triangular sign", "anchor_px": [70.0, 9.0],
         "score": 0.5, "triangle_center": "centroid", "to_centroid_px": -3.0},
    ]  # fmt: skip
    text = {"format": "semviz-proposals", "version": 1, "proposals": rows}
    file.write_text(json.dumps(text))
    read = read_proposals(file)
    assert [row.triangle_center for row in read.rows()] == ["box", "centroid"]
    assert read.triangle_center == "box"  # all can follow it, for the first has no height
    assert read.following("box").anchor_px.tolist() == [[7.0, 9.0], [70.0, 12.0]]
    with pytest.raises(SemvizError, match="frame 1, left: a proposed triangular sign is"):
        read.following("centroid")
    save_proposals(read, tmp_path / "proposals.parquet")
    assert load_proposals(tmp_path / "proposals.parquet").rows() == read.rows()
    only = Proposals.of([read[0]])
    save_proposals(only, tmp_path / "as_before.parquet")
    assert load_proposals(tmp_path / "as_before.parquet").rows() == only.rows()


@pytest.mark.parametrize("turn", [1.0, -1.0], ids=["upright", "give way"])
def test_a_click_snaps_to_what_the_labels_mark(turn: float) -> None:
    rng, off = np.random.default_rng(4), {"box": [], "centroid": []}
    for half in np.geomspace(8.0, 30.0, 12):
        middle = np.array([80.0, 90.0]) + rng.uniform(-1.0, 1.0, 2)
        outline = middle + turn * UPRIGHT * half
        picture = drawn(background(rng), outline, (190, 30, 40))
        centroid = outline.mean(axis=0)
        click = centroid + rng.uniform(-0.3, 0.3, 2) * half
        for center, truth in (("box", middle), ("centroid", centroid)):
            image = MarkedImage.of(VIEW, picture, center)
            mark = Mark((float(click[0]), float(click[1])))
            found = snap(image, mark, DEFAULT_CLASSES[TRIANGULAR])
            if found is not None:
                off[center].append(np.linalg.norm(found.mark.ends_px[0] - truth))
    for errors in off.values():
        assert len(errors) >= 9
        assert np.percentile(errors, 80) < 0.4


def test_boxes_of_other_tools_become_centroids_in_a_new_workspace(tmp_path: Path) -> None:
    shapes = [
        {"label": "triangular sign", "points": [[10.5, 20.5], [30.5, 50.5]],
         "shape_type": "rectangle"},
        {"label": "triangular sign", "points": [[80.5, 20.5]], "shape_type": "point"},
        {"label": "rounded sign", "points": [[50.5, 20.5], [70.5, 50.5]],
         "shape_type": "rectangle"},
    ]  # fmt: skip
    document = {"imagePath": "left/000003.png", "shapes": shapes, "imageWidth": 1241,
                "imageHeight": 376}  # fmt: skip
    file = tmp_path / "000003.json"
    file.write_text(json.dumps(document))
    rows: dict[TriangleCenter, list[float]] = {"box": [], "centroid": []}
    for center, found in rows.items():
        with LabelStore.open(tmp_path / f"{center}.db", triangle_center=center) as store:
            report = import_labels(file, store, "ann")
            found += [row.anchor_px[1] for row in store.labels.observations.values()]
            assert report.triangle_points == (center == "centroid")
            assert report.triangle_boxes == (center == "centroid")
            upright = "1 triangular signs are boxes: taken to stand upright; move those of give-way"
            assert (upright in report.as_text()) == (center == "centroid")
            assert ("taken for the centroid" in report.as_text()) == (center == "centroid")
    assert sorted(rows["box"]) == [20.0, 35.0, 35.0]
    assert sorted(rows["centroid"]) == [20.0, 35.0, 40.0]


def town(center: TriangleCenter, shift: float = 0.0) -> SemanticMap:
    elements = Elements3D.from_ends(
        [1, 2],
        [[9.0, 4.0, 2.0 + shift], [1.0, 2.0, 5.0]],
        [[np.nan] * 3, [1.0, 2.0, 0.0]],
        [TRIANGULAR, POLE],
    )
    return SemanticMap(elements, MapFrame("town"), triangle_center=center)


@pytest.mark.parametrize("ending", ["geojson", "osm", "csv"])
def test_exported_maps_come_back_with_it(tmp_path: Path, ending: str) -> None:
    anchor = None if ending == "csv" else Georeference(48.0, 11.0, 500.0)
    for center in ("box", "centroid"):
        path = tmp_path / f"{center}.{ending}"
        export_map(town(center), path, anchor=anchor)
        again, _ = import_map(path, MapImportContext(MapFrame("town")))
        assert again.triangle_center == center


def test_a_diff_says_that_triangles_are_defined_otherwise() -> None:
    diff = diff_maps(town("box"), town("centroid", -0.13))
    assert (diff.redefined, diff.moved, diff.unchanged) == (1, (), 1)
    assert "triangular signs, not compared: 1; at the middle of its box, now" in diff.as_text()
    moved = diff_maps(town("box"), town("box", -0.13))
    assert (moved.redefined, len(moved.moved)) == (0, 1)


@pytest.fixture(scope="module")
def street() -> Street:
    return next(
        street
        for street in map(Street, range(50, 90))
        if (street.truth_map.elements.class_id == TRIANGULAR).sum() >= 3
    )


def labels_of(street: Street) -> Labels:
    made = label_street(lambda i, side: Detection(*street.labels(i, side)), range(0, 60, 2)).labels
    return replace(made, triangle_center=street.triangle_center)


def test_maps_follow_their_labels_and_fit_the_truth_of_the_same_definition(street: Street) -> None:
    for center in ("box", "centroid"):
        here = street.following(center)
        labels = labels_of(here)
        built, _ = build_map(labels, here, BuildOptions(sigma_px=0.5))
        assert built.triangle_center == center
        other = street.following("box" if center == "centroid" else "centroid")
        triangles = built.elements[built.elements.class_id == TRIANGULAR].anchor_m
        assert len(triangles) >= 2
        for truth, least, most in ((here, 0.0, 0.05), (other, 0.08, 0.3)):
            mapped = truth.truth_map.elements
            known = mapped.anchor_m[mapped.class_id == TRIANGULAR]
            off = np.linalg.norm(triangles[:, None] - known, axis=2).min(axis=1)
            assert least <= np.median(off) < most
        check = check_map(built, labels, here, range(0, 60, 10))
        assert check.as_dict()["triangle_center"] == center
        assert "a triangular sign is the " in check.as_text()
        mixed = replace(labels, triangle_center=other.triangle_center)
        with pytest.raises(SemvizError, match="build the map from these labels"):
            check_map(built, mixed, here)
        frame = next(
            row.frame_index
            for row in labels.observations.values()
            if labels.elements[row.element_id].class_id == TRIANGULAR and row.side == "left"
        )
        observe(labels, frame, "left", built)
        with pytest.raises(SemvizError, match="labels, detections and maps of one definition"):
            observe(mixed, frame, "left", built)


def test_the_version_of_a_log_tells_its_triangles(tmp_path: Path) -> None:
    with LabelStore.open(tmp_path / "a.db") as store:
        store.apply(triangle(), "ann")
        export_operations(store, tmp_path / "full.jsonl")
    text = (tmp_path / "full.jsonl").read_text()
    says = '"triangle_center": "centroid", '
    (tmp_path / "silent.jsonl").write_text(text.replace(says, ""))
    (tmp_path / "forged.jsonl").write_text(text.replace(says, says.replace("centroid", "box")))
    with LabelStore.open(tmp_path / "b.db") as store:
        with pytest.raises(SemvizError, match="line 1: a log of version 8"):
            import_operations(tmp_path / "forged.jsonl", store)
        assert store.last_operation == 0
        import_operations(tmp_path / "silent.jsonl", store)
        assert store.labels.triangle_center == "centroid"


DELETED = "DELETE FROM counters WHERE name = 'triangle centroid'"


@pytest.mark.parametrize("fault", [DELETED, "PRAGMA user_version = 7"])
def test_a_file_whose_version_contradicts_its_triangles_is_refused(
    tmp_path: Path, fault: str
) -> None:
    path = tmp_path / "labels.db"
    with LabelStore.open(path) as store:
        store.apply(triangle(), "ann")
    with sqlite3.connect(path) as file:
        file.execute(fault)
    with pytest.raises(SemvizError, match="contradicts its version"):
        LabelStore.open(path)
    with pytest.raises(SemvizError, match="contradicts its version"):
        check_labels(path)
