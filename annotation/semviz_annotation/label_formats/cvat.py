"""CVAT for images 1.1 and CVAT for video 1.1, in and out: one XML file.

``image`` elements hold shapes; ``track`` elements hold one shape per frame. Frames of tracks count
as in the task: from its start frame, in its step, up to its stop frame. A polyline is a pole, peak
first. A point is a sign. Source: CVAT's documentation, "XML annotation format". The reader streams:
memory holds one shape at a time.
"""

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree  # for writing only; read with defusedxml

from semviz_annotation.label_formats import reading
from semviz_annotation.label_formats.import_context import (
    ImagePlace,
    LabelImportContext,
    sides_of,
)
from semviz_annotation.label_formats.reading import (
    from_corner,
    number,
    points_as_text,
    points_of_text,
    quoted,
)
from semviz_annotation.label_formats.shapes import DrawnShape, Form, outline_of
from semviz_annotation.label_formats.writing import ATTRIBUTES, LabelExportContext, as_word
from semviz_annotation.labels.rows import Observation
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import parsing_xml

_FORMS: Mapping[str, Form] = {
    "polyline": "line",
    "points": "points",
    "box": "box",
    "ellipse": "box",
    "polygon": "polygon",
}
_TEXTS = ("attribute", "version")
_MOST_ATTRIBUTES = 1000
_MOST_ELEMENTS = 5 * reading.MOST_ITEMS
_PLAIN = {"z_order": ("0",), "source": ("manual", "file")}
"""Values at which attributes of a shape carry no information."""


@dataclass
class _Task:
    """What a file says of its task; None where it says nothing."""

    start_frame: int = 0
    stop_frame: int | None = None
    step: int = 1
    width: int | None = None
    height: int | None = None

    @property
    def size(self) -> tuple[object, object] | None:
        return None if self.width is None or self.height is None else (self.width, self.height)

    def note(self, tag: str, text: str) -> None:
        """Take a number of the task's description; CVAT leaves some of them empty."""
        step = re.fullmatch(r"step=([1-9]\d{0,8})", text)
        if tag == "frame_filter" and step is not None:
            self.step = int(step[1])
        elif tag in ("start_frame", "stop_frame", "width", "height") and re.fullmatch(
            r"\d{1,9}", text, re.ASCII
        ):
            setattr(self, tag, int(text))

    def places(self, frames: Collection[int] | None) -> Mapping[int, int]:
        """Return the workspace's frame at each of the task's, if they are one another's in order.

        So many images with other numbers are those of the workspace, uploaded without the rest of
        their sequence. Empty if the numbers are the workspace's.
        """
        if frames is None or self.stop_frame is None:
            return {}
        numbers = range(self.start_frame, self.stop_frame + 1, self.step)
        ordered = sorted(frames)
        if len(numbers) != len(ordered) or list(numbers) == ordered:
            return {}
        return dict(zip(numbers, ordered, strict=True))


def read_cvat(path: Path, context: LabelImportContext) -> reading.ParsedLabels:
    """Return the poles and signs of a CVAT 1.1 file. Raise SemvizError, naming an invalid item."""
    from defusedxml.ElementTree import DefusedXMLParser

    handler = _Handler(path, context)
    with reading.at(path):
        parser = DefusedXMLParser(target=handler, forbid_dtd=True)
        with parsing_xml():
            parser.feed(reading.read_bytes(path, reading.MOST_XML_BYTES))
            parser.close()
        if not handler.is_cvat:
            raise SemvizError("no annotations of CVAT")
    context.refuse_unknown(handler.parsed, path)
    return handler.parsed


