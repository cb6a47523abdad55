"""Helpers of the label readers: errors with file and item, limits, numbers, names of classes.

Numbers are read and written exactly, and converted between pixel origins: parsed coordinates are
semviz pixels. CVAT and labelme put (0, 0) at the top-left CORNER of an image: in both, points run
from 0 to its width (CVAT's ``fitPoints``; labelme's ``outOfPixmap``, issue 278). Here (0, 0) is the
centre of the top-left pixel, so their values are larger by 0.5.
"""

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from decimal import Context, Decimal
from pathlib import Path
from typing import Any

from semviz_annotation.labels.rows import OutlineForm, Pixel
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR, ClassSet
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


def points_of_text(text: str) -> list[Pixel]:
    """Return the points of ``u,v;u,v``, which count from the image corner."""
    points = []
    for pair in text.split(";"):
        u_text, comma, v_text = pair.partition(",")
        if not comma:
            raise SemvizError(f"{quoted(pair)} is not a point")
        points.append((from_corner(u_text), from_corner(v_text)))
    return points


def points_as_text(points: Iterable[Pixel]) -> str:
    """Return the exact inverse of ``points_of_text``."""
    return ";".join(f"{to_corner(u)},{to_corner(v)}" for u, v in points)


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

SYNONYMS: Mapping[int, tuple[str, ...]] = {
    POLE: ("17", "37", "38", "smallpole", "small pole", "lamp",
           "poles", "lamp post", "lamppost", "lamp pole", "light pole", "street light",
           "streetlight", "street lamp", "utility pole", "sign pole", "sign post", "post", "mast"),
    TRIANGULAR: ("triangular", "triangle sign", "triangular traffic sign"),
    RECTANGULAR: ("rectangular", "rectangle sign", "square sign", "rectangular traffic sign"),
    ROUNDED: ("rounded", "round", "round sign", "circular", "circular sign", "circle sign",
              "rounded traffic sign", "round traffic sign"),
}  # fmt: skip
"""Other names of the default classes, first the ids and names of KITTI-360; case, ``_`` and ``-``
do not matter."""
SIGNS_OF_ANY_SHAPE = ("20", "traffic sign")
"""What KITTI-360 and others call signs without their shape: taken for rectangular ones."""


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
    attributes: Mapping[str, str] = field(default_factory=dict)
    """Of its element."""
    outline: tuple[OutlineForm, tuple[Pixel, ...]] | None = None
    """The box or polygon that was drawn, see ``ImportedOutline``."""


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
    assumed: "Counter[str]" = field(default_factory=Counter)
    """Count of labels that were converted on an assumption, by what it was."""
    unknown: dict[str, str] = field(default_factory=dict)
    """Where each class that is not known comes first, by its name."""

    def drop(self, what: str, count: int = 1) -> None:
        _count(self.dropped, what, count)

    def assume(self, what: str, count: int = 1) -> None:
        _count(self.assumed, what, count)


def _count(counter: "Counter[str]", what: str, count: int) -> None:
    known = what in counter or len(counter) < MOST_KINDS
    counter[what if known else "more kinds of things"] += count


def class_named(name: str, classes: ClassSet) -> int | None:
    """Return the id of the class called ``name``, or by a synonym; None if there is none."""
    plain = _plain(name)
    own = next((class_.id for class_ in classes if plain == _plain(class_.name)), None)
    if own is not None:
        return own
    return next((class_id for class_id, names in SYNONYMS.items() if plain in names), None)


def _plain(name: str) -> str:
    return " ".join(re.sub(r"[_\-]", " ", name).lower().split())


def parse_class_map(words: Sequence[str]) -> dict[str, str]:
    """Return words such as ``lamp=pole`` as a mapping. Raise SemvizError for any other form."""
    pairs = [word.rpartition("=") for word in words]
    for word, (_, equals, class_name) in zip(words, pairs, strict=True):
        if not equals or not class_name:
            raise SemvizError(f"--class-map {word}: write NAME=CLASS, such as lamp=pole")
    return {name: class_name for name, _, class_name in pairs}


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


def attribute_text(value: object) -> str:
    """Return the value of an attribute as a text; empty for nothing, and for lists and objects."""
    if isinstance(value, bool):
        return "yes" if value else ""
    if isinstance(value, NumberText):
        return value.text
    return "" if value is None or isinstance(value, list | dict) else str(value)


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
