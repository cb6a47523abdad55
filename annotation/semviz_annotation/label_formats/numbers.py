"""Numbers of label files: read and written exactly, and converted between pixel origins.

CVAT and labelme put (0, 0) at the top-left CORNER of an image: in both, points run from 0 to
its width (CVAT's ``fitPoints``; labelme's ``outOfPixmap``, issue 278). Here (0, 0) is the
centre of the top-left pixel, so their values are larger by 0.5.
"""

import re
from decimal import Context, Decimal

from semviz_annotation.labels.rows import Pixel
from semviz_core.common.arrays import LARGEST
from semviz_core.common.errors import SemvizError

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
