"""The settings of a workspace, ``semviz.toml``: where its images and poses come from.

People edit it, so only what decides which images the labels belong to has a checksum, in a comment
that an editor deletes: a seed, a frame number or a folder's name with one wrong bit opens others.

Places are relative to the workspace: both can move together. ``places.toml`` beside the settings
has the absolute ones: the workspace can be copied alone, to any depth. It can be deleted.
"""

import getpass
import json
import os
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal, TypeAlias

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from semviz_core.base.semantic_map import MapFrame
from semviz_core.common import limits
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.datasets.validation import Calibration
from semviz_core.simulation.objects import SectionKind

if TYPE_CHECKING:
    from semviz.workspace.workspace import Workspace
    from semviz_core.base.frame import FileDataset


VERSION: Final = 1
SETTINGS = "semviz.toml"
STREET_FRAMES = 60
_CHECKSUM = re.compile(r"^# Checksum ([0-9a-f]{8}) of ", re.MULTILINE)


Place: TypeAlias = Annotated[str, Field(pattern=r"^[^\x00]+$")]
"""A folder or file, absolute or relative to the workspace."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class FrameRange(_Model):
    """Frame numbers from ``first`` to ``end``, which is excluded."""

    first: int = Field(ge=0)
    end: int = Field(gt=0)
    step: int = Field(default=1, gt=0)

    @classmethod
    def of(cls, frames: range) -> "FrameRange":
        if not frames or frames.start < 0 or frames.step < 0:
            raise SemvizError(f"frames {frames}: expected numbers from 0, going up")
        return cls(first=frames.start, end=frames.stop, step=frames.step)

    def as_range(self) -> range:
        return range(self.first, self.end, self.step)


class KittiSettings(_Model):
    """A KITTI odometry sequence."""

    kind: Literal["kitti"] = "kitti"
    root: Place
    """Folder that holds ``sequences``."""
    sequence: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    cameras: Annotated[tuple[int, ...], Field(min_length=1, max_length=2)] = (2, 3)
    frames: FrameRange | None = None
    poses: Place | None = None
    """A pose file to use instead of KITTI's."""


class ImagesSettings(_Model):
    """Folders of images of any camera; the file ``drive.json`` holds calibration and poses."""

    kind: Literal["images"] = "images"
    images: Place
    """Folder of the left, or the only, camera."""
    right: Place | None = None
    cameras: dict[str, Place] | None = None
    """Of a rig: the folders of all its cameras by name, of the first one's again."""


class SectionSettings(_Model):
    """A stretch of a simulated street; see ``semviz_core.simulation.layout.Section``."""

    kind: SectionKind
    length_m: float = Field(gt=0, le=10_000)


class StreetSettings(_Model):
    """A simulated street: its seed, number of frames, and sections."""

    kind: Literal["street"] = "street"
    seed: int = Field(ge=0)
    frames: int = Field(default=STREET_FRAMES, gt=0, le=10_000)
    spacing_m: float = Field(default=1.0, gt=0, le=20)
    sections: tuple[SectionSettings, ...] = ()


class GeoreferenceSettings(_Model):
    """Where the origin of the map frame is on Earth (WGS84), and where its x axis points."""

    latitude_deg: float = Field(ge=-90.0, le=90.0)
    longitude_deg: float = Field(ge=-180.0, le=180.0)
    height_m: float = 0.0
    x_heading_deg: float = Field(default=90.0, ge=-360.0, le=360.0)

    @classmethod
    def of(cls, frame: MapFrame) -> "GeoreferenceSettings | None":
        if frame.origin is None:
            return None
        latitude, longitude, height_m = frame.origin
        return cls(
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height_m,
            x_heading_deg=frame.x_heading_deg,
        )

    def applied(self, frame: MapFrame) -> MapFrame:
        """Return a map frame with this place."""
        origin = (self.latitude_deg, self.longitude_deg, self.height_m)
        return MapFrame(frame.name, origin, self.x_heading_deg)


class Settings(_Model):
    """The content of ``semviz.toml``."""

    version: Literal[1]
    name: str
    trust_poses: bool = False
    """Accept poses that jump or go backwards."""
    source: Annotated[KittiSettings | StreetSettings | ImagesSettings, Field(discriminator="kind")]
    georeference: GeoreferenceSettings | None = None
    """Of sources that do not know it themselves."""
    calibration: Calibration | None = None
    """Calibration of the labels; None in a workspace of an older version."""


def read_settings(path: Path) -> Settings:
    """Return the settings in the workspace folder ``path``. Raise SemvizError if unreadable."""
    file = path / SETTINGS
    if not file.is_file():
        raise SemvizError(f"{path}: not a workspace (no {SETTINGS}); make one with 'semviz new'")
    raw = limits.read_toml(file)
    version = raw.get("version")
    if isinstance(version, int) and version > VERSION:
        raise SemvizError(
            f"{file}: workspace version {version}; this semviz reads up to {VERSION}: update semviz"
        )
    try:
        settings = Settings.model_validate(raw)
    except ValidationError as error:
        raise SemvizError(f"{file}: {_first_fault(error)}; repair it") from None
    written = _CHECKSUM.search(
        limits.read_limited(file, limits.MOST_SETTINGS_BYTES).decode("utf-8", "replace")
    )
    if written is not None and written[1] != _checksum(settings):
        raise SemvizError(
            f"{file}: name or [source] is not as semviz wrote it; if you edited it, delete the "
            "line '# Checksum ...' there, else restore the file"
        )
    return settings


