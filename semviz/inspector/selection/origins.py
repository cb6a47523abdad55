"""The labels behind a run's map: what each element was made of, and who drew that last."""

import weakref
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from semviz.recording.run import Run
from semviz.workspace import SETTINGS, Workspace
from semviz_annotation.labels import LabelElement, Labels, Observation
from semviz_annotation.storing.store import LabelStore, Writer
from semviz_core.arrays import IntArray
from semviz_core.semantic_map import Provenance, SemanticMap


@dataclass(frozen=True)
class Origin:
    """A label element that a map element was made of, as the labels know it now."""

    element: LabelElement
    used: tuple[Observation, ...]
    """Its observations that the map element was made of, by frame, left first."""
    others: int
    """How many more it has: left out, of another thing, or drawn since."""
    writer: Writer | None
    """Who drew any of ``used`` last."""


class Origins:
    """Of one run's map. The label file stays open, so that only what is new in it is read."""

    def __init__(self, run: Run, path: Path) -> None:
        """``path`` is where the run was read from."""
        self._run = run
        self._path = path

    def of(self, element_id: int) -> tuple[Origin, ...]:
        """By their numbers; none where they were deleted since, or ``why_none`` says why.

        Raises SemvizError where the label file cannot be read.
        """
        provenance = provenance_of(self._run.semantic_map, element_id)
        if self._store is None or provenance is None:
            return ()
        labels = self._store.labels
        made_of = [labels.elements[one] for one in provenance.label_ids if one in labels.elements]
        used = frozenset(provenance.observation_ids)
        return tuple(
            self._origin(one, used, labels)
            for one in sorted(made_of, key=lambda element: element.number)
        )

    def why_none(self, element_id: int) -> str:
        """Why nothing is known of an element's labels; empty where something is."""
        provenance = provenance_of(self._run.semantic_map, element_id)
        if provenance is None:
            return "The map does not say which labels it was made of."
        if self._store is None:
            where = self._run.info.workspace or "no workspace is named in the run"
            return f"The labels are not at hand ({where})."
        if not self.of(element_id):
            return "Its labels were deleted since this map was built."
        return ""

    def _origin(self, element: LabelElement, used: frozenset[str], labels: Labels) -> Origin:
        rows = labels.of_element(element.id)
        mine = tuple(one for one in rows if one.id in used)
        assert self._store is not None
        writers = self._store.last_writers(one.id for one in mine).values()
        last = max(writers, key=lambda one: one.number, default=None)
        return Origin(element, mine, len(rows) - len(mine), last)

    @cached_property
    def workspace(self) -> Workspace | None:
        """Whose labels they are; None where it is not at hand."""
        return workspace_of(self._run, self._path)

    @property
    def operation(self) -> int:
        """Number of the last operation on the labels; 0 where they are not at hand."""
        return 0 if self._store is None else self._store.labels.operation

    @cached_property
    def _store(self) -> LabelStore | None:
        if self.workspace is None:
            return None
        store = LabelStore.open(self.workspace.labels_path, self.workspace.classes)
        weakref.finalize(self, store.close)
        return store


def provenance_of(semantic_map: SemanticMap, element_id: int) -> Provenance | None:
    """None where the map does not have the element, or was not made from labels."""
    row = map_row(semantic_map, element_id)
    return None if row is None or not semantic_map.provenance else semantic_map.provenance[row]


def map_row(semantic_map: SemanticMap, element_id: int) -> int | None:
    """Row of the map's elements; None where it has no such one."""
    ids, order = semantic_map.elements.id, _by_id(semantic_map)
    at = np.searchsorted(ids, element_id, sorter=order)
    return int(order[at]) if at < len(ids) and ids[order[at]] == element_id else None


@lru_cache(maxsize=4)
def _by_id(semantic_map: SemanticMap) -> IntArray:
    order: IntArray = np.argsort(semantic_map.elements.id)
    return order


def workspace_of(run: Run, path: Path) -> Workspace | None:
    """The workspace that a run lies in, or else the one it names, if the labels are of its map."""
    told = [Path(run.info.workspace)] if run.info.workspace else []
    semantic_map = run.semantic_map
    ids = {one for row in semantic_map.provenance for one in row.label_ids}
    ids |= {one for decision in semantic_map.decisions for one in decision.label_ids}
    for folder in (path.resolve().parent.parent, *told):
        if not (folder / SETTINGS).is_file():
            continue
        workspace = Workspace.open(folder)
        if ids & workspace.read_labels().elements.keys():
            return workspace
    return None
