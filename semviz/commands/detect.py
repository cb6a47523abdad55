"""The commands detect, detect evaluate and detect train."""

import json
import os
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError, require_extra

if TYPE_CHECKING:
    from semviz.research.detector_evaluation import EvaluationImage
    from semviz.research.training_run import ForgettingCheck
    from semviz.research.workspace_data import LabelledSide
    from semviz.workspace.workspace import Workspace
    from semviz_annotation.labels.proposals import Proposals
    from semviz_core.base.frame import Side
    from semviz_core.detection.detector import MeasureRegion
    from semviz_core.research.training.detector_images import (
        LabelledImages,
        PreparedImages,
        StreetImages,
    )


@dataclass(frozen=True)
class DetectCommand:
    """Detect poles and signs in the images of a workspace. Detections become proposals for
    labelling, and observations for 'semviz localize --observations detected'.

    Run the same command again to resume. The word 'run' is optional.

    Example: 'semviz detect town --frames 0:100'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    model: Annotated[str | None, arg(metavar="MODEL", help_behavior_hint="")] = None
    """Weights of 'semviz detect train', the .toml of an ONNX model, the folder of a transformers
    model, or hf:NAME; default: the shipped weights."""
    measuring: Literal["edges", "paper"] = "edges"
    """Measurement within the detected regions: sub-pixel edges, or the paper's Canny and
    morphology."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP], END excluded; default: all frames."""
    sides: Literal["both", "left"] = "both"
    """Images to process; the left ones are enough to localize."""
    least_score: parsing.OptionalFloat = None
    """Minimum score; default: the model's own threshold. With weights of 'semviz detect train' it
    may be lower than that, which was chosen on rendered streets."""
    json: parsing.Json = False

    def run(self) -> int:
        from semviz.presentation.terminal import announce_compiling
        from semviz.workspace.detect import DetectOptions, detect_images, images_of
        from semviz.workspace.outputs import PARQUET, check_outputs
        from semviz_core.base.classes import DEFAULT_CLASSES
        from semviz_core.detection.detector import load_detector

        workspace = parsing.open_workspace(self.workspace)
        check_outputs(workspace.proposals_path, PARQUET, can_force=False, purpose="proposals")
        options = DetectOptions(self.model, self.measuring, self.least_score)
        images = images_of(workspace, parsing.parse_frames(self.frames), self._sides(workspace))
        measure = measurement(self.measuring)
        detector = load_detector(self.model, measure, least_score=self.least_score)
        announce_compiling("measuring")
        start_s = perf_counter()
        proposals = detect_images(workspace, detector, options, images)
        stages_ms = {stage: median(ms) for stage, ms in detector.time_ms.items()}
        if self.json:
            said = {"path": str(workspace.proposals_path), "proposals": len(proposals)}
            print(json.dumps(said | {"images": len(images), "median_ms": stages_ms}))
            return 0
        own = [class_.name for class_ in workspace.classes if class_.id not in DEFAULT_CLASSES]
        if own:
            print(f"the detector does not know {', '.join(own)}: label these by hand")
        print(f"{workspace.proposals_path}: {_summary(proposals, workspace)}")
        if stages_ms:
            stages = [f"{stage} {ms:.0f} ms" for stage, ms in stages_ms.items()]
            print(f"median time of an image: {', '.join(stages)}")
        print(
            f"{perf_counter() - start_s:.0f} s; next: semviz annotate {self.workspace}; "
            f"semviz localize {self.workspace} --observations detected"
        )
        return 0

    def _sides(self, workspace: "Workspace") -> tuple["Side", ...]:
        has_right = workspace.source.rig.right is not None
        return ("left", "right") if self.sides == "both" and has_right else ("left",)


def measurement(measuring: Literal["edges", "paper"]) -> "MeasureRegion":
    """Return the function that ``--measuring`` names."""
    if measuring == "paper":
        from semviz_core.research.paper.method import measure_as_in_paper

        return measure_as_in_paper
    from semviz_core.detection.detector import by_edges

    return by_edges


