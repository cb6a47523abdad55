"""Read a version of a map in tiles: what is around a place, along a way, or all of it."""

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.semantic_map import (
    MapFrame,
    Provenance,
    SemanticMap,
    checked_circle,
    first_in_cubes,
    is_near,
)
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, float_array
from semviz_core.common.store import Store
from semviz_core.map_tiles.manifest import Manifest, read_file, read_manifest

CACHE_BYTES = 256 * 2**20
"""Of the tiles that are kept in memory: about 700,000 elements."""
READERS = 8
"""Threads that read tiles for ``along`` and ``whole``."""
_SLACK = 1e-9
"""Of the limits of a circle, relative and in metres: more than rounding."""


@dataclass(frozen=True, eq=False)
class _ReadTile:
    """What localization needs of a tile."""

    elements: Elements3D
    road_m: FloatArray
    """(k, 3) points of the road, one per cubic metre."""
    road_place: IntArray
    """(k,) their places in the map's trajectory."""

    @property
    def bytes(self) -> int:
        arrays = [getattr(self.elements, each.name) for each in fields(Elements3D)]
        return int(sum(array.nbytes for array in (*arrays, self.road_m, self.road_place)))


@dataclass
class _Cache:
    """The tiles that were used last. Any thread."""

    most_bytes: int
    bytes: int = 0
    _tiles: OrderedDict[int, _ReadTile] = field(default_factory=OrderedDict)
    _lock: Lock = field(default_factory=Lock)

    def get(self, row: int, read: Callable[[int], _ReadTile]) -> _ReadTile:
        """Return a tile, which is read if it is not here; the oldest ones make room for it."""
        with self._lock:
            if row in self._tiles:
                self._tiles.move_to_end(row)
                return self._tiles[row]
        tile = read(row)
        with self._lock:
            if row not in self._tiles:
                self._tiles[row] = tile
                self.bytes += tile.bytes
            while self.bytes > self.most_bytes and len(self._tiles) > 1:
                self.bytes -= self._tiles.popitem(last=False)[1].bytes
        return tile


