"""Lanelet2's OSM files in and out: signs as lower edges with a height, poles as lines.

Extracts of OpenStreetMap are read too: nodes with tags of street lamps, poles and traffic signs.

Tags follow Lanelet2's documentation (lanelet2_core, LinestringTagging): ``type=traffic_sign``
with ``subtype`` of region and number (``de205``). ``type=pole`` is a semviz type; Lanelet2
allows new ones. Data that only semviz reads is in tags ``semviz:...`` and root attributes
``semviz_...``.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree  # for writing only; read with defusedxml

import numpy as np

from semviz_annotation.label_formats.reading import IGNORE, at, number, quoted
from semviz_annotation.map_formats import conversion
from semviz_annotation.map_formats.attributes import parsed_attributes
from semviz_annotation.map_formats.georeference import (
    Georeference,
    fitted_georeference,
    require_georeference,
)
from semviz_annotation.map_formats.sign_codes import OSM_TAGS, sign_class
from semviz_core.base.classes import POLE, parse_triangle_center
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing

NEEDS_PLACE = "Lanelet2's files are in latitude and longitude"
"""Why an export needs the place of the map's origin."""
CLASS, ELEMENT = "semviz:class", "semviz:id"
ATTRIBUTE = "semviz:attribute:"
"""Prefix of a tag; the name of the attribute follows."""
ANCHOR_KNOWN, END_KNOWN, NO = "semviz:anchor_known", "semviz:end_known", "no"
POLE_TYPE, SIGN_TYPE = "pole", "traffic_sign"
_PLACE = ("anchor_latitude", "anchor_longitude", "anchor_height", "x_heading_deg")


