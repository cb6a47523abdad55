"""People's own exported models, run by ONNX Runtime; a small TOML says how to read each."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from semviz_core.arrays import ByteImage
from semviz_core.classes import ClassSet
from semviz_core.detection.boxes import box_regions, detr_boxes, yolo_boxes
from semviz_core.detection.masks import mask_regions, segmentation_maps
from semviz_core.detection.model_classes import ModelClasses, model_classes
from semviz_core.detection.model_input import ModelInput, Placing
from semviz_core.detection.region import Region
from semviz_core.detection.settings_file import read_settings
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

Kind = Literal["yolo-v5", "yolo-v8", "detr", "segmentation"]
_OUTPUTS: dict[Kind, tuple[str, ...]] = {
    "yolo-v5": ("boxes",),
    "yolo-v8": ("boxes",),
    "detr": ("logits", "boxes"),
    "segmentation": ("logits or labels",),
}
_MOST_LABELS = 10_000
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class OnnxSettings(BaseModel):
    """The TOML beside a model."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: str
    """The ONNX file, from the TOML's folder."""
    kind: Kind
    labels: int | tuple[str, ...]
    """The model's classes in its order: their names, or how many there are."""
    outputs: tuple[str, ...]
    """Names of those that are read: one; of DETR the logits, then the boxes."""
    least_score: float = Field(default=0.3, ge=0.0, le=1.0)
    most_overlap: float = Field(default=0.5, ge=0.0, le=1.0)
    """IoU up to which two boxes of YOLO are two elements."""
    input: ModelInput
    classes: dict[str, str]
    """From its labels (or their numbers) to our classes, ``sign`` or ``ignore``."""

    def model_post_init(self, _: Any) -> None:
        wanted = _OUTPUTS[self.kind]
        if len(self.outputs) != len(wanted):
            raise ValueError(f"outputs of kind {self.kind} are {len(wanted)}: {', '.join(wanted)}")
        number = self.labels if isinstance(self.labels, int) else len(self.labels)
        if not 1 <= number <= _MOST_LABELS:
            raise ValueError(f"labels: {number} of them; 1 to {_MOST_LABELS} will do")

    @property
    def label_names(self) -> tuple[str, ...]:
        """In the model's order; numbers where the names are not told."""
        if isinstance(self.labels, int):
            return tuple(str(one) for one in range(self.labels))
        return self.labels


@dataclass(frozen=True, eq=False)
class OnnxFinder:
    """Looks at images with somebody's ONNX model."""

    path: Path
    """Of the ONNX file."""
    settings: OnnxSettings
    classes: ModelClasses
    session: "InferenceSession"

    @classmethod
    def load(cls, path: Path, classes: ClassSet) -> "OnnxFinder":
        """From a TOML. An empty image is tried, so that what does not fit is told at once.

        Raises SemvizError, with the file that is wrong.
        """
        settings = read_settings(path, OnnxSettings)
        ours = model_classes(settings.label_names, settings.classes, classes, path)
        model = path.parent / settings.model
        finder = cls(model, settings, ours, _open_session(model))
        finder._check_session(path)
        taken = settings.input
        finder.find(np.zeros((taken.height, taken.width, 3), np.uint8))
        return finder

    @property
    def name(self) -> str:
        return self.path.stem

    def find(self, image: ByteImage) -> Sequence[Region]:
        """The regions in an image (height, width, 3) sRGB, of any size."""
        placing = self.settings.input.placing(image)
        outputs = self._run(image, placing)
        try:
            return self._regions(outputs, placing)
        except SemvizError as error:
            raise SemvizError(f"{self.path}: {error}; mend its TOML, or export it anew") from None

    def _run(self, image: ByteImage, placing: Placing) -> list[Any]:
        taken = self.session.get_inputs()[0]
        tensor = self.settings.input.tensor(image, placing).astype(_TYPES[taken.type])
        try:
            return list(self.session.run(list(self.settings.outputs), {taken.name: tensor}))
        except Exception as error:  # ONNX Runtime's have no common ancestor below
            told = " ".join(str(error).split())
            raise SemvizError(f"{self.path}: cannot run on {tensor.shape}: {told}") from None

    def _regions(self, outputs: list[Any], placing: Placing) -> list[Region]:
        for name, one in zip(self.settings.outputs, outputs, strict=True):
            numbers = isinstance(one, np.ndarray) and one.dtype.kind in "fiu"
            if not numbers or not np.isfinite(one).all():
                raise SemvizError(f"output {name!r} is not of finite numbers")
        least, kind, labels = self.settings.least_score, self.settings.kind, len(self.classes)
        if kind == "segmentation":
            maps = segmentation_maps(outputs[0], self.classes)
            return mask_regions(maps, self.classes, placing, least)
        if kind == "detr":
            boxes = detr_boxes(outputs[0], outputs[1], labels, placing.input_size)
            return box_regions(boxes, self.classes, placing, least)
        boxes = yolo_boxes(outputs[0], labels, objectness=kind == "yolo-v5")
        return box_regions(boxes, self.classes, placing, least, self.settings.most_overlap)

    def _check_session(self, path: Path) -> None:
        """Raises SemvizError where the model takes or gives something else than the TOML says."""
        inputs = self.session.get_inputs()
        if len(inputs) != 1 or inputs[0].type not in _TYPES:
            taken = ", ".join(f"{one.name} {one.type}" for one in inputs)
            raise SemvizError(f"{self.path}: takes {taken}; semviz gives one image of floats")
        wanted = (1, 3, self.settings.input.height, self.settings.input.width)
        shape = inputs[0].shape
        sides = zip(shape, wanted, strict=False)
        fits = all(one == want or not isinstance(one, int) for one, want in sides)
        if len(shape) != 4 or not fits:  # names, not numbers, are free
            raise SemvizError(f"{self.path}: takes {shape}, and {path} says {list(wanted)}")
        has = [one.name for one in self.session.get_outputs()]
        for name in self.settings.outputs:
            if name not in has:
                raise SemvizError(
                    f"{path}: outputs: no {name!r} in the model, but {', '.join(has)}"
                )


def _open_session(path: Path) -> "InferenceSession":
    try:
        import onnxruntime
    except ImportError:
        raise SemvizError(
            f"{path}: ONNX models need ONNX Runtime; pip install 'semviz[onnx]'"
        ) from None
    if not path.is_file():
        raise SemvizError(f"{path}: no such model; name the ONNX file in the TOML")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # its words go into our one line
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's have no common ancestor below
        told = " ".join(str(error).split())
        raise SemvizError(f"{path}: no ONNX model, or one that cannot run here: {told}") from None
