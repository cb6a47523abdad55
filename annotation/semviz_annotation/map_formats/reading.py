"""What the readers of maps share: what they are told, what they find, and a map made of that."""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from semviz_annotation.formats.numbers import number, quoted
from semviz_annotation.formats.reading import (
    IGNORE,
    MOST_ITEMS,
    MOST_XML_BYTES,
    class_named,
    read_bytes,
)
from semviz_annotation.map_formats.georeference import Georeference
from semviz_annotation.map_formats.tally import Tally
from semviz_core.arrays import FloatArray, float_array
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import MapFrame, Provenance, SemanticMap

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from numpy.typing import ArrayLike

ASSUMED_SIGMA_M = 0.1
"""Of every coordinate of what comes from a file that does not say how exact it is."""


@dataclass(frozen=True, eq=False)
class Thing:
    """One pole or sign in the map frame, as a file has it."""

    class_id: int
    anchor_m: FloatArray
    """(3,) peak of a pole, middle of a sign."""
    end_m: FloatArray | None = None
    """(3,) bottom of a pole."""
    id: int | None = None
    """None where the file gives it no number."""
    covariance_m2: FloatArray | None = None
    """(6, 6) as ``Elements3D``; None where the file does not know."""
    anchor_known: bool = True
    end_known: bool = True
    provenance: Provenance = field(default_factory=Provenance)


@dataclass
class Found:
    """What a reader found in a file."""

    things: list[Thing] = field(default_factory=list)
    trajectory_m: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    georeference: Georeference | None = None
    """Where the map is on Earth, if that was needed to read the file."""
    tally: Tally = field(default_factory=Tally)

    def add(self, thing: Thing) -> None:
        if len(self.things) >= MOST_ITEMS:
            raise SemvizError(f"more than {MOST_ITEMS} poles and signs; split the file")
        self.things.append(thing)


@dataclass(frozen=True)
class Reading:
    """What a file is read against."""

    frame: MapFrame
    """The map frame of the workspace, which the map will be in."""
    classes: ClassSet = DEFAULT_CLASSES
    class_map: Mapping[str, str] = field(default_factory=dict)
    """Name in the file -> name of a class of ours, or ``ignore``."""
    anchor: Georeference | None = None
    """Where the map frame's origin is, as the user says."""

    def georeference(self, of_file: Georeference | None = None) -> Georeference | None:
        """Where the map is on Earth: as the user says, or the file, or the workspace."""
        return self.anchor or of_file or Georeference.of(self.frame)

    def class_id(self, name: object) -> int | None:
        """The class of ours that the file calls ``name``; None where it is to be ignored."""
        if not isinstance(name, str):
            raise SemvizError(f"a class name is expected, not {quoted(name)}")
        meant = self._mapped([name])
        if meant == IGNORE:
            return None
        found = class_named(name, self.classes) if meant is None else meant
        if not isinstance(found, int):
            raise SemvizError(
                f"class {quoted(name)} is not known; {how_to_map(name)}, CLASS being one of "
                f"{self._class_names()}"
            )
        return found

    def class_of_code(self, codes: Sequence[str], table: Mapping[str, int]) -> int | str | None:
        """The class of the first of ``codes`` that the user mapped, or that is in ``table``.

        ``ignore`` where the user said so, None where none is known.
        """
        meant = self._mapped(codes)
        if meant is not None:
            return meant
        known = (table[code] for code in codes if table.get(code) in self.classes)
        return next(known, None)

    def check_frame(self, name: object) -> None:
        """SemvizError where a map of another frame would be mixed up with this one."""
        if name is not None and name != self.frame.name:
            raise SemvizError(
                f"a map of the frame {quoted(name)}, but this workspace's is "
                f"{quoted(self.frame.name)}; their coordinates have nothing in common"
            )

    def _mapped(self, names: Sequence[str]) -> int | str | None:
        name = next((one for one in names if one in self.class_map), None)
        if name is None:
            return None
        meant = self.class_map[name]
        class_id = IGNORE if meant == IGNORE else class_named(meant, self.classes)
        if class_id is None:
            raise SemvizError(
                f"class {quoted(name)} is mapped to {quoted(meant)}, which is not known; "
                f"say one of {self._class_names()}"
            )
        return class_id

    def _class_names(self) -> str:
        return ", ".join([*(one.name for one in self.classes), IGNORE])


