"""OpenDRIVE (.xodr), in: signals and objects, placed along their roads.

ASAM OpenDRIVE 1.8, chapters 13 (objects) and 14 (signals): ``zOffset`` is the height of a
signal's lower edge, and of an object's foot, above the road.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semviz_annotation.formats.numbers import quoted
from semviz_annotation.formats.reading import IGNORE, MOST_ITEMS, at
from semviz_annotation.map_formats.georeference import Georeference
from semviz_annotation.map_formats.reading import (
    Found,
    Reading,
    Thing,
    attribute,
    how_to_map,
    read_xml,
    whole,
)
from semviz_annotation.map_formats.road_line import Place, RoadLine
from semviz_annotation.map_formats.sign_codes import SIGN_CODES, codes_of
from semviz_core.arrays import FloatArray
from semviz_core.classes import POLE
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from pyproj import Transformer

OBJECT_CLASSES: Mapping[str, int] = {"pole": POLE, "streetlamp": POLE}
"""Types of objects, in small letters -> class."""


@dataclass(frozen=True)
class _Standing:
    """An object or signal at one place."""

    place: Place
    z_offset_m: float
    height_m: float

    def above(self, element: "Element", share: float) -> FloatArray:
        """(3,) the point at a share of its height along its own, perhaps tilted, z axis.

        ``hdg`` (``hOffset`` of signals), ``pitch`` and ``roll`` turn about z, y and x, in this
        order, each about the axes as turned before.
        """
        angles = [attribute(element, name, "0") for name in ("roll", "pitch")]
        turn = attribute(element, "hdg", element.get("hOffset", "0"))
        heading = self.place.heading_rad + turn
        up = np.array([0.0, 0.0, 1.0])
        for axis, angle in zip(np.eye(3), (*angles, heading), strict=True):
            up = Pose.from_rotvec(axis * angle, np.zeros(3)).rotation @ up
        foot = self.place.point_m + np.array([0.0, 0.0, self.z_offset_m])
        return np.asarray(foot + share * self.height_m * up)


def read_opendrive(path: Path, reading: Reading) -> Found:
    """Signs and poles of a file; SemvizError naming the road that is broken.

    Coordinates are those of the file, unless it has a georeference and the map's own is known.
    """
    root = read_xml(path, "OpenDRIVE")
    found = Found()
    roads: list[tuple[str, Element, RoadLine]] = []
    for road in root.iterfind("road"):
        where = f"{path}, road {quoted(road.get('id', ''))[1:-1]}"
        with at(where):
            roads.append((where, road, RoadLine.of(road)))
    lines = {road.get("id", ""): line for _, road, line in roads}
    for where, road, line in roads:
        with at(where):
            _read_objects(road, line, found, reading)
            _read_signals(road, line, lines, found, reading)
            shapes = len(road.findall("lateralProfile/shape"))
            found.tally.drop("lateralProfile shapes: roads are taken as flat across", shapes)
    _place_on_earth(root, found, reading)
    return found


def _read_objects(road: "Element", line: RoadLine, found: Found, reading: Reading) -> None:
    for one in road.iterfind("objects/object"):
        kind, name = one.get("type", ""), one.get("name", "")
        what = f"objects of type {quoted(kind)}: neither pole nor sign"
        class_id = _class_id([kind, kind.lower(), name], OBJECT_CLASSES, what, found, reading)
        if class_id is not None:
            for s, t, z_offset_m, height_m in _copies(one, found):
                standing = _standing(line.place(s, t), z_offset_m, height_m)
                _add(one, class_id, standing, found, reading)


def _read_signals(
    road: "Element", line: RoadLine, lines: Mapping[str, RoadLine], found: Found, reading: Reading
) -> None:
    for one in road.iterfind("signals/signal"):
        country, kind = one.get("country", ""), one.get("type", "")
        codes = codes_of(country, kind, one.get("subtype", ""))
        if one.get("dynamic") == "yes":
            found.tally.drop("signals that change, such as traffic lights: no signs")
            continue
        shown = codes[-1] if kind not in ("", "-1") else one.get("name", "")
        what = f"signals {quoted(shown)}: {how_to_map(shown)}"
        class_id = _class_id([*codes, one.get("name", "")], SIGN_CODES, what, found, reading)
        if class_id is not None:
            _add(one, class_id, _standing_of_signal(one, line, lines), found, reading)


def _class_id(
    codes: list[str], table: Mapping[str, int], what: str, found: Found, reading: Reading
) -> int | None:
    """The class; None, noted as ``what``, where nobody knows it, or it is ignored."""
    meant = reading.class_of_code(codes, table)
    if isinstance(meant, int):
        return meant
    found.tally.drop("things of a class that is ignored, as asked" if meant == IGNORE else what)
    return None


def _copies(one: "Element", found: Found) -> Iterator[tuple[float, float, float, float]]:
    """s, t, zOffset and height of an object: once, or of each copy where it is repeated."""
    repeats = one.findall("repeat")
    if not repeats:
        s, t = attribute(one, "s"), attribute(one, "t")
        yield s, t, attribute(one, "zOffset", "0"), attribute(one, "height", "0")
    for repeat in repeats:
        distance_m, length_m = attribute(repeat, "distance"), attribute(repeat, "length")
        if not distance_m > 0.0:
            found.tally.drop("objects that are repeated without a gap: no poles")
            continue
        if length_m / distance_m > MOST_ITEMS:
            raise SemvizError("an object repeated too often")
        for step in range(int(length_m / distance_m + 1e-9) + 1):
            along_m = step * distance_m
            share = along_m / length_m if length_m else 0.0
            t, z_offset_m, height_m = (
                _between(one, repeat, name, share) for name in ("t", "zOffset", "height")
            )
            yield attribute(repeat, "s") + along_m, t, z_offset_m, height_m


def _between(one: "Element", repeat: "Element", name: str, share: float) -> float:
    """A quantity of a copy, at a share of the way from the first copy to the last."""
    of_object = one.get(name, "0")
    first = attribute(repeat, f"{name}Start", of_object)
    return first + share * (attribute(repeat, f"{name}End", of_object) - first)


def _standing(place: Place | None, z_offset_m: float, height_m: float) -> _Standing | None:
    return None if place is None else _Standing(place, z_offset_m, height_m)


def _standing_of_signal(
    one: "Element", line: RoadLine, lines: Mapping[str, RoadLine]
) -> _Standing | None:
    """Where a signal physically is: beside another road, or in the file's own axes, if it says."""
    inertial, beside = one.find("positionInertial"), one.find("positionRoad")
    height_m = attribute(one, "height", "0")
    if inertial is not None:
        point = np.array([attribute(inertial, name) for name in "xyz"])
        return _Standing(Place(point, attribute(inertial, "hdg", "0")), 0.0, height_m)
    if beside is None:
        beside = one
    elif beside.get("roadId", "") not in lines:
        raise SemvizError(f"signal {quoted(one.get('id'))}: its road is missing")
    else:
        line = lines[beside.get("roadId", "")]
    place = line.place(attribute(beside, "s"), attribute(beside, "t"))
    return _standing(place, attribute(beside, "zOffset", "0"), height_m)


