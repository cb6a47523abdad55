"""A detector looks at a workspace's images; what it finds is proposed, and kept as it comes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import TypeAlias

from semviz.progress import track
from semviz.workspace import Workspace
from semviz_annotation.detections import as_proposals
from semviz_annotation.looked import Looked, Setting
from semviz_annotation.proposals import Proposal, Proposals, load_proposals, save_proposals
from semviz_core.detection.detector import Detector
from semviz_core.detection.measure import Measuring
from semviz_core.elements import Elements2D
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

ImageName: TypeAlias = tuple[int, Side]
"""Frame index and side."""

EVERY_S = 2.0
"""What was found is saved so often, so a kill costs no more than that ..."""
SAVING_SHARE = 0.05
"""... but no more of the time than this goes into saving."""
DIGITS = 8
"""Of a model's hash, in the name of a detector: enough to tell models apart."""


@dataclass(frozen=True)
class DetectOptions:
    """Settings of a detector; with others it would find other things."""

    model: str | None = None
    """As ``load_finder`` takes it; None for what comes with semviz."""
    measuring: Measuring = "edges"
    least_score: float | None = None
    """What is less sure is not kept; None keeps all that the model calls found."""

    def __post_init__(self) -> None:
        if self.least_score is not None and not 0.0 <= self.least_score <= 1.0:
            raise SemvizError(f"score {self.least_score:g}: give a number from 0 to 1")


def detect_images(
    workspace: Workspace, detector: Detector, options: DetectOptions, images: Sequence[ImageName]
) -> Proposals:
    """What is proposed for a workspace once ``detector`` has looked at ``images``, too.

    It is saved as it comes: stopped at any moment, the same call goes on where it was. What a
    detector with other settings found before goes; what was brought in from elsewhere stays.
    """
    kept = Kept(workspace, looked_by(detector, options))
    left = [one for one in images if one not in kept.images]
    rig, source = workspace.source.rig, workspace.source
    try:
        for index, side in track(left, "looking", len(left)):
            try:
                found = detector.detect(source.image(index, side))
            except SemvizError as error:
                raise SemvizError(f"frame {index}, {side} image: {error}") from None
            camera = rig.left if side == "left" or rig.right is None else rig.right
            sure = sure_enough(found, options.least_score)
            kept.add((index, side), as_proposals(index, side, sure, camera, kept.detector))
    finally:
        kept.save()
    return kept.proposals


def images_of(workspace: Workspace, frames: range | None, sides: Sequence[Side]) -> list[ImageName]:
    """The images to look at, in order of time; SemvizError where there are none."""
    chosen = [one.index for one in workspace.source.frames if frames is None or one.index in frames]
    if not chosen:
        raise SemvizError("no frames are left: --frames names none that the sequence has")
    return [(index, side) for index in chosen for side in sides]


def sure_enough(found: Elements2D, least_score: float | None) -> Elements2D:
    """Those of at least a score."""
    return found if least_score is None else found[found.score >= least_score]


def looked_by(detector: Detector, options: DetectOptions) -> Looked:
    """Who looks, and with which settings, before it has looked at anything."""
    model = model_hash(options.model)
    settings: dict[str, Setting] = {
        "model": model,
        "measuring": options.measuring,
        "least_score": options.least_score,
        "semviz": version("semviz"),
    }
    return Looked(f"{detector.finder.name} {model[:DIGITS]}"[-100:], settings)


def model_hash(model: str | None) -> str:
    """Of all that a model is made of: its file or folder, or the name that it is loaded by."""
    from semviz_core.learning.weights import shipped_weights

    path = shipped_weights("detector") if model is None else Path(model)
    told = sha256()
    for file in _files(path):
        told.update(file.name.encode())
        with file.open("rb") as content:
            while chunk := content.read(2**20):
                told.update(chunk)
    if not path.exists():
        told.update(str(model).encode())
    return told.hexdigest()


def _files(path: Path) -> Iterable[Path]:
    """What counts: a settings file in TOML speaks of the model beside it."""
    if path.is_dir():
        return sorted(file for file in path.rglob("*") if file.is_file())
    beside = sorted(path.parent.glob("*.onnx")) if path.suffix == ".toml" else []
    return [file for file in (path, *beside) if file.is_file()]


class Kept:
    """A workspace's proposals while a detector is at work."""

    def __init__(self, workspace: Workspace, looked: Looked) -> None:
        self._path, self._classes = workspace.proposals_path, workspace.classes
        self._looked = looked
        before = load_proposals(self._path, self._classes)
        self._read = _stamp(self._path)
        former = before.looked
        goes_on = former is not None and _whose(former) == _whose(looked)
        self._found = list(before.found) if former is not None and goes_on else []
        self._others = _not_of({self.detector} | ({former.detector} if former else set()), before)
        self.images = set(former.images) if former is not None and goes_on else set[ImageName]()
        self._wait_until_s = 0.0

    @property
    def detector(self) -> str:
        """Its name."""
        return self._looked.detector

    @property
    def proposals(self) -> Proposals:
        """All of them, the detector's last."""
        looked = Looked(self.detector, self._looked.settings, frozenset(self.images))
        own = {row.id for row in self._found}
        return Proposals.of(
            [*(row for row in self._others if row.id not in own), *self._found], looked
        )

    def add(self, image: ImageName, found: Iterable[Proposal]) -> None:
        """What was found in an image; saved at once or a little later."""
        self._found += found
        self.images.add(image)
        if perf_counter() >= self._wait_until_s:
            self.save()

    def save(self) -> None:
        """Raises SemvizError where another detector wrote there meanwhile."""
        start_s = perf_counter()
        self._take_in()
        save_proposals(self.proposals, self._path, self._classes)
        self._read = _stamp(self._path)
        now_s = perf_counter()
        self._wait_until_s = now_s + max(EVERY_S, (now_s - start_s) / SAVING_SHARE)

    def _take_in(self) -> None:
        """What people brought in since we last wrote."""
        if _stamp(self._path) == self._read:
            return
        there = load_proposals(self._path, self._classes)
        mine = there.looked is None or _whose(there.looked) == _whose(self._looked)
        if not mine or (there.looked is not None and not there.looked.images <= self.images):
            raise SemvizError(f"{self._path}: another 'semviz detect' writes there; let it finish")
        self._others = _not_of({self.detector}, there)


def _whose(looked: Looked) -> tuple[str, dict[str, Setting]]:
    return looked.detector, looked.settings


def _not_of(detectors: set[str], proposals: Proposals) -> list[Proposal]:
    """What was brought in from elsewhere."""
    return [row for row in proposals.rows() if row.detector not in detectors]


def _stamp(path: Path) -> tuple[int, int] | None:
    """Changes whenever somebody writes the file."""
    if not path.exists():
        return None
    stat = path.stat()
    return stat.st_ino, stat.st_mtime_ns