def write_lanelet2(
    semantic_map: SemanticMap, path: Path, georeference: Georeference | None
) -> conversion.ConversionTally:
    """Write ways; a sign's way is its lower edge, from left to right in driving direction."""
    place = require_georeference(georeference, NEEDS_PLACE)
    elements = semantic_map.elements
    half = 0.5 * conversion.PLATE_M * conversion.across_road(semantic_map)
    below = elements.anchor_m - [0.0, 0.0, 0.5 * conversion.PLATE_M]
    lines = elements.is_line[:, None]
    first = place.to_wgs84(np.where(lines, elements.anchor_m, below - half))
    second = place.to_wgs84(np.where(lines, elements.end_m, below + half))
    root = _root(semantic_map.frame.name, place)
    root.set("semviz_triangle_center", semantic_map.triangle_center)
    for node_id, node in enumerate(np.stack([first, second], axis=1).reshape(-1, 3), 1):
        _add_node(root, node_id, node)
    for row, is_line in enumerate(elements.is_line.tolist()):
        way_id = 2 * len(elements) + 1 + row  # ids of ways and nodes do not meet
        _add_way(root, way_id, (2 * row + 1, 2 * row + 2), _tags(semantic_map, row, is_line))
    ElementTree.indent(root)
    with replacing(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
    tally = conversion.ConversionTally()
    conversion.drop_all_but_places(semantic_map, tally)
    signs = int((~elements.is_line).sum())
    tally.assume(f"plates of signs: {conversion.PLATE_M:g} m wide and high, facing the road", signs)
    tally.assume("numbers of signs (subtype): none, a map knows the shape only", signs)
    return tally


def _root(frame: str, place: Georeference) -> ElementTree.Element:
    """Return the root element, which names the map frame and its origin."""
    about = zip(_PLACE, (*place.origin, place.x_heading_deg), strict=True)
    own = {f"semviz_{name}": repr(float(value)) for name, value in about}
    head = {"version": "0.6", "generator": "semviz", "semviz_frame": frame}
    return ElementTree.Element("osm", head | own)


def _add_node(root: ElementTree.Element, node_id: int, place: FloatArray) -> None:
    longitude, latitude, height = place
    node = ElementTree.SubElement(
        root, "node", id=str(node_id), visible="true", version="1",
        lat=f"{latitude:.11f}", lon=f"{longitude:.11f}",
    )  # fmt: skip
    ElementTree.SubElement(node, "tag", k="ele", v=f"{height:.5f}")


def _add_way(
    root: ElementTree.Element, way_id: int, nodes: tuple[int, int], tags: Mapping[str, str]
) -> None:
    way = ElementTree.SubElement(root, "way", id=str(way_id), visible="true", version="1")
    for node_id in nodes:
        ElementTree.SubElement(way, "nd", ref=str(node_id))
    for key, value in tags.items():
        ElementTree.SubElement(way, "tag", k=key, v=value)


def _tags(semantic_map: SemanticMap, row: int, is_line: bool) -> dict[str, str]:
    elements = semantic_map.elements
    tags = {
        "type": POLE_TYPE if is_line else SIGN_TYPE,
        CLASS: semantic_map.classes[int(elements.class_id[row])].name,
        ELEMENT: str(int(elements.id[row])),
    }
    if not is_line:
        tags["height"] = f"{conversion.PLATE_M:g}"
    odds = semantic_map.provenance[row].log_odds if semantic_map.provenance else None
    if odds is not None:
        tags[f"semviz:{conversion.LOG_ODDS}"] = f"{odds:.3f}"
    for name, value in semantic_map.attributes.get(int(elements.id[row]), {}).items():
        tags[f"{ATTRIBUTE}{name}"] = value
    if not elements.anchor_known[row]:
        tags[ANCHOR_KNOWN] = NO
    if is_line and not elements.end_known[row]:
        tags[END_KNOWN] = NO
    return tags


@dataclass(frozen=True)
class _Coordinates:
    """Which coordinates of the nodes count: degrees, or the local ones if there is no place."""

    place: Georeference | None
    level_m: float
    """Height of nodes without one."""

    def points(
        self, nodes: Sequence[ElementTree.Element], tally: conversion.ConversionTally
    ) -> FloatArray:
        """Return the points (k, 3) of nodes in the map."""
        places = self.places(nodes, tally)
        return places if self.place is None else self.place.to_map(places)

    def places(
        self, nodes: Sequence[ElementTree.Element], tally: conversion.ConversionTally
    ) -> FloatArray:
        """Return longitude, latitude and height (k, 3), or local coordinates."""
        rows = []
        for node in nodes:
            tags = _tags_of(node)
            if "ele" not in tags and self.level_m:
                tally.assume("heights: that of the map's origin, as no node has an ele")
            elif "ele" not in tags:
                tally.assume("heights: 0 where a node has no ele, as Lanelet2 has it")
            height = number(tags["ele"]) if "ele" in tags else self.level_m
            if self.place is None:
                rows.append([number(tags["local_x"]), number(tags["local_y"]), height])
            else:
                rows.append(
                    [*(conversion.attribute(node, name) for name in ("lon", "lat")), height]
                )
        return np.array(rows)


def read_lanelet2(path: Path, context: conversion.MapImportContext) -> conversion.ParsedMap:
    """Return the content of a file of semviz or another tool. Raise SemvizError if invalid."""
    root = conversion.read_xml(path, "osm")
    ours = root.get("semviz_frame")
    context.check_frame(ours)
    nodes = {node.get("id", ""): node for node in root.iterfind("node")}
    place = context.georeference(_anchor(root))
    has_degrees = all(node.get("lat") and node.get("lon") for node in nodes.values())
    is_local = _has_local_coordinates(nodes.values()) and not (place and has_degrees)
    if not is_local:
        require_georeference(place, "the file is in latitude and longitude")
    elif place is None and has_degrees:
        place = _fitted(list(nodes.values()))
    center = parse_triangle_center(root.get("semviz_triangle_center"))
    parsed = conversion.ParsedMap(georeference=place, triangle_center=center)
    if is_local:
        parsed.tally.assume("coordinates: local_x, local_y and ele of the nodes are the map's")
    has_heights = any("ele" in _tags_of(node) for node in nodes.values())
    level_m = 0.0 if has_heights or place is None else place.height_m
    coordinates = _Coordinates(None if is_local else place, level_m)
    for way in root.iterfind("way"):
        with at(f"{path}, way {quoted(way.get('id', ''))[1:-1]}"):
            tags = _tags_of(way)
            class_id = _class_id(tags, parsed.tally, context)
            if class_id is not None:
                points = coordinates.points(_nodes_of(way, nodes), parsed.tally)
                _add(points, class_id, tags, way, parsed, context)
    for id_, node in nodes.items():
        with at(f"{path}, node {quoted(id_)[1:-1]}"):
            _read_node(node, coordinates, parsed, context)
    parsed.tally.drop("relations (lanelets, areas, rules)", len(root.findall("relation")))
    return parsed


def _tags_of(element: ElementTree.Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iterfind("tag")}


def _has_local_coordinates(nodes: Iterable[ElementTree.Element]) -> bool:
    """Whether all nodes have ``local_x`` and ``local_y``, as in files of Autoware."""
    return all({"local_x", "local_y"} <= _tags_of(node).keys() for node in nodes)


def _read_node(
    node: ElementTree.Element,
    coordinates: _Coordinates,
    parsed: conversion.ParsedMap,
    context: conversion.MapImportContext,
) -> None:
    """Read a street lamp, pole or sign of OpenStreetMap; nodes of lines have no such tags."""
    tags = _tags_of(node)
    if not tags.keys() & {"traffic_sign", *(key for key, _ in OSM_TAGS)}:
        return None
    class_id = context.class_of_tags(tags)
    if not isinstance(class_id, int):
        sign = tags.get("traffic_sign")
        if class_id == IGNORE:
            parsed.tally.drop("nodes of a class that is ignored, as asked")
        elif sign is not None:
            parsed.tally.drop(f"signs {quoted(sign)}: {conversion.how_to_map(sign)}")
        return None
    [point_m] = coordinates.points([node], parsed.tally)
    id_ = conversion.parse_integer(node.get("id"))
    if context.classes[class_id].kind != "line":
        middle_m = conversion.raised(point_m, context, parsed)
        return parsed.add(conversion.ParsedElement(class_id, middle_m, None, id_))
    height = conversion.height_of_pole(tags.get("height"), context, parsed)
    if height is None:
        return None
    peak_m = point_m + np.array([0.0, 0.0, height])
    return parsed.add(conversion.ParsedElement(class_id, peak_m, point_m, id_))


def _anchor(root: ElementTree.Element) -> Georeference | None:
    if root.get("semviz_frame") is None:
        return None
    return Georeference(*(conversion.attribute(root, f"semviz_{name}") for name in _PLACE))


def _class_id(
    tags: Mapping[str, str], tally: conversion.ConversionTally, context: conversion.MapImportContext
) -> int | None:
    """Return the class of a way; None if it is no pole or sign, or of an unknown class."""
    if CLASS in tags:
        return context.class_id(tags[CLASS])
    kind, subtype = tags.get("type", ""), tags.get("subtype", "")
    if kind == SIGN_TYPE:
        class_id = context.class_of_code([subtype], sign_class)
    else:
        class_id = context.class_of_code([kind], {POLE_TYPE: POLE}.get)
    if isinstance(class_id, int):
        return class_id
    if class_id == IGNORE:
        tally.drop("ways of a class that is ignored, as asked")
    elif kind == SIGN_TYPE:
        tally.drop(f"signs {quoted(subtype)}: {conversion.how_to_map(subtype)}")
    else:
        tally.drop(f"ways of type {quoted(kind)}: neither sign nor pole")
    return None


def _nodes_of(
    way: ElementTree.Element, nodes: Mapping[str, ElementTree.Element]
) -> list[ElementTree.Element]:
    """Return the nodes of a way, one or more."""
    found = []
    for reference in way.iterfind("nd"):
        node = nodes.get(reference.get("ref", ""))
        if node is None:
            raise SemvizError(f"node {quoted(reference.get('ref'))} is missing")
        found.append(node)
    if not found:
        raise SemvizError("a line without nodes")
    return found


def _fitted(nodes: list[ElementTree.Element]) -> Georeference | None:
    """Return where nodes with both coordinates are on Earth; None if the two do not agree."""
    tally = conversion.ConversionTally()
    places = _Coordinates(Georeference(0.0, 0.0), 0.0).places(nodes, tally)
    return fitted_georeference(_Coordinates(None, 0.0).points(nodes, tally), places)


def _add(
    points: FloatArray, class_id: int, tags: Mapping[str, str], way: ElementTree.Element,
    parsed: conversion.ParsedMap, context: conversion.MapImportContext,
) -> None:  # fmt: skip
    id_ = conversion.parse_integer(tags.get(ELEMENT, way.get("id")))
    own = {key.removeprefix(ATTRIBUTE): tags[key] for key in tags if key.startswith(ATTRIBUTE)}
    attributes = parsed_attributes(own)
    anchor_known, end_known = (tags.get(name) != NO for name in (ANCHOR_KNOWN, END_KNOWN))
    if context.classes[class_id].kind == "line":
        if len(points) < 2:
            return parsed.tally.drop("poles that are ways of one node: a pole has two ends")
        peak, bottom = points[0], points[-1]
        if CLASS not in tags:  # other tools: in any order
            peak, bottom = conversion.upper_first(peak, bottom)
        parsed.add(
            conversion.ParsedElement(
                class_id, peak, bottom, id_, None, anchor_known, end_known, attributes=attributes
            )
        )
        return None
    middle = 0.5 * (points[0] + points[-1])
    if "height" in tags:
        middle = middle + np.array([0.0, 0.0, 0.5 * number(tags["height"])])
    else:
        parsed.tally.assume("middles of signs: their lower edge where they have no height")
    parsed.add(
        conversion.ParsedElement(
            class_id, middle, None, id_, None, anchor_known, attributes=attributes
        )
    )
    return None
