"""Helpers of the label readers: errors with file and item, limits, names of images and classes.

Numbers are read and written exactly, and converted between pixel origins: parsed coordinates are
semviz pixels. CVAT and labelme put (0, 0) at the top-left CORNER of an image: in both, points run
from 0 to its width (CVAT's ``fitPoints``; labelme's ``outOfPixmap``, issue 278). Here (0, 0) is the
centre of the top-left pixel, so their values are larger by 0.5.
"""

import json
import re
import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from decimal import Context, Decimal
from pathlib import Path
from typing import Any, Literal, TypeAlias

from semviz_annotation.labels.rows import Observation, Pixel, Rules
from semviz_core.base.classes import (
    OLDER,
    POLE,
    RECTANGULAR,
    ROUNDED,
    TRIANGULAR,
    ClassSet,
    TriangleCenter,
)
from semviz_core.base.frame import Side
from semviz_core.common.arrays import LARGEST
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import read_limited

_HALF = Decimal("0.5")
_EXACT = Context(prec=400)
"""Enough for the sum of 0.5 and any double, written with the fewest digits that give it back."""
_MOST_DIGITS = 400
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)


class NumberText(float):
    """A number that remembers how it was written."""

    __slots__ = ("text",)
    text: str

    def __new__(cls, text: str) -> "NumberText":
        self = super().__new__(cls, text)
        self.text = text
        return self


def number(text: str) -> float:
    """Return the number in ``text``. Raise SemvizError if it is not a finite number."""
    text = text.strip(" \t\r\n")
    if len(text) > _MOST_DIGITS or not _NUMBER.fullmatch(text):
        raise SemvizError(f"{quoted(text)} is not a number")
    value = float(text)
    if not abs(value) <= LARGEST:
        raise SemvizError(f"{quoted(text)} is too large")
    return value


def from_corner(text: str) -> float:
    """Return the semviz coordinate of one that counts from the image corner."""
    value = number(text)
    return float(_EXACT.subtract(Decimal(text.strip(" \t\r\n")) if value else Decimal(0), _HALF))


def to_corner(value: float) -> str:
    """Return the exact inverse of ``from_corner``."""
    return format(_EXACT.add(Decimal(repr(value)), _HALF), "f")


def json_number(value: object) -> str:
    """Return the text of a number in parsed JSON. Raise SemvizError if it is not finite."""
    if isinstance(value, NumberText):
        text = value.text
    elif isinstance(value, int) and not isinstance(value, bool) and abs(value) <= LARGEST:
        text = str(value)
    else:
        raise SemvizError(f"{quoted(value)} is not a number")
    number(text)
    return text


def box_center(points: list[Pixel]) -> Pixel:
    """Return the centre of the bounding box of ``points``."""
    u, v = zip(*points, strict=True)
    return ((min(u) + max(u)) / 2, (min(v) + max(v)) / 2)


def quoted(value: object) -> str:
    """Return ``value`` as printable text on one line, shortened if it is long."""
    text = ascii(value) if not isinstance(value, int) or abs(value) <= LARGEST else "a huge number"
    return text if len(text) <= 60 else f"{text[:50]} ..."


IGNORE = "ignore"
"""Value of a class map for a class that is left out."""
MOST_JSON_BYTES = 64 * 2**20
MOST_XML_BYTES = 128 * 2**20
MOST_ITEMS = 1_000_000
MOST_DEPTH = 32
MOST_KINDS = 100
"""Largest number of different entries in the list of dropped content."""

Form: TypeAlias = Literal["line", "points", "box"]

SYNONYMS: Mapping[int, tuple[str, ...]] = {
    POLE: ("poles", "lamp post", "lamppost", "lamp pole", "light pole", "street light",
           "streetlight", "street lamp", "utility pole", "sign pole", "sign post", "post", "mast"),
    TRIANGULAR: ("triangular", "triangle sign", "triangular traffic sign"),
    RECTANGULAR: ("rectangular", "rectangle sign", "square sign", "rectangular traffic sign"),
    ROUNDED: ("rounded", "round", "round sign", "circular", "circular sign", "circle sign",
              "rounded traffic sign", "round traffic sign"),
}  # fmt: skip
"""Other names of the default classes; case, ``_`` and ``-`` do not matter."""

