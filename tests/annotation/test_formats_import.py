"""An import is one operation, all or nothing, and does nothing twice."""

import json
import shutil
from pathlib import Path

import pytest
from label_files import FRAMES, RIG, RULES, labels_of, pole, store_of, street

from semviz import cli
from semviz.workspace.workspace import Workspace
from semviz_annotation.label_formats.exchange import (
    export_labels,
    guess_format,
    import_labels,
)
from semviz_annotation.label_formats.import_context import LabelImportContext
from semviz_annotation.label_formats.import_plan import ImportLabels, plan_import
from semviz_annotation.label_formats.reading import (
    ParsedObservation,
    parse_class_map,
)
from semviz_annotation.labels.edits import (
    DeleteElement,
    Dismiss,
    MoveObservation,
    ReviewFrame,
    Unlink,
)
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import Dismissal, new_id, proposal_id
from semviz_annotation.storage.store import LabelStore
from semviz_core.common.errors import SemvizError


def seen(u: float, **more: object) -> ParsedObservation:
    given = {"where": f"a.xml, item {u:.0f}", "frame_index": 3, "side": "left", "class_id": 0}
    return ParsedObservation(**{**given, "anchor_px": (u, 20.0), "end_px": (u, 200.0), **more})  # type: ignore[arg-type]


def after(labels: Labels, *landmarks: ParsedObservation) -> Labels:
    plan = plan_import(landmarks, labels)
    edit = ImportLabels(tuple(plan.elements), tuple(plan.observations))
    return labels.changed(edit.changes(labels, RULES))


def test_a_file_that_has_grown_adds_what_is_new(tmp_path: Path) -> None:
    """Also where only numbers of the file's own say what is one element."""
    first = [seen(10, number=1), seen(50), seen(10, number=1, side="right")]
    labels = after(Labels(), *first)
    assert len(labels.elements) == 2
    grown = [*first, seen(10, number=1, frame_index=4), seen(90)]
    plan = plan_import(grown, labels)
    assert (plan.already, len(plan.observations), len(plan.elements)) == (3, 2, 1)
    later = after(labels, *grown)
    (row,) = (observation for observation in later.in_frame(4))
    assert len(later.of_element(row.element_id)) == 3
    assert after(later, *grown) == later


def test_numbers_of_two_files_are_not_one_element() -> None:
    labels = after(after(Labels(), seen(10, number=1)), seen(11, number=1, frame_index=9))
    assert len(labels.elements) == 2
    named = after(Labels(), seen(10, name="lamp"))
    assert len(after(named, seen(11, name="lamp", frame_index=9)).elements) == 1


def test_the_number_of_a_named_element_is_enough() -> None:
    """Whoever adds a shape in labelme types the group's number, not its name."""
    sign = {"class_id": 3, "end_px": None}
    landmarks = [seen(10, name="lamp", number=4), seen(11, number=4, side="right")]
    labels = after(Labels(), *landmarks, seen(60, number=4, **sign))
    assert len(labels.elements) == 2
    assert len(list(labels.pairs(3))) == 1


def test_classes_keep_numbers_apart_and_names_not() -> None:
    sign = {"class_id": 3, "end_px": None}
    assert len(after(Labels(), seen(10, number=1), seen(60, number=1, **sign)).elements) == 2
    with pytest.raises(SemvizError, match="element 'a' is of another class elsewhere"):
        after(Labels(), seen(10, name="a"), seen(60, name="a", **sign))


def test_the_same_label_twice_counts_once() -> None:
    plan = plan_import([seen(10), seen(10)], Labels())
    assert (len(plan.observations), plan.repeated) == (1, 1)


def test_what_is_labelled_differently_is_refused(tmp_path: Path) -> None:
    with (
        store_of(street(), tmp_path / "first") as first,
        store_of(Labels(), tmp_path / "second") as second,
    ):
        export_labels(first, tmp_path / "out.xml", "cvat")
        import_labels(tmp_path / "out.xml", second, "bea")
        row = second.labels.in_frame(3, "right")[0]
        second.apply(MoveObservation(row.id, (1.0, 2.0)), "ann")
        before = second.last_operation
        with pytest.raises(
            SemvizError, match=r"out.xml, item 2: element 1 is labelled differently"
        ):
            import_labels(tmp_path / "out.xml", second, "bea")
        assert second.last_operation == before
        second.undo("ann")
        assert import_labels(tmp_path / "out.xml", second, "bea").already == 6
        second.apply(Unlink((row.id,), new_id()), "ann")
        with pytest.raises(SemvizError, match="given to another element since"):
            import_labels(tmp_path / "out.xml", second, "bea")


