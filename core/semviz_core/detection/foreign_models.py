"""Run models of others: an ONNX model that a small TOML file describes, or one of transformers.

ONNX Runtime and Hugging Face's transformers are extras, imported when a model is loaded.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from semviz_core.base.classes import ClassSet
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError, require_extra
from semviz_core.common.jit import Stopwatch
from semviz_core.detection import model_config, postprocessing
from semviz_core.detection.regions import Region

if TYPE_CHECKING:
    from torch import Tensor

from typing import TYPE_CHECKING, Literal

from semviz_core.detection.model_config import (
    ImagePlacement,
    ModelClasses,
    ModelInput,
    ProcessorInput,
    model_classes,
    read_settings,
)

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


HUB = "hf:"
"""Prefix of a model's name on Hugging Face."""
SETTINGS = "classes.toml"
"""Optional file in a model's folder that changes the default settings."""
_HEADS = {
    "ForSemanticSegmentation": "AutoModelForSemanticSegmentation",
    "ForUniversalSegmentation": "AutoModelForUniversalSegmentation",
    "ForObjectDetection": "AutoModelForObjectDetection",
}
"""From the suffix of an architecture's name to the class that loads it."""


class TransformersSettings(BaseModel):
    """The contents of ``classes.toml``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    least_score: float = Field(default=0.3, ge=0.0, le=1.0)
    size: tuple[int, int] | None = None
    """Width and height of the model's input; default: the model's own."""
    classes: dict[str, str] | None = None
    """From the labels to semviz classes, ``sign`` or ``ignore``."""


@dataclass(frozen=True, eq=False)
class TransformersModel:
    """A region model that runs a model of transformers."""

    name: str
    input: model_config.ProcessorInput
    classes: model_config.ModelClasses
    network: Any
    least_score: float

    @classmethod
    def load(cls, model: str, classes: ClassSet) -> "TransformersModel":
        """Load a model from a folder, or download ``hf:NAME``.

        Only safetensors are read, and no code of the model is run. Raise SemvizError if that fails,
        or if no class of the model is a pole or a sign.
        """
        for library in ("transformers", "torch"):
            require_extra(model, library, "transformers")
        _quiet()
        folder = _downloaded(model) if model.startswith(HUB) else Path(model)
        settings, settings_path = TransformersSettings(), folder / SETTINGS
        if settings_path.exists():
            settings = model_config.read_settings(settings_path, TransformersSettings)
        network, processor = (
            _load_network(folder),
            model_config.ProcessorInput.load(folder, settings.size),
        )
        labels = [str(label) for _, label in sorted(network.config.id2label.items())]
        mapping = (
            model_config.default_classes(labels) if settings.classes is None else settings.classes
        )
        ours = model_config.model_classes(labels, mapping, classes, settings_path)
        return cls(model, processor, ours, network, settings.least_score)

    def find(self, image: ByteImage, watch: Stopwatch | None = None) -> Sequence[Region]:
        """Return the regions in an image (height, width, 3) sRGB, of any size."""
        watch = watch or Stopwatch()
        try:
            placement = self.input.placement(image)
            output = watch.time("network", lambda: self._run(self.input.tensor(image)))
            return watch.time("regions", lambda: self._regions(output, placement))
        except SemvizError as error:
            raise SemvizError(f"{self.name}: {error}") from None

    def _run(self, tensor: Any) -> Any:
        import torch

        try:
            with torch.inference_mode():
                return self.network(pixel_values=torch.from_numpy(tensor))
        except Exception as error:  # models raise errors of many types
            message = " ".join(str(error).split())
            raise SemvizError(f"cannot run on {tensor.shape}: {message}") from None

    def _regions(self, output: Any, placement: model_config.ImagePlacement) -> list[Region]:
        if "pred_boxes" in output:
            logits, boxes = _finite(output.logits), _finite(output.pred_boxes)
            detected = postprocessing.detr_boxes(
                logits, boxes, len(self.classes), placement.input_size
            )
            return postprocessing.box_regions(detected, self.classes, placement, self.least_score)
        universal = "masks_queries_logits" in output
        logits = _universal(output) if universal else _finite(output.logits)
        maps = postprocessing.segmentation_maps(logits, self.classes)
        return postprocessing.mask_regions(maps, self.classes, placement, self.least_score)


def _universal(output: Any) -> Any:
    """Return (1, classes, h, w) logits of models like Mask2Former, which output masks with classes.

    A pixel's odds are the sum over all masks.
    """
    label = postprocessing.softmax(_finite(output.class_queries_logits)[0], 1)[
        :, :-1
    ]  # the last is nothing
    inside = postprocessing.sigmoid(_finite(output.masks_queries_logits)[0])
    odds = np.einsum("qc,qhw->chw", label, inside)
    return np.log(np.maximum(odds, 1e-12))[None]


def _finite(tensor: "Tensor") -> Any:
    if not tensor.isfinite().all():
        raise SemvizError("its output holds numbers that are not finite; its weights are damaged")
    return tensor.float().numpy()


def _quiet() -> None:
    """Silence the library: its message becomes part of SemvizError."""
    import transformers

    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)
    transformers.utils.logging.disable_progress_bar()


def _downloaded(model: str) -> Path:
    from huggingface_hub import snapshot_download

    try:
        name = model.removeprefix(HUB)
        return Path(snapshot_download(name, allow_patterns=["*.json", "*.safetensors"]))
    except Exception as error:  # no network, unknown name, no permission
        message = " ".join(str(error).split())
        raise SemvizError(
            f"{model}: cannot be fetched ({message}); give the folder of a local model"
        ) from None


def _load_network(folder: Path) -> Any:
    """Load a network for inference. Raise SemvizError if its kind is unknown, or it is damaged."""
    import torch
    import transformers

    try:
        config = transformers.AutoConfig.from_pretrained(
            folder, local_files_only=True, trust_remote_code=False
        )
        names = [*(config.architectures or []), "none"]
        loader = next((kind for head, kind in _HEADS.items() if names[0].endswith(head)), None)
        if loader is None:
            raise SemvizError(
                f"architecture {names[0]}; semviz takes models for semantic or universal "
                "segmentation and for object detection"
            )
        network, loading = getattr(transformers, loader).from_pretrained(
            folder,
            dtype=torch.float32,
            local_files_only=True,
            trust_remote_code=False,
            use_safetensors=True,
            output_loading_info=True,
        )
    except Exception as error:  # its errors are of many types
        raise SemvizError(f"{folder}: cannot be loaded: {' '.join(str(error).split())}") from None
    if loading["missing_keys"]:
        missing = ", ".join(sorted(loading["missing_keys"])[:3])
        raise SemvizError(f"{folder}: its weights are incomplete, without {missing}; copy it again")
    return network.eval()


Kind = Literal["yolo-v5", "yolo-v8", "detr", "segmentation"]
_OUTPUTS: dict[Kind, tuple[str, ...]] = {
    "yolo-v5": ("boxes",),
    "yolo-v8": ("boxes",),
    "detr": ("logits", "boxes"),
    "segmentation": ("logits or labels",),
}
_MOST_LABELS = 10_000
_EMPTY = (376, 1241)
"""Height and width of the test image for a model whose input may have any size."""
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class OnnxSettings(BaseModel):
    """The TOML file that describes a model."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: str
    """Path of the ONNX file, relative to the TOML's folder."""
    kind: Kind
    labels: int | tuple[str, ...]
    """The model's classes in its order: their names, or their number."""
    outputs: tuple[str, ...]
    """Names of the outputs to read: one, or for DETR the logits, then the boxes."""
    least_score: float = Field(default=0.3, ge=0.0, le=1.0)
    most_overlap: float = Field(default=0.5, ge=0.0, le=1.0)
    """IoU up to which two YOLO boxes are two elements."""
    input: ModelInput | None = None
    """None: as described by the ``preprocessor_config.json`` beside the model."""
    classes: dict[str, str]
    """From the labels (or their numbers) to semviz classes, ``sign`` or ``ignore``."""

    def model_post_init(self, _: Any) -> None:
        wanted = _OUTPUTS[self.kind]
        if len(self.outputs) != len(wanted):
            raise ValueError(f"outputs of kind {self.kind} are {len(wanted)}: {', '.join(wanted)}")
        number = self.labels if isinstance(self.labels, int) else len(self.labels)
        if not 1 <= number <= _MOST_LABELS:
            raise ValueError(f"labels: {number} of them; 1 to {_MOST_LABELS} will do")

    @property
    def label_names(self) -> tuple[str, ...]:
        """Labels in the model's order; numbers if the names are unknown."""
        if isinstance(self.labels, int):
            return tuple(str(number) for number in range(self.labels))
        return self.labels