def how_to_map(name: str) -> str:
    """What to say so that ``name`` of a file is understood."""
    shown = name if name.isprintable() and 0 < len(name) <= 50 else "NAME"
    return f"say --class-map {shlex.quote(f'{shown}=CLASS')}"


def map_of(found: Found, reading: Reading, made_by: str) -> SemanticMap:
    """The map of what was found; SemvizError where that is nothing."""
    things, tally = found.things, found.tally
    if not things:
        others = ", ".join(f"{count} x {what}" for what, count in tally.dropped.items())
        raise SemvizError("holds no pole and no sign that can be read" + (others and f": {others}"))
    tally.assume(
        f"standard deviations: {ASSUMED_SIGMA_M:g} m where the file has none",
        sum(one.covariance_m2 is None for one in things),
    )
    is_line = np.array([one.end_m is not None for one in things])
    ends = [np.full(3, np.nan) if one.end_m is None else one.end_m for one in things]
    elements = Elements3D(
        id=np.array(_ids(things, tally)),
        anchor_m=np.array([one.anchor_m for one in things]),
        end_m=np.array(ends),
        class_id=np.array([one.class_id for one in things]),
        covariance_m2=np.array([_covariance(one) for one in things]),
        anchor_known=np.array([one.anchor_known for one in things]),
        end_known=is_line & np.array([one.end_known for one in things]),
    )
    provenance = tuple(one.provenance for one in things)
    return SemanticMap(
        elements=elements,
        frame=_frame(reading.frame, found.georeference),
        classes=reading.classes,
        trajectory_m=found.trajectory_m,
        provenance=provenance if any(one.label_ids for one in provenance) else (),
        made_by=made_by,
    )


def _frame(frame: MapFrame, georeference: Georeference | None) -> MapFrame:
    if georeference is None:
        return frame
    return MapFrame(frame.name, georeference.origin, georeference.x_heading_deg)


def _ids(things: Iterable[Thing], tally: Tally) -> list[int]:
    """The file's own where it has them; what has none, or one for the second time, is new."""
    things = list(things)
    following = max((one.id for one in things if one.id is not None), default=0)
    ids: list[int] = []
    taken: set[int] = set()
    for one in things:
        if one.id is None or one.id in taken:
            following += 1
            tally.assume("numbers: new ones where the file has none, or the same twice")
        ids.append(following if one.id is None or one.id in taken else one.id)
        taken.add(ids[-1])
    return ids


def _covariance(thing: Thing) -> FloatArray:
    if thing.covariance_m2 is not None:
        return thing.covariance_m2
    variances = np.full(6, ASSUMED_SIGMA_M**2)
    variances[3:] *= thing.end_m is not None
    return np.diag(variances)


def read_xml(path: Path, root: str) -> "Element":
    """The outermost element, namespaces taken off; SemvizError where it is not ``root``."""
    from xml.etree.ElementTree import ParseError

    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    try:
        document: Element = fromstring(read_bytes(path, MOST_XML_BYTES), forbid_dtd=True)
    except DefusedXmlException:
        raise SemvizError("declares a document type or entities; such files are refused") from None
    except (ParseError, LookupError, ValueError) as error:
        raise SemvizError(f"not XML ({str(error).splitlines()[0][:200]})") from None
    for element in document.iter():
        element.tag = element.tag.rpartition("}")[2]
    if document.tag != root:
        raise SemvizError(f"the outermost element is {quoted(document.tag)}, not {root!r}")
    return document


def attribute(element: "Element", name: str, default: str | None = None) -> float:
    """A number among the attributes of an element of XML."""
    text = element.get(name, default)
    if text is None:
        raise SemvizError(f"a {element.tag} without {name!r}")
    return number(text)


def whole(text: str | None) -> int | None:
    """The number from 0 to 2^53 that ``text`` is; None where it is none."""
    if text is None or not (text.isascii() and text.isdigit() and len(text) <= 16):
        return None
    value = int(text)
    return value if value <= 2**53 else None


def upper_first(one: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two ends of a pole, the upper one first."""
    return (one, other) if one[2] >= other[2] else (other, one)


def checked_covariance(value: object, name: str) -> FloatArray:
    """(6, 6) of a nested list of 6 by 6 numbers, or 3 by 3 for a point."""
    array = float_array(cast("ArrayLike", value), (None, None), name)
    if array.shape not in ((3, 3), (6, 6)):
        raise SemvizError(f"{name} is not a matrix of 3 by 3 or 6 by 6 numbers")
    full = np.zeros((6, 6))
    full[: len(array), : len(array)] = array
    return full
