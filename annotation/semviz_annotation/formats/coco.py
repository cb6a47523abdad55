"""COCO keypoints: one JSON file, in and out.

A pole has the keypoints ``peak`` and ``bottom``, a sign the keypoint ``middle`` (or, in others'
files, the middle of its ``bbox``). Visibility 2 is a known end, 1 one that is not, 0 none.

COCO's keypoints are pixel indices, so that (0, 0) is the CENTRE of the top-left pixel, as ours is;
its boxes count from the image's corner. Facebook's detectron2 reads and writes them so: it adds
0.5 to keypoints only.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semviz_annotation.formats.numbers import from_corner, json_number, number, quoted
from semviz_annotation.formats.reading import (
    MOST_JSON_BYTES,
    Form,
    Found,
    Reading,
    as_number,
    as_object,
    as_text,
    at,
    listed,
    read_bytes,
    read_json,
)
from semviz_annotation.formats.writing import Sheet, Writing
from semviz_annotation.rows import Observation, Pixel
from semviz_core.classes import Kind
from semviz_core.errors import SemvizError
from semviz_core.files import replacing

KEYPOINTS: Mapping[Kind, tuple[str, ...]] = {"line": ("peak", "bottom"), "point": ("middle",)}
_DERIVED = frozenset(
    {"id", "image_id", "category_id", "bbox", "area", "keypoints", "num_keypoints", "track_id"}
)
"""Keys that are used, or follow from those that are."""


def read_coco(path: Path, reading: Reading) -> Found:
    """Poles and signs of a COCO file; SemvizError naming file and item where it is broken."""
    with at(path):
        document = as_object(read_json(read_bytes(path, MOST_JSON_BYTES)))
        images = _by_id(path, "image", listed(document, "images"))
        categories = _by_id(path, "category", listed(document, "categories"))
        annotations = listed(document, "annotations")
    found = Found(images=len(images))
    for item, annotation in enumerate(annotations, 1):
        where = f"{path}, item {item}"
        with at(where):
            _read(where, as_object(annotation), images, categories, reading, found)
    return found


def _by_id(path: Path, what: str, rows: list[Any]) -> dict[int, dict[str, Any]]:
    result: dict[int, dict[str, Any]] = {}
    for item, row in enumerate(rows, 1):
        with at(f"{path}, {what} {item}"):
            id_ = as_number(as_object(row).get("id"), "id")
            if id_ is None or id_ in result:
                raise SemvizError("no id" if id_ is None else f"id {id_} is another's already")
            result[id_] = row
    return result


def _read(
    where: str, annotation: dict[str, Any], images: Mapping[int, dict[str, Any]],
    categories: Mapping[int, dict[str, Any]], reading: Reading, found: Found,
) -> None:  # fmt: skip
    category = _of(annotation, "category_id", categories)
    image = _of(annotation, "image_id", images)
    name = as_text(category.get("name"), "the category's name")
    class_id = reading.class_id(name)
    if class_id is None:
        return found.drop(f"annotations of category {quoted(name)}: ignored, as asked")
    kind = reading.rules.classes[class_id].kind
    shape = _shape(annotation, category, kind, found)
    if shape is None:
        return None
    form, points, known = shape
    place = reading.image(as_text(image.get("file_name"), "file_name"))
    reading.check_size(place[1], image.get("width"), image.get("height"))
    attributes = as_object(annotation.get("attributes") or {})
    _drop_others(annotation, attributes, found)
    element = attributes.get("element", annotation.get("element"))
    reading.seen(
        found, where, place, class_id, form, points,
        name=None if element is None else as_text(element, "element"),
        number=as_number(attributes.get("track_id", annotation.get("track_id")), "track_id"),
        **dict(zip(("anchor_known", "end_known"), known, strict=False)),
    )  # fmt: skip
    return None


def _of(annotation: dict[str, Any], key: str, rows: Mapping[int, dict[str, Any]]) -> dict[str, Any]:
    id_ = as_number(annotation.get(key), key)
    if id_ is None or id_ not in rows:
        raise SemvizError(f"{key} {id_} is not in the file")
    return rows[id_]


def _shape(
    annotation: dict[str, Any], category: dict[str, Any], kind: Kind, found: Found
) -> tuple[Form, list[Pixel], list[bool]] | None:
    """Points and which of them are known; None where there is no pole or sign in it."""
    values = annotation.get("keypoints") or []
    if not isinstance(values, list) or len(values) % 3:
        raise SemvizError("keypoints are not a list of u, v, visibility")
    rows = [_keypoint(values[start : start + 3]) for start in range(0, len(values), 3)]
    names = category.get("keypoints") or []
    if not isinstance(names, list) or (rows and len(rows) != len(names)):
        raise SemvizError(f"{len(rows)} keypoints, other than its category names")
    if kind == "point" and len(rows) != 1:
        if rows:
            found.drop("keypoints of signs that have several: a sign is the middle of its bbox")
        return _box(annotation, found)
    if kind == "line":
        by_name = dict(zip(map(str, names), rows, strict=False))
        rows = [by_name[name] for name in KEYPOINTS["line"] if name in by_name]
        if len(rows) < 2:
            found.drop("poles without the keypoints peak and bottom: a pole needs both")
            return None
    if any(visibility == 0 for _, visibility in rows):
        found.drop("keypoints that are not labelled (visibility 0): nothing is there")
        return None
    form: Form = "line" if kind == "line" else "points"
    return form, [point for point, _ in rows], [visibility == 2 for _, visibility in rows]


def _keypoint(values: list[Any]) -> tuple[Pixel, int]:
    u, v = (number(json_number(value)) for value in values[:2])
    visibility = number(json_number(values[2]))  # some tools write 2.0
    if visibility not in (0, 1, 2):
        raise SemvizError(f"visibility {quoted(values[2])} is not 0, 1 or 2")
    return (u, v), int(visibility)


def _box(annotation: dict[str, Any], found: Found) -> tuple[Form, list[Pixel], list[bool]] | None:
    values = annotation.get("bbox")
    if values is None or values == []:
        found.drop("signs with neither one keypoint nor a bbox: nothing tells their middle")
        return None
    if not isinstance(values, list) or len(values) != 4:
        raise SemvizError("bbox is not a list of u, v, width, height")
    left, top = (from_corner(json_number(value)) for value in values[:2])
    width, height = (number(json_number(value)) for value in values[2:])
    if width < 0 or height < 0:
        raise SemvizError("a bbox of negative size")
    return "box", [(left, top), (left + width, top + height)], []


def _drop_others(annotation: dict[str, Any], attributes: dict[str, Any], found: Found) -> None:
    others = [key for key, value in annotation.items() if key not in _DERIVED and value]
    others = [key for key in others if key not in ("attributes", "element")]
    others += [key for key in attributes if key not in ("element", "track_id")]
    for key in others:
        found.drop(f"{quoted(key)}: not known here")


def write_coco(writing: Writing, path: Path) -> None:
    """All images and labels in one file, whole or not at all."""
    rows = [(one, sheet, row) for one, sheet in enumerate(writing.sheets, 1)
            for row in sheet.observations]  # fmt: skip
    document = {
        "info": {"description": "poles and traffic signs", "version": "1.0"},
        "licenses": [],
        "images": [_image(one, sheet) for one, sheet in enumerate(writing.sheets, 1)],
        "categories": [
            {
                "id": one.id + 1,
                "name": one.name,
                "supercategory": "pole" if one.kind == "line" else "traffic sign",
                "keypoints": list(KEYPOINTS[one.kind]),
                "skeleton": [[1, 2]] if one.kind == "line" else [],
            }
            for one in writing.classes
        ],
        "annotations": [
            _annotation(writing, row, one, image) for one, (image, _, row) in enumerate(rows, 1)
        ],
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(document), encoding="utf-8")


def _image(id_: int, sheet: Sheet) -> dict[str, Any]:
    return {"id": id_, "file_name": sheet.name, "width": sheet.width, "height": sheet.height}


def _annotation(writing: Writing, row: Observation, id_: int, image_id: int) -> dict[str, Any]:
    element = writing.labels.element(row.element_id)
    ends = [(row.anchor_px, row.anchor_known)]
    if row.end_px is not None:
        ends.append((row.end_px, row.end_known))
    (left, top), (right, bottom) = (
        tuple(pick(point[axis] for point, _ in ends) for axis in (0, 1)) for pick in (min, max)
    )
    width, height = right - left, bottom - top
    return {
        "id": id_,
        "image_id": image_id,
        "category_id": element.class_id + 1,
        "keypoints": [part for (u, v), known in ends for part in (u, v, 2 if known else 1)],
        "num_keypoints": len(ends),
        "bbox": [left + 0.5, top + 0.5, width, height],
        "area": width * height,
        "iscrowd": 0,
        "track_id": element.number,
        "attributes": {"element": row.element_id},
    }
