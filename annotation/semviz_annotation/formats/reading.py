"""What the readers share: where things stand in a file, limits, names of images and classes."""

import json
import re
import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

from semviz_annotation.formats.numbers import NumberText, middle, quoted
from semviz_annotation.rows import Observation, Pixel
from semviz_annotation.rules import Rules
from semviz_core.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR, ClassSet
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

IGNORE = "ignore"
"""What a class map says of a class that is left out."""
MOST_JSON_BYTES = 64 * 2**20
MOST_XML_BYTES = 128 * 2**20
MOST_ITEMS = 1_000_000
MOST_DEPTH = 32
MOST_KINDS = 100
"""So many different things are told apart in the list of what was dropped."""

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
    """An error that already says where."""


@contextmanager
def at(where: object) -> Iterator[None]:
    """Say of every error inside that it is ``where``."""
    try:
        yield
    except _PlacedError:
        raise
    except SemvizError as error:
        raise _PlacedError(f"{where}: {error}. Nothing was imported.") from None


@dataclass(frozen=True)
class Seen:
    """One pole or sign in one image, as a file has it, in our pixels."""

    where: str
    """``street.xml, item 214``, for people."""
    frame_index: int
    side: Side
    class_id: int
    anchor_px: Pixel
    end_px: Pixel | None
    anchor_known: bool = True
    end_known: bool = True
    name: str | None = None
    """What the file calls its element: our id, or a name of someone's own."""
    number: int | None = None
    """The number of its element within the file (track, group); None where it has none."""
    kept: Mapping[str, Any] = field(default_factory=dict)
    """What only the file's own format understands."""


@dataclass
class Found:
    """What a reader found in a file, or in a folder of files."""

    seen: list[Seen] = field(default_factory=list)
    images: int = 0
    dropped: "Counter[str]" = field(default_factory=Counter)
    """How often what was left out, and why."""
    kept_images: dict[tuple[Side, int], dict[str, Any]] = field(default_factory=dict)

    def drop(self, what: str, count: int = 1) -> None:
        known = what in self.dropped or len(self.dropped) < MOST_KINDS
        self.dropped[what if known else "more kinds of things"] += count