def _summary(proposals: "Proposals", workspace: "Workspace") -> str:
    """Return the number of detections per class, and of images, in words."""
    images = 0 if proposals.processed is None else len(proposals.processed.images)
    counts = Counter(row.class_id for row in proposals.detections)
    classes = [
        f"{counts[class_.id]} {class_.name}" for class_ in workspace.classes if counts[class_.id]
    ]
    return (
        f"{len(proposals.detections)} found in {images} images ({', '.join(classes) or 'nothing'})"
    )


REPORT = "report.html"


@dataclass(frozen=True)
class DetectEvaluateCommand:
    """Evaluate a detector: precision and recall per class, localization error, calibration of
    sigma and runtime, on held-out rendered streets or on labels.

    Example: 'semviz detect evaluate town --model trained/detector.safetensors'."""

    workspaces: Annotated[Positional[tuple[Path, ...]], arg(metavar="[WORKSPACE ...]")] = ()
    """Workspaces whose labels are the ground truth; default: rendered streets."""
    model: Annotated[str | None, arg(metavar="MODEL", help_behavior_hint="")] = None
    """As for 'semviz detect'; default: the shipped weights."""
    measuring: Literal["edges", "paper"] = "edges"
    """Measurement within the detected regions, as for 'semviz detect'."""
    streets: int = 20
    """Number of rendered streets; without workspaces only."""
    frames_a_street: int = 5
    """Number of frames per street."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP]: only these frames of the workspaces."""
    sides: Literal["left", "both"] = "left"
    """left: left images only; both: right ones too."""
    reach_m: float = 40.0
    """Ignore elements farther away than this."""
    ignore: Annotated[tuple[int, ...], arg(metavar="NUMBER ...")] = ()
    """Numbers of labelled elements that are neither to be found nor false if they are, such as
    advert boards among traffic signs."""
    least_score: parsing.OptionalFloat = None
    """Minimum score; default: the lowest with at most 0.2 false detections per frame."""
    out: parsing.OptionalPath = None
    """Folder for report.html: one page without network requests, with images of the errors."""
    stored: bool = False
    """Evaluate the detections that 'semviz detect' stored, whatever made them. Without it, stored
    ones are used if the same model and settings made them."""
    pictures: int = 24
    """Images of missed detections in the report, and as many of false positives."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object instead of tables."""

    def run(self) -> int:
        os.environ |= parsing.ONE_THREAD

        import cv2

        from semviz.research.detector_evaluation import evaluate
        from semviz.research.detector_report import detector_report_html, evaluation_text
        from semviz.workspace.outputs import check_outputs, contains
        from semviz_core.common.files import replacing
        from semviz_core.detection.detector import load_detector

        self._check()
        cv2.setNumThreads(1)
        if self.out is not None:
            ours = contains(b"<!DOCTYPE html>", b"<title>semviz detector: ")
            check_outputs(self.out / REPORT, ours, force=self.force, reads=self.workspaces)
        images = self._images()
        is_stored = self.stored or all(image.stored is not None for image in images)
        detector = None if is_stored else load_detector(self.model, measurement(self.measuring))
        settings = {"reach": f"{self.reach_m:g} m"}
        if self.ignore:
            settings["ignored elements"] = ", ".join(map(str, self.ignore))
        if self.workspaces:
            settings["detections"] = "stored by 'semviz detect'" if is_stored else "made now"
        evaluation = evaluate(detector, self.measuring, images, self.least_score, settings)
        if self.out is not None:
            page = detector_report_html(evaluation, self.pictures)
            with replacing(self.out / REPORT) as temporary:
                temporary.write_text(page, encoding="utf-8", newline="\n")
        print(json.dumps(evaluation.as_json()) if self.json else evaluation_text(evaluation))
        return 0

    def _check(self) -> None:
        from semviz_core.metrics.detection import NEAREST_M

        for number, option, minimum in (
            (self.streets, "--streets", 1),
            (self.frames_a_street, "--frames-a-street", 1),
            (self.pictures, "--pictures", 0),
        ):
            if number < minimum:
                raise SemvizError(f"{option} {number}: give {minimum} or more")
        if not self.reach_m > NEAREST_M:
            raise SemvizError(f"--reach-m {self.reach_m:g}: give more than {NEAREST_M:g} m")
        if self.least_score is not None and not 0.0 <= self.least_score <= 1.0:
            raise SemvizError(f"--least-score {self.least_score:g}: give a number from 0 to 1")
        if self.frames is not None and not self.workspaces:
            raise SemvizError("--frames needs a workspace; for streets use --frames-a-street")
        if self.ignore and len(self.workspaces) != 1:
            raise SemvizError("--ignore names elements of one workspace: give one")
        if self.stored and not self.workspaces:
            raise SemvizError("--stored needs a workspace, with detections of 'semviz detect'")
        if self.stored and self.model is not None:
            raise SemvizError("--stored takes the detections as they are; leave out --model")

    def _images(self) -> "list[EvaluationImage]":
        from semviz.research.detector_evaluation import labelled_images, street_images, with_stored
        from semviz.workspace.detect import DetectOptions, stored_detections
        from semviz_core.base.frame import Side

        sides: tuple[Side, ...] = ("left", "right") if self.sides == "both" else ("left",)
        if not self.workspaces:
            return list(street_images(self.streets, self.frames_a_street, sides, self.reach_m))
        frames = parsing.parse_frames(self.frames)
        workspaces = [parsing.open_workspace(path) for path in self.workspaces]
        options = None if self.stored else DetectOptions(self.model, self.measuring)
        return [
            image
            for workspace in workspaces
            for image in with_stored(
                labelled_images(workspace, frames, sides, self.reach_m, self.ignore),
                stored_detections(workspace, options),
            )
        ]


