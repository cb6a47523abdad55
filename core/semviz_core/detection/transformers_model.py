"""Models of Hugging Face transformers: segmentation and object detection."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from semviz_core.arrays import ByteImage
from semviz_core.classes import ClassSet
from semviz_core.detection.boxes import box_regions, detr_boxes, sigmoid, softmax
from semviz_core.detection.image_rules import ImageRules, Size, read_image_rules
from semviz_core.detection.masks import mask_regions, segmentation_maps
from semviz_core.detection.model_classes import ModelClasses, model_classes, usual_classes
from semviz_core.detection.model_input import Placing
from semviz_core.detection.region import Region
from semviz_core.detection.settings_file import read_settings
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from torch import Tensor

HUB = "hf:"
"""Before the name of a model that Hugging Face keeps."""
SETTINGS = "classes.toml"
"""In a model's folder, where people want something else than what is usual."""
_HEADS = {
    "ForSemanticSegmentation": "AutoModelForSemanticSegmentation",
    "ForUniversalSegmentation": "AutoModelForUniversalSegmentation",
    "ForObjectDetection": "AutoModelForObjectDetection",
}
"""Of the names of architectures, and the classes that load them."""


class TransformersSettings(BaseModel):
    """``classes.toml``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    least_score: float = Field(default=0.3, ge=0.0, le=1.0)
    size: tuple[int, int] | None = None
    """Width and height of what the model looks at, in place of the model's own."""
    classes: dict[str, str] | None = None
    """From its labels to our classes, ``sign`` or ``ignore``."""


@dataclass(frozen=True, eq=False)
class TransformersFinder:
    """Looks at images with a model of transformers."""

    name: str
    rules: ImageRules
    classes: ModelClasses
    network: Any
    least_score: float

    @classmethod
    def load(cls, model: str, classes: ClassSet) -> "TransformersFinder":
        """From a folder, or ``hf:NAME`` where there is a network.

        Only safetensors are read, and no code that comes with a model is run. Raises SemvizError
        where that cannot be, or no class of the model is a pole or a sign.
        """
        _check_installed(model)
        folder = _downloaded(model) if model.startswith(HUB) else Path(model)
        settings, told_in = TransformersSettings(), folder / SETTINGS
        if told_in.exists():
            settings = read_settings(told_in, TransformersSettings)
        rules, network = read_image_rules(folder), _load_network(folder)
        if settings.size is not None:
            width, height = settings.size
            rules = rules.model_copy(
                update={"do_resize": True, "size": Size(width=width, height=height)}
            )
        labels = [str(one) for _, one in sorted(network.config.id2label.items())]
        told = usual_classes(labels) if settings.classes is None else settings.classes
        ours = model_classes(labels, told, classes, told_in)
        return cls(model, rules, ours, network, settings.least_score)

    def find(self, image: ByteImage) -> Sequence[Region]:
        """The regions in an image (height, width, 3) sRGB, of any size."""
        try:
            taken = self.rules.model_input(image.shape[1], image.shape[0])
            placing = taken.placing(image)
            return self._regions(self._run(taken.tensor(image, placing)), placing)
        except SemvizError as error:
            raise SemvizError(f"{self.name}: {error}") from None

    def _run(self, tensor: Any) -> Any:
        import torch

        try:
            with torch.inference_mode():
                return self.network(pixel_values=torch.from_numpy(tensor))
        except Exception as error:  # whatever a model trips over
            told = " ".join(str(error).split())
            raise SemvizError(f"cannot run on {tensor.shape}: {told}") from None

    def _regions(self, output: Any, placing: Placing) -> list[Region]:
        if "pred_boxes" in output:
            logits, boxes = _finite(output.logits), _finite(output.pred_boxes)
            found = detr_boxes(logits, boxes, len(self.classes), placing.input_size)
            return box_regions(found, self.classes, placing, self.least_score)
        universal = "masks_queries_logits" in output
        logits = _universal(output) if universal else _finite(output.logits)
        maps = segmentation_maps(logits, self.classes)
        return mask_regions(maps, self.classes, placing, self.least_score)


def _universal(output: Any) -> Any:
    """(1, classes, h, w) logits of Mask2Former and its kin, which tell masks and a class for each.

    A pixel's odds are those of all masks it is in, added up.
    """
    label = softmax(_finite(output.class_queries_logits)[0], 1)[:, :-1]  # the last is nothing
    inside = sigmoid(_finite(output.masks_queries_logits)[0])
    odds = np.einsum("qc,qhw->chw", label, inside)
    return np.log(np.maximum(odds, 1e-12))[None]


def _finite(tensor: "Tensor") -> Any:
    if not tensor.isfinite().all():
        raise SemvizError("its output is not of finite numbers; its weights are damaged")
    return tensor.float().numpy()


def _check_installed(model: str) -> None:
    try:
        import transformers
    except ImportError:
        raise SemvizError(
            f"{model}: needs transformers; pip install 'semviz[transformers]'"
        ) from None
    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)
    transformers.utils.logging.disable_progress_bar()


def _downloaded(model: str) -> Path:
    from huggingface_hub import snapshot_download

    try:
        name = model.removeprefix(HUB)
        return Path(snapshot_download(name, allow_patterns=["*.json", "*.safetensors"]))
    except Exception as error:  # no network, no such name, no right to it
        told = " ".join(str(error).split())
        raise SemvizError(
            f"{model}: cannot be fetched ({told}); give the folder of a model that is here"
        ) from None


def _load_network(folder: Path) -> Any:
    """Ready to look. Raises SemvizError where it is of another kind, damaged, or not whole."""
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
                f"a model of architecture {names[0]}; semviz takes those for semantic or universal "
                "segmentation and for object detection"
            )
        network, told = getattr(transformers, loader).from_pretrained(
            folder,
            dtype=torch.float32,
            local_files_only=True,
            trust_remote_code=False,
            use_safetensors=True,
            output_loading_info=True,
        )
    except Exception as error:  # its errors are of many kinds
        raise SemvizError(f"{folder}: cannot be loaded: {' '.join(str(error).split())}") from None
    if told["missing_keys"]:
        missing = ", ".join(sorted(told["missing_keys"])[:3])
        raise SemvizError(f"{folder}: its weights are not whole: no {missing}")
    return network.eval()
