"""The workspace: one folder, copyable, with everything that belongs to a piece of work.

semviz.toml          where the images come from
labels.db            labels and their history
proposals.parquet    what a detector proposes, if one did
kept/                what other labelling tools wrote beside labels, if any did
maps/NAME.parquet
runs/NAME.rrd
"""

import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from semviz_core.camera import Rig
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.errors import SemvizError
from semviz_core.files import replacing
from semviz_core.map_file import load_map, save_map
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.calibration import Calibration
from semviz_core.sources.source import Source
from semviz_core.sources.street.things import SectionKind

if TYPE_CHECKING:
    from semviz_annotation.labels import Labels
    from semviz_annotation.storing.store import LabelStore
    from semviz_core.sources.street.layout import Section
    from semviz_core.sources.street.street import Street

VERSION: Final = 1
SETTINGS = "semviz.toml"
STREET_FRAMES = 60
MOST_NAME_BYTES = 200
"""File systems take 255 with the ending and a temporary one."""
MAIN = "main"
"""Name of the map that is built and used where no other is asked for."""
TRUTH = "truth"
"""Name of the map that a simulated street comes with."""


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
    """Folder that holds ``sequences``, relative to the workspace where it is not absolute."""
    sequence: str = Field(pattern=r"^[A-Za-z0-9_-]+$")
    cameras: Annotated[tuple[int, ...], Field(min_length=1, max_length=2)] = (2, 3)
    frames: FrameRange | None = None
    poses: str | None = None
    """A file of poses in place of KITTI's own, relative to the workspace likewise."""


class SectionSettings(_Model):
    """A stretch of a simulated street; see ``semviz_core.sources.street.layout.Section``."""

    kind: SectionKind
    length_m: float = Field(gt=0, le=10_000)


class StreetSettings(_Model):
    """A simulated street: its seed, how many frames, past what."""

    kind: Literal["street"] = "street"
    seed: int = Field(ge=0)
    frames: int = Field(default=STREET_FRAMES, gt=0, le=10_000)
    spacing_m: float = Field(default=1.0, gt=0, le=20)
    sections: tuple[SectionSettings, ...] = ()


class Settings(_Model):
    """What ``semviz.toml`` holds."""

    version: Literal[1]
    name: str
    trust_poses: bool = False
    """Poses that jump or lead backwards are as they should be."""
    source: Annotated[KittiSettings | StreetSettings, Field(discriminator="kind")]
    calibration: Calibration | None = None
    """What the labels were made with; None in a workspace of an older version."""