STREETS, STREETS_BESIDE_LABELS = 400, 40
HELD_OUT = 64
"""Size of the validation set, in crops."""
IMAGES, PREPARED = "streets", "prepared"


@dataclass(frozen=True)
class DetectTrainCommand:
    """Train the detector's network on rendered streets and on labels.

    Run the same command again to resume. A checkpoint is written every minute, at the end, on
    ctrl-C and on SIGTERM.

    Example: 'semviz detect train town --from shipped --out trained'."""

    workspaces: Annotated[Positional[tuple[Path, ...]], arg(metavar="[WORKSPACE ...]")] = ()
    """Also train on the labels of these workspaces."""
    map: parsing.OptionalText = None
    """Train on the elements of this map of the workspaces, projected into every frame, instead of
    the labels. An element counts where labels or stored detections show that it is visible."""
    segmentation: Annotated[tuple[Path, ...], arg(metavar="DIR ...")] = ()
    """Also train on these data sets of semantic segmentation: folders in Cityscapes' layout, or
    with segmentation.toml."""
    boxes: Annotated[tuple[Path, ...], arg(metavar="DIR ...")] = ()
    """Also train on these data sets of boxes, in COCO or YOLO form: folders with boxes.toml."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("detector")
    """Training folder: rendered images, checkpoint, losses as JSON lines and as a plot."""
    start: Annotated[str | None, arg(name="from", metavar="WEIGHTS", help_behavior_hint="")] = None
    """Initial weights; 'shipped': those that come with semviz."""
    streets: parsing.OptionalInt = None
    """Number of rendered streets, with ten images each; default: 400, or 40 with workspaces;
    0: labels only."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP]: only these frames of the workspaces."""
    samples: parsing.OptionalInt = None
    """Total number of crops; default: as planned before, or 48000."""
    batch: int = 8
    """Crops per step."""
    seed: int = 0
    """Seed of the initial weights and of the crops."""
    workers: int = 1
    """Processes that render and make crops."""
    precision: Literal["float32", "bf16"] = "float32"
    """bf16: half precision, faster on a GPU or a processor with AMX or AVX-512 BF16."""
    stop_after_s: parsing.OptionalFloat = None
    """Save and stop after this many seconds of training."""
    allow_loss: bool = False
    """Accept weights that find less on held-out streets than the initial ones."""
    force: parsing.Force = False
    json: parsing.Json = False

    def run(self) -> int:
        require_extra("semviz detect train", "torch", "train")
        if self.workers < 1:
            raise SemvizError(f"--workers {self.workers}: give 1 or more")

        from semviz.research.training_run import check_training_folder, train, training_summary
        from semviz_core.research.training.detector import make_detector
        from semviz_core.research.training.detector_images import ConcatImages

        check_training_folder(self.out, self.force, self.workspaces)
        start = self._start()
        sources = self._sources()
        check = None if start is None else self._check_of(start, sources)
        source = tuple(sources.values())
        task = make_detector(
            source[0] if len(source) == 1 else ConcatImages(source), self.seed, start
        )
        weights = "FOLDER/detector.safetensors"
        next_commands = [
            f"semviz weights {self.out} --out FOLDER",
            f"semviz detect evaluate --model {weights}",
            f"semviz detect WORKSPACE --model {weights}",
        ]
        run_check = None if check is None else partial(check.run, task)
        with parsing.text_aside(self.json):
            status = train(task, self, HELD_OUT, next_commands, run_check)
        if self.json:
            print(json.dumps(training_summary(self.out)))
        return status

    def _check_of(self, start: Path, sources: "dict[str, LabelledImages]") -> "ForgettingCheck":
        """Return the check for what the initial weights found; streets are always part of it."""
        from semviz.research.training_run import REPLAYED, ForgettingCheck

        streets = sources.get(REPLAYED) or self._render(0)
        check = ForgettingCheck(self.out, start, {**sources, REPLAYED: streets}, self.allow_loss)
        check.resume()
        return check

    def _start(self) -> Path | None:
        from semviz_core.base.weights import read_weights, shipped_weights

        if self.start is None:
            return None
        path = shipped_weights("detector") if self.start == "shipped" else Path(self.start)
        read_weights(path)  # fail before streets are rendered, not after
        return path

    def _sources(self) -> "dict[str, LabelledImages]":
        """Return labelled images, rendered streets, or both; render streets that are missing."""
        from semviz.research.training_run import REPLAYED

        sources: dict[str, LabelledImages] = {}
        if self.workspaces:
            from semviz.research.workspace_data import workspace_images

            workspaces = [parsing.open_workspace(path) for path in self.workspaces]
            name = "labels" if self.map is None else f"map {self.map}"
            sides_of = None if self.map is None else self._mapped_sides
            frames = parsing.parse_frames(self.frames)
            sources[name] = workspace_images(workspaces, frames, sides_of)
        elif self.frames is not None or self.map is not None:
            option = "--map" if self.frames is None else "--frames"
            raise SemvizError(f"{option} selects from workspaces; name a workspace")
        sources |= self._data_sets()
        if streets := self._streets():
            sources[REPLAYED] = self._render(streets)
        if not sources:
            raise SemvizError("--streets 0: no training images are left; name a workspace")
        return sources

    def _mapped_sides(self, workspace: "Workspace", frames: range | None) -> "list[LabelledSide]":
        from semviz.research.mapped_elements import mapped_sides

        assert self.map is not None
        return mapped_sides(workspace, self.map, frames)

    def _streets(self) -> int:
        if self.streets is not None and not 0 <= self.streets <= 9_000:
            raise SemvizError(f"--streets {self.streets}: give 0 to 9000")
        others = self.workspaces or self.segmentation or self.boxes
        default = STREETS_BESIDE_LABELS if others else STREETS
        return default if self.streets is None else self.streets

    def _render(self, streets: int) -> "StreetImages":
        from semviz_core.research.training.detector_images import StreetImages

        images = StreetImages(self.out / IMAGES, streets, max(2, streets // 20))
        self._make(images.render, images.missing(), "rendering streets")
        return images

    def _data_sets(self) -> "dict[str, PreparedImages[Any]]":
        """Return data sets by name, their elements measured."""
        from semviz_core.research.training.annotated_images import BoxImages, SegmentationImages

        prepared = self.out / PREPARED
        data_sets: dict[str, PreparedImages[Any]] = {
            str(folder): SegmentationImages.of(folder, prepared) for folder in self.segmentation
        }
        data_sets |= {f"boxes of {folder}": BoxImages.of(folder, prepared) for folder in self.boxes}
        for name, images in data_sets.items():
            self._make(images.prepare, images.missing(), f"measuring {name}")
        return data_sets

    def _make(self, make: Callable[[int], None], numbers: Sequence[int], doing: str) -> None:
        """Call ``make`` with each number, in processes of its own."""
        from semviz.presentation.terminal import track

        if not numbers:
            return
        try:
            with ProcessPoolExecutor(self.workers, get_context("spawn")) as pool:
                for _ in track(pool.map(make, numbers), doing, len(numbers)):
                    pass
        except BrokenProcessPool:
            raise SemvizError(
                f"a process died while {doing} (out of memory?); run the same command again to "
                "resume"
            ) from None