_SIDES: Mapping[str, Side] = {
    "left": "left", "image_0": "left", "image_2": "left", "image_00": "left", "image_02": "left",
    "right": "right", "image_1": "right", "image_3": "right", "image_01": "right",
    "image_03": "right",
}  # fmt: skip


class _PlacedError(SemvizError):
    """An error that already names file and item."""


@contextmanager
def at(where: object) -> Iterator[None]:
    """Prefix every SemvizError of the block with ``where``."""
    try:
        yield
    except _PlacedError:
        raise
    except SemvizError as error:
        raise _PlacedError(f"{where}: {error}. Nothing was imported.") from None


@dataclass(frozen=True)
class ParsedObservation:
    """One pole or sign in one image, as in a file, in semviz pixels."""

    where: str
    """Position in the file for messages, for example ``street.xml, item 214``."""
    frame_index: int
    side: Side
    class_id: int
    anchor_px: Pixel
    end_px: Pixel | None
    anchor_known: bool = True
    end_known: bool = True
    name: str | None = None
    """Name of its element in the file: a semviz id, or any other name."""
    number: int | None = None
    """Number of its element in the file (track, group); None if it has none."""
    kept: Mapping[str, Any] = field(default_factory=dict)
    """Keys that only the file's own format understands."""


@dataclass
class ParsedLabels:
    """The content of a file, or of a folder of files."""

    observations: list[ParsedObservation] = field(default_factory=list)
    images: int = 0
    dropped: "Counter[str]" = field(default_factory=Counter)
    """Count of dropped content, by what it was and why."""
    triangle_points: int = 0
    """Triangular signs marked by a point, which is taken for the centroid."""
    triangle_boxes: int = 0
    """Triangular signs marked by a box, whose centroid is that of an upright triangle."""
    kept_images: dict[tuple[Side, int], dict[str, Any]] = field(default_factory=dict)

    def drop(self, what: str, count: int = 1) -> None:
        known = what in self.dropped or len(self.dropped) < MOST_KINDS
        self.dropped[what if known else "more kinds of things"] += count


