"""Lanelet2's OSM files, in and out: signs as lower edges with a height, poles as lines.

Tags as in Lanelet2's documentation (lanelet2_core, LinestringTagging): ``type=traffic_sign`` with
``subtype`` of region and number (``de205``). ``type=pole`` is ours: Lanelet2 lets new types be
added. What only we know is in tags ``semviz:...`` and attributes ``semviz_...`` of the root.
"""

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree  # for writing only; read with defusedxml

import numpy as np

from semviz_annotation.formats.numbers import number, quoted
from semviz_annotation.formats.reading import IGNORE, at
from semviz_annotation.map_formats.georeference import Georeference, needed
from semviz_annotation.map_formats.reading import (
    Found,
    Reading,
    Thing,
    attribute,
    how_to_map,
    read_xml,
    upper_first,
    whole,
)
from semviz_annotation.map_formats.sign_codes import SIGN_CODES
from semviz_annotation.map_formats.tally import Tally
from semviz_annotation.map_formats.writing import PLATE_M, across_road, drop_all_but_places
from semviz_core.arrays import FloatArray
from semviz_core.classes import POLE
from semviz_core.errors import SemvizError
from semviz_core.files import replacing
from semviz_core.semantic_map import SemanticMap

CLASS, ELEMENT = "semviz:class", "semviz:id"
ANCHOR_KNOWN, END_KNOWN, NO = "semviz:anchor_known", "semviz:end_known", "no"
POLE_TYPE, SIGN_TYPE = "pole", "traffic_sign"
_PLACE = ("anchor_latitude", "anchor_longitude", "anchor_height", "x_heading_deg")


def write_lanelet2(
    semantic_map: SemanticMap, path: Path, georeference: Georeference | None
) -> Tally:
    """Write ways; a sign's is its lower edge, from the left to the right of who drives past."""
    place = needed(georeference, "Lanelet2's files are in latitude and longitude")
    elements = semantic_map.elements
    half = 0.5 * PLATE_M * across_road(semantic_map)
    below = elements.anchor_m - [0.0, 0.0, 0.5 * PLATE_M]
    lines = elements.is_line[:, None]
    first = place.to_wgs84(np.where(lines, elements.anchor_m, below - half))
    second = place.to_wgs84(np.where(lines, elements.end_m, below + half))
    root = _root(semantic_map.frame.name, place)
    for node_id, node in enumerate(np.stack([first, second], axis=1).reshape(-1, 3), 1):
        _add_node(root, node_id, node)
    for row, is_line in enumerate(elements.is_line.tolist()):
        way_id = 2 * len(elements) + 1 + row  # ids of ways and nodes do not meet
        _add_way(root, way_id, (2 * row + 1, 2 * row + 2), _tags(semantic_map, row, is_line))
    ElementTree.indent(root)
    with replacing(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
    tally = Tally()
    drop_all_but_places(semantic_map, tally)
    signs = int((~elements.is_line).sum())
    tally.assume(f"plates of signs: {PLATE_M:g} m wide and high, facing the road", signs)
    tally.assume("numbers of signs (subtype): none, a map knows the shape only", signs)
    return tally


def _root(frame: str, place: Georeference) -> ElementTree.Element:
    """The outermost element, which says of which map it is."""
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
        tags["height"] = f"{PLATE_M:g}"
    if not elements.anchor_known[row]:
        tags[ANCHOR_KNOWN] = NO
    if is_line and not elements.end_known[row]:
        tags[END_KNOWN] = NO
    return tags


def read_lanelet2(path: Path, reading: Reading) -> Found:
    """Signs and poles of a file, ours or another's; SemvizError naming the way that is broken."""
    root = read_xml(path, "osm")
    ours = root.get("semviz_frame")
    reading.check_frame(ours)
    place = needed(reading.georeference(_anchor(root)), "the file is in latitude and longitude")
    found = Found(georeference=place)
    nodes = {one.get("id", ""): one for one in root.iterfind("node")}
    for way in root.iterfind("way"):
        with at(f"{path}, way {quoted(way.get('id', ''))[1:-1]}"):
            tags = {tag.get("k", ""): tag.get("v", "") for tag in way.iterfind("tag")}
            class_id = _class_id(tags, found.tally, reading)
            if class_id is not None:
                points = place.to_map(_places(way, nodes, found.tally))
                _add(points, class_id, tags, way, found, reading)
    found.tally.drop("relations (lanelets, areas, rules)", len(root.findall("relation")))
    return found


def _anchor(root: ElementTree.Element) -> Georeference | None:
    if root.get("semviz_frame") is None:
        return None
    return Georeference(*(attribute(root, f"semviz_{name}") for name in _PLACE))


def _class_id(tags: Mapping[str, str], tally: Tally, reading: Reading) -> int | None:
    """The class of a way; None where it is neither pole nor sign, or nobody knows which."""
    if CLASS in tags:
        return reading.class_id(tags[CLASS])
    kind, subtype = tags.get("type", ""), tags.get("subtype", "")
    if kind == SIGN_TYPE:
        meant = reading.class_of_code(_codes(subtype), SIGN_CODES)
    else:
        meant = reading.class_of_code([kind], {POLE_TYPE: POLE})
    if isinstance(meant, int):
        return meant
    if meant == IGNORE:
        tally.drop("ways of a class that is ignored, as asked")
    elif kind == SIGN_TYPE:
        tally.drop(f"signs {quoted(subtype)}: {how_to_map(subtype)}")
    else:
        tally.drop(f"ways of type {quoted(kind)}: neither sign nor pole")
    return None


def _codes(subtype: str) -> list[str]:
    """As in the file, and as in the table, where ``de274_1`` is ``de274.1``."""
    plain = subtype.lower().replace("_", ".")
    return [subtype, plain, plain.partition("-")[0]]


def _places(
    way: ElementTree.Element, nodes: Mapping[str, ElementTree.Element], tally: Tally
) -> FloatArray:
    """(k, 3) longitude, latitude and height of a way's nodes."""
    rows = []
    for reference in way.iterfind("nd"):
        node = nodes.get(reference.get("ref", ""))
        if node is None:
            raise SemvizError(f"node {quoted(reference.get('ref'))} is missing")
        heights = [tag.get("v", "") for tag in node.iterfind("tag") if tag.get("k") == "ele"]
        if not heights:
            tally.assume("heights: 0 where a node has no ele, as Lanelet2 has it")
        height = number(heights[0]) if heights else 0.0
        rows.append([attribute(node, "lon"), attribute(node, "lat"), height])
    if len(rows) < 2:
        raise SemvizError("a line with less than 2 nodes")
    return np.array(rows)


def _add(
    points: FloatArray, class_id: int, tags: Mapping[str, str], way: ElementTree.Element,
    found: Found, reading: Reading,
) -> None:  # fmt: skip
    id_ = whole(tags.get(ELEMENT, way.get("id")))
    anchor_known, end_known = (tags.get(name) != NO for name in (ANCHOR_KNOWN, END_KNOWN))
    if reading.classes[class_id].kind == "line":
        peak, bottom = points[0], points[-1]
        if CLASS not in tags:  # of others: in any order
            peak, bottom = upper_first(peak, bottom)
        found.add(Thing(class_id, peak, bottom, id_, None, anchor_known, end_known))
        return
    middle = 0.5 * (points[0] + points[-1])
    if "height" in tags:
        middle = middle + np.array([0.0, 0.0, 0.5 * number(tags["height"])])
    else:
        found.tally.assume("middles of signs: their lower edge where they have no height")
    found.add(Thing(class_id, middle, None, id_, None, anchor_known))
