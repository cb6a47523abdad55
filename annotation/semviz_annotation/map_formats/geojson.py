"""GeoJSON (RFC 7946) in and out: longitude and latitude of WGS84, ellipsoidal height.

A pole is a LineString from its peak to its bottom, a sign a Point. The member ``semviz`` of a
written file names the map frame and its origin.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from semviz_annotation.label_formats.reading import (
    MOST_JSON_BYTES,
    as_flag,
    as_object,
    as_text,
    at,
    json_number,
    listed,
    quoted,
    read_bytes,
    read_json,
)
from semviz_annotation.map_formats import conversion
from semviz_annotation.map_formats.attributes import parsed_attributes
from semviz_annotation.map_formats.conversion import LOG_ODDS, ConversionTally, as_json, drop_making
from semviz_annotation.map_formats.georeference import Georeference, require_georeference
from semviz_core.base.classes import parse_triangle_center
from semviz_core.base.semantic_map import Provenance, SemanticMap
from semviz_core.common.arrays import FloatArray, float_array
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

NEEDS_PLACE = "GeoJSON is in longitude and latitude"
"""Why an export needs the place of the map's origin."""
DIGITS_DEG, DIGITS_M = 10, 5
"""Decimals: 0.01 mm."""
ROAD = "road"
"""Name of the feature that holds ``SemanticMap.trajectory_m``."""
OTHER_TAGS = "other_tags"
"""Property of GDAL's exports of OpenStreetMap with the tags that have no column."""
_HSTORE = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')
_WGS84 = ("CRS84", "4326", "4979")
_OURS = frozenset({"class", "id", "anchor_known", "end_known", "covariance_enu_m2", "label_ids",
                   "observation_ids", LOG_ODDS, "height", "attributes", "@id", "osm_id",
                   OTHER_TAGS})  # fmt: skip


def write_geojson(
    semantic_map: SemanticMap, path: Path, georeference: Georeference | None
) -> ConversionTally:
    """Write the map with all data of its elements. Raise SemvizError without a georeference."""
    place = require_georeference(georeference, NEEDS_PLACE)
    features = _features(semantic_map, place)
    if len(semantic_map.trajectory_m) > 1:
        road = rounded(place.to_wgs84(semantic_map.trajectory_m))
        features.append(feature("LineString", road, {"semviz": ROAD}))
    write_collection(
        path, semantic_map, place, {"triangle_center": semantic_map.triangle_center}, features
    )
    tally = ConversionTally()
    drop_making(semantic_map, tally)
    return tally


def write_collection(
    path: Path,
    semantic_map: SemanticMap,
    place: Georeference,
    about: Mapping[str, Any],
    features: Sequence[Mapping[str, Any]],
) -> None:
    """Write features of a map, one a line, with the map's origin and what the file is ``about``."""
    origin = {"anchor": place.origin, "x_heading_deg": place.x_heading_deg}
    collection = {
        "type": "FeatureCollection",
        "semviz": {"frame": semantic_map.frame.name, **origin, **about},
    }
    lines = ",\n".join(as_json(one) for one in features)
    with replacing(path) as temporary:
        temporary.write_text(
            f'{as_json(collection)[:-1]}, "features": [\n{lines}\n]}}\n', encoding="utf-8"
        )


def _features(semantic_map: SemanticMap, place: Georeference) -> list[dict[str, Any]]:
    elements = semantic_map.elements
    anchors, ends = (
        rounded(place.to_wgs84(points))
        for points in (elements.anchor_m, np.nan_to_num(elements.end_m))
    )
    J = np.kron(np.eye(2), place.rotation)
    covariances = J @ elements.covariance_m2 @ J.T
    provenance = semantic_map.provenance or (Provenance(),) * len(elements)
    features = []
    for row, is_line in enumerate(elements.is_line.tolist()):
        size = 6 if is_line else 3
        properties = {
            "class": semantic_map.classes[int(elements.class_id[row])].name,
            "anchor_known": bool(elements.anchor_known[row]),
            "covariance_enu_m2": covariances[row, :size, :size].tolist(),
            "label_ids": provenance[row].label_ids,
            "observation_ids": provenance[row].observation_ids,
        }
        attributes = semantic_map.attributes.get(int(elements.id[row]), {})
        if attributes:
            properties["attributes"] = attributes
        if provenance[row].log_odds is not None:
            properties[LOG_ODDS] = provenance[row].log_odds
        if is_line:
            properties["end_known"] = bool(elements.end_known[row])
        coordinates = [anchors[row], ends[row]] if is_line else anchors[row]
        kind = "LineString" if is_line else "Point"
        features.append(feature(kind, coordinates, properties, int(elements.id[row])))
    return features