def test_numbers_are_kept_where_no_element_ever_had_them(tmp_path: Path) -> None:
    with (
        store_of(street(), tmp_path / "first") as first,
        store_of(labels_of(pole(9, 1, "left", (5.0, 6.0))), tmp_path / "second") as second,
    ):
        export_labels(first, tmp_path / "out.json", "coco")
        import_labels(tmp_path / "out.json", second, "bea")
        assert sorted(element.number for element in second.labels.elements.values()) == [
            1,
            2,
            3,
            4,
            5,
        ]
        same = [
            element
            for element in first.labels.elements
            if first.labels.elements[element].number > 1
        ]
        assert all(
            second.labels.elements[element_id] == first.labels.elements[element_id]
            for element_id in same
        )


def test_an_import_overrules_that_it_is_not_there(tmp_path: Path) -> None:
    with store_of(street(), tmp_path / "first") as first:
        export_labels(first, tmp_path / "out.xml", "cvat")
        (row,) = first.labels.in_frame(7)
        spare = first.labels.in_frame(3, "left")[0]
        first.apply(DeleteElement(row.element_id), "ann")
        id_ = proposal_id(spare.element_id, 5, "left")
        first.apply(Dismiss((Dismissal(id_, 5, "left", "absent", spare.element_id),)), "ann")
        assert id_ in first.labels.dismissals
        found = seen(100, name=spare.element_id, frame_index=5)
        assert not after(first.labels, found).dismissals
        assert import_labels(tmp_path / "out.xml", first, "bea").observations == 1
        assert first.labels.element(row.element_id).number == 5  # 4 was another's once
        assert len(first.labels.observations) == 6


def test_what_a_format_cannot_hold_is_listed(tmp_path: Path) -> None:
    with store_of(street(), tmp_path / "first") as first:
        first.apply(ReviewFrame(9, "reviewed, empty"), "ann")
        report = export_labels(first, tmp_path / "out.xml", "cvat-video")
        assert report.dropped == {
            "reviews of frames: the format has no word for them": 1,
            "labels of right images: export them with --side right": 3,
        }
        assert "dropped: 3 x labels of right images" in report.as_text()
        assert (report.images, report.observations) == (4, 3)


def test_what_is_upside_down_is_noted(tmp_path: Path) -> None:
    fallen = labels_of(pole(1, 3, "left", (10.0, 200.0), (10.0, 20.0)))
    with store_of(fallen, tmp_path / "a") as first, store_of(Labels(), tmp_path / "b") as second:
        export_labels(first, tmp_path / "out.xml", "cvat")
        report = import_labels(tmp_path / "out.xml", second, "bea")
        assert "1 poles start at their lower end; R swaps the ends" in report.as_text()


@pytest.mark.parametrize(
    ("content", "format_"),
    [
        ("\ufeff <annotations/>", "cvat"),
        ('{"images": [], "annotations": []}', "coco"),
        ('{"shapes": []}', "labelme"),
        ('{"a": 1}', None),
        ("hello", None),
        ("PK\x03\x04", None),
        ("", None),
        ("[]", None),
        ('{"a"', None),
    ],
)
def test_what_is_in_a_file_tells_its_format(
    tmp_path: Path, content: str, format_: str | None
) -> None:
    path = tmp_path / "some.thing"
    path.write_text(content, encoding="utf-8")
    if format_ is None:
        with pytest.raises(SemvizError, match=r"some.thing: .*"):
            guess_format(path)
    else:
        assert guess_format(path) == format_
    with pytest.raises(SemvizError, match="cannot be read"):
        guess_format(tmp_path / "none")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("left/000012.png", (12, "left")),
        ("a\\Right\\7.jpg", (7, "right")),
        ("2011_09_26/image_02/data/0000000012.png", (12, "left")),
        ("sequences/02/image_3/000000.png", (0, "right")),
        ("frame_12_left.png", (12, "left")),
        ("right-000012-1.png", (12, "right")),
        ("left.7/8", (8, "left")),
        ("right/000012_png.rf.8d24f3a1b2c3d4e5f60718293a4b5c6d.jpg", (12, "right")),  # Roboflow
        ("images/3fa85f64-left_000012.png", (12, "left")),  # Label Studio
    ],
)
def test_names_of_images(name: str, expected: tuple[int, str]) -> None:
    place = LabelImportContext(RULES).image((name,), None)
    assert (place.frame_index, place.side) == expected


