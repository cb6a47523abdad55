"""labelme: what is understood, what is kept, what is refused."""

import json
from pathlib import Path
from typing import Any

import pytest
from label_files import FRAMES, RULES, said, store_of, street

from semviz_annotation.label_formats.exchange import KEPT, export_labels, import_labels
from semviz_annotation.label_formats.import_context import LabelImportContext
from semviz_annotation.label_formats.labelme import read_labelme
from semviz_annotation.label_formats.reading import ParsedLabels
from semviz_annotation.labels.edits import MoveObservation
from semviz_annotation.labels.labels import Labels
from semviz_core.common.errors import SemvizError

READING = LabelImportContext(RULES, FRAMES)


def shape(kind: str, label: str, *points: list[Any], **more: Any) -> dict[str, Any]:
    return {"label": label, "shape_type": kind, "points": list(points), **more}


def document(*shapes: Any, **more: Any) -> dict[str, Any]:
    return {
        "version": "5.7.0", "flags": {}, "shapes": list(shapes), "imagePath": "000003.png",
        "imageData": None, "imageHeight": 480, "imageWidth": 640, **more,
    }  # fmt: skip


POLE = shape("line", "pole", [10.5, 20.5], [11.5, 200.5])


def write(folder: Path, name: str, content: Any) -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def read(tmp_path: Path, *shapes: Any, **more: Any) -> ParsedLabels:
    return read_labelme(write(tmp_path, "left/a.json", document(*shapes, **more)), READING)


def test_shapes(tmp_path: Path) -> None:
    found = read(
        tmp_path, POLE,
        shape("linestrip", "lamp post", [1, 2], [3, 4], [5, 99], group_id=7),
        shape("point", "round", [7.5, 8.5], flags={"anchor_known": False}),
        shape("rectangle", "triangular sign", [30.5, 60.5], [10.5, 20.5], group_id=None),
        shape("mask", "whatever", [1, 2], [3, 4]),
        imageData="aGVsbG8=",
    )  # fmt: skip
    pole, lamp, sign, triangle = found.observations
    assert (pole.frame_index, pole.side) == (3, "left")
    assert (pole.anchor_px, pole.end_px, pole.end_known) == ((10.0, 20.0), (11.0, 200.0), True)
    assert (lamp.class_id, lamp.end_px, lamp.number) == (0, (4.5, 98.5), 7)
    assert (sign.class_id, sign.anchor_px, sign.anchor_known) == (3, (7.0, 8.0), False)
    assert (triangle.class_id, triangle.anchor_px) == (1, (20.0, 40.0))
    assert sorted(found.dropped) == [
        "imageData: the images stay where they are",
        "inner points of lines: a pole is its peak and its bottom",
        "mask: neither line, point, box nor polygon",
    ]
    assert triangle.outline == ("box", ((10.0, 20.0), (30.0, 60.0)))


def test_a_group_is_an_element_over_the_files_of_a_folder(tmp_path: Path) -> None:
    grouped = dict(POLE, group_id=4)
    write(tmp_path, "in/left/3.json", document(grouped))
    write(tmp_path, "in/right/3.json", document(grouped))
    write(tmp_path, "in/image_2/deep/4.json", document(POLE, imagePath="..\\000004.png"))
    with store_of(Labels(), tmp_path / "store") as store:
        report = import_labels(tmp_path / "in", store, "bea", frames=FRAMES)
        assert (report.elements, report.observations, report.images) == (2, 3, 3)
        assert len(list(store.labels.pairs(3))) == 1