def _add(
    one: "Element", class_id: int, standing: _Standing | None, found: Found, reading: Reading
) -> None:
    if standing is None:
        return found.tally.drop(f"{one.tag}s beyond the end of their road")
    is_line = reading.classes[class_id].kind == "line"
    if standing.height_m <= 0.0 and is_line:
        return found.tally.drop("poles without a height: a pole has two ends")
    if standing.height_m <= 0.0:
        found.tally.assume("middles of signs: their lower edge where they have no height")
    id_ = whole(one.get("id"))
    if is_line:
        peak, foot = standing.above(one, 1.0), standing.above(one, 0.0)
        return found.add(Thing(class_id, peak, foot, id=id_))
    return found.add(Thing(class_id, standing.above(one, 0.5), id=id_))


def _place_on_earth(root: "Element", found: Found, reading: Reading) -> None:
    """Takes what was found from the file's coordinates to the map's, where both are on Earth."""
    header = root.find("header")
    reference = None if header is None else header.findtext("geoReference")
    place = reading.georeference()
    if header is None or not reference or not reference.strip():
        found.georeference = reading.anchor
        found.tally.assume("axes: the file's x, y and z are the map's")
        return
    if place is None:
        found.tally.drop("geoReference: without --anchor the file's x, y and z are the map's")
        return
    to_map = partial(_to_map, _transformer(reference), header, place)
    found.georeference = place
    found.things = [
        replace(
            one,
            anchor_m=to_map(one.anchor_m),
            end_m=None if one.end_m is None else to_map(one.end_m),
        )
        for one in found.things
    ]


def _transformer(reference: str) -> "Transformer":
    """From the file's projected coordinates to longitude and latitude."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    try:
        crs = CRS.from_user_input(reference.strip()).to_2d()
        return Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    except ProjError:
        raise SemvizError(f"geoReference {quoted(reference.strip())} is not understood") from None


def _to_map(
    transformer: "Transformer", header: "Element", place: Georeference, point_m: FloatArray
) -> FloatArray:
    """(3,) a point of the file in the map frame; heights are taken as above the ellipsoid."""
    offset = header.find("offset")
    if offset is not None:
        turn = Pose.from_rotvec(
            [0.0, 0.0, attribute(offset, "hdg", "0")],
            [attribute(offset, name, "0") for name in "xyz"],
        )
        point_m = turn.apply(point_m)
    x, y, z = point_m
    longitude, latitude = transformer.transform(x, y)
    return np.asarray(place.to_map(np.array([[longitude, latitude, z]]))[0])
