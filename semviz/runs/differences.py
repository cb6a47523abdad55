"""Find the differences between two runs: changed map elements and changed setups.

Map changes are sorted by the number of broken and fixed frames that observed them. The setup
lists map, labels, method, images and version, and the settings that differ.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias
from zlib import crc32

import numpy as np

from semviz.runs.comparison import Comparison
from semviz.runs.frame_table import frame_table
from semviz.runs.metrics import settings_of
from semviz.runs.run import Run
from semviz_annotation.mapping.quality.diff import MapDiff
from semviz_core.base.semantic_map import SemanticMap

Kind = Literal["added", "removed", "merged", "split", "class changed", "moved"]
Ids: TypeAlias = tuple[int, ...]


@dataclass(frozen=True)
class MapChange:
    """One difference of the other map from the base map."""

    kind: Kind
    base: tuple[str, ...]
    """Names in the base map, for example ``P-04``; several if they were merged."""
    other: tuple[str, ...]
    moved_m: float | None = None
    base_ids: Ids = ()
    other_ids: Ids = ()
    broken: Ids = ()
    """Numbers of the broken frames in which either run observed it: as the true element of a
    detection, or as its estimated match."""
    fixed: Ids = ()


def map_changes(comparison: Comparison, base: Run, other: Run) -> tuple[MapChange, ...]:
    """Return the map changes, those that most broken and fixed frames observed first.

    Elements that only have another id are left out. Empty if both runs used the same map.
    """
    if comparison.maps is None:
        return ()
    ids = _ids_by_name(base.semantic_map), _ids_by_name(other.semantic_map)
    observed = _frames_by_element(base), _frames_by_element(other)
    broken = {frame.index for frame in comparison.of("broken")}
    fixed = {frame.index for frame in comparison.of("fixed")}
    changes = []
    for change in _changes(comparison.maps):
        base_ids = tuple(ids[0][name] for name in change.base)
        other_ids = tuple(ids[1][name] for name in change.other)
        frames = {index for id in base_ids for index in observed[0].get(id, ())}
        frames |= {index for id in other_ids for index in observed[1].get(id, ())}
        changes.append(
            replace(
                change,
                base_ids=base_ids,
                other_ids=other_ids,
                broken=tuple(sorted(frames & broken)),
                fixed=tuple(sorted(frames & fixed)),
            )
        )
    return tuple(sorted(changes, key=lambda change: -len(change.broken) - len(change.fixed)))


def renumbered(maps: MapDiff, base: SemanticMap, other: SemanticMap) -> dict[int, int]:
    """Return base ids, by other id, of the elements whose id changed."""
    ids = _ids_by_name(base), _ids_by_name(other)
    return {ids[1][pair.other]: ids[0][pair.base] for pair in maps.renumbered}


def _changes(maps: MapDiff) -> Iterator[MapChange]:
    """Yield the changes, without ids and frames."""
    base_name = {pair.other: pair.base for pair in (*maps.class_changed, *maps.renumbered)}
    for name in maps.new:
        yield MapChange("added", (), (name,))
    for name in maps.gone:
        yield MapChange("removed", (name,), ())
    for group in maps.merged:
        yield MapChange("merged", group.several, (group.one,))
    for group in maps.split:
        yield MapChange("split", (group.one,), group.several)
    for pair in maps.class_changed:
        yield MapChange("class changed", (pair.base,), (pair.other,))
    for element in maps.moved:
        yield MapChange(
            "moved",
            (base_name.get(element.name, element.name),),
            (element.name,),
            element.distance_m,
        )


def _ids_by_name(semantic_map: SemanticMap) -> Mapping[str, int]:
    elements, classes = semantic_map.elements, semantic_map.classes
    rows = zip(elements.class_id.tolist(), elements.id.tolist(), strict=True)
    return {classes.element_name(class_id, id): id for class_id, id in rows}


def _frames_by_element(run: Run) -> Mapping[int, set[int]]:
    """Return the numbers of the frames that observed or matched a map element, by its id."""
    table, frames = frame_table(run), defaultdict[int, set[int]](set)
    ids = np.concatenate([table.detected_id, table.pair_id])
    rows = np.concatenate([table.frame_of_detection(), table.frame_of_pair()])
    real = ids >= 0
    for id, number in zip(ids[real].tolist(), table.index[rows[real]].tolist(), strict=True):
        frames[id].add(number)
    return frames


class Setup(NamedTuple):
    """One row of the setup, as texts."""

    what: str
    base: str
    other: str


def setups(base: Run, other: Run) -> tuple[Setup, ...]:
    """Return map, labels, method, settings that differ, images and version of both runs."""
    first, second = settings_of(base), settings_of(other)
    names = ("method", "observations", "seed")
    return (
        Setup("Map", *_maps(base, other)),
        Setup("Labels", _labels(base), _labels(other)),
        *(Setup(name.capitalize(), first[name], second[name]) for name in names),
        *_options(base, other),
        Setup("Images", *_images(base, other)),
        Setup("semviz", first["semviz"], second["semviz"]),
    )


def _maps(base: Run, other: Run) -> tuple[str, str]:
    """Return the names of the maps; with their digests if different maps have one name."""
    names = base.info.map_name, other.info.map_name
    digests = base.semantic_map.digest, other.semantic_map.digest
    if digests[0] == digests[1]:
        return names[1], names[1]
    if names[0] != names[1]:
        return names
    return f"{names[0]} ({digests[0][:6]})", f"{names[1]} ({digests[1][:6]})"


def _labels(run: Run) -> str:
    operation = run.semantic_map.operation
    return f"operation {operation}" if operation else "none"


def _options(base: Run, other: Run) -> Iterator[Setup]:
    first, second = base.info.options, other.info.options
    names = dict.fromkeys([*first, *second])
    differ = [name for name in names if first.get(name) != second.get(name)]
    for name in differ:
        yield Setup(name, str(first.get(name, "-")), str(second.get(name, "-")))
    if not differ:
        yield Setup("Settings", "", "")


def _images(base: Run, other: Run) -> tuple[str, str]:
    """Return the number of common frames with images, and how many of them differ."""
    base_images = _image_digests(base)
    pairs = [
        (base_images[number], digest)
        for number, digest in _image_digests(other).items()
        if number in base_images
    ]
    counts = [sum(pair[side] is not None for pair in pairs) for side in (0, 1)]
    different = sum(type(a) is type(b) and a != b for a, b in pairs)
    note = f", {different} different" if different else ""
    return _frame_count(counts[0]), _frame_count(counts[1]) + note


def _image_digests(run: Run) -> dict[int, int | str | None]:
    """Return a checksum of each frame's left image, or the name of its file, by frame number."""
    return {
        frame.frame.index: frame.image_file or None if frame.image is None else crc32(frame.image)
        for frame in run.frames
    }


def _frame_count(frames: int) -> str:
    return f"{frames} {'frame' if frames == 1 else 'frames'}" if frames else "none"