@dataclass(frozen=True)
class LabelImportContext:
    """The workspace and options that a file is checked against."""

    rules: Rules
    frames: Collection[int] | None = None
    """The existing frames; None accepts every number."""
    side: Side | None = None
    """Side of images whose names do not state it."""
    class_map: Mapping[str, str] = field(default_factory=dict)
    """Class name in the file -> semviz class name, or ``ignore``."""
    triangle_center: TriangleCenter = OLDER
    """What the labels of triangular signs mark in the workspace."""

    def class_id(self, name: object) -> int | None:
        """Return the class that the file calls ``name``; None if it is ignored."""
        if not isinstance(name, str):
            raise SemvizError(f"a class name is expected, not {quoted(name)}")
        class_name = self.class_map.get(name, name)
        if name in self.class_map and class_name == IGNORE:
            return None
        class_id = class_named(class_name, self.rules.classes)
        if class_id is None:
            names = ", ".join(class_.name for class_ in self.rules.classes)
            problem = f"class {quoted(name)} is not known"
            if name in self.class_map:
                problem = (
                    f"class {quoted(name)} is mapped to {quoted(class_name)}, which is not known"
                )
            shown = name if name.isprintable() and len(name) <= 50 else "NAME"
            raise SemvizError(
                f"{problem}; say --class-map {shlex.quote(f'{shown}=CLASS')}, CLASS being one of "
                f"{names}, or {IGNORE}"
            )
        return class_id

    def image(self, *names: str) -> tuple[int, Side]:
        """Return frame and side of an image: the frame from its first name, the side from any.

        The frame is the longest number in the file name, the last of equally long ones. The side is
        a folder or word "left" or "right", or a folder of a KITTI camera (image_0, image_2: left;
        image_1, image_3: right).
        """
        frame = _frame_of(names[0])
        if self.frames is not None and frame not in self.frames:
            raise SemvizError(f"image {quoted(names[0])} is of frame {frame}, which is not there")
        sides = next(filter(None, map(sides_of, names)), None)
        if sides is None:
            return frame, self.side_or_refuse(f"image {quoted(names[0])}")
        if len(sides) > 1:
            raise SemvizError(f"image {quoted(names[0])} says both left and right")
        return frame, next(iter(sides))

    def side_or_refuse(self, what: str) -> Side:
        """Return the default side. Raise SemvizError if there are two cameras and no default."""
        if self.side is not None:
            return self.side
        if self.rules.rig is not None and self.rules.rig.right is None:
            return "left"
        raise SemvizError(
            f"{what} does not say whether it is left or right; name it like "
            "left/000012.png, or say --side left or --side right"
        )

    def check_size(self, side: Side, width: object, height: object) -> None:
        """Raise SemvizError if an image's size differs from its camera's."""
        for size in (width, height):
            if not isinstance(size, int) or isinstance(size, bool) or not 0 < size < 2**31:
                raise SemvizError(f"an image of {quoted(width)} by {quoted(height)} pixels")
        rig = self.rules.rig
        camera = None if rig is None else rig.left if side == "left" else rig.right
        if camera is not None and (width, height) != (camera.width, camera.height):
            raise SemvizError(
                f"the image is {width}x{height}, but the {side} images of this workspace are "
                f"{camera.width}x{camera.height}"
            )

    def add_observation(
        self, parsed: ParsedLabels, where: str, place: tuple[int, Side], class_id: int,
        form: Form, points: list[Pixel], **more: Any,
    ) -> None:  # fmt: skip
        """Add a shape to ``parsed``, as an observation or as dropped content."""
        marked = self._mark(parsed, class_id, form, points)
        if marked is None:
            return
        anchor_px, end_px = marked
        observation = ParsedObservation(where, *place, class_id, anchor_px, end_px, **more)
        self.rules.check(_observation(observation), class_id)
        if len(parsed.observations) >= MOST_ITEMS:
            raise SemvizError(f"more than {MOST_ITEMS} labels; split the file")
        parsed.observations.append(observation)

    def _mark(
        self, parsed: ParsedLabels, class_id: int, form: Form, points: list[Pixel]
    ) -> tuple[Pixel, Pixel | None] | None:
        element_class = self.rules.classes[class_id]
        if element_class.kind == "line":
            if form != "line":
                parsed.drop(
                    f"{form} of class {element_class.name}: a pole is a line from peak to bottom"
                )
                return None
            if len(points) > 2:
                parsed.drop("inner points of lines: a pole is its peak and its bottom")
            return points[0], points[-1]
        if form == "box":
            parsed.drop("width and height of boxes: a sign is its middle")
            u, v = box_center(points)
            if class_id == TRIANGULAR and self.triangle_center == "centroid":
                parsed.triangle_boxes += 1
                v += abs(points[1][1] - points[0][1]) / 6.0  # taken to stand upright
            return (u, v), None
        if form == "points" and len(points) == 1:
            if class_id == TRIANGULAR and self.triangle_center == "centroid":
                parsed.triangle_points += 1
            return points[0], None
        parsed.drop(f"{form} of class {element_class.name}: a sign is one point, or a box")
        return None


def _observation(parsed: ParsedObservation) -> Observation:
    return Observation(
        id="", element_id="", frame_index=parsed.frame_index, side=parsed.side,
        anchor_px=parsed.anchor_px, end_px=parsed.end_px,
        anchor_known=parsed.anchor_known, end_known=parsed.end_known,
    )  # fmt: skip


def class_named(name: str, classes: ClassSet) -> int | None:
    """Return the id of the class called ``name``, or by a synonym; None if there is none."""
    plain = _plain(name)
    for class_ in classes:
        if plain == _plain(class_.name) or plain in SYNONYMS.get(class_.id, ()):
            return class_.id
    return None