class Workspace:
    """A folder that ``open`` found or ``create_*`` made; both raise SemvizError.

    Opening reads ``semviz.toml`` only; ``source`` looks for the images when first asked.
    """

    def __init__(self, path: Path, settings: Settings) -> None:
        self.path = path
        self.settings = settings

    @classmethod
    def open(cls, path: Path | str) -> "Workspace":
        """The workspace in folder ``path``."""
        path = Path(path)
        if not path.is_dir():
            raise SemvizError(
                f"{path}: no such workspace; make one with "
                f"'semviz new {path} --kitti ROOT' or 'semviz new {path} --simulate SEED'"
            )
        return cls(path, _read_settings(path))

    @classmethod
    def create_kitti(
        cls,
        path: Path,
        root: Path,
        sequence: str,
        cameras: tuple[int, ...] = (2, 3),
        frames: range | None = None,
        trust_poses: bool = False,
        poses: Path | None = None,
    ) -> "Workspace":
        """A new workspace over a KITTI sequence; ``frames`` None takes all.

        ``trust_poses``: also where they jump or lead backwards. ``poses``: a file of TUM's or
        KITTI's format in place of the sequence's own.
        """
        from semviz_core.sources.kitti import KittiSequence

        sequence_there = KittiSequence(root, sequence, cameras, frames, poses)
        _refuse_faults(sequence_there, trust_poses)  # wrong input leaves no folder behind
        source = {
            "kind": "kitti",
            "root": os.path.relpath(root.resolve(), path.resolve()),
            "sequence": sequence,
            "cameras": cameras,
            "frames": None if frames is None else FrameRange.of(frames),
            "poses": None if poses is None else os.path.relpath(poses.resolve(), path.resolve()),
        }
        settings = _new_settings(path, source, trust_poses)
        return cls._create(path, settings, sequence_there.rig)

    @classmethod
    def create_street(
        cls,
        path: Path,
        seed: int,
        frames: range | None = None,
        spacing_m: float = 1.0,
        sections: Iterable["Section"] = (),
    ) -> "Workspace":
        """A new workspace over the simulated street of ``seed``, which has 60 frames if None.

        ``sections`` are what the street leads past, an ordinary street if there are none. What
        truly stands there is kept as the map ``truth``.
        """
        if seed < 0:
            raise SemvizError(f"seed {seed}: the seed of a street is 0 or more")
        if frames is not None and (not frames or frames.start != 0 or frames.step != 1):
            raise SemvizError("a simulated street has the frames from 0 on: write 0:END")
        source = {
            "kind": "street",
            "seed": seed,
            "frames": STREET_FRAMES if frames is None else frames.stop,
            "spacing_m": spacing_m,
            "sections": [{"kind": one.kind, "length_m": one.length_m} for one in sections],
        }
        settings = _new_settings(path, source)
        street = cls(path, settings).street  # where it fails no folder is left behind
        made = cls._create(path, settings, street.rig)
        save_map(street.truth_map, made.map_path(TRUTH))
        return made

    @classmethod
    def _create(cls, path: Path, settings: Settings, rig: Rig) -> "Workspace":
        settings = settings.model_copy(update={"calibration": Calibration.of(rig)})
        if path.is_file() or (path.is_dir() and any(path.iterdir())):
            raise SemvizError(f"{path}: exists and is not empty; choose another name")
        text = tomli_w.dumps(settings.model_dump(exclude_none=True))
        with replacing(path / SETTINGS) as temporary:
            temporary.write_text(text, encoding="utf-8")
        (path / "maps").mkdir(exist_ok=True)
        (path / "runs").mkdir(exist_ok=True)
        return cls(path, settings)

    @property
    def name(self) -> str:
        return self.settings.name

    @property
    def classes(self) -> ClassSet:
        return DEFAULT_CLASSES

    @cached_property
    def source(self) -> Source:
        """The images and poses.

        SemvizError where they are not found, cannot be right, or have another calibration than
        that of the labels.
        """
        settings = self.settings.source
        if isinstance(settings, StreetSettings):
            source = self._open_street(settings)
            self._refuse_another_calibration(source.rig)
        else:
            source = self._open_kitti(settings)
            self._refuse_another_calibration(source.rig)
            _refuse_faults(source, self.settings.trust_poses)
        return source

    @property
    def street(self) -> "Street":
        """The source, where it is a simulated street; SemvizError where it is not."""
        from semviz_core.sources.street.street import Street

        if not isinstance(self.source, Street):
            raise SemvizError(f"{self.path}: only a simulated street knows what is truly there")
        return self.source

    @property
    def labels_path(self) -> Path:
        return self.path / "labels.db"

    @property
    def proposals_path(self) -> Path:
        """What a detector proposes, by 'semviz detect' or brought in by 'semviz labels propose'."""
        return self.path / "proposals.parquet"

    def map_path(self, name: str) -> Path:
        """Where the map called ``name`` is or would be."""
        return self.path / "maps" / f"{_checked_name(name)}.parquet"

    def run_path(self, name: str) -> Path:
        """Where the run called ``name`` is or would be."""
        return self.path / "runs" / f"{_checked_name(name)}.rrd"

    def maps(self) -> tuple[str, ...]:
        """Names of the maps, oldest first."""
        return _names(self.path / "maps", ".parquet")

    def runs(self) -> tuple[str, ...]:
        """Names of the runs, oldest first."""
        return _names(self.path / "runs", ".rrd")

    def read_map(self, name: str) -> SemanticMap:
        """The map called ``name``; SemvizError where it is missing or broken."""
        path = self.map_path(name)
        if not path.is_file():
            there = ", ".join(self.maps())
            raise SemvizError(
                f"{path}: no such map; "
                + (f"there are {there}" if there else f"'semviz map build {self.path}' makes one")
            )
        return load_map(path)

    def open_labels(self) -> "LabelStore":
        """The label file, made where there is none; close it (or use ``with``)."""
        from semviz_annotation.storing.store import LabelStore

        rig = self.source.rig
        store = LabelStore.open(self.labels_path, self.classes, rig)
        if self.settings.calibration is None:
            self._keep_calibration(rig)
        return store

    def read_labels(self) -> "Labels":
        """The labels as they are now, also without images; none where nobody has labelled yet."""
        from semviz_annotation.labels import Labels
        from semviz_annotation.storing.store import LabelStore

        if not self.labels_path.exists():
            return Labels()
        with LabelStore.open(self.labels_path, self.classes) as store:
            return store.labels

    @property
    def default_observations(self) -> Literal["labels", "simulated"]:
        """What a run sees unless told: labels, or a street's detector where there are none."""
        is_street = isinstance(self.settings.source, StreetSettings)
        return "simulated" if is_street and not self.read_labels().observations else "labels"

    def _refuse_another_calibration(self, rig: Rig) -> None:
        known, now = self.settings.calibration, Calibration.of(rig)
        if known is None or known.hash == now.hash:
            return
        changed = ", ".join(known.differences(now)) or "its hash in the settings"
        raise SemvizError(
            f"{self.path}: the calibration is not the one of its labels: {changed}. Nothing was "
            f"loaded; put the old one back or, where the new one is right for these images, delete "
            f"[calibration] in {self.path / SETTINGS} (labels stay as they are)"
        )

    def _keep_calibration(self, rig: Rig) -> None:
        """Adds it to the settings of an older version, which people may have edited."""
        kept = Calibration.of(rig)
        file = self.path / SETTINGS
        text = file.read_text(encoding="utf-8").rstrip()
        table = {name: value for name, value in asdict(kept).items() if value is not None}
        with replacing(file) as temporary:
            temporary.write_text(f"{text}\n\n{tomli_w.dumps({'calibration': table})}", "utf-8")
        self.settings = self.settings.model_copy(update={"calibration": kept})

    def _open_kitti(self, settings: KittiSettings) -> Source:
        from semviz_core.sources.kitti import KittiSequence

        root = (self.path.resolve() / settings.root).resolve()
        if not root.is_dir():
            raise SemvizError(
                f"{root}: the images of workspace '{self.name}' are not there; "
                f"edit 'root' in {self.path / SETTINGS}"
            )
        frames = None if settings.frames is None else settings.frames.as_range()
        poses = None if settings.poses is None else (self.path.resolve() / settings.poses).resolve()
        return KittiSequence(root, settings.sequence, settings.cameras, frames, poses)

    def _open_street(self, settings: StreetSettings) -> Source:
        from semviz_core.sources.street.layout import Section, StreetOptions
        from semviz_core.sources.street.street import Street

        sections = tuple(Section(one.kind, one.length_m) for one in settings.sections)
        options = StreetOptions(settings.frames, settings.spacing_m)
        return Street(settings.seed, replace(options, sections=sections) if sections else options)


