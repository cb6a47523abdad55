"""The commands collection create, add, show, publish and export."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.collection.collection import Collection, Drive
    from semviz_core.base.semantic_map import SemanticMap
    from semviz_core.map_tiles.manifest import Manifest

Where = Annotated[Positional[str], arg(metavar="COLLECTION", help="Folder, or s3://BUCKET/PREFIX.")]
Drives = Annotated[
    Positional[tuple[str, ...]],
    arg(metavar="WORKSPACE", help="Folders of workspaces, or NAME=FOLDER."),
]


@dataclass(frozen=True)
class CollectionCreateCommand:
    """Make a collection of drives in a new folder, or in an object store.

    Workspaces stay where they are. Example: 'semviz collection create city may june july'."""

    collection: Where
    workspaces: Drives = ()
    json: bool = False
    """Print one JSON object instead of lines: the drives."""

    def run(self) -> int:
        from semviz.collection.collection import Collection

        collection = Collection.create(self.collection, self.workspaces)
        _print_drives(collection.drives(), self.json)
        return 0


@dataclass(frozen=True)
class CollectionAddCommand:
    """Add drives to a collection; several people may do so at once.

    Example: 'semviz collection add city august night=drives/2026-08-02'."""

    collection: Where
    workspaces: Drives
    json: bool = False
    """Print one JSON object instead of lines: the drives that were added."""

    def run(self) -> int:
        _print_drives(_open(self.collection).add(self.workspaces), self.json)
        return 0


@dataclass(frozen=True)
class CollectionShowCommand:
    """Show the drives of a collection, and the newest version of its map.

    Example: 'semviz collection show city --json'."""

    collection: Where
    json: bool = False
    """Print one JSON object instead of lines."""

    def run(self) -> int:
        from semviz_core.map_tiles.manifest import read_manifest, versions

        collection = _open(self.collection)
        drives, there = collection.drives(), versions(collection.store)
        newest = _described(read_manifest(collection.store)) if there else None
        if self.json:
            told = [asdict(drive) for drive in drives]
            print(json.dumps({"drives": told, "versions": there, "map": newest}))
            return 0
        _print_drives(drives, as_json=False)
        print(f"{len(drives)} drives; " + ("no map" if newest is None else _map_line(newest)))
        return 0


@dataclass(frozen=True)
class CollectionPublishCommand:
    """Publish a map as a new version of the map of a collection.

    Earlier versions stay, and those who read them go on; tiles that stay as they are, are shared.
    Example: 'semviz collection publish city may --map town'."""

    collection: Where
    source: Annotated[Positional[Path], arg(metavar="MAP")]
    """Workspace whose map it is, or a map (.parquet)."""
    map: str = "main"
    """Name of the map in the workspace."""
    parent: parsing.OptionalInt = None
    """Version that the map was made from: refused if there is a newer one. Default: the newest."""
    json: bool = False
    """Print one JSON object instead of a line."""

    def run(self) -> int:
        from semviz.presentation.terminal import Steps
        from semviz.workspace.settings import login_name
        from semviz_core.map_tiles.manifest import versions
        from semviz_core.map_tiles.publish import publish_map

        store = _open(self.collection).store
        parent = self.parent or max(versions(store), default=None)
        semantic_map = self._read()
        if not len(semantic_map):
            raise SemvizError(f"{self.source}: the map has no element; nothing is published")
        with Steps() as steps:
            manifest = publish_map(store, semantic_map, parent, login_name(), steps.show)
        told = _described(manifest)
        print(json.dumps(told) if self.json else f"{self.collection}: {_map_line(told)}")
        return 0

    def _read(self) -> "SemanticMap":
        from semviz_core.base.map_file import load_map

        if self.source.suffix == ".parquet":
            return load_map(self.source)
        return parsing.open_workspace(self.source).read_map(self.map)


@dataclass(frozen=True)
class CollectionExportCommand:
    """Write the map of a collection, or the part around a place, to a map file.

    Example: 'semviz collection export city near.parquet --near 120,-40'."""

    collection: Where
    file: Positional[Path]
    """Map to write (.parquet)."""
    version: parsing.OptionalInt = None
    """Version of the map; default: the newest."""
    near: parsing.OptionalText = None
    """X,Y: centre of the part, in metres of the map's frame. Default: the whole map."""
    radius_m: float = 200.0
    """Radius of the part around --near."""
    json: bool = False
    """Print one JSON object instead of a line."""

    def run(self) -> int:
        from semviz.workspace.outputs import PARQUET, check_outputs
        from semviz_core.base.map_file import save_map

        center = None if self.near is None else _place(self.near)
        if self.file.suffix != ".parquet":
            raise SemvizError(f"{self.file}: name a map file, for example near.parquet")
        check_outputs(self.file, PARQUET, can_force=False)
        tiles = _open(self.collection).tiled_map(self.version)
        part = tiles.whole() if center is None else tiles.along([center], self.radius_m)
        save_map(part, self.file)
        if self.json:
            told = {"map": str(self.file), "version": tiles.version, "elements": len(part)}
            print(json.dumps(told))
            return 0
        print(f"{self.file}: {len(part)} of {len(tiles)} elements of version {tiles.version}")
        return 0


def _open(where: str) -> "Collection":
    from semviz.collection.collection import Collection

    return Collection.open(where)


def _print_drives(drives: "Sequence[Drive]", as_json: bool) -> None:
    if as_json:
        print(json.dumps({"drives": [asdict(drive) for drive in drives]}))
        return
    for drive in drives:
        print(f"{drive.name}: {drive.workspace}")


def _place(text: str) -> tuple[float, float]:
    try:
        x_m, y_m = (float(part) for part in text.split(","))
    except ValueError:
        raise SemvizError(f"--near {text}: write X,Y in metres, for example 120,-40") from None
    return x_m, y_m


def _described(manifest: "Manifest") -> dict[str, Any]:
    """Return what is said of a version of the map."""
    return {
        "version": manifest.map_version,
        "parent": manifest.parent,
        "published": manifest.published,
        "by": manifest.by,
        "elements": manifest.elements,
        "tiles": len(manifest.tiles),
        "bytes": sum(tile.bytes for tile in manifest.tiles),
    }


def _map_line(told: Mapping[str, Any]) -> str:
    return (
        f"map version {told['version']} by {told['by']}, {told['published']}: {told['elements']} "
        f"elements in {told['tiles']} tiles, {told['bytes'] / 1e3:,.0f} kB"
    )
