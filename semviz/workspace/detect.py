"""Run a detector over a workspace's images, and store its proposals as they come.

An interrupted run resumes. Proposals are stored with the detector's settings and the hash of
its files, so that proposals of different detectors are never mixed.

``semviz detect choose`` writes a calibration beside the model; for the shipped model and models of
the hub, into the workspace. It holds for one model and one way of measuring; others are refused.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Literal, TypeAlias

from semviz.presentation.terminal import track
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.proposal import ProcessedImages, Proposal, Setting
from semviz_annotation.labels.proposals import Proposals, load_proposals, save_proposals
from semviz_core.base.detector_model import CALIBRATION_ENDING, DetectorCalibration
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError
from semviz_core.detection.detector import Detector

ImageName: TypeAlias = tuple[int, Side]
"""Frame index and side."""
Measuring = Literal["edges", "paper"]

SAVE_INTERVAL_S = 2.0
"""Detections are saved at least this often, so a killed process loses little ..."""
SAVING_SHARE = 0.05
"""... unless saving would take more than this share of the time."""
MODEL_FILE = "model_file"
"""Setting: the path of the model, beside which its calibration is. Not part of its identity."""
HASH_DIGITS = 8
"""Digits of the model's hash in the name of a detector."""
NO_CALIBRATION = "none"
"""Value of ``--calibration`` for scores and sigmas as the detector gave them."""
_CALIBRATION_NAME = f"detector{CALIBRATION_ENDING}"


@dataclass(frozen=True)
class DetectOptions:
    """Settings that determine the detections."""

    model: str | None = None
    """As in ``load_detector``; None: the shipped weights."""
    measuring: Measuring = "edges"
    least_score: float | None = None
    """Minimum score; None: the model's own threshold."""

    def __post_init__(self) -> None:
        if self.least_score is not None and not 0.0 <= self.least_score <= 1.0:
            raise SemvizError(f"score {self.least_score:g}: give a number from 0 to 1")


def detect_images(
    workspace: Workspace, detector: Detector, options: DetectOptions, images: Sequence[ImageName]
) -> Proposals:
    """Detect in ``images`` that were not processed before. Return all proposals of the workspace.

    Proposals are saved while it runs; the same call resumes. They replace those of a detector
    with other settings, and leave imported proposals alone.
    """
    writer = ProposalWriter(workspace, new_processed_images(detector, options))
    pending = [image for image in images if image not in writer.images]
    rig, source = workspace.source.rig, workspace.source
    try:
        for index, side in track(pending, "detecting", len(pending)):
            try:
                detections = detector.detect(source.image(index, side))
            except SemvizError as error:
                raise SemvizError(f"frame {index}, {side} image: {error}") from None
            camera = rig.left if side == "left" or rig.right is None else rig.right
            if options.least_score is not None:
                detections = detections[detections.score >= options.least_score]
            proposals = as_proposals(index, side, detections, camera, writer.detector)
            writer.add((index, side), proposals)
    finally:
        writer.save()
    return writer.proposals


def images_of(workspace: Workspace, frames: range | None, sides: Sequence[Side]) -> list[ImageName]:
    """Return the images of ``frames`` (None: all), by time. Raise SemvizError if there are none."""
    chosen = [
        frame.index for frame in workspace.source.frames if frames is None or frame.index in frames
    ]
    if not chosen:
        raise SemvizError("--frames: the sequence has none of these frames")
    return [(index, side) for index in chosen for side in sides]


def new_processed_images(detector: Detector, options: DetectOptions) -> ProcessedImages:
    """Return the record of a detector and its settings, without images yet."""
    settings = detection_settings(options)
    name = detector_name(detector, str(settings["model"]))
    if options.model is not None and Path(options.model).exists():
        settings[MODEL_FILE] = str(Path(options.model).resolve())
    return ProcessedImages(name, settings)


def detector_name(detector: Detector, model: str) -> str:
    """Return the name of a detector in proposals; ``model`` is the hash of its files."""
    return f"{detector.model.name} {model[:HASH_DIGITS]}"[-100:]


def detection_settings(options: DetectOptions) -> dict[str, Setting]:
    """Return the settings that detections depend on, as stored with them."""
    return {
        "model": model_hash(options.model),
        "measuring": options.measuring,
        "least_score": options.least_score,
        "semviz": version("semviz"),
    }


def stored_detections(workspace: Workspace, options: DetectOptions | None) -> Proposals:
    """Return the stored detections of ``options``, or of any detector if None.

    Without such detections, no image is processed.
    """
    stored = load_proposals(workspace.proposals_path, workspace.classes)
    processed = stored.processed
    if processed is None or (
        options is not None and _without_path(processed.settings) != detection_settings(options)
    ):
        return Proposals()
    return Proposals.of(stored.detections, processed)


def model_hash(model: str | None) -> str:
    """Return the hash of a model's files, or of the name it is loaded by."""
    from semviz_core.base.weights import shipped_weights

    path = shipped_weights("detector") if model is None else Path(model)
    hashed = sha256()
    for file in _files(path):
        hashed.update(file.name.encode())
        with file.open("rb") as content:
            while chunk := content.read(2**20):
                hashed.update(chunk)
    if not path.exists():
        hashed.update(str(model).encode())
    return hashed.hexdigest()