class _Handler:
    """Target of the XML parser; holds one shape at a time, whatever the file's size."""

    def __init__(self, path: Path, context: LabelImportContext) -> None:
        self.parsed = reading.ParsedLabels()
        self.is_cvat = False
        self._path = path
        self._context = context
        self._tags: list[str] = []
        self._elements = 0
        self._items = 0
        self._group: dict[str, str] = {}  # of the image or track that we are in
        self._shape: dict[str, str] = {}
        self._attributes: dict[str, str] = {}
        self._attribute = ""
        self._text: list[str] = []
        self._task_side: Side | None = None
        self._task = _Task()
        self._frames: Mapping[int, int] | None = None  # the task's, once it is described

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._tags.append(tag)
        self._text.clear()
        depth = len(self._tags)
        self._elements += 1
        if depth > reading.MOST_DEPTH:
            raise SemvizError("nested too deeply")
        if self._items > reading.MOST_ITEMS or self._elements > _MOST_ELEMENTS:
            raise SemvizError(f"more than {reading.MOST_ITEMS} labels; split the file")
        if depth == 1:
            if tag != "annotations":
                raise SemvizError(f"the outermost element is {quoted(tag)}, not 'annotations'")
            self.is_cvat = True
        elif depth == 2:
            self._group = attributes
            self.parsed.images += tag == "image"
        elif depth == 3 and self._in_group:
            self._items += 1
            self._shape, self._attributes = attributes, {}
        elif depth == 4 and self._in_group and tag == "attribute":
            self._attribute = attributes.get("name", "")

    def data(self, text: str) -> None:
        if self._tags and (self._tags[1:2] == ["meta"] or self._tags[-1] in _TEXTS):
            self._text.append(text)

    def end(self, tag: str) -> None:
        text = "".join(self._text).strip()
        self._text.clear()
        match len(self._tags), self._in_group:
            case 2, _ if tag == "version" and not re.match(r"1\.", text):
                raise SemvizError(f"version {quoted(text)} of CVAT's format; 1.1 is understood")
            case 4, False if self._in_task and tag in ("name", "source"):
                self._note_side(text)
            case 4, False if self._in_task:
                self._task.note(tag, text)
            case 5, False if self._in_task and self._tags[3] == "original_size":
                self._task.note(tag, text)
            case 3, False if tag == "source":
                self._note_side(text)
            case 4, True if tag == "attribute":
                if len(self._attributes) >= _MOST_ATTRIBUTES:
                    raise SemvizError(f"a shape with more than {_MOST_ATTRIBUTES} attributes")
                self._attributes[self._attribute] = text
            case 3, True:
                self._take(tag)
        self._tags.pop()

    def close(self) -> None:
        """Required by the parser; the result is ``parsed``."""

    @property
    def _in_group(self) -> bool:
        return self._tags[1:2] in (["image"], ["track"])

    @property
    def _in_task(self) -> bool:
        return self._tags[1:3] in (["meta", "task"], ["meta", "job"])

    def _note_side(self, text: str) -> None:
        sides = sides_of(text[:1000])
        self._task_side = next(iter(sides)) if len(sides) == 1 else self._task_side

    def _take(self, tag: str) -> None:
        where = f"{self._path}, item {self._items}"
        with reading.at(where):
            in_track = self._tags[1] == "track"
            if tag not in _FORMS:
                return self.parsed.drop(
                    f"{quoted(tag)[1:-1]}: neither line, point, box nor polygon"
                )
            if in_track and self._flag("outside"):
                return None  # the end of a track: nothing is visible
            label = self._group.get("label") if in_track else self._shape.get("label")
            class_id = self._context.class_id(label, self.parsed, where)
            if class_id is None:
                return None
            shape = self._drawn(tag)
            place = self._place_of_track() if in_track else self._image()
            is_sign = self._context.rules.classes[class_id].kind == "point"
            rest = self._rest(in_track, is_sign)
            self._context.add_observation(self.parsed, where, place, class_id, shape, **rest)

    def _drawn(self, tag: str) -> DrawnShape:
        turn_rad = math.radians(number(self._shape.get("rotation", "0")))
        if tag == "box":
            left, top, right, bottom = (
                from_corner(self._needed(name)) for name in ("xtl", "ytl", "xbr", "ybr")
            )
            if right < left or bottom < top:
                raise SemvizError("a box of negative size")
            return DrawnShape("box", ((left, top), (right, bottom)), turn_rad)
        if tag == "ellipse":
            u, v = (from_corner(self._needed(name)) for name in ("cx", "cy"))
            half_u, half_v = (abs(number(self._needed(name))) for name in ("rx", "ry"))
            return DrawnShape("box", ((u - half_u, v - half_v), (u + half_u, v + half_v)), turn_rad)
        points = points_of_text(self._needed("points"))
        if tag == "polyline" and len(points) < 2:
            raise SemvizError("a polyline with 1 point")
        return DrawnShape(_FORMS[tag], tuple(points))

    def _image(self) -> ImagePlace:
        name = self._of_group("name")
        width, height = (number(self._of_group(name)) for name in ("width", "height"))
        if width != int(width) or height != int(height):
            raise SemvizError(f"an image of {width} by {height} pixels")
        return self._context.image((name,), (int(width), int(height)))

    def _place_of_track(self) -> ImagePlace:
        text = self._needed("frame")
        frame = number(text)
        if frame != int(frame) or not 0 <= frame < 2**31:
            raise SemvizError(f"frame {quoted(text)} is not a frame number")
        context = self._context
        if self._frames is None:
            self._frames = self._task.places(context.frames)
        if self._frames:
            self.parsed.assume("frames of tracks: the task's images are the workspace's, in order")
        frame = self._frames.get(int(frame), int(frame))
        if context.frames is not None and frame not in context.frames:
            raise SemvizError(f"frame {frame} is not there")
        side = self._task_side or context.side_or_refuse("a track")
        return context.place(frame, side, self._task.size, recorded=context.pixels == "recorded")

    def _rest(self, in_track: bool, is_sign: bool) -> dict[str, Any]:
        """Return name, number and known ends of a shape; count other attributes as dropped."""
        attributes = dict(self._attributes)
        known = {name: attributes.pop(name, None) for name in ("anchor_known", "end_known")}
        name = attributes.pop("element", None) or None
        outline = attributes.pop("outline", None) or None
        for plain, nothing in _PLAIN.items():
            if self._shape.get(plain, nothing[0]) not in nothing:
                self.parsed.drop(f"{plain}: not known here")
        occluded = self._flag("occluded")
        if is_sign and occluded and known["anchor_known"] is None:
            self.parsed.drop("occluded on a sign: not known here")
        return {
            "name": name,
            "number": self._number_of_element(in_track),
            "anchor_known": _truth(known["anchor_known"], "anchor_known", True),
            "end_known": _truth(known["end_known"], "end_known", not occluded),
            "attributes": {key: value for key, value in attributes.items() if value},
            "outline": None if outline is None else outline_of(points_of_text(outline)),
        }

    def _number_of_element(self, in_track: bool) -> int | None:
        source = self._group if in_track else self._shape
        text = source.get("id" if in_track else "group_id") or None
        if text is None or (not in_track and text == "0"):  # CVAT's group 0 is none
            return None
        value = number(text)
        if value != int(value):
            raise SemvizError(f"group or track {quoted(text)} is not a whole number")
        return int(value)

    def _flag(self, name: str) -> bool:
        text = self._shape.get(name, "0")
        if text not in ("0", "1"):
            raise SemvizError(f"{name} is neither 0 nor 1 but {quoted(text)}")
        return text == "1"

    def _needed(self, name: str) -> str:
        try:
            return self._shape[name]
        except KeyError:
            raise SemvizError(f"a shape without {name!r}") from None

    def _of_group(self, name: str) -> str:
        try:
            return self._group[name]
        except KeyError:
            raise SemvizError(f"an image without {name!r}") from None