@dataclass(frozen=True, eq=False)
class OnnxModel:
    """A region model that runs an ONNX file."""

    path: Path
    """The ONNX file."""
    settings: OnnxSettings
    input: ModelInput | ProcessorInput
    classes: ModelClasses
    session: "InferenceSession"

    @classmethod
    def load(cls, path: Path, classes: ClassSet) -> "OnnxModel":
        """Load the model that a TOML describes, and run it on an empty image.

        Raise SemvizError, with the file that is wrong.
        """
        settings = read_settings(path, OnnxSettings)
        ours = model_classes(settings.label_names, settings.classes, classes, path)
        model = path.parent / settings.model
        model_input = settings.input or ProcessorInput.load(model.parent)
        loaded = cls(model, settings, model_input, ours, _open_session(model))
        loaded._check_session(path)
        own_input = settings.input
        loaded.find(
            np.zeros((*((own_input.height, own_input.width) if own_input else _EMPTY), 3), np.uint8)
        )
        return loaded

    @property
    def name(self) -> str:
        return self.path.stem

    def find(self, image: ByteImage, watch: Stopwatch | None = None) -> Sequence[Region]:
        """Return the regions in an image (height, width, 3) sRGB, of any size."""
        watch = watch or Stopwatch()
        placement = self.input.placement(image)
        outputs = watch.time("network", lambda: self._run(image, placement))
        try:
            return watch.time("regions", lambda: self._regions(outputs, placement))
        except SemvizError as error:
            raise SemvizError(f"{self.path}: {error}; fix its TOML, or export it again") from None

    def _run(self, image: ByteImage, placement: ImagePlacement) -> list[Any]:
        session_input = self.session.get_inputs()[0]
        tensor = self.input.tensor(image, placement).astype(_TYPES[session_input.type])
        try:
            return list(self.session.run(list(self.settings.outputs), {session_input.name: tensor}))
        except Exception as error:  # ONNX Runtime's errors have no other common base class
            message = " ".join(str(error).split())
            raise SemvizError(f"{self.path}: cannot run on {tensor.shape}: {message}") from None

    def _regions(self, outputs: list[Any], placement: ImagePlacement) -> list[Region]:
        least, kind, labels = self.settings.least_score, self.settings.kind, len(self.classes)
        for name, output in zip(self.settings.outputs, outputs, strict=True):
            numbers = isinstance(output, np.ndarray) and output.dtype.kind in "fiu"
            if not numbers or not (kind == "segmentation" or _all_finite(output)):
                raise SemvizError(f"output {name!r} holds other than finite numbers")
        if kind == "segmentation":
            maps = postprocessing.segmentation_maps(outputs[0], self.classes)
            return postprocessing.mask_regions(maps, self.classes, placement, least)
        if kind == "detr":
            boxes = postprocessing.detr_boxes(outputs[0], outputs[1], labels, placement.input_size)
            return postprocessing.box_regions(boxes, self.classes, placement, least)
        boxes = postprocessing.yolo_boxes(outputs[0], labels, objectness=kind == "yolo-v5")
        return postprocessing.box_regions(
            boxes, self.classes, placement, least, self.settings.most_overlap
        )

    def _check_session(self, path: Path) -> None:
        """Raise SemvizError if the model's inputs or outputs differ from the TOML."""
        inputs = self.session.get_inputs()
        if len(inputs) != 1 or inputs[0].type not in _TYPES:
            given = ", ".join(f"{input_.name} {input_.type}" for input_ in inputs)
            raise SemvizError(f"{self.path}: takes {given}; semviz gives one image of floats")
        own_input = self.settings.input
        wanted = (1, 3, own_input.height, own_input.width) if own_input else (1, 3)
        shape = inputs[0].shape
        sides = zip(shape, wanted, strict=False)
        fits = all(side == want or not isinstance(side, int) for side, want in sides)
        if len(shape) != 4 or not fits:  # names, not numbers, are free
            raise SemvizError(f"{self.path}: takes {shape}, and {path} says {list(wanted)}")
        has = [output.name for output in self.session.get_outputs()]
        for name in self.settings.outputs:
            if name not in has:
                raise SemvizError(
                    f"{path}: outputs: no {name!r} in the model, but {', '.join(has)}"
                )


def _all_finite(output: NDArray[Any]) -> bool:
    """Return whether there is no NaN and no infinity; the sum is quick, and may overflow."""
    if np.isfinite(output.sum()):
        return True
    return bool(np.isfinite(output).all())


def _open_session(path: Path) -> "InferenceSession":
    require_extra(str(path), "onnxruntime", "onnx")
    import onnxruntime

    if not path.is_file():
        raise SemvizError(f"{path}: no such model; name the ONNX file in the TOML")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # its message becomes part of SemvizError
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's errors have no other common base class
        message = " ".join(str(error).split())
        raise SemvizError(f"{path}: not an ONNX model that can run here: {message}") from None
