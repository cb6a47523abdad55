"""A collection: a folder, or a place in an object store, that names drives and holds their map.

    collection.json            says that this is a collection
    drives/NAME.json           a drive: where its workspace is
    manifests/000001.json      a version of the map, and its tiles; see ``semviz_core.map_tiles``
    tiles/                     tiles of all versions

Every file is written once and stays, so those who read and those who add do not disturb each other.
Workspaces stay where they are, on a file system that all can open.
"""

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from semviz.workspace.outputs import check_empty, check_new_folder, checked_name
from semviz.workspace.workspace import Workspace
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import first_line, shown
from semviz_core.common.store import FolderStore, Store
from semviz_core.map_tiles.tiled_map import TiledMap

_COLLECTION = "collection.json"
READERS = 16
"""Threads that read files of drives."""
_DRIVES, _ENDING = "drives/", ".json"


@dataclass(frozen=True)
class Drive:
    """A drive of a collection."""

    name: str
    workspace: str
    """Absolute path of its workspace."""


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    version: Literal[1] = 1


class _CollectionFile(_File):
    format: Literal["semviz-collection"] = "semviz-collection"


class _DriveFile(_File):
    format: Literal["semviz-drive"] = "semviz-drive"
    workspace: str
    """Path of the workspace; from the folder of the collection, if that is a folder."""


_Content = TypeVar("_Content", bound=_File)


@dataclass(frozen=True)
class Collection:
    """Drives, and a map in tiles; get one from ``create`` or ``open``, which raise SemvizError."""

    store: Store

    @classmethod
    def create(cls, where: Path | str, workspaces: Iterable[Path | str] = ()) -> "Collection":
        """Make a collection with some drives in a new folder, or in an object store."""
        if "://" not in str(where):
            check_new_folder(Path(where))
            check_empty(Path(where))
        named = _named(workspaces)  # before a folder is made
        collection = cls(Store.at(where, make=True))
        content = _content(_CollectionFile())
        if not collection.store.write_new(_COLLECTION, content):
            raise SemvizError(f"{where}: is a collection already; use 'semviz collection add'")
        if collection.store.write_new(_COLLECTION, content):
            raise SemvizError(
                f"{where}: this object store replaces files that it has to keep (If-None-Match); "
                "use another one, or a folder"
            )
        collection._add(named)
        return collection

    @classmethod
    def open(cls, where: Path | str) -> "Collection":
        """Return the collection in a folder, or at a URL."""
        collection = cls(Store.at(where))
        if not collection.store.exists(_COLLECTION):
            raise SemvizError(
                f"{shown(where)}: no collection; make one with 'semviz collection create'"
            )
        collection._parsed(_COLLECTION, _CollectionFile)
        return collection

    @property
    def where(self) -> str:
        """Folder or URL."""
        return self.store.where

    def drives(self) -> tuple[Drive, ...]:
        """Return the drives, by name."""
        keys = [key for key in self.store.keys(_DRIVES) if key.endswith(_ENDING)]
        with ThreadPoolExecutor(READERS) as pool:
            return tuple(pool.map(self._drive, keys))

    def add(self, workspaces: Iterable[Path | str]) -> tuple[Drive, ...]:
        """Add workspaces as drives, and return these.

        A drive is called as its workspace's folder, or as a text ``NAME=FOLDER`` says. Raise
        SemvizError if one is no workspace, or a name is taken; then none is added.
        """
        return self._add(_named(workspaces))

    def _add(self, named: dict[str, Path]) -> tuple[Drive, ...]:
        taken = {drive.name for drive in self.drives()} & set(named)
        if taken:
            raise _taken(min(taken))
        for name, path in named.items():
            content = _content(_DriveFile(workspace=self._kept(path)))
            if not self.store.write_new(_key(name), content):
                raise _taken(name)
        return tuple(self._drive(_key(name)) for name in named)

    def tiled_map(self, version: int | None = None) -> TiledMap:
        """Return a version of the map; None: the newest. Raise SemvizError if there is none."""
        return TiledMap.open(self.store, version)

    def _drive(self, key: str) -> Drive:
        kept = self._parsed(key, _DriveFile).workspace
        if isinstance(self.store, FolderStore):
            kept = str((Path(self.where) / kept).resolve())
        return Drive(key.removeprefix(_DRIVES).removesuffix(_ENDING), kept)

    def _kept(self, workspace: Path) -> str:
        """Return the path of a workspace that is stored: it stays right if both are moved."""
        if isinstance(self.store, FolderStore):
            return os.path.relpath(workspace.resolve(), Path(self.where).resolve())
        return str(workspace.resolve())

    def _parsed(self, key: str, kind: type[_Content]) -> _Content:
        try:
            return kind.model_validate_json(self.store.read(key))
        except ValidationError as error:
            fault = first_line(error.errors()[0]["msg"])
            raise SemvizError(
                f"{shown(self.where)}/{key}: damaged, or of a newer semviz ({fault}); update "
                "semviz, or restore the file from a copy"
            ) from None


def _named(workspaces: Iterable[Path | str]) -> dict[str, Path]:
    """Return folders of workspaces by the names of the drives. Raise SemvizError if one is no
    workspace, or two have one name."""
    named: dict[str, Path] = {}
    for given in workspaces:
        name, equals, folder = ("", "", given) if isinstance(given, Path) else given.partition("=")
        path = Path(folder if equals else given)
        name = checked_name(name if equals else path.resolve().name)
        Workspace.open(path)
        if name in named:
            raise SemvizError(f"{path}: {named[name]} is called '{name}', too; write NAME={path}")
        named[name] = path
    return named


def _key(name: str) -> str:
    return f"{_DRIVES}{name}{_ENDING}"


def _taken(name: str) -> SemvizError:
    return SemvizError(f"the collection has a drive '{name}' already; write NAME=WORKSPACE")


def _content(file: _File) -> bytes:
    return file.model_dump_json(indent=1).encode() + b"\n"
