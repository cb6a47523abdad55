"""OpenDRIVE (.xodr), in: signals and objects, placed along their roads.

ASAM OpenDRIVE 1.8, chapters 13 (objects) and 14 (signals): ``zOffset`` is the height of a
signal's lower edge, and of an object's foot, above the road.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semviz_annotation.label_formats.reading import IGNORE, MOST_ITEMS, at, quoted
from semviz_annotation.map_formats import conversion
from semviz_annotation.map_formats.georeference import FURTHEST_M, Georeference
from semviz_annotation.map_formats.reference_line import RoadLine, RoadPose
from semviz_annotation.map_formats.sign_codes import (
    VIENNA,
    codes_of,
    has_catalogue,
    is_like_germany,
    sign_class,
)
from semviz_core.base.classes import POLE
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from pyproj import Transformer

OBJECT_CLASSES: Mapping[str, int] = {"pole": POLE, "streetlamp": POLE}
"""Object type, in lower case -> class."""


@dataclass(frozen=True)
class _Standing:
    """An object or signal at one position."""

    place: RoadPose
    z_offset_m: float
    height_m: float

    def above(self, element: "Element", share: float) -> FloatArray:
        """Return the point (3,) at a share of its height along its own, perhaps tilted, z axis.

        ``hdg`` (``hOffset`` of signals), ``pitch`` and ``roll`` rotate about z, y and x, in this
        order, each about the rotated axes.
        """
        angles = [conversion.attribute(element, name, "0") for name in ("roll", "pitch")]
        turn = conversion.attribute(element, "hdg", element.get("hOffset", "0"))
        heading = self.place.heading_rad + turn
        up = np.array([0.0, 0.0, 1.0])
        for axis, angle in zip(np.eye(3), (*angles, heading), strict=True):
            up = Pose.from_rotvec(axis * angle, np.zeros(3)).rotation @ up
        foot = self.place.point_m + np.array([0.0, 0.0, self.z_offset_m])
        return np.asarray(foot + share * self.height_m * up)


def read_opendrive(path: Path, context: conversion.MapImportContext) -> conversion.ParsedMap:
    """Return the signs and poles of a file. Raise SemvizError, naming an invalid road.

    Coordinates are those of the file, unless both the file and the map have a georeference.
    """
    root = conversion.read_xml(path, "OpenDRIVE")
    parsed = conversion.ParsedMap()
    roads: list[tuple[str, Element, RoadLine]] = []
    for road in root.iterfind("road"):
        where = f"{path}, road {quoted(road.get('id', ''))[1:-1]}"
        with at(where):
            roads.append((where, road, RoadLine.of(road)))
    lines = {road.get("id", ""): line for _, road, line in roads}
    for where, road, line in roads:
        with at(where):
            _read_objects(road, line, parsed, context)
            _read_signals(road, line, lines, parsed, context)
            shapes = len(road.findall("lateralProfile/shape"))
            parsed.tally.drop("lateralProfile shapes: roads are taken as flat across", shapes)
    _place_on_earth(root, parsed, context)
    return parsed


def _read_objects(
    road: "Element",
    line: RoadLine,
    parsed: conversion.ParsedMap,
    context: conversion.MapImportContext,
) -> None:
    for element in road.iterfind("objects/object"):
        kind, name = element.get("type", ""), element.get("name", "")
        what = f"objects of type {quoted(kind)}: neither pole nor sign"
        class_id = _class_id([kind, kind.lower(), name], OBJECT_CLASSES.get, what, parsed, context)
        if class_id is not None:
            for s, t, z_offset_m, height_m in _copies(element, parsed):
                standing = _standing(line.place(s, t), z_offset_m, height_m)
                _add(element, class_id, standing, parsed, context)


def _read_signals(
    road: "Element",
    line: RoadLine,
    lines: Mapping[str, RoadLine],
    parsed: conversion.ParsedMap,
    context: conversion.MapImportContext,
) -> None:
    for element in road.iterfind("signals/signal"):
        country, kind = element.get("country", ""), element.get("type", "")
        codes = codes_of(country, kind, element.get("subtype", ""))
        if element.get("dynamic") == "yes":
            parsed.tally.drop("signals that change, such as traffic lights: no signs")
            continue
        if is_like_germany(country) and sign_class(codes[-1]) is not None:
            parsed.tally.assume(
                "numbers of signs without a country, or of OpenDRIVE: as in Germany"
            )
        shown = codes[-1] if kind not in ("", "-1") else element.get("name", "")
        what = f"signals {quoted(shown)}: {conversion.how_to_map(shown)}"
        letters = [] if has_catalogue(country) else [f"{VIENNA}{kind}"]
        names = [*codes, *letters, element.get("name", "")]
        class_id = _class_id(names, sign_class, what, parsed, context)
        if class_id is not None and class_id in map(sign_class, letters):
            parsed.tally.assume(f"signs of {quoted(country)}: by the Vienna Convention's letters")
        if class_id is not None:
            _add(element, class_id, _standing_of_signal(element, line, lines), parsed, context)


def _class_id(
    codes: list[str],
    find: Callable[[str], int | None],
    what: str,
    parsed: conversion.ParsedMap,
    context: conversion.MapImportContext,
) -> int | None:
    """Return the class; None if it is unknown (counted as ``what``) or ignored."""
    class_id = context.class_of_code(codes, find)
    if isinstance(class_id, int):
        return class_id
    parsed.tally.drop("things of a class that is ignored, as asked" if class_id == IGNORE else what)
    return None


def _copies(
    element: "Element", parsed: conversion.ParsedMap
) -> Iterator[tuple[float, float, float, float]]:
    """Return s, t, zOffset and height of an object, or of each copy if it is repeated."""
    repeats = element.findall("repeat")
    if not repeats:
        s, t = conversion.attribute(element, "s"), conversion.attribute(element, "t")
        yield (
            s,
            t,
            conversion.attribute(element, "zOffset", "0"),
            conversion.attribute(element, "height", "0"),
        )
    for repeat in repeats:
        distance_m, length_m = (
            conversion.attribute(repeat, "distance"),
            conversion.attribute(repeat, "length"),
        )
        if not distance_m > 0.0:
            parsed.tally.drop("objects that are repeated without a gap: no poles")
            continue
        if length_m / distance_m > MOST_ITEMS:
            raise SemvizError("an object repeated too often")
        for step in range(int(length_m / distance_m + 1e-9) + 1):
            along_m = step * distance_m
            share = along_m / length_m if length_m else 0.0
            t, z_offset_m, height_m = (
                _between(element, repeat, name, share) for name in ("t", "zOffset", "height")
            )
            yield conversion.attribute(repeat, "s") + along_m, t, z_offset_m, height_m


def _between(element: "Element", repeat: "Element", name: str, share: float) -> float:
    """Interpolate a quantity of a copy, at a share of the way from the first to the last."""
    of_object = element.get(name, "0")
    first = conversion.attribute(repeat, f"{name}Start", of_object)
    return first + share * (conversion.attribute(repeat, f"{name}End", of_object) - first)


def _standing(place: RoadPose | None, z_offset_m: float, height_m: float) -> _Standing | None:
    return None if place is None else _Standing(place, z_offset_m, height_m)


def _standing_of_signal(
    element: "Element", line: RoadLine, lines: Mapping[str, RoadLine]
) -> _Standing | None:
    """Return the physical position of a signal, which may be at another road or in file axes."""
    inertial, beside = element.find("positionInertial"), element.find("positionRoad")
    height_m = conversion.attribute(element, "height", "0")
    if inertial is not None:
        point = np.array([conversion.attribute(inertial, name) for name in "xyz"])
        return _Standing(RoadPose(point, conversion.attribute(inertial, "hdg", "0")), 0.0, height_m)
    if beside is None:
        beside = element
    elif beside.get("roadId", "") not in lines:
        raise SemvizError(f"signal {quoted(element.get('id'))}: its road is missing")
    else:
        line = lines[beside.get("roadId", "")]
    place = line.place(conversion.attribute(beside, "s"), conversion.attribute(beside, "t"))
    return _standing(place, conversion.attribute(beside, "zOffset", "0"), height_m)


def _add(
    element: "Element",
    class_id: int,
    standing: _Standing | None,
    parsed: conversion.ParsedMap,
    context: conversion.MapImportContext,
) -> None:
    if standing is None:
        return parsed.tally.drop(f"{element.tag}s beyond the end of their road")
    is_line = context.classes[class_id].kind == "line"
    if standing.height_m <= 0.0 and is_line:
        return parsed.tally.drop("poles without a height: a pole has two ends")
    if standing.height_m <= 0.0:
        parsed.tally.assume("middles of signs: their lower edge where they have no height")
    id_ = conversion.parse_integer(element.get("id"))
    if is_line:
        peak, foot = standing.above(element, 1.0), standing.above(element, 0.0)
        return parsed.add(conversion.ParsedElement(class_id, peak, foot, id=id_))
    return parsed.add(conversion.ParsedElement(class_id, standing.above(element, 0.5), id=id_))


def _place_on_earth(
    root: "Element", parsed: conversion.ParsedMap, context: conversion.MapImportContext
) -> None:
    """Transform the elements to map coordinates if file and map are both georeferenced."""
    header = root.find("header")
    reference = None if header is None else header.findtext("geoReference")
    place = context.georeference()
    if header is None or not reference or not reference.strip():
        parsed.georeference = context.anchor
        parsed.tally.assume("axes: the file's x, y and z are the map's")
        return
    if place is None:
        _take_origin(header, reference, parsed)
        return
    to_map = partial(_to_map, _transformer(reference), header, place)
    parsed.georeference = place
    parsed.elements = [
        replace(
            element,
            anchor_m=to_map(element.anchor_m),
            end_m=None if element.end_m is None else to_map(element.end_m),
        )
        for element in parsed.elements
    ]


def _take_origin(header: "Element", reference: str, parsed: conversion.ParsedMap) -> None:
    """Take the file's offset, or a whole kilometre near its elements, as the map's origin.

    Where that is on Earth becomes the map's georeference.
    """
    points = np.array([element.anchor_m for element in parsed.elements]).reshape(-1, 3)
    moved = np.zeros(3)
    if len(points) and np.abs(points[:, :2]).max() > FURTHEST_M:
        moved[:2] = np.round(points[0, :2] / 1000.0) * 1000.0
        parsed.elements = [
            replace(
                element,
                anchor_m=element.anchor_m - moved,
                end_m=None if element.end_m is None else element.end_m - moved,
            )
            for element in parsed.elements
        ]
    transformer = _transformer(reference)
    ahead = moved + np.array([1.0, 0.0, 0.0])
    origin, east = (_on_earth(transformer, header, point_m) for point_m in (moved, ahead))
    here = Georeference(float(origin[1]), float(origin[0]), float(origin[2]))
    x, y, _ = here.to_map(east[None])[0]
    heading_deg = float(np.rad2deg(np.arctan2(x, y)) % 360.0)
    parsed.georeference = Georeference(*here.origin, heading_deg)
    shift = "" if not moved.any() else f", moved by {-moved[0]:.0f}, {-moved[1]:.0f} m"
    parsed.tally.assume(
        f"origin: that of the file{shift}, at latitude {origin[1]:.6f}, longitude {origin[0]:.6f}; "
        "give --anchor if the map's is elsewhere"
    )


def _transformer(reference: str) -> "Transformer":
    """Return the transform from projected coordinates to longitude and latitude."""
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
    """Return a point (3,) of the file in the map frame; heights are above the ellipsoid."""
    return np.asarray(place.to_map(_on_earth(transformer, header, point_m)[None])[0])


def _on_earth(transformer: "Transformer", header: "Element", point_m: FloatArray) -> FloatArray:
    """Return longitude, latitude and height (3,) of a point of the file."""
    offset = header.find("offset")
    if offset is not None:
        turn = Pose.from_rotvec(
            [0.0, 0.0, conversion.attribute(offset, "hdg", "0")],
            [conversion.attribute(offset, name, "0") for name in "xyz"],
        )
        point_m = turn.apply(point_m)
    x, y, z = point_m
    longitude, latitude = transformer.transform(x, y)
    return np.array([longitude, latitude, z])