def settings_content(settings: Settings, path: Path) -> bytes:
    """Return the content of ``semviz.toml`` of the workspace ``path``.

    Raise SemvizError for names that are no text.
    """
    checksum = _checksum(settings)
    note = f"# Checksum {checksum} of name and [source]: if you edit them, delete this line."
    text = f"{note}\n{tomli_w.dumps(settings.model_dump(exclude_none=True))}"
    try:
        return text.encode()
    except UnicodeEncodeError:
        raise SemvizError(
            f"{limits.shown(path)}: its name, or that of its images, is no text (UTF-8); rename it"
        ) from None


def append_table(path: Path, name: str, table: Mapping[str, object]) -> None:
    """Add a table to ``semviz.toml`` of the workspace ``path``, and keep people's edits."""
    file = path / SETTINGS
    text = file.read_text(encoding="utf-8").rstrip()
    with replacing(file) as temporary:
        temporary.write_text(f"{text}\n\n{tomli_w.dumps({name: table})}", encoding="utf-8")


def _checksum(settings: Settings) -> str:
    """Return the checksum of which images these are; spaces and comments do not count."""
    values = settings.model_dump(mode="json", include={"name", "source"}, exclude_defaults=True)
    return f"{zlib.crc32(json.dumps(values, sort_keys=True).encode()):08x}"


def new_settings(path: Path, source: Mapping[str, object], trust_poses: bool = False) -> Settings:
    """Return the settings of a new workspace. Raise SemvizError if a value is impossible."""
    name = path.resolve().name
    try:
        return Settings.model_validate(
            {"version": VERSION, "name": name, "trust_poses": trust_poses, "source": source}
        )
    except ValidationError as error:
        raise SemvizError(f"{path}: {_first_fault(error)}; choose another value") from None


def _first_fault(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"]) or "file"
    return limits.first_line(f"{where}: {first['msg']}")


def login_name() -> str:
    """Return the user's login name, the default author of edits."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "somebody"


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


def find_place(workspace: Path, name: str, relative: str, *, is_camera: bool = False) -> Path:
    """Return the folder or file of a setting. Raise SemvizError if it is at neither place.

    ``is_camera``: the folder of a camera of a rig.
    """
    near = (workspace.resolve() / relative).resolve()
    if _is_there(near):
        return near
    known = limits.read_toml(workspace / PLACES) if (workspace / PLACES).is_file() else {}
    far = known.get(name)
    if isinstance(far, str) and _is_there(Path(far)):
        return Path(far)
    also = f", nor at {limits.shown(far)}" if isinstance(far, str) and Path(far) != near else ""
    option = "--images PLACE, the folder of all cameras" if is_camera else f"--{name} PLACE"
    raise SemvizError(
        f"{limits.shown(near)}: '{name}' of the workspace not found there{also}; say where it is: "
        f"semviz relink {workspace} {option}"
    )


def _is_there(place: Path) -> bool:
    """Return whether a folder or file exists; a name that is too long is none."""
    try:
        return place.exists()
    except OSError:
        return False


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


def relink(workspace: "Workspace", given: dict[str, Path]) -> "Workspace":
    """Say where images and poses are now, and return the workspace with them.

    Settings and ``places.toml`` change only if the workspace opens with the new places: with the
    calibration of its labels, and all of its images' files. Raise SemvizError if not.
    """
    known = places_of(workspace.settings.source)
    given = cameras_within(workspace.settings.source, given) | given
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


def cameras_within(source: Source, given: dict[str, Path]) -> dict[str, Path]:
    """Return the folders of a rig's cameras within the one given as ``images``, if it has all.

    ``given`` loses it then. Cameras given one by one are not looked for.
    """
    if not isinstance(source, ImagesSettings) or not source.cameras or "images" not in given:
        return {}
    places = {"images": source.images, **source.cameras}
    within = {name: given["images"] / Path(path).name for name, path in places.items()}
    wanted = (place for name, place in within.items() if name == "images" or name not in given)
    if not all(place.is_dir() for place in wanted):
        return {}
    del given["images"]
    return within


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
    """Raise SemvizError if the source does not open, or images are missing or of another size.

    Whether images of the right names and size are the same ones is not checked."""
    from semviz_core.base.frame import FileDataset

    source = workspace.source
    if not isinstance(source, FileDataset):
        return
    sides = source.rig.sides
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
    if source.frames:
        _check_size(source)


def _check_size(source: "FileDataset") -> None:
    """Raise SemvizError if the first frame's images have another size than the calibration's."""
    from semviz_annotation.labels.views import camera_of

    for side in source.rig.sides:
        camera, _ = camera_of(source.rig, side)
        height, width, _ = source.image(source.frames[0].index, side).shape
        if (width, height) != (camera.width, camera.height):
            raise SemvizError(
                f"the {side} images there have {width}x{height} pixels, those of the workspace "
                f"{camera.width}x{camera.height}; nothing was changed"
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
