"""What the other run's map has differently, and in which frames that was seen."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from semviz.comparing.comparison import Comparison
from semviz.recording.run import Run
from semviz_annotation.mapping.quality.diff import MapDiff
from semviz_core.semantic_map import SemanticMap

Kind = Literal["added", "removed", "merged", "split", "class changed", "moved"]
Ids: TypeAlias = tuple[int, ...]


@dataclass(frozen=True)
class MapChange:
    """One thing that is otherwise in the other map."""

    kind: Kind
    base: tuple[str, ...]
    """What it is called in the base map, such as ``P-04``; several where they were merged."""
    other: tuple[str, ...]
    moved_m: float | None = None
    base_ids: Ids = ()
    other_ids: Ids = ()
    broken: Ids = ()
    """Numbers of the broken frames in which either run saw it: as a true element of a detection,
    or as the partner of one in the answer."""
    fixed: Ids = ()


def map_changes(comparison: Comparison, base: Run, other: Run) -> tuple[MapChange, ...]:
    """Those that most broken and fixed frames saw first; none where both used the same map.

    Numbers alone that changed are left out.
    """
    if comparison.maps is None:
        return ()
    ids = _ids_by_name(base.semantic_map), _ids_by_name(other.semantic_map)
    seen = _frames_by_element(base), _frames_by_element(other)
    broken = {one.index for one in comparison.of("broken")}
    fixed = {one.index for one in comparison.of("fixed")}
    changes = []
    for one in _listed(comparison.maps):
        mine = tuple(ids[0][name] for name in one.base)
        theirs = tuple(ids[1][name] for name in one.other)
        frames = {index for id in mine for index in seen[0].get(id, ())}
        frames |= {index for id in theirs for index in seen[1].get(id, ())}
        changes.append(
            replace(
                one,
                base_ids=mine,
                other_ids=theirs,
                broken=tuple(sorted(frames & broken)),
                fixed=tuple(sorted(frames & fixed)),
            )
        )
    return tuple(sorted(changes, key=lambda one: -len(one.broken) - len(one.fixed)))


def renumbered(maps: MapDiff, base: SemanticMap, other: SemanticMap) -> dict[int, int]:
    """Ids in the base map of what has another one in the other map, by that one."""
    ids = _ids_by_name(base), _ids_by_name(other)
    return {ids[1][one.other]: ids[0][one.base] for one in maps.renumbered}


def _listed(maps: MapDiff) -> Iterator[MapChange]:
    """Without what the diff does not know."""
    base_name = {one.other: one.base for one in (*maps.class_changed, *maps.renumbered)}
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
    for one in maps.moved:
        yield MapChange("moved", (base_name.get(one.name, one.name),), (one.name,), one.distance_m)


def _ids_by_name(semantic_map: SemanticMap) -> Mapping[str, int]:
    elements, classes = semantic_map.elements, semantic_map.classes
    rows = zip(elements.class_id.tolist(), elements.id.tolist(), strict=True)
    return {classes.element_name(class_id, id): id for class_id, id in rows}


def _frames_by_element(run: Run) -> Mapping[int, set[int]]:
    """Numbers of the frames that saw an element of the run's map, by its id."""
    frames: defaultdict[int, set[int]] = defaultdict(set)
    for record in run.frames:
        fine = record.localization.refinement
        ids = [record.element_id[record.element_id >= 0]]
        if fine is not None:
            ids.append(record.localization.submap.id[fine.pairs[:, 1]])
        for id in np.unique(np.concatenate(ids)).tolist():
            frames[id].add(record.frame.index)
    return frames