def _plain(name: str) -> str:
    return " ".join(re.sub(r"[_\-]", " ", name).lower().split())


def parse_class_map(words: Sequence[str]) -> dict[str, str]:
    """Return words such as ``lamp=pole`` as a mapping. Raise SemvizError for any other form."""
    pairs = [word.rpartition("=") for word in words]
    for word, (_, equals, class_name) in zip(words, pairs, strict=True):
        if not equals or not class_name:
            raise SemvizError(f"--class-map {word}: write NAME=CLASS, such as lamp=pole")
    return {name: class_name for name, _, class_name in pairs}


def _frame_of(name: str) -> int:
    file = _parts(name)[-1].rpartition(".")
    runs = re.findall(r"[0-9]+", file[0] or file[2])
    digits = max(reversed(runs), key=len, default="")
    if not digits or len(digits) > 18 or int(digits) >= 2**31:
        raise SemvizError(
            f"image {quoted(name)} has no frame number in its name; name it like left/000012.png"
        )
    return int(digits)


def sides_of(name: str) -> set[Side]:
    """Return the sides that the folders and words of a name state."""
    words: set[str] = set()
    for part in _parts(name.lower()):
        words.update((part, *re.split(r"[^a-z]+", part)))
    return {_SIDES[word] for word in words if word in _SIDES}


def _parts(name: str) -> list[str]:
    return name.replace("\\", "/").split("/")


def read_bytes(path: Path, most: int, count: int | None = None) -> bytes:
    """Return a file's content, or its first ``count`` bytes.

    Raise SemvizError if it is missing, no ordinary file, or larger than ``most``.
    """
    try:
        return read_limited(path, most, count)
    except SemvizError as error:  # ``at`` names the file
        raise SemvizError(str(error).removeprefix(f"{path}: ")) from None


def read_json(data: bytes) -> Any:
    """Return parsed JSON, numbers as ``NumberText``. Raise SemvizError if it is invalid."""
    try:
        value = json.loads(data, parse_float=NumberText)
    except RecursionError:
        raise SemvizError("nested too deeply") from None
    except ValueError as error:  # also for text that is not UTF-8, and for endless integers
        raise SemvizError(f"not JSON ({str(error).splitlines()[0]})") from None
    _check_depth(value)
    return value


def _check_depth(value: Any) -> None:
    level = [value]
    for _ in range(MOST_DEPTH):
        inner = [part for part in level if isinstance(part, dict | list)]
        level = [
            part
            for container in inner
            for part in (container.values() if isinstance(container, dict) else container)
        ]
        if not level:
            return
    raise SemvizError("nested too deeply")


def listed(document: Mapping[str, Any], key: str) -> list[Any]:
    """Return a list in a JSON object. Raise SemvizError if there is none of that name."""
    value = document.get(key)
    if not isinstance(value, list):
        raise SemvizError(f"no list {key!r}")
    if len(value) > MOST_ITEMS:
        raise SemvizError(f"more than {MOST_ITEMS} {key}; split the file")
    return value


def as_object(value: object) -> dict[str, Any]:
    """Return ``value``. Raise SemvizError if it is not a JSON object."""
    if not isinstance(value, dict):
        raise SemvizError(f"an object is expected, not {quoted(value)}")
    return value


def as_text(value: object, what: str) -> str:
    """Return ``value``. Raise SemvizError if it is not a text."""
    if not isinstance(value, str):
        raise SemvizError(f"{what} is not a text but {quoted(value)}")
    return value


def as_number(value: object, what: str) -> int | None:
    """Return ``value``. Raise SemvizError if it is neither a whole number nor None."""
    if value is None:
        return None
    if not isinstance(value, int) or isinstance(value, bool) or not abs(value) < 2**53:
        raise SemvizError(f"{what} is not a whole number but {quoted(value)}")
    return value


def as_flag(value: object, what: str) -> bool:
    """Return ``value``. Raise SemvizError if it is neither true nor false."""
    if not isinstance(value, bool):
        raise SemvizError(f"{what} is neither true nor false but {quoted(value)}")
    return value