def _truth(text: str | None, name: str, otherwise: bool) -> bool:
    if text is None:
        return otherwise
    if text.lower() not in ("true", "false"):
        raise SemvizError(f"attribute {name} is neither true nor false but {quoted(text)}")
    return text.lower() == "true"


def write_cvat(context: LabelExportContext, path: Path) -> None:
    """Write all images as ``image`` elements of one file, completely or not at all."""
    root = _root(context, "annotation", len(context.images), "street")
    for number_, labelled in enumerate(context.images):
        image = ElementTree.SubElement(
            root, "image", id=str(number_), name=labelled.name,
            width=str(labelled.width), height=str(labelled.height),
        )  # fmt: skip
        for row in labelled.observations:
            element = context.labels.element(row.element_id)
            shape = _shape(image, context, row, {"label": context.class_name(row)})
            shape.set("group_id", str(element.number))
    _save(root, path)


def write_cvat_video(
    context: LabelExportContext, path: Path, start_frame: int | None = None
) -> None:
    """Write the images of one side as frames and elements as tracks, completely or not at all.

    ``start_frame`` numbers the workspace's frames from there on, for a task that has their images
    alone; None: they keep their numbers, for a task that has the whole sequence.
    """
    if context.side is None:
        raise SemvizError("a file of tracks has one side; choose left or right")
    task, number_of = _task_of(context.frames, start_frame)
    root = _root(context, "interpolation", len(task), context.side, task)
    rows = [row for labelled in context.images for row in labelled.observations]
    rows.sort(key=lambda row: (context.labels.element(row.element_id).number, row.frame_index))
    for element_id, group in groupby(rows, key=lambda row: row.element_id):
        observations = list(group)
        track = ElementTree.SubElement(
            root, "track", id=str(context.labels.element(element_id).number),
            label=context.class_name(observations[0]), source="manual",
        )  # fmt: skip
        numbers = {number_of[row.frame_index]: row for row in observations}
        for frame, row in numbers.items():
            _tracked(track, context, row, frame, outside=False)
            after = frame + task.step
            if after in task and after not in numbers:
                _tracked(track, context, row, after, outside=True)
    _save(root, path)