def feature(
    kind: str, coordinates: object, properties: Mapping[str, Any], id_: int | None = None
) -> dict[str, Any]:
    """Return a feature of GeoJSON; ``coordinates`` are ``rounded``."""
    geometry = {"type": kind, "coordinates": coordinates}
    named = {} if id_ is None else {"id": id_}
    return {"type": "Feature", **named, "geometry": geometry, "properties": dict(properties)}


def rounded(places: FloatArray) -> list[list[float]]:
    """Return longitudes, latitudes and heights (n, 3) as they are written."""
    degrees, heights = np.round(places[:, :2], DIGITS_DEG), np.round(places[:, 2:], DIGITS_M)
    values: list[list[float]] = np.concatenate([degrees, heights], axis=1).tolist()
    return values


def read_geojson(path: Path, context: conversion.MapImportContext) -> conversion.ParsedMap:
    """Return the content of a file of semviz or another tool. Raise SemvizError if invalid."""
    document = as_object(read_json(read_bytes(path, MOST_JSON_BYTES)))
    if document.get("type") != "FeatureCollection":
        raise SemvizError("JSON, but no FeatureCollection of GeoJSON")
    _check_crs(document.get("crs"))
    ours = document.get("semviz")
    about = as_object(ours) if ours is not None else {}
    context.check_frame(about.get("frame"))
    place = require_georeference(
        context.georeference(_anchor(about)), "the file is in longitude and latitude"
    )
    center = parse_triangle_center(about.get("triangle_center"))
    parsed = conversion.ParsedMap(georeference=place, triangle_center=center)
    for number, feature in enumerate(listed(document, "features"), 1):
        with at(f"{path}, feature {number}"):
            _read_feature(as_object(feature), bool(about), parsed, context)
    return parsed


def _check_crs(crs: object) -> None:
    """Raise SemvizError for other reference systems, which GeoJSON allowed before RFC 7946."""
    if crs is not None and not any(name in str(crs) for name in _WGS84):
        raise SemvizError(
            f"coordinates of {quoted(crs)}, not WGS84; convert the file to EPSG:4326 first"
        )


def _anchor(about: Mapping[str, Any]) -> Georeference | None:
    anchor = about.get("anchor")
    if anchor is None:
        return None
    numbers = [*anchor, about.get("x_heading_deg", 90)] if isinstance(anchor, list) else []
    if len(numbers) != 4:
        raise SemvizError("the anchor is not latitude, longitude and height")
    return Georeference(*(float(json_number(number)) for number in numbers))


def _read_feature(
    feature: dict[str, Any],
    ours: bool,
    parsed: conversion.ParsedMap,
    context: conversion.MapImportContext,
) -> None:
    properties = as_object(feature.get("properties") or {})
    properties |= {key: value for key, value in _tags(properties).items() if key not in properties}
    geometry = as_object(feature.get("geometry") or {})
    kind = geometry.get("type")
    if kind == "MultiPoint" and len(listed(geometry, "coordinates")) == 1:
        kind, geometry = "Point", {"coordinates": geometry["coordinates"][0]}
    if kind not in ("Point", "LineString"):
        return parsed.tally.drop(f"features that are {quoted(kind)}, neither Point nor LineString")
    place = parsed.georeference
    assert place is not None
    coordinates = geometry.get("coordinates")
    points = place.to_map(_places([coordinates] if kind == "Point" else coordinates, parsed, place))
    if properties.get("semviz") == ROAD:  # also if an editor dropped the member "semviz"
        parsed.trajectory_m = points
        return None
    class_id = _class_id(properties, parsed, context)
    if class_id is None:
        return None
    used = {context.class_property, context.height_property}
    for name in sorted(properties.keys() - _OURS - used):
        parsed.tally.drop(f"properties {quoted(name)}")
    is_line = context.classes[class_id].kind == "line"
    ends = _ends(points, is_line, ours, properties, parsed, context)
    odds = properties.get(LOG_ODDS)
    if ends is not None:
        parsed.add(
            conversion.ParsedElement(
                class_id,
                *ends,
                _id(feature, properties),
                _covariance(properties, place, is_line),
                as_flag(properties.get("anchor_known", True), "anchor_known"),
                as_flag(properties.get("end_known", True), "end_known"),
                Provenance(
                    _texts(properties, "label_ids"),
                    _texts(properties, "observation_ids"),
                    None if odds is None else float(json_number(odds)),
                ),
                parsed_attributes(as_object(properties.get("attributes") or {})),
            )
        )
    return None


