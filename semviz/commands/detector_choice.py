"""The command detect choose."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.research.detector_choice import DetectorChoice
    from semviz.research.detector_evaluation import EvaluationImage
    from semviz.workspace.detect import DetectOptions
    from semviz.workspace.workspace import Workspace


@dataclass(frozen=True)
class DetectChooseCommand:
    """Calibrate a detector and choose its minimum score, on labelled frames or on a map.

    Writes what scores and sigmas mean, and the detector's rates, into one file beside the model.
    'semviz localize --observations detected' takes it from there."""

    workspace: Positional[Path]
    """Folder of the workspace. Its stored detections are used if the same model made them."""
    model: Annotated[str | None, arg(metavar="MODEL", help_behavior_hint="")] = None
    """As for 'semviz detect'; default: the shipped weights."""
    measuring: Literal["edges", "paper"] = "edges"
    """Measurement within the detected regions, as for 'semviz detect'."""
    map: parsing.OptionalText = None
    """Ground truth: elements of this map at the true poses; a detection without one is false.
    Default: the labels; a detection without one is false in reviewed frames."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP]: only these frames."""
    sides: Literal["left", "both"] = "left"
    """left: left images only; both: right ones too."""
    most_false: parsing.OptionalFloat = None
    """Choose the lowest score with at most this many false detections per image; default: the
    score that leaves the most right detections minus false ones."""
    out: parsing.OptionalPath = None
    """File to write; default: NAME.calibration.toml beside the model, or
    detector.calibration.toml in the workspace if the model is the shipped one or of the hub."""
    force: parsing.Force = False

    def run(self) -> int:
        from semviz.workspace.detect import DetectOptions, default_calibration_path
        from semviz.workspace.outputs import check_outputs, starts_with
        from semviz_core.base.detector_calibration import CALIBRATION_HEADER

        if self.most_false is not None and not self.most_false > 0.0:
            raise SemvizError(f"--most-false {self.most_false:g}: give a number above 0")
        workspace = parsing.open_workspace(self.workspace)
        path = self.out or default_calibration_path(workspace, self.model)
        ours = starts_with(CALIBRATION_HEADER.encode())
        check_outputs(path, ours, force=self.force, reads=[self.workspace], purpose="calibration")
        choice = self._choose(workspace, DetectOptions(self.model, self.measuring))
        choice.calibration.save(path)
        print(choice.as_text())
        print(f"{path}: written; next: semviz localize {self.workspace} --observations detected")
        return 0

    def _choose(self, workspace: "Workspace", options: "DetectOptions") -> "DetectorChoice":
        from semviz.commands.detect import measurement
        from semviz.research.detector_choice import calibration_images, choose
        from semviz.research.detector_evaluation import stored_detector, with_stored
        from semviz.workspace.detect import detection_settings, detector_name, stored_detections
        from semviz_core.detection.detector import load_detector

        stored = stored_detections(workspace, options)
        images = with_stored(self._images(workspace), stored)
        is_stored = all(image.stored is not None for image in images)
        detector = None if is_stored else load_detector(self.model, measurement(self.measuring))
        hash_ = str(detection_settings(options)["model"])
        name = stored_detector(images) if detector is None else detector_name(detector, hash_)
        return choose(
            calibration_images(detector, images),
            name,
            (hash_, self.measuring),
            self._truth(images),
            self.most_false,
        )

    def _images(self, workspace: "Workspace") -> "Sequence[EvaluationImage]":
        from semviz.research.detector_evaluation import labelled_images
        from semviz.research.mapped_elements import mapped_images
        from semviz_core.base.frame import Side
        from semviz_core.metrics.detection_calibration import REACH_M

        sides: tuple[Side, ...] = ("left", "right") if self.sides == "both" else ("left",)
        frames = parsing.parse_frames(self.frames)
        if self.map is None:
            return labelled_images(workspace, frames, sides, REACH_M)
        return mapped_images(workspace, self.map, frames, sides, REACH_M)

    def _truth(self, images: "Sequence[EvaluationImage]") -> str:
        """Return for example ``20 images of kitti02, 18 of them reviewed``."""
        what = f"{len(images)} images of {images[0].place}"
        if self.map is not None:
            return f"{what}, elements of map {self.map}"
        return f"{what}, {sum(image.is_complete for image in images)} of them reviewed"
