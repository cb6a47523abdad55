"""COCO keypoints: what is understood, what is dropped, what is refused."""

import json
from pathlib import Path
from typing import Any

import pytest
from label_files import FRAMES, RULES

from semviz_annotation.label_formats.coco import read_coco
from semviz_annotation.label_formats.import_context import LabelImportContext
from semviz_annotation.label_formats.import_plan import plan_import
from semviz_annotation.label_formats.reading import ParsedLabels
from semviz_annotation.labels.labels import Labels
from semviz_core.common.errors import SemvizError

READING = LabelImportContext(RULES, FRAMES, class_map={"person": "ignore"})
POLE = {"id": 1, "image_id": 10, "category_id": 1, "keypoints": [10, 20, 2, 11.5, 200.25, 1]}
SIGN = {"id": 2, "image_id": 11, "category_id": 2, "keypoints": [7.5, 8.5, 2]}
BOXED = {"id": 3, "image_id": 10, "category_id": 3, "bbox": [10.5, 20.5, 20, 40]}


def document(*annotations: Any, **more: Any) -> dict[str, Any]:
    size = {"width": 640, "height": 480}
    return {
        "images": [
            {"id": 10, "file_name": "left/000003.png", **size},
            {"id": 11, "file_name": "image_3/000004.png", **size},
        ],
        "categories": [
            {"id": 1, "name": "pole", "keypoints": ["bottom", "peak"][::-1]},
            {"id": 2, "name": "round sign", "keypoints": ["middle"]},
            {"id": 3, "name": "triangular", "supercategory": "sign"},
            {"id": 4, "name": "person", "keypoints": ["nose"]},
        ],
        "annotations": list(annotations),
        **more,
    }


def read(tmp_path: Path, content: Any) -> ParsedLabels:
    path = tmp_path / "street.json"
    path.write_text(json.dumps(content))
    return read_coco(path, READING)


def test_annotations(tmp_path: Path) -> None:
    others = {"area": 3.0, "num_keypoints": 2, "iscrowd": 0, "segmentation": [[1, 2]]}
    found = read(tmp_path, document(POLE | others, SIGN, BOXED, {**POLE, "category_id": 4}))
    pole, sign, boxed = found.observations
    assert (pole.frame_index, pole.side, pole.class_id) == (3, "left", 0)
    assert (pole.anchor_px, pole.end_px) == ((10.0, 20.0), (11.5, 200.25))
    assert (pole.anchor_known, pole.end_known) == (True, False)
    assert (sign.frame_index, sign.side, sign.class_id) == (4, "right", 3)
    assert (sign.anchor_px, sign.end_px) == ((7.5, 8.5), None)
    assert (boxed.class_id, boxed.anchor_px) == (1, (20.0, 40.0))
    assert found.dropped == {
        "'segmentation': no polygons; the keypoints count": 1,
        "shapes of class 'person': ignored, as asked": 1,
    }
    assert boxed.outline == ("box", ((10.0, 20.0), (30.0, 60.0)))


def test_keypoints_are_told_by_name_not_by_place(tmp_path: Path) -> None:
    content = document(POLE)
    content["categories"][0]["keypoints"] = ["bottom", "peak"]
    (pole,) = read(tmp_path, content).observations
    assert (pole.anchor_px, pole.end_px) == ((11.5, 200.25), (10.0, 20.0))
    assert (pole.anchor_known, pole.end_known) == (False, True)


def test_what_is_not_labelled_is_dropped(tmp_path: Path) -> None:
    content = document(
        POLE | {"keypoints": [10, 20, 2, 0, 0, 0]},
        SIGN | {"keypoints": [0, 0, 0]},
        SIGN | {"keypoints": []},
        POLE | {"keypoints": None},
    )
    found = read(tmp_path, content)
    assert not found.observations
    assert sum(found.dropped.values()) == 4


@pytest.mark.parametrize(
    "mark",
    [{"track_id": 3}, {"attributes": {"track_id": 3}}, {"element": "P-3"},
     {"attributes": {"element": "P-3"}}],
)  # fmt: skip
def test_tracks_and_names_are_elements(tmp_path: Path, mark: dict[str, Any]) -> None:
    found = read(tmp_path, document(POLE | mark, POLE | {"image_id": 11} | mark, POLE))
    assert len(plan_import(found.observations[:2], Labels()).elements) == 1
    assert found.dropped == {}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (document(POLE, POLE | {"image_id": 9}), "item 2: image_id 9 is not in the file"),
        (document(POLE | {"category_id": None}), "item 1: category_id None is not in the file"),
        (document(POLE | {"keypoints": [1, 2]}), "keypoints are not a list of u, v, visibility"),
        (document(POLE | {"keypoints": "123"}), "keypoints are not a list"),
        (document(POLE | {"keypoints": [1, 2, 2]}), "1 keypoints, other than its category names"),
        (document(POLE | {"keypoints": [1, 2, 2, 3, 99, 7]}), "visibility 7 is not 0, 1 or 2"),
        (document(POLE | {"keypoints": [1, float("nan"), 2, 3, 99, 2]}), "nan is not a number"),
        (document(POLE | {"keypoints": [1, 2, 2, 3, 480, 2]}), "outside the left image"),
        (document(BOXED | {"bbox": [1, 2, -1, 3]}), "a bbox of negative size"),
        (document(BOXED | {"bbox": [1, 2, 3]}), "bbox is not a list of u, v, width, height"),
        (document(POLE | {"track_id": 1.5}), "track_id is not a whole number but 1.5"),
        (document(POLE | {"attributes": {"element": 5}}), "element is not a text but 5"),
        (document(POLE, categories=[{"id": 1, "name": "tree"}]), r"class 'tree' is not known"),
        (document(POLE, categories=[{"id": 1, "name": "pole", "keypoints": 3}]), "other than"),
        (document(categories=[{"id": 1}, {"id": 1}]), "category 2: id 1 is another's already"),
        (document(images=[{"id": "a"}]), "image 1: id is not a whole number but 'a'"),
        (document(images=[3]), "image 1: an object is expected, not 3"),
        (document(POLE, images=[{"id": 10, "file_name": "left/3.png"}]), "an image of None by"),
        (document(POLE, images=[{"id": 10}]), "file_name is not a text but None"),
        (document(annotations=3), "no list 'annotations'"),
        (3, "an object is expected, not 3"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, content: Any, words: str) -> None:
    with pytest.raises(SemvizError, match=words) as caught:
        read(tmp_path, content)
    line = str(caught.value)
    assert line.startswith(str(tmp_path / "street.json"))
    assert line.endswith(". Nothing was imported.")
    assert "\n" not in line