def test_what_only_labelme_understands_comes_back(tmp_path: Path) -> None:
    """Also after an undo and a redo, and for a label that was moved since."""
    strange = {"vendor": {"deep": [1, 2.5, None]}, "text": "Straße 😀"}
    sign = shape(
        "point", "round", [7.5, 8.5], description="bent", mask=None, flags={"wet": True}, **strange
    )
    content = document(POLE, sign, flags={"night": True}, project=strange, version="5.0.1")
    path = write(tmp_path, "left/a.json", content)
    with store_of(Labels(), tmp_path / "store") as store:
        report = import_labels(path, store, "bea")
        assert report.dropped == {}
        store.undo("bea")
        store.redo("bea")
        (row,) = (
            observation for observation in store.labels.in_frame(3) if observation.end_px is None
        )
        store.apply(MoveObservation(row.id, (8.0, 9.0)), "ann")
        export_labels(store, tmp_path / "out", "labelme", "left")
        assert len(list((tmp_path / "store" / KEPT).iterdir())) == 1
    back = json.loads((tmp_path / "out" / "left" / "000003.json").read_text())
    assert back["flags"] == {"night": True}
    assert back["project"] == strange
    assert back["version"] == "5.0.1"
    (pole, point) = sorted(back["shapes"], key=lambda entry: str(entry["shape_type"]))
    assert pole["points"] == POLE["points"]
    assert {key: point[key] for key in strange} == strange
    assert point["description"] == "bent"
    assert point["flags"] == {"wet": True, "anchor_known": True}
    assert point["points"] == [[8.5, 9.5]]


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    with store_of(street(), tmp_path / "store") as store:
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "mine.json").write_text("{}")
        with pytest.raises(SemvizError, match="already exists; choose a new folder"):
            export_labels(store, tmp_path / "out", "labelme")
        assert [file.name for file in (tmp_path / "out").iterdir()] == ["mine.json"]
        (tmp_path / "out" / "mine.json").unlink()
        export_labels(store, tmp_path / "out", "labelme")
        assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "store"]
        with store_of(Labels(), tmp_path / "again") as again:
            import_labels(tmp_path / "out", again, "bea")
            assert said(again.labels) == said(store.labels)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (document(shape("line", "pole", [1, 2])), "item 1: a line with 1 point"),
        (document(POLE, shape("rectangle", "round", [1, 2])), "item 2: a rectangle with 1 point"),
        (document(shape("line", "pole", [1, 2], [3])), r"item 1: \[3\] is not a point"),
        (document(shape("line", "pole", [1, 2], [3, "4"])), "item 1: '4' is not a number"),
        (document(shape("line", "pole", [1, 2], [3, float("nan")])), "item 1: nan is not a num"),
        (document(shape("line", "pole", [1, 2], [3, True])), "item 1: True is not a number"),
        (document(shape("line", "pole", [1, 2], [3, 10**500])), "item 1: a huge number is not"),
        (document(shape("line", "pole", [1, 2], [3, 999])), "outside the left image"),
        (document(shape("line", "tree", [1, 2], [3, 99])), r"item 1: class 'tree'.*--class-map"),
        (document(shape("line", None, [1, 2], [3, 99])), "a class name is expected, not None"),
        (document(dict(POLE, group_id="a")), "group_id is not a whole number but 'a'"),
        (document(dict(POLE, flags={"end_known": 1})), "end_known is neither true nor false"),
        (document(dict(POLE, flags=[1])), "an object is expected"),
        (document(dict(POLE, more=float("inf"))), "item 1: holds NaN or infinite numbers"),
        (document(POLE, more=float("inf")), r"a.json: holds NaN or infinite numbers"),
        (document("a"), "item 1: an object is expected, not 'a'"),
        (document(POLE, imageWidth=641), "641x480, but the left images of this workspace are"),
        (document(POLE, imageWidth=-5), "an image of -5 by 480 pixels"),
        (document(POLE, imagePath="x.png"), "no frame number"),
        (document(POLE, imagePath=None), "imagePath is not a text but None"),
        ({"shapes": 1, "imagePath": "1.png"}, "no list 'shapes'"),
        ([], r"an object is expected, not \[\]"),
        ("[" * 100_000, "nested too deeply"),
        ("[" * 100 + "]" * 100, "nested too deeply"),
        ('{"shapes": ', "not JSON"),
        ("\udcff", "not JSON"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, content: Any, words: str) -> None:
    path = tmp_path / "left" / "a.json"
    path.parent.mkdir()
    text = content if isinstance(content, str) else json.dumps(content)
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(SemvizError, match=words) as caught:
        read_labelme(path, READING)
    line = str(caught.value)
    assert line.startswith(str(path))
    assert line.endswith(". Nothing was imported.")
    assert "\n" not in line


def test_two_files_of_one_image_are_refused(tmp_path: Path) -> None:
    write(tmp_path, "left/3.json", document(POLE))
    write(tmp_path, "left/copy.json", document(POLE))
    with pytest.raises(SemvizError, match=r"copy.json: a second file of the left image of frame 3"):
        read_labelme(tmp_path / "left", READING)
    (tmp_path / "none").mkdir()
    with pytest.raises(
        SemvizError, match=r"a folder without .json files\. Nothing was imported\.$"
    ):
        read_labelme(tmp_path / "none", READING)
