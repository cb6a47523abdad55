"""labelme in and out: one JSON file per image.

``line`` and ``linestrip`` are poles, peak first; a ``point`` is a sign. ``rectangle``, ``circle``,
``polygon`` and X-AnyLabeling's ``rotation`` are either. Unknown keys are kept and written again.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from semviz_annotation.label_formats import reading
from semviz_annotation.label_formats.import_context import LabelImportContext
from semviz_annotation.label_formats.reading import from_corner, json_number, quoted, to_corner
from semviz_annotation.label_formats.shapes import DrawnShape, Form, outline_of
from semviz_annotation.label_formats.writing import ImageLabels, LabelExportContext, Sidecar
from semviz_annotation.labels.rows import Observation, Pixel
from semviz_core.common.errors import SemvizError

VERSION = "5.5.0"
"""labelme version of files that were not imported from labelme."""
_FORMS: Mapping[str, Form] = {
    "line": "line",
    "linestrip": "line",
    "point": "points",
    "rectangle": "box",
    "circle": "box",
    "polygon": "polygon",
    "rotation": "polygon",
}
_OURS = frozenset(
    {"label", "points", "shape_type", "group_id", "flags", "element", "attributes", "outline"}
)
_OURS_ABOVE = frozenset({"shapes", "imagePath", "imageData", "imageHeight", "imageWidth"})
_FLAGS = ("anchor_known", "end_known")


def labelme_files(path: Path) -> list[Path]:
    """Return ``path``, or all JSON files in the folder ``path``, by name.

    Raise SemvizError, without the path, if a folder has none.
    """
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.rglob("*.json") if file.is_file())
    if not files:
        raise SemvizError("a folder without .json files")
    return files


def read_labelme(path: Path, context: LabelImportContext) -> reading.ParsedLabels:
    """Return the poles and signs of a file or folder. Raise SemvizError, naming an invalid item."""
    parsed = reading.ParsedLabels()
    with reading.at(path):
        files = labelme_files(path)
    for file in files:
        with reading.at(file):
            beside = file.relative_to(path.parent) if path.is_dir() else Path(*file.parts[-2:])
            document = reading.as_object(
                reading.read_json(reading.read_bytes(file, reading.MOST_JSON_BYTES))
            )
            _read_image(file, beside, document, context, parsed)
    context.refuse_unknown(parsed, path)
    return parsed


def _read_image(
    file: Path,
    beside: Path,
    document: dict[str, Any],
    context: LabelImportContext,
    parsed: reading.ParsedLabels,
) -> None:
    shapes: list[dict[str, Any]] = []
    for number_, shape in enumerate(reading.listed(document, "shapes"), 1):
        where = f"{file}, item {number_}"
        with reading.at(where):
            arguments = _read_shape(reading.as_object(shape), where, context, parsed)
            shapes += [{"where": where, **arguments}] if arguments is not None else []
    parsed.images += 1
    if document.get("imageData"):
        parsed.drop("imageData: the images stay where they are")
    if not shapes:
        return
    name = reading.as_text(document.get("imagePath"), "imagePath")
    size = document.get("imageWidth"), document.get("imageHeight")
    place = context.image((name, str(beside)), None if size == (None, None) else size)
    frame, side = place.frame_index, place.side
    if (side, frame) in parsed.kept_images:
        raise SemvizError(f"a second file of the {side} image of frame {frame}")
    parsed.kept_images[side, frame] = _rest(document, _OURS_ABOVE)
    for arguments in shapes:
        with reading.at(arguments["where"]):
            context.add_observation(parsed, place=place, **arguments)


def _read_shape(
    shape: dict[str, Any], where: str, context: LabelImportContext, parsed: reading.ParsedLabels
) -> dict[str, Any] | None:
    """Return arguments of ``LabelImportContext.add_observation``; None if the shape is dropped."""
    shape_type = reading.as_text(shape.get("shape_type", "polygon"), "shape_type")
    if shape_type not in _FORMS:
        parsed.drop(f"{quoted(shape_type)[1:-1]}: neither line, point, box nor polygon")
        return None
    class_id = context.class_id(shape.get("label"), parsed, where)
    if class_id is None:
        return None
    flags = dict(reading.as_object(shape.get("flags") or {}))
    known = {name: reading.as_flag(flags.pop(name, True), f"flag {name}") for name in _FLAGS}
    name = shape.get("element")
    attributes = reading.as_object(shape.get("attributes") or {})
    texts = {key: reading.attribute_text(value) for key, value in attributes.items()}
    outline = _corners(shape, "outline") if shape.get("outline") else None
    return {
        "class_id": class_id,
        "shape": _drawn(shape_type, _points(shape, shape_type)),
        "name": None if name is None else reading.as_text(name, "element"),
        "number": reading.as_number(shape.get("group_id"), "group_id"),
        "kept": _rest(shape, _OURS) | ({"flags": _rest(flags, frozenset())} if flags else {}),
        "attributes": {key: text for key, text in texts.items() if text},
        "outline": None if outline is None else outline_of(outline),
        **known,
    }


def _points(shape: dict[str, Any], shape_type: str) -> list[Pixel]:
    points = _corners(shape, "points")
    fits = {"line": (2,), "point": (1,), "rectangle": (2, 4), "circle": (2,)}.get(shape_type)
    if len(points) not in fits if fits else len(points) < 2:
        plural = "" if len(points) == 1 else "s"
        raise SemvizError(f"a {shape_type} with {len(points)} point{plural}")
    return points


def _corners(shape: dict[str, Any], key: str) -> list[Pixel]:
    points: list[Pixel] = []
    for point in reading.listed(shape, key):
        if not isinstance(point, list) or len(point) != 2:
            raise SemvizError(f"{quoted(point)} is not a point")
        u, v = (from_corner(json_number(part)) for part in point)
        points.append((u, v))
    return points


def _drawn(shape_type: str, points: list[Pixel]) -> DrawnShape:
    """Return a shape; a circle, given by its middle and a point on it, as its box."""
    if shape_type == "circle":
        (u, v), on_it = points
        radius = math.dist((u, v), on_it)
        points = [(u - radius, v - radius), (u + radius, v + radius)]
    if _FORMS[shape_type] == "box":
        columns, rows = zip(*points, strict=True)
        points = [(min(columns), min(rows)), (max(columns), max(rows))]
    return DrawnShape(_FORMS[shape_type], tuple(points))


def _rest(document: dict[str, Any], ours: frozenset[str]) -> dict[str, Any]:
    """Return the keys to keep. Raise SemvizError if they cannot be written as JSON again."""
    unread = {key: value for key, value in document.items() if key not in ours}
    try:
        json.dumps(unread, allow_nan=False)
    except ValueError:
        raise SemvizError("holds NaN or infinite numbers") from None
    return unread


def write_labelme(context: LabelExportContext, folder: Path, kept: Sidecar) -> None:
    """Write one file per image into the existing ``folder``, for example ``left/000012.json``.

    labelme opens a file that lies next to its image, ``000012.png``.
    """
    for labelled in context.images:
        path = folder / labelled.side / f"{labelled.stem}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(_document(context, labelled, kept), encoding="utf-8")


def _document(context: LabelExportContext, labelled: ImageLabels, kept: Sidecar) -> str:
    shapes = [_shape(context, row, kept) for row in labelled.observations]
    above = {"version": VERSION, "flags": {}} | kept.of_image(labelled.side, labelled.frame_index)
    values = {key: json.dumps(value) for key, value in above.items()}
    values["shapes"] = "[\n    " + ",\n    ".join(shapes) + "\n  ]" if shapes else "[]"
    values["imagePath"] = json.dumps(f"{labelled.stem}.png")
    values["imageData"] = "null"
    values["imageHeight"], values["imageWidth"] = str(labelled.height), str(labelled.width)
    return "{\n  " + ",\n  ".join(_members(values)) + "\n}\n"


def _shape(context: LabelExportContext, row: Observation, kept: Sidecar) -> str:
    """Return one shape as JSON, its coordinates with all digits."""
    points = [point for point in (row.anchor_px, row.end_px) if point is not None]
    extra = kept.of_observation(row.id)
    flags = {"anchor_known": row.anchor_known}
    if row.end_px is not None:
        flags["end_known"] = row.end_known
    written: dict[str, Any] = {
        "label": context.class_name(row),
        "group_id": context.labels.element(row.element_id).number,
        "shape_type": "point" if row.end_px is None else "line",
        "element": row.element_id,
    }
    if attributes := context.attributes(row):
        written["attributes"] = attributes
    values = {key: json.dumps(value) for key, value in (extra | written).items()}
    values["flags"] = json.dumps(extra.get("flags", {}) | flags)
    values["points"] = _points_text(points)
    if outline := context.outline(row):
        values["outline"] = _points_text(outline)
    return "{" + ", ".join(_members(values)) + "}"


def _points_text(points: Iterable[Pixel]) -> str:
    corners = (f"[{to_corner(u)}, {to_corner(v)}]" for u, v in points)
    return f"[{', '.join(corners)}]"


def _members(values: Mapping[str, str]) -> Iterator[str]:
    """Return the members of a JSON object; the values are JSON texts."""
    return (f"{json.dumps(key)}: {value}" for key, value in values.items())