def _ends(
    points: FloatArray,
    is_line: bool,
    ours: bool,
    properties: Mapping[str, Any],
    parsed: conversion.ParsedMap,
    context: conversion.MapImportContext,
) -> tuple[FloatArray, FloatArray | None] | None:
    """Return anchor and end of a feature; None if its geometry does not suit its class."""
    if not is_line:
        if len(points) > 1:
            parsed.tally.drop("signs that are lines: a sign is a Point")
            return None
        return conversion.raised(points[0], context, parsed) if not ours else points[0], None
    if len(points) == 1:
        value = properties.get(context.height_property or "height")
        height = conversion.height_of_pole(value, context, parsed)
        if height is None:
            return None
        return conversion.upper_first(points[0], points[0] + [0.0, 0.0, height])
    parsed.tally.drop("inner points of poles: a pole is its peak and its bottom", len(points) - 2)
    return (points[0], points[-1]) if ours else conversion.upper_first(points[0], points[-1])


def _places(coordinates: object, parsed: conversion.ParsedMap, place: Georeference) -> FloatArray:
    """Return longitude, latitude, height (k, 3)."""
    if not isinstance(coordinates, list) or not coordinates:
        raise SemvizError("no coordinates")
    rows = []
    for position in coordinates:
        if not isinstance(position, list) or len(position) not in (2, 3):
            raise SemvizError(f"{quoted(position)} is not longitude, latitude and height")
        row = [float(json_number(coordinate)) for coordinate in position]
        if len(row) == 2:
            parsed.tally.assume("heights: that of the map's origin where a point has none")
            row.append(place.height_m)
        rows.append(row)
    return np.array(rows)


def _class_id(
    properties: Mapping[str, Any],
    parsed: conversion.ParsedMap,
    context: conversion.MapImportContext,
) -> int | None:
    """Return the class of a feature; None if it is ignored, or of no known class."""
    class_id: int | str | None
    what = "features of a class that is ignored, as asked"
    if context.all_of_class is not None:
        class_id = context.class_id(context.all_of_class)
    elif context.class_property is not None:
        name = str(properties.get(context.class_property, ""))
        shown = f"{context.class_property} {quoted(name)}"
        class_id = context.class_of_name(name)
        if class_id is None:
            what = f"features of {shown}: {conversion.how_to_map(name)}"
    elif "class" in properties:
        class_id = context.class_id(properties["class"])
    else:
        class_id = context.class_of_tags(_tags(properties))
        if class_id is None:
            what = "features without 'class' or OpenStreetMap's tags: say --class-property NAME"
    if isinstance(class_id, int):
        return class_id
    parsed.tally.drop(what)
    return None


def _tags(properties: Mapping[str, Any]) -> dict[str, str]:
    """Return the properties that are texts, and those within GDAL's ``other_tags`` (hstore)."""
    others = _HSTORE.findall(str(properties.get(OTHER_TAGS) or ""))
    texts = {name: value for name, value in properties.items() if isinstance(value, str)}
    return dict(others) | texts


def _id(feature: Mapping[str, Any], properties: Mapping[str, Any]) -> int | None:
    """Return the number of a feature, also of OpenStreetMap's ``node/123``."""
    names = (properties.get(name) for name in ("id", "@id", "osm_id"))
    id_ = next((name for name in (feature.get("id"), *names) if name is not None), None)
    text = str(id_).removeprefix("node/") if isinstance(id_, int | str) else None
    return conversion.parse_integer(text)


def _covariance(
    properties: Mapping[str, Any], place: Georeference, is_line: bool
) -> FloatArray | None:
    """Return the covariance (6, 6) in the axes of the map; None if the file has none."""
    if properties.get("covariance_enu_m2") is None:
        return None
    matrix = checked_covariance(properties["covariance_enu_m2"], "covariance_enu_m2")
    if not is_line and matrix[3:].any():
        raise SemvizError("covariance_enu_m2 of a sign has 6 rows; it has 3 coordinates only")
    J = np.kron(np.eye(2), place.rotation.T)
    turned = np.asarray(J @ matrix @ J.T)
    variances = np.diagonal(turned)
    rounded = np.abs(variances) < 1e-12 * np.abs(matrix).max()  # may be negative
    np.fill_diagonal(turned, np.where(rounded, 0.0, variances))
    return turned


def _texts(properties: Mapping[str, Any], name: str) -> tuple[str, ...]:
    if properties.get(name) is None:
        return ()
    return tuple(as_text(text, name) for text in listed(properties, name))


def checked_covariance(value: object, name: str) -> FloatArray:
    """Return a covariance (6, 6) from a nested list of 6 by 6 numbers, or 3 by 3 for a point."""
    array = float_array(cast("ArrayLike", value), (None, None), name)
    if array.shape not in ((3, 3), (6, 6)):
        raise SemvizError(f"{name} is not a matrix of 3 by 3 or 6 by 6 numbers")
    full = np.zeros((6, 6))
    full[: len(array), : len(array)] = array
    return full