def _task_of(frames: Sequence[int], start_frame: int | None) -> tuple[range, Mapping[int, int]]:
    """Return the frames of a task, and the number of each of ours: tracks must stay within."""
    if start_frame is not None:
        task = range(start_frame, start_frame + max(len(frames), 1))
        return task, dict(zip(frames, task, strict=False))
    step = math.gcd(*(after - before for before, after in pairwise(frames))) or 1
    task = range(frames[0], frames[-1] + 1, step) if frames else range(0)
    return task, {frame: frame for frame in frames}


def _tracked(
    track: ElementTree.Element,
    context: LabelExportContext,
    row: Observation,
    frame: int,
    outside: bool,
) -> None:
    """Add one shape of a track; an outside shape ends it, or CVAT would extend the last one."""
    more = {"frame": str(frame), "outside": str(int(outside)), "keyframe": "1"}
    _shape(track, context, row, more)


def _shape(
    parent: ElementTree.Element,
    context: LabelExportContext,
    row: Observation,
    more: Mapping[str, str],
) -> ElementTree.Element:
    points = [point for point in (row.anchor_px, row.end_px) if point is not None]
    unknown = not row.anchor_known or (row.end_px is not None and not row.end_known)
    shape = ElementTree.SubElement(
        parent, "points" if row.end_px is None else "polyline", dict(more),
        source="manual", occluded=str(int(unknown)), z_order="0",
        points=points_as_text(points),
    )  # fmt: skip
    for name, text in _attributes_of(context, row):
        ElementTree.SubElement(shape, "attribute", name=name).text = text
    return shape


def _attributes_of(context: LabelExportContext, row: Observation) -> Iterator[tuple[str, str]]:
    yield "element", row.element_id
    yield "anchor_known", as_word(row.anchor_known)
    if row.end_px is not None:
        yield "end_known", as_word(row.end_known)
    if outline := context.outline(row):
        yield "outline", points_as_text(outline)
    yield from context.attributes(row).items()


def _root(
    context: LabelExportContext, mode: str, size: int, name: str, frames: range | None = None
) -> ElementTree.Element:
    """Return the root with the description of a task; ``frames`` are those of a video."""
    root = ElementTree.Element("annotations")
    _leaf(root, "version", "1.1")
    task = ElementTree.SubElement(ElementTree.SubElement(root, "meta"), "task")
    about = {"name": name, "size": str(size), "mode": mode, "z_order": "True"}
    if frames:
        about |= {"start_frame": str(frames[0]), "stop_frame": str(frames[-1])}
        about["frame_filter"] = f"step={frames.step}" if frames.step > 1 else ""
    for tag, text in about.items():
        _leaf(task, tag, text)
    if frames is not None and context.images:
        original_size = ElementTree.SubElement(task, "original_size")
        _leaf(original_size, "width", str(context.images[0].width))
        _leaf(original_size, "height", str(context.images[0].height))
    labels = ElementTree.SubElement(task, "labels")
    for class_ in context.classes:
        label = ElementTree.SubElement(labels, "label")
        _leaf(label, "name", class_.name)
        _leaf(label, "color", class_.color.lower())
        _leaf(label, "type", "polyline" if class_.kind == "line" else "points")
        attributes = ElementTree.SubElement(label, "attributes")
        names = (["outline"] if context.labels.outlines else []) + context.attribute_names
        more = dict.fromkeys(names, "text")
        for attribute, kind in {**ATTRIBUTES[class_.kind], **more}.items():
            spec = ElementTree.SubElement(attributes, "attribute")
            _leaf(spec, "name", attribute)
            _leaf(spec, "mutable", as_word(kind == "checkbox"))
            _leaf(spec, "input_type", kind)
            _leaf(spec, "default_value", "true" if kind == "checkbox" else "")
            _leaf(spec, "values", "true\nfalse" if kind == "checkbox" else "")
    return root


def _leaf(parent: ElementTree.Element, tag: str, text: str) -> None:
    ElementTree.SubElement(parent, tag).text = text


def _save(root: ElementTree.Element, path: Path) -> None:
    ElementTree.indent(root)
    with replacing(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
