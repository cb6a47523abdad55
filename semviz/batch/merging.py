"""Merge the maps of a batch's drives, and publish the result as the collection's map."""

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from semviz.batch.batch import DriveBatch, DriveOutcome
from semviz_annotation.mapping.drives.corrections import PoseErrors
from semviz_annotation.mapping.drives.former_ids import with_former_ids
from semviz_annotation.mapping.drives.merge import MergeOptions
from semviz_annotation.mapping.drives.merged_map import merge_maps
from semviz_core.base.map_file import load_map
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnProgress
from semviz_core.map_tiles.manifest import read_manifest, versions
from semviz_core.map_tiles.publish import publish_map
from semviz_core.map_tiles.tiled_map import TiledMap


@dataclass(frozen=True)
class Published:
    """The version of the collection's map that a batch made."""

    map_version: int
    elements: int
    lines: tuple[str, ...] = ()
    """What was merged, for people; empty if it was published before."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def __str__(self) -> str:
        version = f"version {self.map_version} of the map: {self.elements} elements"
        return "; ".join([version, *self.lines])


def publish_merged(batch: DriveBatch, errors: PoseErrors, on_progress: OnProgress) -> Published:
    """Merge the maps of all drives that are done, and publish them as the next version.

    Landmarks of the version before keep their ids. If the same maps have been published, that
    version is returned. Raise SemvizError if maps cannot be merged, or somebody
    publishes meanwhile.
    """
    done = [one for one in batch.done_before() if "map" in one.printed]
    by = _made_from(batch.name, done)
    newest = read_manifest(batch.store) if versions(batch.store) else None
    if newest is not None and newest.by == by:
        return Published(newest.map_version, newest.elements)
    maps = _maps(batch, [one.drive for one in done], on_progress)
    merged, lines = _merged(maps, errors, on_progress)
    parent = None
    if newest is not None:
        parent = newest.map_version
        merged = with_former_ids(merged, TiledMap.open(batch.store, parent).whole())
    manifest = publish_map(batch.store, merged, parent, by, on_progress)
    return Published(manifest.map_version, manifest.elements, lines)


def _made_from(batch: str, done: Sequence[DriveOutcome]) -> str:
    """Return what the manifest says of where the map comes from."""
    state = json.dumps([[one.drive, one.inputs] for one in done]).encode()
    return f"batch {batch}, {len(done)} drives ({sha256(state).hexdigest()[:8]})"


def _maps(
    batch: DriveBatch, names: Sequence[str], on_progress: OnProgress
) -> dict[str, SemanticMap]:
    """Return the maps of the drives, by name. Raise SemvizError if there is none."""
    maps = {}
    if not names:
        raise SemvizError(f"batch {batch.name}: no map was built, so nothing is published")
    with tempfile.TemporaryDirectory(prefix="semviz-batch-") as folder:
        path = Path(folder) / "map.parquet"
        for number, name in enumerate(names):
            on_progress("reading maps", number, len(names))
            batch.store.fetch(batch.output("maps", name), path)
            maps[name] = load_map(path)
    return maps


def _merged(
    maps: Mapping[str, SemanticMap], errors: PoseErrors, on_progress: OnProgress
) -> tuple[SemanticMap, tuple[str, ...]]:
    """Return the map of all drives, and lines for people."""
    if len(maps) == 1:
        return next(iter(maps.values())), ()
    merged = merge_maps(maps, MergeOptions(errors), on_progress)
    lines = list(merged.report.lines())
    return merged.semantic_map, tuple(lines[len(maps) :])  # without those of single drives
