"""Coordinates as text, so that moving the origin by half a pixel loses no digit.

CVAT and labelme put (0, 0) at the top-left CORNER of an image: both let points run from 0 to its
width (CVAT's ``fitPoints``; labelme's ``outOfPixmap``, issue 278). Ours is the centre of the
top-left pixel, so theirs are larger by 0.5.
"""

import re
from decimal import Context, Decimal

from semviz_annotation.rows import Pixel
from semviz_core.arrays import LARGEST
from semviz_core.errors import SemvizError

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
    """The finite number that ``text`` is; SemvizError where it is none."""
    text = text.strip(" \t\r\n")
    if len(text) > _MOST_DIGITS or not _NUMBER.fullmatch(text):
        raise SemvizError(f"{quoted(text)} is not a number")
    value = float(text)
    if not abs(value) <= LARGEST:
        raise SemvizError(f"{quoted(text)} is too large")
    return value


def from_corner(text: str) -> float:
    """Our coordinate of one that counts from the image's corner."""
    value = number(text)
    return float(_EXACT.subtract(Decimal(text.strip(" \t\r\n")) if value else Decimal(0), _HALF))


def to_corner(value: float) -> str:
    """The opposite of ``from_corner``, exactly."""
    return format(_EXACT.add(Decimal(repr(value)), _HALF), "f")


def json_number(value: object) -> str:
    """How a number of parsed JSON was written; SemvizError where it is no finite number."""
    if isinstance(value, NumberText):
        text = value.text
    elif isinstance(value, int) and not isinstance(value, bool) and abs(value) <= LARGEST:
        text = str(value)
    else:
        raise SemvizError(f"{quoted(value)} is not a number")
    number(text)
    return text


def middle(points: list[Pixel]) -> Pixel:
    """The middle of the box around ``points``."""
    u, v = zip(*points, strict=True)
    return ((min(u) + max(u)) / 2, (min(v) + max(v)) / 2)


def quoted(value: object) -> str:
    """``value`` on one line, not too long, whatever it holds."""
    text = ascii(value) if not isinstance(value, int) or abs(value) <= LARGEST else "a huge number"
    return text if len(text) <= 60 else f"{text[:50]} ..."
