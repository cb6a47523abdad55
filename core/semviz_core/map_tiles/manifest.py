"""The manifest of one version of a map: its tiles, and the file with all else.

    manifests/000007.json      version 7
    tiles/DIGEST.parquet       a tile, or the head: a map file, called by the SHA-256 of its content

The head is a map without elements: frame, classes, decisions, settings. Files of tiles are shared
by all versions in which they are the same. A manifest is written when its files are, so a version
is there as a whole or not at all, and of two publishers of one version one succeeds.
"""

import hashlib
from collections import Counter
from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from semviz_core.base.map_file import parsed_map
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import first_line, shown
from semviz_core.common.store import Store

_MANIFESTS, _ENDING = "manifests/", ".json"
Digest: TypeAlias = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Cell: TypeAlias = tuple[int, int]
"""Column and row of a cell: it holds x from column * cell_m on, and y from row * cell_m on."""


class _Content(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Tile(_Content):
    """The file of a cell."""

    cell: Cell
    file: Digest
    bytes: int = Field(ge=0)
    elements: int = Field(ge=0)
    """Those with an anchor in the cell."""
    road_points: int = Field(ge=0)
    """Points of the map's trajectory in the cell."""


class Manifest(_Content):
    """A version of a map."""

    format: Literal["semviz-map-tiles"] = "semviz-map-tiles"
    version: Literal[1] = 1
    """Of the format."""
    map_version: int = Field(ge=1)
    parent: int | None
    """The version that it was made from."""
    published: str
    """UTC, ISO 8601."""
    by: str
    id: str
    """Random: by it a publisher knows its own manifest."""
    cell_m: int = Field(ge=1)
    head: Digest
    tiles: tuple[Tile, ...]
    road: tuple[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1)]], ...]
    """The map's trajectory as stretches in one cell: index of the tile, and number of points."""

    @model_validator(mode="after")
    def _is_consistent(self) -> "Manifest":
        if len({tile.cell for tile in self.tiles}) < len(self.tiles):
            raise ValueError("a cell has two tiles")
        points: Counter[int] = Counter()
        for tile, count in self.road:
            points[tile] += count
        if points != Counter({row: tile.road_points for row, tile in enumerate(self.tiles)}):
            raise ValueError("the road's stretches are not those of the tiles")
        return self

    @property
    def elements(self) -> int:
        """Number of elements."""
        return sum(tile.elements for tile in self.tiles)


def versions(store: Store) -> list[int]:
    """Return the versions of the map in a store, ascending."""
    names = [
        key.removeprefix(_MANIFESTS).removesuffix(_ENDING)
        for key in store.keys(_MANIFESTS)
        if key.endswith(_ENDING)
    ]
    return sorted(int(name) for name in names if name.isascii() and name.isdigit())


def manifest_key(version: int) -> str:
    """Return the key of the manifest of a version."""
    return f"{_MANIFESTS}{version:06d}{_ENDING}"


def read_manifest(store: Store, version: int | None = None) -> Manifest:
    """Return the manifest of a version; None: the newest. Raise SemvizError if there is none."""
    if version is None or not store.exists(manifest_key(version)):
        there = versions(store)
        if version is not None or not there:
            has = f"versions {there[0]} to {there[-1]}" if there else "no map yet"
            hint = "choose one of them" if there else "run 'semviz collection publish'"
            raise SemvizError(f"{shown(store.where)}: has {has}; {hint}")
        version = there[-1]
    key = manifest_key(version)
    try:
        manifest = Manifest.model_validate_json(store.read(key))
        if manifest.map_version != version:
            raise SemvizError(f"{shown(store.where)}/{key}: holds version {manifest.map_version}")
    except ValidationError as error:
        first = error.errors()[0]
        fault = first_line(f"{'.'.join(map(str, first['loc'])) or 'file'}: {first['msg']}")
        raise SemvizError(
            f"{shown(store.where)}/{key}: damaged, or of a newer semviz ({fault}); update semviz, "
            "or restore the file from a copy"
        ) from None
    return manifest


def digest_of(content: bytes) -> str:
    """Return what the file of a tile is called by."""
    return hashlib.sha256(content).hexdigest()


def file_key(digest: str) -> str:
    """Return the key of a tile's file."""
    return f"tiles/{digest}.parquet"


def read_file(store: Store, digest: str, name: str, *, origins: bool = True) -> SemanticMap:
    """Return the map in a file, with or without ``origins`` as ``parsed_map``.

    Raise SemvizError, starting with ``name``, if the file is missing or damaged.
    """
    key = file_key(digest)
    try:
        content = store.read(key)
    except SemvizError as error:
        raise SemvizError(f"{name}: {error}; restore it from a copy") from None
    place = f"{shown(store.where)}/{key}"
    if digest_of(content) != digest:
        raise SemvizError(f"{name}: {place}: damaged; restore it from a copy")
    return parsed_map(content, place, origins=origins)
