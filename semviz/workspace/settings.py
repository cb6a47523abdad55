"""The settings of a workspace, ``semviz.toml``: where its images come from.

People edit it, so only what decides which images the labels belong to has a checksum, in a comment
that an editor deletes: a seed, a frame number or a folder's name with one wrong bit opens others.
"""

import getpass
import json
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Literal

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import (
    MOST_SETTINGS_BYTES,
    first_line,
    read_limited,
    read_toml,
    shown,
)
from semviz_core.datasets.validation import Calibration
from semviz_core.simulation.objects import SectionKind

VERSION: Final = 1
SETTINGS = "semviz.toml"
STREET_FRAMES = 60
_CHECKSUM = re.compile(r"^# Checksum ([0-9a-f]{8}) of ", re.MULTILINE)


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
    root: str
    """Folder that holds ``sequences``, absolute or relative to the workspace."""
    sequence: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    cameras: Annotated[tuple[int, ...], Field(min_length=1, max_length=2)] = (2, 3)
    frames: FrameRange | None = None
    poses: str | None = None
    """A pose file to use instead of KITTI's, absolute or relative to the workspace."""


class ImagesSettings(_Model):
    """Folders of images of any camera; the file ``drive.json`` holds calibration and poses."""

    kind: Literal["images"] = "images"
    images: str
    """Folder of the left, or the only, camera, absolute or relative to the workspace."""
    right: str | None = None
    cameras: dict[str, str] | None = None
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


class Settings(_Model):
    """The content of ``semviz.toml``."""

    version: Literal[1]
    name: str
    trust_poses: bool = False
    """Accept poses that jump or go backwards."""
    source: Annotated[KittiSettings | StreetSettings | ImagesSettings, Field(discriminator="kind")]
    calibration: Calibration | None = None
    """Calibration of the labels; None in a workspace of an older version."""


def read_settings(path: Path) -> Settings:
    """Return the settings in the workspace folder ``path``. Raise SemvizError if unreadable."""
    file = path / SETTINGS
    if not file.is_file():
        raise SemvizError(f"{path}: not a workspace (no {SETTINGS}); make one with 'semviz new'")
    raw = read_toml(file)
    version = raw.get("version")
    if isinstance(version, int) and version > VERSION:
        raise SemvizError(
            f"{file}: workspace version {version}; this semviz reads up to {VERSION}: update semviz"
        )
    try:
        settings = Settings.model_validate(raw)
    except ValidationError as error:
        raise SemvizError(f"{file}: {_first_fault(error)}; repair it") from None
    written = _CHECKSUM.search(read_limited(file, MOST_SETTINGS_BYTES).decode("utf-8", "replace"))
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
            f"{shown(path)}: its name, or that of its images, is no text (UTF-8); rename it"
        ) from None


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
    return first_line(f"{where}: {first['msg']}")


def login_name() -> str:
    """Return the user's login name, the default author of edits."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "somebody"
