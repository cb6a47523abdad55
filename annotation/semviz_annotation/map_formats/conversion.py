"""Helpers of the map formats: the map made from a file, sign plates, and the tally of a conversion.

The tally counts dropped and assumed content, and is reported to users and scripts.
"""

import json
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semviz_annotation.label_formats.reading import (
    IGNORE,
    MOST_ITEMS,
    MOST_KINDS,
    MOST_XML_BYTES,
    class_named,
    number,
    quoted,
    read_bytes,
)
from semviz_annotation.map_formats.georeference import Georeference
from semviz_annotation.map_formats.sign_codes import OSM_TAGS, osm_codes, sign_class
from semviz_core.base.classes import DEFAULT_CLASSES, OLDER_CENTER, ClassSet, TriangleCenter
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import MapFrame, Provenance, SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import parsing_xml

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


LOG_ODDS = "existence_log_odds"
"""Name of ``Provenance.log_odds`` in files."""


@dataclass
class ConversionTally:
    """Counts of dropped and assumed content, by what it is and why."""

    dropped: "Counter[str]" = field(default_factory=Counter)
    assumed: "Counter[str]" = field(default_factory=Counter)

    def drop(self, what: str, count: int = 1) -> None:
        _count(self.dropped, what, count)

    def assume(self, what: str, count: int = 1) -> None:
        _count(self.assumed, what, count)


@dataclass(frozen=True)
class ExchangeReport:
    """The result of an export or import."""

    path: str
    format: str
    counts: Mapping[str, int]
    """Counts of exchanged elements, for example ``poles``."""
    dropped: Mapping[str, int]
    """Counts of content that could not be kept."""
    assumed: Mapping[str, int]
    """Counts of values that were unknown and had to be assumed."""

    @classmethod
    def of(
        cls, path: object, format_: str, counts: Mapping[str, int], tally: ConversionTally
    ) -> "ExchangeReport":
        return cls(str(path), format_, dict(counts), dict(tally.dropped), dict(tally.assumed))

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    def as_text(self) -> str:
        counts = ", ".join(
            f"{count} {what.removesuffix('s') if count == 1 else what}"
            for what, count in self.counts.items()
        )
        lines = [f"{self.path}: {counts} ({self.format})"]
        lines += [f"  dropped: {count} x {what}" for what, count in sorted(self.dropped.items())]
        lines += [f"  assumed: {count} x {what}" for what, count in sorted(self.assumed.items())]
        return "\n".join(lines)


def _count(counter: "Counter[str]", what: str, count: int) -> None:
    if count:
        known = what in counter or len(counter) < MOST_KINDS
        counter[what if known else "more kinds of things"] += count


PLATE_M = 0.6
"""Width and height of a sign's plate; a map has only the centre of a sign."""