def _refuse_faults(source: Source, trust_poses: bool) -> None:
    """What cannot be right in a recorded sequence, in one line each."""
    from semviz_core.sources.guard import check_poses, check_sizes
    from semviz_core.sources.sides import check_sides

    name = source.map_frame.name
    try:
        check_sizes(source.rig)
        check_sides(source)
    except SemvizError as error:
        raise SemvizError(f"{name}: {error}") from None
    try:
        if not trust_poses:
            check_poses(source.frames)
    except SemvizError as error:
        raise SemvizError(
            f"{name}: {error}; if the poses are right after all, say --trust-poses to 'semviz new' "
            f"or set trust_poses = true at the top of {SETTINGS}"
        ) from None


def find_runs(paths: Iterable[Path]) -> tuple[Path, ...]:
    """The runs that ``paths`` name: .rrd files, and all runs of workspaces, oldest first.

    Raises SemvizError where a path is neither, or no run is found at all.
    """
    from semviz.recording.reader import check_run_file

    runs: list[Path] = []
    for path in paths:
        if path.is_file() or path.suffix == ".rrd":
            check_run_file(path)
            runs.append(path)
        else:
            workspace = Workspace.open(path)
            if not workspace.runs():
                raise SemvizError(f"{path}: no runs yet; 'semviz localize {path}' records one")
            runs += [workspace.run_path(name) for name in workspace.runs()]
    return tuple(runs)


def _read_settings(path: Path) -> Settings:
    file = path / SETTINGS
    if not file.is_file():
        raise SemvizError(f"{path}: not a workspace, it has no {SETTINGS}; 'semviz new' makes one")
    try:
        raw = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise SemvizError(f"{file}: not readable as TOML ({error}); repair it") from None
    version = raw.get("version")
    if isinstance(version, int) and version > VERSION:
        raise SemvizError(
            f"{file}: workspace version {version}, this semviz reads up to {VERSION}; update semviz"
        )
    try:
        return Settings.model_validate(raw)
    except ValidationError as error:
        raise SemvizError(f"{file}: {_first_fault(error)}; repair it") from None


def _new_settings(path: Path, source: Mapping[str, object], trust_poses: bool = False) -> Settings:
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
    return f"{where}: {first['msg']}"


def _checked_name(name: str) -> str:
    fits = 0 < len(name.encode()) <= MOST_NAME_BYTES and name.isprintable()
    if not fits or name.startswith(".") or set(name) & set('/\\:*?"<>|'):
        raise SemvizError(f"{name!r} cannot be a file name; use letters, digits, '-' and '_'")
    return name


def _names(folder: Path, suffix: str) -> tuple[str, ...]:
    files = (file for file in folder.glob(f"*{suffix}") if not file.name.startswith("."))
    ordered = sorted(files, key=lambda file: (file.stat().st_mtime_ns, file.name))
    return tuple(file.stem for file in ordered)