class TiledMap:
    """One version of a map in tiles; get it from ``open``. Any thread.

    ``crop`` and ``road_near`` give what those of the map ``whole`` give, to the last bit. Later
    versions do not change it. Methods raise SemvizError if a tile is missing or damaged.
    """

    def __init__(self, store: Store, manifest: Manifest, head: SemanticMap, cache: int) -> None:
        self.store = store
        self.manifest = manifest
        self.head = head
        """The map without its elements and its trajectory."""
        self._cache = _Cache(cache)
        self._stretches = _stretches_of(manifest)
        self._row_of = {tile.cell: row for row, tile in enumerate(manifest.tiles)}

    @classmethod
    def open(
        cls, store: Store, version: int | None = None, cache_bytes: int = CACHE_BYTES
    ) -> "TiledMap":
        """Return a version of the map in a store; None: the newest.

        Tiles in memory take ``cache_bytes``. Raise SemvizError if there is no such version.
        """
        manifest = read_manifest(store, version)
        head = read_file(store, manifest.head, f"head of map version {manifest.map_version}")
        return cls(store, manifest, head, cache_bytes)

    @property
    def version(self) -> int:
        return self.manifest.map_version

    @property
    def frame(self) -> MapFrame:
        return self.head.frame

    @property
    def cache_bytes(self) -> int:
        """What the tiles in memory take."""
        return self._cache.bytes

    def __len__(self) -> int:
        return self.manifest.elements

    def crop(self, center_m: ArrayLike, radius_m: float) -> Elements3D:
        """Return elements with an anchor within ``radius_m`` of ``center_m`` on the ground plane,
        by their ids. ``center_m`` is (2,) or (3,) in the map frame."""
        center, radius = checked_circle(center_m, radius_m)
        parts = [self.head.elements]
        for tile in self._tiles_near(center, radius):
            near = is_near(tile.elements.anchor_m, center, radius)
            if near.any():
                parts.append(tile.elements[near])
        found = joined(*parts)
        return found[np.argsort(found.id)]

    def road_near(self, center_m: ArrayLike, radius_m: float) -> FloatArray:
        """Return (k, 3) points of the trajectory within ``radius_m``, as ``SemanticMap``."""
        center, radius = checked_circle(center_m, radius_m)
        parts, places = [self.head.trajectory_m], [np.zeros(0, np.int64)]
        for tile in self._tiles_near(center, radius):
            near = is_near(tile.road_m, center, radius)
            parts.append(tile.road_m[near])
            places.append(tile.road_place[near])
        road_m: FloatArray = np.concatenate(parts)[np.argsort(np.concatenate(places))]
        return road_m

    def along(self, way_m: ArrayLike, radius_m: float) -> SemanticMap:
        """Return the part of the map within ``radius_m`` of any point (k, 2 or 3) of a way, with
        provenance, attributes, and the decisions that concern its labels."""
        from scipy.spatial import cKDTree

        way = float_array(way_m, (None, None), "way_m")[:, :2]
        _, radius = checked_circle((0.0, 0.0), radius_m)
        if not len(way):
            return replace(self.head, decisions=())
        way = np.unique(way, axis=0)
        tree = cKDTree(way)

        def near(points_m: FloatArray) -> BoolArray:
            apart, _ = tree.query(points_m[:, :2], distance_upper_bound=_wider(radius))
            return np.asarray(np.isfinite(apart))

        rows = sorted({row for point in way for row in self._rows_near(point, radius)})
        part = self._united(rows, near)
        labels = {label for entry in part.provenance for label in entry.label_ids}
        concern = (one for one in part.decisions if not labels.isdisjoint(one.label_ids))
        return replace(part, decisions=tuple(concern))

    def whole(self) -> SemanticMap:
        """Return the map that was published, its elements by their ids."""
        rows = range(len(self.manifest.tiles))
        return self._united(rows, lambda points_m: np.ones(len(points_m), dtype=bool))

    def _united(self, rows: Sequence[int], near: Callable[[FloatArray], BoolArray]) -> SemanticMap:
        """Return what is ``near`` of the maps of some tiles."""
        elements, road, places = [self.head.elements], [self.head.trajectory_m], [_NOWHERE]
        provenance: dict[int, Provenance] = {}
        attributes: dict[int, Mapping[str, str]] = {}
        for row, tile in self._read_all(rows):
            kept, kept_road = near(tile.elements.anchor_m), near(tile.trajectory_m)
            elements.append(tile.elements[kept])
            road.append(tile.trajectory_m[kept_road])
            places.append(self._road_places(row)[kept_road])
            provenance |= zip(tile.elements.id.tolist(), tile.provenance, strict=False)
            attributes |= tile.attributes
        found = joined(*elements)
        found = found[np.argsort(found.id)]
        ids = found.id.tolist()
        return replace(
            self.head,
            elements=found,
            trajectory_m=np.concatenate(road)[np.argsort(np.concatenate(places))],
            provenance=tuple(provenance.get(id_, Provenance()) for id_ in ids)
            if provenance
            else (),
            attributes={id_: attributes[id_] for id_ in ids if id_ in attributes},
        )

    def _read_all(self, rows: Sequence[int]) -> Iterator[tuple[int, SemanticMap]]:
        """Yield tiles with all that they hold; from an object store, several are on their way."""
        with ThreadPoolExecutor(READERS) as pool:
            for some in (rows[at : at + READERS] for at in range(0, len(rows), READERS)):
                tiles = pool.map(lambda row: self._read(row, origins=True), some)
                yield from zip(some, tiles, strict=True)

    def _tiles_near(self, center: FloatArray, radius: float) -> Iterator[_ReadTile]:
        for row in self._rows_near(center, radius):
            yield self._cache.get(row, self._read_tile)

    def _rows_near(self, center: FloatArray, radius: float) -> list[int]:
        """Return the rows of the tiles that a circle may touch."""
        cell_m, reach = self.manifest.cell_m, _wider(radius)
        columns, rows = (
            range(math.floor(middle - reach) // cell_m, math.floor(middle + reach) // cell_m + 1)
            for middle in center.tolist()
        )
        if len(columns) * len(rows) > len(self._row_of):
            return [at for (i, j), at in self._row_of.items() if i in columns and j in rows]
        cells = ((column, row) for column in columns for row in rows)
        return [self._row_of[cell] for cell in cells if cell in self._row_of]

    def _read_tile(self, row: int) -> _ReadTile:
        tile = self._read(row, origins=False)
        first = first_in_cubes(tile.trajectory_m)
        return _ReadTile(tile.elements, tile.trajectory_m[first], self._road_places(row)[first])

    def _read(self, row: int, *, origins: bool) -> SemanticMap:
        tile = self.manifest.tiles[row]
        name = f"tile {tile.cell[0]},{tile.cell[1]} of map version {self.version}"
        return read_file(self.store, tile.file, name, origins=origins)

    def _road_places(self, row: int) -> IntArray:
        """Return the places of a tile's points in the map's trajectory."""
        tile, start, count = self._stretches
        low, high = np.searchsorted(tile, [row, row + 1])
        starts, counts = start[low:high], count[low:high]
        before = np.cumsum(counts) - counts
        places: IntArray = np.arange(counts.sum()) + np.repeat(starts - before, counts)
        return places


def _stretches_of(manifest: Manifest) -> IntArray:
    """Return (3, k): tile, place of the first point, and number of points of each stretch of the
    trajectory, by tile."""
    tile, count = np.array(manifest.road, np.int64).reshape(-1, 2).T
    by_tile = np.argsort(tile, kind="stable")
    return np.stack([tile, np.cumsum(count) - count, count])[:, by_tile]


_NOWHERE: IntArray = np.zeros(0, np.int64)


def _wider(radius: float) -> float:
    return radius * (1.0 + _SLACK) + _SLACK