def across_road(semantic_map: SemanticMap) -> FloatArray:
    """Return level unit vectors (n, 3) to the right of the driving direction at each element.

    The direction is that of the step of ``trajectory_m`` that starts nearest to the anchor; without
    a trajectory the result is -y.
    """
    anchors, road = semantic_map.elements.anchor_m, semantic_map.trajectory_m
    steps = np.diff(road[:, :2], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    starts, steps = road[:-1][lengths > 0.0], steps[lengths > 0.0]
    if not len(steps):
        return np.tile([0.0, -1.0, 0.0], (len(anchors), 1))
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(starts[:, :2]).query(anchors[:, :2])
    ahead = steps[nearest] / lengths[lengths > 0.0][nearest, None]
    return np.column_stack([ahead[:, 1], -ahead[:, 0], np.zeros(len(anchors))])


def counts(semantic_map: SemanticMap) -> dict[str, int]:
    """Return the numbers of poles and signs of a map."""
    lines = int(semantic_map.elements.is_line.sum())
    return {"poles": lines, "signs": len(semantic_map) - lines}


def drop_all_but_places(semantic_map: SemanticMap, tally: ConversionTally) -> None:
    """Count what a format drops that holds only positions and classes of elements."""
    tally.drop("standard deviations and correlations", len(semantic_map))
    drop_history(semantic_map, tally)
    tally.drop("labels and observations that elements come from", len(semantic_map.provenance))


def drop_history(semantic_map: SemanticMap, tally: ConversionTally) -> None:
    """Count the dropped build history and road."""
    drop_making(semantic_map, tally)
    tally.drop("points of the road that was driven", len(semantic_map.trajectory_m))


def drop_making(semantic_map: SemanticMap, tally: ConversionTally) -> None:
    """Count the dropped content that no other format holds."""
    tally.drop("decisions that the map was built by", len(semantic_map.decisions))
    tally.drop("method, settings and label operation of the map", bool(semantic_map.made_by))


def as_json(value: object) -> str:
    """Return plain values as JSON, numbers with all digits."""
    return json.dumps(value, allow_nan=False)


def unseen_ends(semantic_map: SemanticMap) -> int:
    """Return the number of unknown ends of poles, and of unknown signs."""
    elements = semantic_map.elements
    return int((~elements.anchor_known).sum() + (elements.is_line & ~elements.end_known).sum())


MOST_HEIGHT_M = 200.0
"""Height of a pole that is a mistake: a code, or millimetres."""
_METRES = {"": 1.0, "m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0, "cm": 0.01,
           "mm": 0.001, "ft": 0.3048, "feet": 0.3048, "foot": 0.3048}  # fmt: skip
ASSUMED_SIGMA_M = 0.1
"""Standard deviation of coordinates from a file that states none."""


@dataclass(frozen=True, eq=False)
class ParsedElement:
    """One pole or sign in the map frame, as in a file."""

    class_id: int
    anchor_m: FloatArray
    """(3,) peak of a pole, centre of a sign."""
    end_m: FloatArray | None = None
    """(3,) bottom of a pole."""
    id: int | None = None
    """None if the file has no number."""
    covariance_m2: FloatArray | None = None
    """(6, 6) as in ``Elements3D``; None if the file has none."""
    anchor_known: bool = True
    end_known: bool = True
    provenance: Provenance = field(default_factory=Provenance)
    attributes: Mapping[str, str] = field(default_factory=dict)


@dataclass
class ParsedMap:
    """The content of a file."""

    elements: list[ParsedElement] = field(default_factory=list)
    trajectory_m: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    georeference: Georeference | None = None
    """Position of the map on Earth, if reading the file needed it."""
    triangle_center: TriangleCenter = OLDER_CENTER
    """What the points of triangular signs are."""
    tally: ConversionTally = field(default_factory=ConversionTally)

    def add(self, element: ParsedElement) -> None:
        if len(self.elements) >= MOST_ITEMS:
            raise SemvizError(f"more than {MOST_ITEMS} poles and signs; split the file")
        self.elements.append(element)


@dataclass(frozen=True)
class MapImportContext:
    """The workspace and options that a file is read with."""

    frame: MapFrame
    """The map frame of the workspace and of the imported map."""
    classes: ClassSet = DEFAULT_CLASSES
    class_map: Mapping[str, str] = field(default_factory=dict)
    """Class name in the file -> semviz class name, or ``ignore``."""
    anchor: Georeference | None = None
    """Position of the map frame's origin on Earth, as the user states it."""
    class_property: str | None = None
    """Property of GeoJSON that says what a feature is; None: ``class``, or OpenStreetMap's tags."""
    all_of_class: str | None = None
    """The class of everything in the file, whatever it says."""
    height_property: str | None = None
    """Property of GeoJSON with the height of a pole; None: ``height``."""
    pole_height_m: float | None = None
    """Of poles that are points without a height; None: such poles are dropped."""
    sign_height_m: float | None = None
    """Of the middles of signs above points without a height of their own; None: 0."""

    def georeference(self, of_file: Georeference | None = None) -> Georeference | None:
        """Return the position on Earth stated by the user, else the file, else the workspace."""
        return self.anchor or of_file or Georeference.of(self.frame)

    def class_id(self, name: object) -> int | None:
        """Return the class that the file calls ``name``; None if it is ignored."""
        if not isinstance(name, str):
            raise SemvizError(f"a class name is expected, not {quoted(name)}")
        mapped = self._mapped([name])
        if mapped == IGNORE:
            return None
        class_id = class_named(name, self.classes) if mapped is None else mapped
        if not isinstance(class_id, int):
            raise SemvizError(
                f"class {quoted(name)} is not known; {how_to_map(name)}, CLASS being one of "
                f"{self._class_names()}"
            )
        return class_id

    def class_of_name(self, name: str) -> int | str | None:
        """Return the class called ``name``, as ``class_of_code``."""
        mapped = self._mapped([name])
        return class_named(name, self.classes) if mapped is None else mapped

    def class_of_tags(self, tags: Mapping[str, str]) -> int | str | None:
        """Return the class of an element with OpenStreetMap's tags, as ``class_of_code``."""
        if self.all_of_class is not None:
            return self.class_id(self.all_of_class)
        pairs = {f"{key}={value}": (key, value) for key, value in tags.items()}
        poles = {text: OSM_TAGS[pair] for text, pair in pairs.items() if pair in OSM_TAGS}
        pole = self.class_of_code(list(pairs), poles.get)
        if pole is not None or "traffic_sign" not in tags:
            return pole
        return self.class_of_code(osm_codes(tags), sign_class)

    def class_of_code(
        self, codes: Sequence[str], find: Callable[[str], int | None]
    ) -> int | str | None:
        """Return the class of the first of ``codes`` that the user mapped or ``find`` knows.

        Return ``ignore`` if the user mapped it so, None if no code is known.
        """
        mapped = self._mapped(codes)
        if mapped is not None:
            return mapped
        known = (class_id for code in codes if (class_id := find(code)) is not None)
        return next((class_id for class_id in known if class_id in self.classes), None)

    def check_frame(self, name: object) -> None:
        """Raise SemvizError if a file names another map frame."""
        if name is not None and name != self.frame.name:
            raise SemvizError(
                f"a map of the frame {quoted(name)}, but this workspace's is "
                f"{quoted(self.frame.name)}; their coordinates have nothing in common"
            )

    def _mapped(self, names: Sequence[str]) -> int | str | None:
        name = next((candidate for candidate in names if candidate in self.class_map), None)
        if name is None:
            return None
        class_name = self.class_map[name]
        class_id = IGNORE if class_name == IGNORE else class_named(class_name, self.classes)
        if class_id is None:
            raise SemvizError(
                f"class {quoted(name)} is mapped to {quoted(class_name)}, which is not known; "
                f"say one of {self._class_names()}"
            )
        return class_id

    def _class_names(self) -> str:
        return ", ".join([*(class_.name for class_ in self.classes), IGNORE])


def how_to_map(name: str) -> str:
    """Return the option that maps the class ``name`` of a file."""
    shown = name if name.isprintable() and 0 < len(name) <= 50 else "NAME"
    return f"say --class-map {shlex.quote(f'{shown}=CLASS')}"


_MOST_DROPPED = 8
"""Kinds of dropped content that one line of an error names."""


def map_of(parsed: ParsedMap, context: MapImportContext, made_by: str) -> SemanticMap:
    """Return the map of the parsed elements. Raise SemvizError if there are none."""
    rows, tally = parsed.elements, parsed.tally
    if not rows:
        listed = sorted(tally.dropped.items(), key=lambda pair: -pair[1])
        dropped = ", ".join(f"{count} x {what}" for what, count in listed[:_MOST_DROPPED])
        if len(listed) > _MOST_DROPPED:
            dropped += f" and {len(listed) - _MOST_DROPPED} more"
        raise SemvizError(
            "holds no pole and no sign that can be read" + (dropped and f": {dropped}")
        )
    tally.assume(
        f"standard deviations: {ASSUMED_SIGMA_M:g} m where the file has none",
        sum(row.covariance_m2 is None for row in rows),
    )
    is_line = np.array([row.end_m is not None for row in rows])
    ids = _ids(rows, tally)
    ends = [np.full(3, np.nan) if row.end_m is None else row.end_m for row in rows]
    elements = Elements3D(
        id=np.array(ids),
        anchor_m=np.array([row.anchor_m for row in rows]),
        end_m=np.array(ends),
        class_id=np.array([row.class_id for row in rows]),
        covariance_m2=np.array([_covariance(row) for row in rows]),
        anchor_known=np.array([row.anchor_known for row in rows]),
        end_known=is_line & np.array([row.end_known for row in rows]),
    )
    provenance = tuple(row.provenance for row in rows)
    return SemanticMap(
        elements=elements,
        frame=_frame(context.frame, parsed.georeference),
        classes=context.classes,
        trajectory_m=parsed.trajectory_m,
        provenance=provenance if any(origin.label_ids for origin in provenance) else (),
        made_by=made_by,
        triangle_center=parsed.triangle_center,
        attributes={
            id_: row.attributes for id_, row in zip(ids, rows, strict=True) if row.attributes
        },
    )


def _frame(frame: MapFrame, georeference: Georeference | None) -> MapFrame:
    if georeference is None:
        return frame
    return MapFrame(frame.name, georeference.origin, georeference.x_heading_deg)


def _ids(rows: Iterable[ParsedElement], tally: ConversionTally) -> list[int]:
    """Return the ids of the file; elements without an id, or with a repeated one, get a new one."""
    rows = list(rows)
    following = max((row.id for row in rows if row.id is not None), default=0)
    ids: list[int] = []
    taken: set[int] = set()
    for row in rows:
        if row.id is None or row.id in taken:
            following += 1
            tally.assume("numbers: new ones where the file has none, or the same twice")
        ids.append(following if row.id is None or row.id in taken else row.id)
        taken.add(ids[-1])
    return ids


def _covariance(row: ParsedElement) -> FloatArray:
    if row.covariance_m2 is not None:
        return row.covariance_m2
    variances = np.full(6, ASSUMED_SIGMA_M**2)
    variances[3:] *= row.end_m is not None
    return np.diag(variances)


def read_xml(path: Path, root: str) -> "Element":
    """Return the root element without namespaces. Raise SemvizError if it is not ``root``."""
    from defusedxml.ElementTree import fromstring

    with parsing_xml():
        document: Element = fromstring(read_bytes(path, MOST_XML_BYTES), forbid_dtd=True)
    for element in document.iter():
        element.tag = element.tag.rpartition("}")[2]
    if document.tag != root:
        raise SemvizError(f"the outermost element is {quoted(document.tag)}, not {root!r}")
    return document


def attribute(element: "Element", name: str, default: str | None = None) -> float:
    """Return a numeric attribute of an XML element. Raise SemvizError if it is missing."""
    text = element.get(name, default)
    if text is None:
        raise SemvizError(f"a {element.tag} without {name!r}")
    return number(text)


def parse_length_m(value: object) -> float:
    """Return metres of ``8``, ``"8 m"``, ``"8,5"``, ``"850 cm"``, ``"26 ft"`` or ``26'3"``.

    Raise SemvizError if it is unclear.
    """
    text = str(value).strip().lower().removesuffix(".")
    feet = re.fullmatch(r"(\d{1,6})\s*'\s*(?:(\d{1,2})\s*\")?", text)
    if feet is not None:
        return 0.3048 * (int(feet[1]) + int(feet[2] or 0) / 12.0)
    found = re.fullmatch(r"(\d{1,9}(?:[.,]\d{1,9})?)\s*([a-z]*)", text)
    if found is None or found[2] not in _METRES:
        raise SemvizError(f"{quoted(value)} is not a length; write metres, such as 8 or '8 m'")
    return _METRES[found[2]] * float(found[1].replace(",", "."))


def parse_integer(text: str | None) -> int | None:
    """Return the integer from 0 to 2^53 in ``text``; None if it is not one."""
    if text is None or not (text.isascii() and text.isdigit() and len(text) <= 16):
        return None
    value = int(text)
    return value if value <= 2**53 else None


def height_of_pole(value: object, context: MapImportContext, parsed: ParsedMap) -> float | None:
    """Return the height of a pole that is a point: as stated, else the default, else None."""
    if value is not None and str(value).strip():
        try:
            height_m = parse_length_m(value)
        except SemvizError:
            parsed.tally.drop(f"heights such as {quoted(value)}: no length, such as 8 or '8 m'")
        else:
            if 0.0 < height_m < MOST_HEIGHT_M:
                return height_m
            parsed.tally.drop(f"heights such as {height_m:g} m: no pole is that high")
    if context.pole_height_m is None:
        parsed.tally.drop("poles that are points without a height: say --pole-height METRES")
    else:
        parsed.tally.assume(f"heights of poles: {context.pole_height_m:g} m where there is none")
    return context.pole_height_m


def raised(point_m: FloatArray, context: MapImportContext, parsed: ParsedMap) -> FloatArray:
    """Return the middle of a sign whose point is on the ground."""
    if context.sign_height_m is None:
        return point_m
    parsed.tally.assume(f"middles of signs: {context.sign_height_m:g} m above their points")
    return np.asarray(point_m + np.array([0.0, 0.0, context.sign_height_m]))


def upper_first(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two ends of a pole, the upper one first."""
    return (first, second) if first[2] >= second[2] else (second, first)
