"""COCO keypoints in and out, COCO instances in: one JSON file.

A pole has the keypoints ``peak`` and ``bottom``, a sign the keypoint ``middle``. Visibility 2 is a
known end, 1 an unknown one, 0 none. Without keypoints, the polygons of ``segmentation`` or else the
``bbox`` are read.

COCO's keypoints are pixel indices, so (0, 0) is the CENTRE of the top-left pixel, as here; its
boxes count from the image corner. Facebook's detectron2 does the same: it adds 0.5 to keypoints
only.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from semviz_annotation.label_formats import reading
from semviz_annotation.label_formats.import_context import LabelImportContext
from semviz_annotation.label_formats.reading import (
    from_corner,
    json_number,
    number,
    quoted,
    to_corner,
)
from semviz_annotation.label_formats.shapes import DrawnShape, outline_of
from semviz_annotation.label_formats.writing import ImageLabels, LabelExportContext
from semviz_annotation.labels.rows import Observation, OutlineForm, Pixel
from semviz_core.base.classes import Kind
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing

KEYPOINTS: Mapping[Kind, tuple[str, ...]] = {"line": ("peak", "bottom"), "point": ("middle",)}
_DERIVED = frozenset(
    {"id", "image_id", "category_id", "bbox", "area", "keypoints", "num_keypoints", "track_id",
     "segmentation", "attributes", "element"}
)  # fmt: skip
"""Keys that are read, or that follow from those that are read."""


def read_coco(path: Path, context: LabelImportContext) -> reading.ParsedLabels:
    """Return the poles and signs of a COCO file. Raise SemvizError, naming an invalid item."""
    with reading.at(path):
        document = reading.as_object(
            reading.read_json(reading.read_bytes(path, reading.MOST_JSON_BYTES))
        )
        images = _by_id(path, "image", reading.listed(document, "images"))
        categories = _by_id(path, "category", reading.listed(document, "categories"))
        annotations = reading.listed(document, "annotations")
    parsed = reading.ParsedLabels(images=len(images))
    for item, annotation in enumerate(annotations, 1):
        where = f"{path}, item {item}"
        with reading.at(where):
            _read(where, reading.as_object(annotation), images, categories, context, parsed)
    context.refuse_unknown(parsed, path)
    return parsed


def _by_id(path: Path, what: str, rows: list[Any]) -> dict[int, dict[str, Any]]:
    result: dict[int, dict[str, Any]] = {}
    for item, row in enumerate(rows, 1):
        with reading.at(f"{path}, {what} {item}"):
            id_ = reading.as_number(reading.as_object(row).get("id"), "id")
            if id_ is None or id_ in result:
                raise SemvizError("no id" if id_ is None else f"id {id_} is another's already")
            result[id_] = row
    return result


def _read(
    where: str, annotation: dict[str, Any], images: Mapping[int, dict[str, Any]],
    categories: Mapping[int, dict[str, Any]], context: LabelImportContext,
    parsed: reading.ParsedLabels,
) -> None:  # fmt: skip
    category = _of(annotation, "category_id", categories)
    image = _of(annotation, "image_id", images)
    name = reading.as_text(category.get("name"), "the category's name")
    class_id = context.class_id(name, parsed, where)
    if class_id is None:
        return
    kind = context.rules.classes[class_id].kind
    drawn = _keypoints(annotation, category, kind, parsed)
    if drawn is None:
        return
    shape, known = drawn
    place = context.image(
        (reading.as_text(image.get("file_name"), "file_name"),),
        (image.get("width"), image.get("height")),
    )
    attributes = reading.as_object(annotation.get("attributes") or {})
    if kind == "line" and not known and attributes.get("occluded") is True:  # as CVAT has it
        known = {"end_known": False}
    _drop_others(annotation, parsed)
    is_drawn = shape.form in ("line", "points")
    outline = _outline_beside(annotation, parsed) if is_drawn else None
    element = attributes.get("element", annotation.get("element"))
    context.add_observation(
        parsed, where, place, class_id, shape,
        name=None if element is None else reading.as_text(element, "element"),
        number=reading.as_number(
            attributes.get("track_id", annotation.get("track_id")), "track_id"
        ),
        attributes=_attribute_texts(attributes),
        outline=outline,
        **known,
    )  # fmt: skip


def _of(annotation: dict[str, Any], key: str, rows: Mapping[int, dict[str, Any]]) -> dict[str, Any]:
    id_ = reading.as_number(annotation.get(key), key)
    if id_ is None or id_ not in rows:
        raise SemvizError(f"{key} {id_} is not in the file")
    return rows[id_]


_Drawn: TypeAlias = tuple[DrawnShape, dict[str, bool]]
"""A shape, and which of its ends are known, as far as the file says."""


def _keypoints(
    annotation: dict[str, Any], category: dict[str, Any], kind: Kind, parsed: reading.ParsedLabels
) -> _Drawn | None:
    """Return the shape of an annotation; None if there is no pole or sign."""
    values = annotation.get("keypoints") or []
    if not isinstance(values, list) or len(values) % 3:
        raise SemvizError("keypoints are not a list of u, v, visibility")
    rows = [_keypoint(values[start : start + 3]) for start in range(0, len(values), 3)]
    names = category.get("keypoints") or []
    if not isinstance(names, list) or (rows and len(rows) != len(names)):
        raise SemvizError(f"{len(rows)} keypoints, other than its category names")
    if kind == "line":
        by_name = dict(zip(map(str, names), rows, strict=False))
        rows = [by_name[name] for name in KEYPOINTS["line"] if name in by_name]
    needed = len(KEYPOINTS[kind])
    if len(rows) != needed:
        if rows:
            parsed.drop(f"keypoints other than {' and '.join(KEYPOINTS[kind])}")
        return _outline(annotation, parsed)
    if any(visibility == 0 for _, visibility in rows):
        parsed.drop("keypoints that are not labelled (visibility 0): nothing is there")
        return None
    points = tuple(point for point, _ in rows)
    known = (visibility == 2 for _, visibility in rows)
    shape = DrawnShape("line" if kind == "line" else "points", points, is_peak_first=True)
    return shape, dict(zip(("anchor_known", "end_known"), known, strict=False))


def _keypoint(values: list[Any]) -> tuple[Pixel, int]:
    u, v = (number(json_number(value)) for value in values[:2])
    visibility = number(json_number(values[2]))  # some tools write 2.0
    if visibility not in (0, 1, 2):
        raise SemvizError(f"visibility {quoted(values[2])} is not 0, 1 or 2")
    return (u, v), int(visibility)


def _outline(annotation: dict[str, Any], parsed: reading.ParsedLabels) -> _Drawn | None:
    """Return the polygons of an annotation as one, else its box; None if it has neither."""
    rings = annotation.get("segmentation")
    if isinstance(rings, list) and rings:
        points = [point for ring in rings for point in _ring(ring)]
        return DrawnShape("polygon", tuple(points)), {}
    if rings:
        parsed.drop("masks (run lengths) of 'segmentation': the bbox is taken")
    values = annotation.get("bbox")
    if values is None or values == []:
        parsed.drop("annotations without keypoints, polygon or bbox that say where they are")
        return None
    if not isinstance(values, list) or len(values) != 4:
        raise SemvizError("bbox is not a list of u, v, width, height")
    left, top = (from_corner(json_number(value)) for value in values[:2])
    width, height = (number(json_number(value)) for value in values[2:])
    if width < 0 or height < 0:
        raise SemvizError("a bbox of negative size")
    return DrawnShape("box", ((left, top), (left + width, top + height))), {}


def _outline_beside(
    annotation: dict[str, Any], parsed: reading.ParsedLabels
) -> tuple[OutlineForm, tuple[Pixel, ...]] | None:
    """Return the polygon beside keypoints; None if there is none."""
    rings = annotation.get("segmentation")
    if not rings:
        return None
    try:
        listed = reading.listed(annotation, "segmentation")
        return outline_of([point for ring in listed for point in _ring(ring)])
    except SemvizError:
        parsed.drop("'segmentation': no polygons; the keypoints count")
        return None


def _ring(ring: object) -> list[Pixel]:
    """Return the points of a polygon, which count from the image corner as boxes do."""
    if not isinstance(ring, list) or len(ring) % 2 or len(ring) < 6:
        raise SemvizError("segmentation is not a list of polygons u, v, u, v, ...")
    values = [from_corner(json_number(value)) for value in ring]
    return list(zip(values[::2], values[1::2], strict=True))


def _drop_others(annotation: dict[str, Any], parsed: reading.ParsedLabels) -> None:
    for key, value in annotation.items():
        if key not in _DERIVED and value:
            parsed.drop(f"{quoted(key)}: not known here")


def _attribute_texts(attributes: Mapping[str, Any]) -> dict[str, str]:
    """Return attributes of an element as texts, without those of CVAT about one image."""
    own = {"element", "track_id", "occluded", "rotation", "keyframe", "outside"}
    texts = {key: reading.attribute_text(value) for key, value in attributes.items()}
    return {key: text for key, text in texts.items() if key not in own and text}


def write_coco(context: LabelExportContext, path: Path) -> None:
    """Write all images and labels into one file, completely or not at all."""
    rows = [(image_id, labelled, row) for image_id, labelled in enumerate(context.images, 1)
            for row in labelled.observations]  # fmt: skip
    document = {
        "info": {"description": "poles and traffic signs", "version": "1.0"},
        "licenses": [],
        "images": [
            _image(image_id, labelled) for image_id, labelled in enumerate(context.images, 1)
        ],
        "categories": [
            {
                "id": class_.id + 1,
                "name": class_.name,
                "supercategory": "pole" if class_.kind == "line" else "traffic sign",
                "keypoints": list(KEYPOINTS[class_.kind]),
                "skeleton": [[1, 2]] if class_.kind == "line" else [],
            }
            for class_ in context.classes
        ],
        "annotations": [
            _annotation(context, row, id_, image) for id_, (image, _, row) in enumerate(rows, 1)
        ],
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(document), encoding="utf-8")


def _image(id_: int, labelled: ImageLabels) -> dict[str, Any]:
    return {
        "id": id_,
        "file_name": labelled.name,
        "width": labelled.width,
        "height": labelled.height,
    }


def _annotation(
    context: LabelExportContext, row: Observation, id_: int, image_id: int
) -> dict[str, Any]:
    element = context.labels.element(row.element_id)
    ends = [(row.anchor_px, row.anchor_known)]
    if row.end_px is not None:
        ends.append((row.end_px, row.end_known))
    (left, top), (right, bottom) = (
        tuple(pick(point[axis] for point, _ in ends) for axis in (0, 1)) for pick in (min, max)
    )
    width, height = right - left, bottom - top
    corners = context.outline(row)
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
        **({"segmentation": [_segmentation(corners)]} if corners else {}),
        "attributes": {"element": row.element_id, **context.attributes(row)},
    }


def _segmentation(corners: Iterable[Pixel]) -> list[float]:
    """Return corners as they are counted in segmentations; see ``_ring``."""
    return [float(to_corner(value)) for corner in corners for value in corner]
