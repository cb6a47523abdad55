"""Publish a version of a map in tiles: write the tiles that are new, then the manifest."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from uuid import uuid4

import numpy as np

from semviz_core.base.map_file import map_content
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.common.progress import OnProgress, unwatched
from semviz_core.common.store import Store
from semviz_core.map_tiles.manifest import (
    Cell,
    Manifest,
    Tile,
    digest_of,
    file_key,
    manifest_key,
    read_file,
    read_manifest,
)

CELL_M = 200
"""Side of a cell: a crop of 120 m reads nine tiles at most, and few elements that it leaves out."""
WRITERS = 8
"""Threads that write tiles."""


_NONE: IntArray = np.zeros(0, np.int64)


def publish_map(
    store: Store,
    semantic_map: SemanticMap,
    parent: int | None,
    by: str,
    on_progress: OnProgress = unwatched,
) -> Manifest:
    """Publish a map as the version after ``parent``, from which it was made; None: as the first.

    Only tiles that ``parent`` lacks are written. Raise SemvizError if somebody has published that
    version, if the map is in another frame than ``parent``, or the store cannot be written.
    """
    version = 1 if parent is None else parent + 1
    before = None if parent is None else read_manifest(store, parent)
    _check_new(store, version)
    known, cell_m = set[str](), CELL_M
    if before is not None:
        _check_frame(store, before, semantic_map)
        known, cell_m = {before.head, *(tile.file for tile in before.tiles)}, before.cell_m
    cut = _Cut.of(semantic_map, cell_m)
    with _Writer(store, known) as writer:
        tiles = tuple(_written_tiles(cut, writer, on_progress))
        head, _ = writer.write(_only(semantic_map, _NONE, _NONE))
    manifest = Manifest(
        map_version=version,
        parent=parent,
        published=datetime.now(UTC).isoformat(timespec="seconds"),
        by=by,
        id=uuid4().hex,
        cell_m=cell_m,
        head=head,
        tiles=tiles,
        road=cut.stretches(),
    )
    key, content = manifest_key(version), manifest.model_dump_json().encode()
    if not store.write_new(key, content) and store.read(key) != content:
        _check_new(store, version)
    return manifest


def _written_tiles(cut: "_Cut", writer: "_Writer", on_progress: OnProgress) -> Iterator[Tile]:
    """Write the tiles of a map, and yield what the manifest says of them."""
    for done, (cell, part) in enumerate(cut.parts(), 1):
        file, size = writer.write(part)
        points = len(part.trajectory_m)
        yield Tile(cell=cell, file=file, bytes=size, elements=len(part), road_points=points)
        on_progress("tiles", done, len(cut.cells))


class _Writer:
    """Writes files, several at once: each waits for the disk, or the network.

    All are there when the context ends. It raises the first error.
    """

    def __init__(self, store: Store, known: set[str]) -> None:
        self._store = store
        self._known = known
        """Digests of files that are in the store."""
        self._pool = ThreadPoolExecutor(WRITERS)
        self._waiting = deque[Future[bool]]()

    def write(self, part: SemanticMap) -> tuple[str, int]:
        """Write a map, unless it is there. Return its digest and size in bytes."""
        content = map_content(part)
        digest = digest_of(content)
        if digest not in self._known:
            self._known.add(digest)
            key = file_key(digest)
            self._waiting.append(self._pool.submit(self._store.write_new, key, content))
        if len(self._waiting) > 2 * WRITERS:
            self._waiting.popleft().result()
        return digest, len(content)

    def __enter__(self) -> "_Writer":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._pool.shutdown(cancel_futures=kind is not None)
        if kind is None:
            for one in self._waiting:
                one.result()


@dataclass(frozen=True, eq=False)
class _Cut:
    """A map, and what lies in which cell."""

    semantic_map: SemanticMap
    cells: tuple[Cell, ...]
    rows: tuple[IntArray, ...]
    """Of the elements in each cell, by their ids."""
    road_rows: tuple[IntArray, ...]
    """Of the points of the trajectory in each cell, in its order."""
    road_cell: IntArray
    """(k,) index of the cell of each point of the trajectory."""

    @classmethod
    def of(cls, semantic_map: SemanticMap, cell_m: int) -> "_Cut":
        order = np.argsort(semantic_map.elements.id)
        anchors = cells_of(semantic_map.elements.anchor_m[order], cell_m)
        road = cells_of(semantic_map.trajectory_m, cell_m)
        cells, which = np.unique(np.concatenate([anchors, road]), axis=0, return_inverse=True)
        which = which.reshape(-1)
        in_cell, road_cell = which[: len(order)], which[len(order) :]
        return cls(
            semantic_map,
            tuple((int(column), int(row)) for column, row in cells),
            tuple(order[rows] for rows in _grouped(in_cell, len(cells))),
            tuple(_grouped(road_cell, len(cells))),
            road_cell,
        )

    def parts(self) -> Iterator[tuple[Cell, SemanticMap]]:
        """Yield each cell, with the part of the map in it and nothing of the whole."""
        for cell, rows, road_rows in zip(self.cells, self.rows, self.road_rows, strict=True):
            part = _only(self.semantic_map, rows, road_rows)
            yield cell, replace(part, decisions=(), made_by="", settings={}, operation=0)

    def stretches(self) -> tuple[tuple[int, int], ...]:
        """Return ``Manifest.road``."""
        starts = np.flatnonzero(np.diff(self.road_cell, prepend=-1))
        counts = np.diff(np.append(starts, len(self.road_cell)))
        return tuple(zip(self.road_cell[starts].tolist(), counts.tolist(), strict=True))


def cells_of(points_m: FloatArray, cell_m: int) -> IntArray:
    """Return (n, 2) the cells of points (n, 3). No cubic metre is cut."""
    cells: IntArray = np.floor(points_m[:, :2]).astype(np.int64) // cell_m
    return cells


def _grouped(group: IntArray, count: int) -> list[IntArray]:
    """Return the rows of each of ``count`` groups, ascending."""
    order = np.argsort(group, kind="stable")
    return np.split(order, np.searchsorted(group[order], np.arange(1, count)))[:count][:count]


def _only(semantic_map: SemanticMap, rows: IntArray, road_rows: IntArray) -> SemanticMap:
    """Return some elements of a map, and some points of its trajectory."""
    elements, provenance = semantic_map.elements[rows], semantic_map.provenance
    attributes = semantic_map.attributes
    return replace(
        semantic_map,
        elements=elements,
        trajectory_m=semantic_map.trajectory_m[road_rows],
        provenance=tuple(provenance[row] for row in rows.tolist()) if provenance else (),
        attributes={id_: attributes[id_] for id_ in elements.id.tolist() if id_ in attributes},
    )


def _check_new(store: Store, version: int) -> None:
    if store.exists(manifest_key(version)):
        raise SemvizError(
            f"{shown(store.where)}: somebody has published version {version} meanwhile; make the "
            "map again from that one, or publish it after that one if it has all its changes"
        )


def _check_frame(store: Store, before: Manifest, semantic_map: SemanticMap) -> None:
    name = f"head of version {before.map_version}"
    old, new = read_file(store, before.head, name).frame.name, semantic_map.frame.name
    if old != new:
        raise SemvizError(
            f"the map is in frame '{new}', that of {shown(store.where)} in '{old}'; make it in "
            "that frame, or create another collection"
        )