def test_a_class_map_is_name_and_class() -> None:
    assert parse_class_map(["a=pole", "b=c=ignore", "=pole"]) == {
        "a": "pole",
        "b=c": "ignore",
        "": "pole",
    }
    with pytest.raises(SemvizError, match="--class-map a: write NAME=CLASS"):
        parse_class_map(["a"])


# -- the commands


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated street of four frames, without labels."""
    path = tmp_path_factory.mktemp("town") / "town"
    Workspace.create_street(path, 7, frames=range(4))
    return path


def semviz(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as caught:
        cli.main([str(word) for word in words])
    out = capsys.readouterr()
    return int(caught.value.code or 0), out.out, out.err


@pytest.fixture
def workspace(town: Path, tmp_path: Path) -> Path:
    shutil.copytree(town, tmp_path / "town")
    return tmp_path / "town"


def test_the_commands(workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = Workspace.open(workspace).source.rig.left
    image = f'<image name="left/1.png" width="{size.width}" height="{size.height}">'
    lamp = '<polyline label="Mast 7" points="10,20;11,200"/>'
    file = tmp_path / "in.xml"
    file.write_text(f"<annotations>{image}{lamp}<tag label='x'/></image></annotations>")

    status, out, err = semviz(capsys, "labels", "import", workspace, file)
    assert (status, out) == (2, "")
    assert "in.xml, item 1: class 'Mast 7' is not known; say --class-map 'Mast 7=CLASS'" in err
    assert len(err.splitlines()) == 1

    mapped = ("--class-map", "Mast 7=pole", "--author", "bea")
    status, out, err = semviz(capsys, "labels", "import", workspace, file, *mapped)
    assert (status, err) == (0, "")
    assert "1 labels of 1 new elements from 1 images (cvat)" in out
    assert "dropped: 1 x tag: neither line, point, box nor polygon" in out

    status, out, err = semviz(capsys, "labels", "import", workspace, file, *mapped, "--json")
    assert json.loads(out)["already"] == 1

    for name, format_ in (("a.xml", "cvat"), ("a.json", "coco")):
        status, out, err = semviz(capsys, "labels", "export", workspace, tmp_path / name, "--json")
        assert (status, json.loads(out)["format"]) == (0, format_)
    status, out, err = semviz(
        capsys, "labels", "export", workspace, tmp_path / "folder", "--format", "labelme"
    )
    assert (status, out.splitlines()) == (0, [f"{tmp_path}/folder: 1 labels in 2 images (labelme)"])
    status, out, err = semviz(capsys, "labels", "export", workspace, tmp_path / "a.jsonl")
    assert (status, out.splitlines()) == (0, [f"{tmp_path}/a.jsonl: 1 operations"])

    with Workspace.open(workspace).open_labels() as store:
        assert store.operations()[0].author == "bea"
        assert store.operations()[0].kind == "import"
        assert store.labels.in_frame(1)[0].anchor_px == (9.5, 19.5)


def test_a_log_with_an_import_goes_into_a_new_workspace(
    workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with store_of(street(), tmp_path / "first") as first:
        export_labels(first, tmp_path / "out.xml", "cvat")
    with LabelStore.open(workspace / "labels.db", rig=RIG) as store:
        import_labels(tmp_path / "out.xml", store, "bea", frames=FRAMES)
        before = store.labels
        store.undo("bea")
        store.redo("bea")
    assert semviz(capsys, "labels", "export", workspace, tmp_path / "a.jsonl")[0] == 0
    again = workspace.parent / "again"
    Workspace.create_street(again, 7, frames=range(40))
    status, _, err = semviz(capsys, "labels", "import", again, tmp_path / "a.jsonl")
    assert (status, err) == (0, "")
    assert Workspace.open(again).read_labels() == before
    status, _, err = semviz(
        capsys, "labels", "import", again, tmp_path / "a.jsonl", "--side", "left"
    )
    assert (status, "do not apply to a log of operations" in err) == (2, True)
