"""labelme: one JSON file an image, in and out.

``line`` and ``linestrip`` are poles, peak first; ``point`` is a sign, and so is the middle of a
``rectangle``. Keys of files and shapes that mean nothing here are kept, and written again.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from semviz_annotation.formats.kept import Kept
from semviz_annotation.formats.numbers import from_corner, json_number, quoted, to_corner
from semviz_annotation.formats.reading import (
    MOST_JSON_BYTES,
    Form,
    Found,
    Reading,
    as_flag,
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
from semviz_core.errors import SemvizError

VERSION = "5.5.0"
"""Of labelme, whose form we write where the image did not come from there."""
_FORMS: Mapping[str, Form] = {
    "line": "line",
    "linestrip": "line",
    "point": "points",
    "rectangle": "box",
}
_OURS = frozenset({"label", "points", "shape_type", "group_id", "flags", "element"})
_OURS_ABOVE = frozenset({"shapes", "imagePath", "imageData", "imageHeight", "imageWidth"})
_FLAGS = ("anchor_known", "end_known")


def labelme_files(path: Path) -> list[Path]:
    """The JSON files that are meant: ``path``, or all in the folder ``path``, by name."""
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.rglob("*.json") if file.is_file())
    if not files:
        raise SemvizError(f"{path}: a folder without .json files; nothing was imported")
    return files


def read_labelme(path: Path, reading: Reading) -> Found:
    """Poles and signs of one file or of a folder; SemvizError naming what is broken."""
    found = Found()
    for file in labelme_files(path):
        with at(file):
            beside = file.relative_to(path.parent) if path.is_dir() else Path(*file.parts[-2:])
            document = as_object(read_json(read_bytes(file, MOST_JSON_BYTES)))
            _read_image(file, beside, document, reading, found)
    return found


def _read_image(
    file: Path, beside: Path, document: dict[str, Any], reading: Reading, found: Found
) -> None:
    shapes: list[dict[str, Any]] = []
    for number_, shape in enumerate(listed(document, "shapes"), 1):
        where = f"{file}, item {number_}"
        with at(where):
            one = _read_shape(as_object(shape), reading, found)
            shapes += [{"where": where, **one}] if one is not None else []
    found.images += 1
    if document.get("imageData"):
        found.drop("imageData: the images stay where they are")
    if not shapes:
        return
    frame, side = reading.image(as_text(document.get("imagePath"), "imagePath"), str(beside))
    size = document.get("imageWidth"), document.get("imageHeight")
    if size != (None, None):
        reading.check_size(side, *size)
    if (side, frame) in found.kept_images:
        raise SemvizError(f"a second file of the {side} image of frame {frame}")
    found.kept_images[side, frame] = _rest(document, _OURS_ABOVE)
    for one in shapes:
        with at(one["where"]):
            reading.seen(found, place=(frame, side), **one)


def _read_shape(shape: dict[str, Any], reading: Reading, found: Found) -> dict[str, Any] | None:
    """What ``Reading.seen`` is told of a shape, but for its image; None where it is dropped."""
    shape_type = as_text(shape.get("shape_type", "polygon"), "shape_type")
    if shape_type not in _FORMS:
        found.drop(f"{quoted(shape_type)[1:-1]}: neither line, point nor rectangle")
        return None
    class_id = reading.class_id(shape.get("label"))
    if class_id is None:
        found.drop(f"shapes of class {quoted(shape['label'])}: ignored, as asked")
        return None
    flags = dict(as_object(shape.get("flags") or {}))
    known = {name: as_flag(flags.pop(name, True), f"flag {name}") for name in _FLAGS}
    name = shape.get("element")
    return {
        "class_id": class_id,
        "form": _FORMS[shape_type],
        "points": _points(shape, shape_type),
        "name": None if name is None else as_text(name, "element"),
        "number": as_number(shape.get("group_id"), "group_id"),
        "kept": _rest(shape, _OURS) | ({"flags": _rest(flags, frozenset())} if flags else {}),
        **known,
    }


def _points(shape: dict[str, Any], shape_type: str) -> list[Pixel]:
    points: list[Pixel] = []
    for point in listed(shape, "points"):
        if not isinstance(point, list) or len(point) != 2:
            raise SemvizError(f"{quoted(point)} is not a point")
        u, v = (from_corner(json_number(part)) for part in point)
        points.append((u, v))
    fits = {"line": (2,), "point": (1,), "rectangle": (2, 4)}.get(shape_type)
    if len(points) not in fits if fits else len(points) < 2:
        plural = "" if len(points) == 1 else "s"
        raise SemvizError(f"a {shape_type} with {len(points)} point{plural}")
    return points


def _rest(document: dict[str, Any], ours: frozenset[str]) -> dict[str, Any]:
    """What is kept of an object; SemvizError where that could not be written again."""
    rest = {key: value for key, value in document.items() if key not in ours}
    try:
        json.dumps(rest, allow_nan=False)
    except ValueError:
        raise SemvizError("holds NaN or infinite numbers") from None
    return rest


def write_labelme(writing: Writing, folder: Path, kept: Kept) -> None:
    """``left/000012.json`` and so on under ``folder``, which exists; one file an image.

    A file is opened by labelme once it lies beside its image, ``000012.png``.
    """
    for sheet in writing.sheets:
        path = folder / sheet.side / f"{sheet.stem}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(_document(writing, sheet, kept), encoding="utf-8")


def _document(writing: Writing, sheet: Sheet, kept: Kept) -> str:
    shapes = [_shape(writing, row, kept) for row in sheet.observations]
    above = {"version": VERSION, "flags": {}} | kept.of_image(sheet.side, sheet.frame_index)
    values = {key: json.dumps(value) for key, value in above.items()}
    values["shapes"] = "[\n    " + ",\n    ".join(shapes) + "\n  ]" if shapes else "[]"
    values["imagePath"] = json.dumps(f"{sheet.stem}.png")
    values["imageData"] = "null"
    values["imageHeight"], values["imageWidth"] = str(sheet.height), str(sheet.width)
    return "{\n  " + ",\n  ".join(_members(values)) + "\n}\n"


def _shape(writing: Writing, row: Observation, kept: Kept) -> str:
    """One shape as JSON, its coordinates with every digit that they need."""
    points = [point for point in (row.anchor_px, row.end_px) if point is not None]
    others = kept.of_observation(row.id)
    flags = {"anchor_known": row.anchor_known}
    if row.end_px is not None:
        flags["end_known"] = row.end_known
    written: dict[str, Any] = {
        "label": writing.class_name(row),
        "group_id": writing.labels.element(row.element_id).number,
        "shape_type": "point" if row.end_px is None else "line",
        "element": row.element_id,
    }
    values = {key: json.dumps(value) for key, value in (others | written).items()}
    values["flags"] = json.dumps(others.get("flags", {}) | flags)
    corner = (f"[{to_corner(u)}, {to_corner(v)}]" for u, v in points)
    values["points"] = f"[{', '.join(corner)}]"
    return "{" + ", ".join(_members(values)) + "}"


def _members(values: Mapping[str, str]) -> Iterator[str]:
    """Members of a JSON object, their values being JSON already."""
    return (f"{json.dumps(key)}: {value}" for key, value in values.items())
