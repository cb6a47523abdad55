"""Which model looks at images: the one that ships, or one that people name."""

from pathlib import Path

from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.detection.detector import Detector, Finder
from semviz_core.detection.measure import Measuring
from semviz_core.detection.onnx_model import OnnxFinder
from semviz_core.detection.transformers_model import HUB, TransformersFinder
from semviz_core.errors import SemvizError

_KINDS = (
    "give *.safetensors of 'semviz detect train', a *.toml that describes an ONNX model, a folder "
    f"of a transformers model, or {HUB}NAME"
)


def load_finder(model: str | None = None, classes: ClassSet = DEFAULT_CLASSES) -> Finder:
    """None: the one that comes with semviz. Raises SemvizError where it cannot be loaded."""
    path = None if model is None else Path(model)
    if path is None or path.suffix == ".safetensors":
        from semviz_core.detection.own import load_own

        return load_own(path, classes)
    if path.suffix == ".toml":
        return OnnxFinder.load(path, classes)
    if str(model).startswith(HUB) or (path / "config.json").is_file():
        return TransformersFinder.load(str(model), classes)
    if path.suffix == ".onnx":
        raise SemvizError(f"{path}: name the TOML that says how to read it (docs/detector.md)")
    raise SemvizError(f"{path}: no model that semviz knows; {_KINDS}")


def load_detector(
    model: str | None = None,
    measuring: Measuring = "edges",
    classes: ClassSet = DEFAULT_CLASSES,
) -> Detector:
    """As ``load_finder``, with how regions become elements."""
    return Detector(load_finder(model, classes), measuring)
