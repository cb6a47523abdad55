"""Where a workspace's images and poses are, if it does not hold them itself.

Its settings name them relative to the workspace: both can move together. ``places.toml`` beside
them has the absolute paths: the workspace can be copied alone, to any depth. It can be deleted.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import tomli_w

from semviz.workspace.settings import (
    SETTINGS,
    ImagesSettings,
    KittiSettings,
    Settings,
    StreetSettings,
    read_settings,
)
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import read_toml

if TYPE_CHECKING:
    from semviz.workspace.workspace import Workspace

PLACES = "places.toml"
_HEADER = (
    "# Absolute paths, tried if those of semviz.toml lead nowhere. 'semviz relink' changes both;\n"
    "# delete this file before you pass the workspace on, if nobody is to read these names.\n"
)


Source: TypeAlias = KittiSettings | ImagesSettings | StreetSettings


def places_of(source: Source) -> dict[str, str]:
    """Return the paths of the settings that lead out of the workspace, by their names."""
    if isinstance(source, StreetSettings):
        return {}
    if isinstance(source, KittiSettings):
        given = {"root": source.root, "poses": source.poses}
    else:
        given = {"images": source.images, "right": source.right, **(source.cameras or {})}
    return {name: path for name, path in given.items() if path is not None}


def find_place(workspace: Path, name: str, relative: str) -> Path:
    """Return the folder or file of a setting. Raise SemvizError if it is at neither place."""
    near = (workspace.resolve() / relative).resolve()
    if near.exists():
        return near
    known = read_toml(workspace / PLACES) if (workspace / PLACES).is_file() else {}
    far = known.get(name)
    if isinstance(far, str) and Path(far).exists():
        return Path(far)
    also = f", nor at {far}" if isinstance(far, str) and Path(far) != near else ""
    raise SemvizError(
        f"{near}: '{name}' of the workspace not found there{also}; say where it is: "
        f"semviz relink {workspace} --{name} PLACE"
    )


def keep_places(workspace: Path, settings: Settings) -> None:
    """Write the absolute paths of what exists outside the workspace, if there is any."""
    places = {}
    for name, relative in places_of(settings.source).items():
        place = (workspace.resolve() / relative).resolve()
        if place.exists() and not place.is_relative_to(workspace.resolve()):
            places[name] = str(place)
    if places:
        with replacing(workspace / PLACES) as temporary:
            temporary.write_text(_HEADER + tomli_w.dumps(places), "utf-8")


def relink(workspace: "Workspace", given: Mapping[str, Path]) -> "Workspace":
    """Say where images and poses are now, and return the workspace with them.

    Settings and ``places.toml`` change only if the workspace opens with the new places: with the
    calibration of its labels, and all of its images' files. Raise SemvizError if not.
    """
    known = places_of(workspace.settings.source)
    for name in given:
        if name not in known:
            has = ", ".join(f"--{one}" for one in known) or "none: it is a simulated street"
            raise SemvizError(f"--{name}: workspace '{workspace.name}' has no such place ({has})")
    absolute = {
        name: given[name].resolve() if name in given else find_place(workspace.path, name, relative)
        for name, relative in known.items()
    }
    for name, place in absolute.items():
        if not place.exists():
            raise SemvizError(f"--{name} {place}: no such folder or file")
    relative = {
        name: os.path.relpath(place, workspace.path.resolve()) for name, place in absolute.items()
    }
    source = _moved(workspace.settings.source, relative)
    settings = workspace.settings.model_copy(update={"source": source})
    changed = type(workspace)(workspace.path, settings)
    _check_images(changed)
    _rewrite(workspace.path / SETTINGS, relative)
    keep_places(workspace.path, settings)
    return changed


def _moved(source: Source, relative: Mapping[str, str]) -> Source:
    """Return the source with other paths."""
    cameras = getattr(source, "cameras", None)
    update: dict[str, object] = {
        name: path for name, path in relative.items() if name not in (cameras or {})
    }
    if isinstance(source, ImagesSettings) and cameras:
        update["cameras"] = {name: relative[name] for name in cameras}
    return source.model_copy(update=update)


def _check_images(workspace: "Workspace") -> None:
    """Raise SemvizError if the source does not open, or the image of a frame is missing."""
    from semviz_core.base.frame import FileDataset, Side

    source = workspace.source
    if not isinstance(source, FileDataset):
        return
    sides: tuple[Side, ...] = ("left",) if source.rig.right is None else ("left", "right")
    there = {
        frame.index
        for frame in source.frames
        if all(source.original_path(frame.index, side).is_file() for side in sides)
    }
    labelled = {row.frame_index for row in workspace.read_labels().observations.values()}
    needed = labelled | {frame.index for frame in source.frames}
    if missing := sorted(needed - there):
        raise SemvizError(
            f"the images there are others: of {len(needed)} frames {len(missing)} are missing, the "
            f"first is {missing[0]}; nothing was changed"
        )


def _rewrite(file: Path, values: Mapping[str, str]) -> None:
    """Replace paths in the settings; everything else stays as people wrote it."""
    lines = file.read_text("utf-8").splitlines()
    lines = [line for line in lines if not line.startswith("# Checksum ")]  # of the old paths
    for row, line in enumerate(lines):
        name = line.partition("=")[0].strip()
        if name in values:
            lines[row] = tomli_w.dumps({name: values[name]}).strip()
    before = file.read_bytes()
    with replacing(file) as temporary:
        temporary.write_text("\n".join(lines) + "\n", "utf-8")
    try:
        read_settings(file.parent)
    except SemvizError:  # written by hand in a way that lines do not show
        with replacing(file) as temporary:
            temporary.write_bytes(before)
        raise SemvizError(f"{file}: cannot be changed line by line; edit its paths") from None
