"""The workspace: one folder that can be copied, with labels, proposals, maps and runs.

    semviz.toml          settings: where the images come from
    places.toml          their absolute paths; see ``places``
    drive.json           cameras, images and poses of an own drive; see ``drive_file``
    left-out.csv         images that its import left out, if any; see ``drive_file``
    recorded/            images of a bag as recorded
    rectified/           images of an own drive without distortion, made when needed
    checks/              of an import: checks.json, and rows.png of a stereo pair
    labels.db            labels and their history
    proposals.parquet    detector proposals, if any
    kept/                keys that other labelling tools wrote, if any
    backdrop.safetensors dense coloured points of the drive, if made; see ``backdrop``
    image_motions.safetensors  motions measured in the images; see ``pose_check``
    pose_choices.json    what people chose for wrong poses, if anything; see ``pose_choices``
    map_decisions.json   what people decided on changes of a map; see ``map_decisions``
    detector.calibration.toml  what the scores of the detector mean, if chosen; see ``calibration``
    blind/NAME/          labels of frames that two people label blind; see ``blind``
    maps/NAME.parquet
    runs/NAME.rrd

The author of stored operations defaults to the login name.
"""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from semviz.workspace.drive import drive_file
from semviz.workspace.outputs import check_empty, checked_name
from semviz.workspace.poses.pose_choices import FILE as POSE_CHOICES
from semviz.workspace.poses.pose_choices import PoseChoices, read_choices
from semviz.workspace.settings import (
    SETTINGS,
    STREET_FRAMES,
    FrameRange,
    GeoreferenceSettings,
    ImagesSettings,
    KittiSettings,
    Settings,
    StreetSettings,
    append_table,
    find_place,
    keep_places,
    new_settings,
    read_settings,
    settings_content,
)
from semviz_core.base.camera import Rig
from semviz_core.base.classes import NEW_CENTER, ClassSet, TriangleCenter
from semviz_core.base.frame import Dataset, FileDataset
from semviz_core.base.map_file import load_map, save_map
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.datasets.validation import Calibration

if TYPE_CHECKING:
    from semviz_annotation.labels.labels import Labels
    from semviz_annotation.storage.store import LabelStore
    from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive
    from semviz_core.simulation.layout import Section
    from semviz_core.simulation.street import Street

BLIND = "blind"
MAIN = "main"
"""Default name of the map to build and use."""
TRUTH = "truth"
"""Name of the true map of a simulated street."""


