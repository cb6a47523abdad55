"""Run a Hugging Face transformers model for segmentation or object detection."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from semviz_core.base.classes import ClassSet
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError, require_extra
from semviz_core.common.jit import Stopwatch
from semviz_core.detection import model_config, postprocessing
from semviz_core.detection.regions import Region

if TYPE_CHECKING:
    from torch import Tensor

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