@dataclass(frozen=True)
class Reading:
    """What a file is read against."""

    rules: Rules
    frames: Collection[int] | None = None
    """The frames there are; None accepts every number."""
    side: Side | None = None
    """Of images whose names do not tell."""
    class_map: Mapping[str, str] = field(default_factory=dict)
    """Name in the file -> name of a class of ours, or ``ignore``."""

    def class_id(self, name: object) -> int | None:
        """The class that the file calls ``name``; None where it is to be ignored."""
        if not isinstance(name, str):
            raise SemvizError(f"a class name is expected, not {quoted(name)}")
        meant = self.class_map.get(name, name)
        if name in self.class_map and meant == IGNORE:
            return None
        found = class_named(meant, self.rules.classes)
        if found is None:
            names = ", ".join(one.name for one in self.rules.classes)
            said = f"class {quoted(name)} is not known"
            if name in self.class_map:
                said = f"class {quoted(name)} is mapped to {quoted(meant)}, which is not known"
            shown = name if name.isprintable() and len(name) <= 50 else "NAME"
            raise SemvizError(
                f"{said}; say --class-map {shlex.quote(f'{shown}=CLASS')}, CLASS being one of "
                f"{names}, or {IGNORE}"
            )
        return found

    def image(self, *names: str) -> tuple[int, Side]:
        """Frame and side of an image: the frame from its first name, the side from any.

        The frame is the longest number in the file's name (the last of those). The side is
        where a folder or a word in the file's name says left or right, or a folder is one of
        KITTI's cameras (image_0, image_2 left; image_1, image_3 right).
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
        """The side of something whose name does not tell it."""
        if self.side is not None:
            return self.side
        if self.rules.rig is not None and self.rules.rig.right is None:
            return "left"
        raise SemvizError(
            f"{what} does not say whether it is left or right; name it like "
            "left/000012.png, or say --side left or --side right"
        )

    def check_size(self, side: Side, width: object, height: object) -> None:
        """SemvizError where an image is not of the size that its camera has."""
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

    def seen(
        self, found: Found, where: str, place: tuple[int, Side], class_id: int,
        form: Form, points: list[Pixel], **more: Any,
    ) -> None:  # fmt: skip
        """Add to ``found`` the pole or sign that a shape is, or that it is none."""
        marked = self._mark(found, class_id, form, points)
        if marked is None:
            return
        anchor_px, end_px = marked
        one = Seen(where, *place, class_id, anchor_px, end_px, **more)
        self.rules.check(_observation(one), class_id)
        if len(found.seen) >= MOST_ITEMS:
            raise SemvizError(f"more than {MOST_ITEMS} labels; split the file")
        found.seen.append(one)

    def _mark(
        self, found: Found, class_id: int, form: Form, points: list[Pixel]
    ) -> tuple[Pixel, Pixel | None] | None:
        one = self.rules.classes[class_id]
        if one.kind == "line":
            if form != "line":
                found.drop(f"{form} of class {one.name}: a pole is a line from peak to bottom")
                return None
            if len(points) > 2:
                found.drop("inner points of lines: a pole is its peak and its bottom")
            return points[0], points[-1]
        if form == "box":
            found.drop("width and height of boxes: a sign is its middle")
            return middle(points), None
        if form == "points" and len(points) == 1:
            return points[0], None
        found.drop(f"{form} of class {one.name}: a sign is one point, or a box")
        return None


def _observation(one: Seen) -> Observation:
    return Observation(
        id="", element_id="", frame_index=one.frame_index, side=one.side, anchor_px=one.anchor_px,
        end_px=one.end_px, anchor_known=one.anchor_known, end_known=one.end_known,
    )  # fmt: skip


def class_named(name: str, classes: ClassSet) -> int | None:
    """Id of the class called ``name``, or by a synonym; None where there is none."""
    plain = _plain(name)
    for one in classes:
        if plain == _plain(one.name) or plain in SYNONYMS.get(one.id, ()):
            return one.id
    return None


def _plain(name: str) -> str:
    return " ".join(re.sub(r"[_\-]", " ", name).lower().split())


def parse_class_map(words: Sequence[str]) -> dict[str, str]:
    """``lamp=pole`` and so on, as a mapping; SemvizError where a word is not of that form."""
    pairs = [word.rpartition("=") for word in words]
    for word, (_, equals, meant) in zip(words, pairs, strict=True):
        if not equals or not meant:
            raise SemvizError(f"--class-map {word}: write NAME=CLASS, such as lamp=pole")
    return {name: meant for name, _, meant in pairs}


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
    """What the folders and words of a name say of the side."""
    words: set[str] = set()
    for part in _parts(name.lower()):
        words.update((part, *re.split(r"[^a-z]+", part)))
    return {_SIDES[word] for word in words if word in _SIDES}


def _parts(name: str) -> list[str]:
    return name.replace("\\", "/").split("/")


def read_bytes(path: Path, most: int) -> bytes:
    """A whole file; SemvizError where there is none, or it is larger than ``most``."""
    try:
        if path.exists() and not path.is_file():
            raise SemvizError("a folder or a device, not a file")
        if path.stat().st_size > most:
            raise SemvizError(f"more than {most // 2**20} MB; split the file")
        with path.open("rb") as file:
            return file.read(most)
    except OSError as error:
        raise SemvizError(f"cannot be read ({error.strerror})") from None


def read_json(data: bytes) -> Any:
    """Parsed JSON, numbers with their text (``NumberText``); SemvizError where it is none."""
    try:
        value = json.loads(data, parse_float=NumberText)
    except RecursionError:
        raise SemvizError("nested too deeply") from None
    except ValueError as error:  # also where it is no text, and where an integer is endless
        raise SemvizError(f"not JSON ({str(error).splitlines()[0]})") from None
    _check_depth(value)
    return value


def _check_depth(value: Any) -> None:
    level = [value]
    for _ in range(MOST_DEPTH):
        inner = [one for one in level if isinstance(one, dict | list)]
        level = [part for one in inner for part in (one.values() if isinstance(one, dict) else one)]
        if not level:
            return
    raise SemvizError("nested too deeply")


def listed(document: Mapping[str, Any], key: str) -> list[Any]:
    """A list in a JSON object; SemvizError where there is none of that name."""
    value = document.get(key)
    if not isinstance(value, list):
        raise SemvizError(f"no list {key!r}")
    if len(value) > MOST_ITEMS:
        raise SemvizError(f"more than {MOST_ITEMS} {key}; split the file")
    return value


def as_object(value: object) -> dict[str, Any]:
    """A JSON object; SemvizError where it is something else."""
    if not isinstance(value, dict):
        raise SemvizError(f"an object is expected, not {quoted(value)}")
    return value


def as_text(value: object, what: str) -> str:
    """A text; SemvizError where it is something else."""
    if not isinstance(value, str):
        raise SemvizError(f"{what} is not a text but {quoted(value)}")
    return value


def as_number(value: object, what: str) -> int | None:
    """A whole number or None; SemvizError where it is something else."""
    if value is None:
        return None
    if not isinstance(value, int) or isinstance(value, bool) or not abs(value) < 2**53:
        raise SemvizError(f"{what} is not a whole number but {quoted(value)}")
    return value


def as_flag(value: object, what: str) -> bool:
    """True or false; SemvizError where it is something else."""
    if not isinstance(value, bool):
        raise SemvizError(f"{what} is neither true nor false but {quoted(value)}")
    return value