def _files(path: Path) -> Iterable[Path]:
    """Return the files of a model; a TOML file describes the ONNX model beside it."""
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        return [file for file in files if not file.name.endswith(CALIBRATION_ENDING)]
    beside = sorted(path.parent.glob("*.onnx")) if path.suffix == ".toml" else []
    return [file for file in (path, *beside) if file.is_file()]


class ProposalWriter:
    """Adds a detector's proposals to a workspace's file, and saves it now and then."""

    def __init__(self, workspace: Workspace, processed: ProcessedImages) -> None:
        self._path, self._classes = workspace.proposals_path, workspace.classes
        self._processed = processed
        stored = load_proposals(self._path, self._classes)
        self._saved_stamp = _stamp(self._path)
        former = stored.processed
        resumes = former is not None and _identity(former) == _identity(processed)
        self._detections = list(stored.detections) if former is not None and resumes else []
        detectors = {self.detector} | ({former.detector} if former else set())
        self._imported = _without(detectors, stored)
        self.images = set(former.images) if former is not None and resumes else set[ImageName]()
        self._next_save_s = 0.0

    @property
    def detector(self) -> str:
        """Name of the detector."""
        return self._processed.detector

    @property
    def proposals(self) -> Proposals:
        """All proposals, the detector's last."""
        settings = self._processed.settings
        processed = ProcessedImages(self.detector, settings, frozenset(self.images))
        own = {row.id for row in self._detections}
        return Proposals.of(
            [*(row for row in self._imported if row.id not in own), *self._detections], processed
        )

    def add(self, image: ImageName, detections: Iterable[Proposal]) -> None:
        """Add the proposals of an image; they are saved now or a little later."""
        self._detections += detections
        self.images.add(image)
        if perf_counter() >= self._next_save_s:
            self.save()

    def save(self) -> None:
        """Save. Raise SemvizError if another detector wrote the file meanwhile."""
        start_s = perf_counter()
        self._merge_imported()
        save_proposals(self.proposals, self._path, self._classes)
        self._saved_stamp = _stamp(self._path)
        now_s = perf_counter()
        self._next_save_s = now_s + max(SAVE_INTERVAL_S, (now_s - start_s) / SAVING_SHARE)

    def _merge_imported(self) -> None:
        """Take over proposals that people imported since the last save."""
        if _stamp(self._path) == self._saved_stamp:
            return
        stored = load_proposals(self._path, self._classes)
        former = stored.processed
        is_own = former is None or _identity(former) == _identity(self._processed)
        if not is_own or (former is not None and not former.images <= self.images):
            raise SemvizError(f"{self._path}: another 'semviz detect' writes there; let it finish")
        self._imported = _without({self.detector}, stored)


def _identity(processed: ProcessedImages) -> tuple[str, dict[str, Setting]]:
    return processed.detector, _without_path(processed.settings)


def _without_path(settings: dict[str, Setting]) -> dict[str, Setting]:
    """Return the settings without the model's place: a model that was moved is the same."""
    return {name: value for name, value in settings.items() if name != MODEL_FILE}


def _without(detectors: set[str], proposals: Proposals) -> list[Proposal]:
    """Return the proposals of other detectors, which were imported."""
    return [row for row in proposals.rows() if row.detector not in detectors]


def _stamp(path: Path) -> tuple[int, int] | None:
    """Return a value that changes with every write of the file."""
    if not path.exists():
        return None
    stat = path.stat()
    return stat.st_ino, stat.st_mtime_ns


def default_calibration_path(workspace: Workspace, model: str | None) -> Path:
    """Return where the calibration of a model is: beside it, or else in the workspace."""
    path = None if model is None else Path(model)
    if path is None or not path.exists():
        return workspace.path / _CALIBRATION_NAME
    return (
        path / _CALIBRATION_NAME
        if path.is_dir()
        else path.with_name(path.stem + CALIBRATION_ENDING)
    )


def find_calibration(
    workspace: Workspace, given: str | None
) -> tuple[Path, DetectorCalibration] | None:
    """Return the calibration of a workspace's detections with its file: the given one, or that of
    their model.

    Raise SemvizError if it was made for another model.
    """
    processed = load_proposals(workspace.proposals_path, workspace.classes).processed
    if given == NO_CALIBRATION:
        return None
    if given is not None:
        return _checked(Path(given), processed)
    if processed is None:
        return None
    model = processed.settings.get(MODEL_FILE)
    beside = default_calibration_path(workspace, None if model is None else str(model))
    if beside.is_file():
        return _checked(beside, processed)
    own = workspace.path / _CALIBRATION_NAME
    return _checked(own, processed) if own.is_file() else None


def _checked(path: Path, processed: ProcessedImages | None) -> tuple[Path, DetectorCalibration]:
    calibration = DetectorCalibration.load(path)
    detector = "unknown: they were imported" if processed is None else processed.detector
    if processed is None or not calibration.is_of(processed.settings):
        raise SemvizError(
            f"{path}: made for {calibration.detector}, measured by {calibration.measuring}, but "
            f"the detector is {detector}; run 'semviz detect choose' for it, or give "
            f"--calibration {NO_CALIBRATION}"
        )
    return path, calibration
