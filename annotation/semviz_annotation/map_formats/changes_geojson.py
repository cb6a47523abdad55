"""Changes of a map over time as GeoJSON, for QGIS and other tools that show or decide on them.

Each change is a feature of its element: a pole is a LineString from peak to bottom, a sign a Point.
One that moved is two: where it is mapped, and where passes found it.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from semviz_annotation.map_formats.geojson import feature, rounded, write_collection
from semviz_annotation.map_formats.georeference import Georeference
from semviz_annotation.mapping.passes.changes import Change, MapChanges

Place = Literal["mapped", "found"]


def write_changes(
    found: MapChanges,
    path: Path,
    place: Georeference,
    dates: Mapping[str, str],
    decisions: Mapping[str, Mapping[str, str]],
) -> None:
    """Write the changes of a map to ``path``.

    ``dates`` are those of passes, by name; ``decisions`` are further properties of the changes that
    people decided on, by name.
    """
    about = {
        "map_digest": found.semantic_map.digest,
        "passes": found.passes,
        "dates": [dates.get(name, "") for name in found.passes],
    }
    features = [
        one
        for change in found.changes
        for one in _features(found, change, place, _properties(change, dates, decisions))
    ]
    write_collection(path, found.semantic_map, place, about, features)


def _properties(
    change: Change, dates: Mapping[str, str], decisions: Mapping[str, Mapping[str, str]]
) -> dict[str, Any]:
    return {
        "name": change.name,
        "class": change.class_name,
        "change": change.kind,
        "existence": round(change.existence, 4),
        "why": change.story,
        "since": change.since,
        "since_date": dates.get(change.since, ""),
        "moved_m": change.moved_m,
        "frames_seen": change.seen,
        "frames_in_view": change.chances,
        "existence_by_pass": [round(each, 4) for each in change.probability],
        "answer": "open",
        **decisions.get(change.name, {}),
    }


def _features(
    found: MapChanges, change: Change, place: Georeference, properties: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    rows: dict[Place, int] = {}
    if change.element_id is not None:
        rows["mapped"] = found.row_in_map(change)
    if change.kind in ("new", "moved"):
        rows["found"] = change.row
    for where, row in rows.items():
        element = found.whole[[row]]
        ends = [element.anchor_m, element.end_m] if element.is_line[0] else [element.anchor_m]
        points = rounded(place.to_wgs84(np.concatenate(ends)))
        kind, coordinates = ("LineString", points) if len(points) > 1 else ("Point", points[0])
        yield feature(kind, coordinates, properties | {"place": where})