class Workspace:
    """A workspace folder; get one from ``open`` or ``create_...``, which raise SemvizError.

    Opening reads ``semviz.toml`` only; ``source`` looks for the images on first use."""

    def __init__(self, path: Path, settings: Settings) -> None:
        self.path = path
        self.settings = settings

    @classmethod
    def open(cls, path: Path | str) -> "Workspace":
        """Return the workspace in folder ``path``."""
        path = Path(path)
        if path.parent.name == BLIND and (path.parent.parent / SETTINGS).is_file():
            from semviz.workspace.blind import BlindWorkspace

            return BlindWorkspace(cls.open(path.parent.parent), path.name)
        if not path.is_dir():
            raise SemvizError(
                f"{path}: no such workspace; make one with "
                f"'semviz new {path} --images FOLDER' (or --kitti ROOT, or --simulate SEED)"
            )
        return cls(path, read_settings(path))

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
        """Create a workspace for a KITTI sequence; ``frames`` None takes all.

        ``trust_poses`` accepts poses that jump or go backwards. ``poses`` is a file in TUM's or
        KITTI's format to use instead of the sequence's own.
        """
        from semviz_core.datasets.kitti import KittiSequence

        dataset = KittiSequence(root, sequence, cameras, frames, poses)
        _check_dataset(dataset, trust_poses)  # before a folder is made
        source = {
            "kind": "kitti",
            "root": os.path.relpath(root.resolve(), path.resolve()),
            "sequence": sequence,
            "cameras": cameras,
            "frames": None if frames is None else FrameRange.of(frames),
            "poses": None if poses is None else os.path.relpath(poses.resolve(), path.resolve()),
        }
        settings = new_settings(path, source, trust_poses)
        return cls._create(path, settings, dataset.rig)

    @classmethod
    def create_images(
        cls,
        path: Path,
        drive: "RecordedDrive",
        trust_poses: bool = False,
        extracted: Path | None = None,
    ) -> "Workspace":
        """Create a workspace for an own drive.

        ``trust_poses`` accepts poses that jump or are inverted. Images in the folder ``extracted``
        move into the workspace; others stay where they are.
        """

        def kept(folder: Path) -> str:
            if extracted is not None and folder.is_relative_to(extracted):
                return str(drive_file.RECORDED / folder.relative_to(extracted))
            return os.path.relpath(folder.resolve(), path.resolve())

        source: dict[str, object] = {"kind": "images", "images": kept(drive.left_folder)}
        if drive.right_folder is not None:
            source["right"] = kept(drive.right_folder)
        if drive.cameras:
            source["cameras"] = {name: kept(one.folder) for name, one in drive.cameras.items()}
        settings = new_settings(path, source, trust_poses)
        content = drive_file.DriveFile.of(drive, f"drive-{settings.name}")
        with tempfile.TemporaryDirectory() as cache:  # before a folder is made
            dataset = content.dataset(drive_file.ImageFolders.of_drive(drive), Path(cache))
            _check_dataset(dataset, trust_poses, looks_ahead=False)

        def fill() -> None:
            content.save(path / drive_file.DRIVE_FILE)
            drive_file.write_left_out(path / drive_file.LEFT_OUT, drive.left_out)
            if extracted is not None and extracted.is_dir():
                shutil.move(extracted, path / drive_file.RECORDED)

        return cls._create(path, settings, dataset.rig, fill)

    @classmethod
    def create_street(
        cls,
        path: Path,
        seed: int,
        frames: range | None = None,
        spacing_m: float = 1.0,
        sections: Iterable["Section"] = (),
    ) -> "Workspace":
        """Create a workspace for the simulated street of ``seed``; ``frames`` None makes 60.

        Without ``sections`` the street is an ordinary one. Its true map is saved as ``truth``.
        """
        if seed < 0:
            raise SemvizError(f"seed {seed}: give 0 or more")
        if frames is not None and (not frames or frames.start != 0 or frames.step != 1):
            raise SemvizError("frames of a simulated street start at 0: write 0:END")
        source = {
            "kind": "street",
            "seed": seed,
            "frames": STREET_FRAMES if frames is None else frames.stop,
            "spacing_m": spacing_m,
            "sections": [
                {"kind": section.kind, "length_m": section.length_m} for section in sections
            ],
        }
        settings = new_settings(path, source)
        workspace = cls(path, settings)
        street = workspace.street  # may fail, so before a folder is made
        truth = workspace.map_path(TRUTH)
        return cls._create(path, settings, street.rig, lambda: save_map(street.truth_map, truth))

    @classmethod
    def _create(
        cls,
        path: Path,
        settings: Settings,
        rig: Rig,
        fill: Callable[[], None] = lambda: None,
    ) -> "Workspace":
        """Make the folder, ``fill`` it, and write its settings: a folder without is no workspace,
        so one that was interrupted is never taken for a whole one."""
        settings = settings.model_copy(update={"calibration": Calibration.of(rig)})
        check_empty(path)
        content = settings_content(settings, path)
        for name in ("maps", "runs"):
            (path / name).mkdir(parents=True, exist_ok=True)
        fill()
        with replacing(path / SETTINGS) as temporary:
            temporary.write_bytes(content)
        keep_places(path, settings)
        return cls(path, settings)

    @property
    def name(self) -> str:
        return self.settings.name

    @property
    def classes(self) -> ClassSet:
        from semviz_annotation.storage.classes import read_classes

        return read_classes(self.labels_path)

    @cached_property
    def source(self) -> Dataset:
        """Images and poses, as people chose them: some refined, some frames left out. Raise
        SemvizError like ``given_source``, and if the choices belong to other poses."""
        given, choices = self.given_source, self.pose_choices()
        if not choices.present or not isinstance(given, FileDataset):
            return given
        try:
            return given.with_frames(choices.applied(given.frames))
        except SemvizError as error:
            raise SemvizError(f"{self.pose_choices_path}: {error}") from None

    @cached_property
    def given_source(self) -> Dataset:
        """Images, and poses as the drive gives them. Raise SemvizError if they are missing or
        implausible, or if the calibration is not that of the labels."""
        settings = self.settings.source
        if isinstance(settings, StreetSettings):
            source = self._open_street(settings)
            self._check_calibration(source.rig)
            return source
        is_kitti = isinstance(settings, KittiSettings)
        source = self._open_recorded(settings)
        self._check_calibration(source.rig)
        _check_dataset(source, self.settings.trust_poses, looks_ahead=is_kitti)
        return source

    @property
    def street(self) -> "Street":
        """The simulated street; raise SemvizError if the source is another one."""
        from semviz_core.simulation.street import Street

        if not isinstance(self.source, Street):
            raise SemvizError(f"{self.path}: only a simulated street has ground truth for this")
        return self.source

    def pose_choices(self) -> PoseChoices:
        """Read what people chose for wrong poses. Raise SemvizError if the file is damaged."""
        return read_choices(self.pose_choices_path)

    @property
    def pose_choices_path(self) -> Path:
        return self.path / POSE_CHOICES

    @property
    def labels_path(self) -> Path:
        return self.path / "labels.db"

    @property
    def proposals_path(self) -> Path:
        return self.path / "proposals.parquet"

    def map_path(self, name: str) -> Path:
        """Path of the map ``name``, which need not exist."""
        return self.path / "maps" / f"{checked_name(name)}.parquet"

    def run_path(self, name: str) -> Path:
        """Path of the run ``name``, which need not exist."""
        return self.path / "runs" / f"{checked_name(name)}.rrd"

    def maps(self) -> tuple[str, ...]:
        """Names of the maps, oldest first."""
        return _names(self.path / "maps", ".parquet")

    def runs(self) -> tuple[str, ...]:
        """Names of the runs, oldest first."""
        return _names(self.path / "runs", ".rrd")

    def read_map(self, name: str) -> SemanticMap:
        """Return the map ``name``. Raise SemvizError if it is missing or broken."""
        path = self.map_path(name)
        if not path.is_file():
            names = ", ".join(self.maps())
            raise SemvizError(
                f"{path}: no such map; "
                + (f"choose from {names}" if names else f"run 'semviz map build {self.path}'")
            )
        semantic_map = load_map(path)
        return replace(semantic_map, frame=self._on_earth(semantic_map.frame))

    @property
    def map_frame(self) -> MapFrame:
        """The frame of poses and maps; its place on Earth is the source's or as imports told it."""
        return self._on_earth(self.source.map_frame)

    def _on_earth(self, frame: MapFrame) -> MapFrame:
        place = self.settings.georeference
        return frame if place is None or frame.origin is not None else place.applied(frame)

    def keep_georeference(self, frame: MapFrame) -> bool:
        """Keep where a map of this workspace is on Earth, if nothing has told that before.

        Return whether it is new.
        """
        place = GeoreferenceSettings.of(frame)
        if place is None or self.map_frame.origin is not None:
            return False
        append_table(self.path, "georeference", place.model_dump())
        self.settings = self.settings.model_copy(update={"georeference": place})
        return True

    def open_labels(self) -> "LabelStore":
        """Open the label file; create it if it is missing. Close it, or use ``with``."""
        from semviz_annotation.storage.closed_frames import until_merged
        from semviz_annotation.storage.store import LabelStore

        rig = self.source.rig
        center = NEW_CENTER if self.labels_path.exists() else self._center_of_proposals
        store = LabelStore.open(self.labels_path, rig, center)
        store.closed = until_merged(store.team().shares)
        if self.settings.calibration is None:
            self._keep_calibration(rig)
        return store

    def read_labels(self) -> "Labels":
        """Return the present labels, empty if there is no label file. Needs no images."""
        from semviz_annotation.labels.labels import Labels
        from semviz_annotation.storage.store import LabelStore

        if not self.labels_path.exists():
            return Labels(triangle_center=self._center_of_proposals)
        with LabelStore.open(self.labels_path) as store:
            return store.labels

    @property
    def _center_of_proposals(self) -> TriangleCenter:
        """What new labels of triangular signs mark, as stored proposals can follow it."""
        from semviz_annotation.labels.proposals import load_proposals

        return load_proposals(self.proposals_path, self.classes).triangle_center

    @property
    def default_observations(self) -> Literal["labels", "simulated"]:
        """Default observations of a run: labels, or for a street without labels its detector."""
        is_street = isinstance(self.settings.source, StreetSettings)
        return "simulated" if is_street and not self.read_labels().observations else "labels"

    def _check_calibration(self, rig: Rig) -> None:
        known, now = self.settings.calibration, Calibration.of(rig)
        if known is None or known.hash == now.hash:
            return
        changed = ", ".join(known.differences(now)) or "its hash in the settings"
        raise SemvizError(
            f"{self.path}: the calibration is not the one of its labels: {changed}. Nothing was "
            f"loaded; restore the old one or, if the new one is right for these images, delete "
            f"[calibration] in {self.path / SETTINGS} (labels stay as they are)"
        )

    def _keep_calibration(self, rig: Rig) -> None:
        """Append the calibration to settings of an older version, and keep people's edits."""
        calibration = Calibration.of(rig)
        values = asdict(calibration).items()
        table = {name: value for name, value in values if value is not None}
        append_table(self.path, "calibration", table)
        self.settings = self.settings.model_copy(update={"calibration": calibration})

    def _open_recorded(self, settings: KittiSettings | ImagesSettings) -> Dataset:
        if isinstance(settings, KittiSettings):
            return self._open_kitti(settings)
        return self._open_images(settings)

    def _open_kitti(self, settings: KittiSettings) -> Dataset:
        from semviz_core.datasets.kitti import KittiSequence

        root = find_place(self.path, "root", settings.root)
        frames = None if settings.frames is None else settings.frames.as_range()
        poses = settings.poses and find_place(self.path, "poses", settings.poses)
        return KittiSequence(root, settings.sequence, settings.cameras, frames, poses or None)

    def _open_images(self, settings: ImagesSettings) -> Dataset:
        cameras = settings.cameras or {}
        place = partial(find_place, self.path, is_camera=bool(cameras))
        folders = drive_file.ImageFolders(
            place("images", settings.images),
            None if settings.right is None else place("right", settings.right),
            {name: place(name, kept) for name, kept in cameras.items()},
        )
        return drive_file.open_drive(
            self.path / drive_file.DRIVE_FILE, folders, self.path / drive_file.RECTIFIED
        )

    def _open_street(self, settings: StreetSettings) -> Dataset:
        from semviz_core.simulation.layout import Section, StreetOptions
        from semviz_core.simulation.street import Street

        sections = tuple(Section(section.kind, section.length_m) for section in settings.sections)
        options = StreetOptions(settings.frames, settings.spacing_m)
        return Street(settings.seed, replace(options, sections=sections) if sections else options)


def _check_dataset(source: Dataset, trust_poses: bool, looks_ahead: bool = True) -> None:
    """Raise SemvizError if image sizes, sides or poses of a recorded sequence are implausible.

    The camera of a vehicle that ``looks_ahead`` moves ahead.
    """
    from semviz_core.datasets.rig_cameras import frames_by_camera
    from semviz_core.datasets.validation import check_poses, check_sides, check_sizes

    name = source.map_frame.name
    try:
        check_sizes(source.rig)
        check_sides(source)
    except SemvizError as error:
        raise SemvizError(f"{name}: {error}") from None
    try:
        for frames in () if trust_poses else frames_by_camera(source).values():
            check_poses(frames, looks_ahead)
    except SemvizError as error:
        raise SemvizError(
            f"{name}: {error}; if the poses are right, use 'semviz new --trust-poses' "
            f"or set trust_poses = true at the top of {SETTINGS}"
        ) from None


def _names(folder: Path, suffix: str) -> tuple[str, ...]:
    files = [file for file in folder.glob(f"*{suffix}") if not file.name.startswith(".")]
    files.sort(key=lambda file: (file.stat().st_mtime_ns, file.name))
    return tuple(file.stem for file in files)
