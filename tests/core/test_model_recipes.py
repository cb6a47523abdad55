"""The recipes of docs/detector.md: what the models' processors make of an image, and where answers
land. The models themselves cannot be downloaded by a test: networks here are stand-ins.
"""

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semviz_core.base.classes import POLE
from semviz_core.common.arrays import ByteImage
from semviz_core.detection import foreign_models
from semviz_core.detection.detector import load_region_model
from semviz_core.detection.foreign_models import SETTINGS, TransformersModel
from semviz_core.detection.model_config import IGNORED, SIGN
from semviz_core.detection.regions import Region

REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs" / "detector.md").read_text()
SIZE = 1241, 376
"""Width and height of KITTI's images."""
POLE_PX = np.array([600.0, 100.0, 605.0, 299.0])
"""Left, top, right, bottom of the planted pole."""
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
CITYSCAPES = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign",
    "vegetation", "terrain", "sky", "person", "rider", "car", "truck", "bus", "train",
    "motorcycle", "bicycle",
)  # fmt: skip
MAPILLARY = (
    "Road", "Building", "Banner", "Billboard", "Street Light", "Pole", "Traffic Sign Frame",
    "Utility Pole", "Traffic Light", "Traffic Sign (Back)", "Traffic Sign (Front)", "Car",
)  # fmt: skip
"""The classes of Mapillary Vistas that could be meant, and some others."""


@pytest.fixture(scope="module", autouse=True)
def transformers() -> Any:
    return pytest.importorskip("transformers", reason="pip install 'semviz[transformers]'")


def folder_of(folder: Path, labels: tuple[str, ...], **processor: Any) -> Path:
    """Write what a model's folder holds beside its weights."""
    folder.mkdir()
    names = {str(number): label for number, label in enumerate(labels)}
    (folder / "config.json").write_text(json.dumps({"id2label": names}))
    settings = {
        "do_resize": True, "do_normalize": True, "image_mean": MEAN, "image_std": STD,
        "resample": 2, **processor,
    }  # fmt: skip
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    return folder


def loaded(
    folder: Path, labels: tuple[str, ...], answer: Any, monkeypatch: pytest.MonkeyPatch
) -> TransformersModel:
    """Load a folder with a network that always gives ``answer(tensor)``."""

    class Network:
        config = SimpleNamespace(id2label=dict(enumerate(labels)))

        def __call__(self, pixel_values: Any) -> Any:
            return answer(pixel_values)

    monkeypatch.setattr(foreign_models, "_load_network", lambda _: Network())
    model = load_region_model(str(folder))
    assert isinstance(model, TransformersModel)
    return model


class Output(dict[str, Any]):
    """A record like those of transformers."""

    __getattr__ = dict.__getitem__


def planted(height: int, width: int) -> Any:
    """Logits of one class: the pole, in an input that the image fills."""
    import torch

    edges_px = np.add(POLE_PX, (-0.5, -0.5, 0.5, 0.5))
    left, top, right, bottom = edges_px * np.tile(np.divide((width, height), SIZE), 2)
    logits = torch.full((height, width), -9.0)
    logits[round(top) : round(bottom), round(left) : max(round(right), round(left) + 1)] = 9.0
    return logits


def image() -> ByteImage:
    return np.random.default_rng(2).integers(0, 255, (SIZE[1], SIZE[0], 3)).astype(np.uint8)


def assert_is_the_pole(regions: Any, within_px: float) -> None:
    (region,) = regions
    assert isinstance(region, Region)
    assert region.class_id == POLE
    assert np.abs(region.box_px - POLE_PX).max() <= within_px


def classes_toml() -> str:
    """The ``classes.toml`` of the page."""
    blocks = re.findall(r"^```toml\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    (block,) = (block for block in blocks if re.search(r"^size = ", block, re.MULTILINE))
    return str(block)


@pytest.mark.parametrize("square", [512, 1024])
def test_segformer_of_cityscapes(
    tmp_path: Path, transformers: Any, square: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its processor makes images square; the page's classes.toml keeps their proportions."""
    import torch

    def answer(tensor: Any) -> Any:
        height, width = (side // 4 for side in tensor.shape[2:])
        logits = torch.zeros(1, len(CITYSCAPES), height, width)
        logits[0, CITYSCAPES.index("pole")] = planted(height, width)
        return Output(logits=logits)

    folder = folder_of(
        tmp_path / "segformer", CITYSCAPES, image_processor_type="SegformerImageProcessor",
        size={"height": square, "width": square},
    )  # fmt: skip
    plain = loaded(folder, CITYSCAPES, answer, monkeypatch)
    assert plain.input.placement(image()).input_size == (square, square)
    (folder / SETTINGS).write_text(classes_toml())
    model = loaded(folder, CITYSCAPES, answer, monkeypatch)
    placement = model.input.placement(image())
    assert placement.input_size == (1248, 384)
    own = transformers.AutoImageProcessor.from_pretrained(folder, backend="pil")
    wanted = own(image(), size={"height": 384, "width": 1248}, return_tensors="np")
    np.testing.assert_array_equal(model.input.tensor(image()), wanted["pixel_values"])
    target = dict(zip(CITYSCAPES, model.classes.target.tolist(), strict=True))
    assert {label: id_ for label, id_ in target.items() if id_ != IGNORED} == {
        "pole": POLE,
        "traffic sign": SIGN,
    }
    assert_is_the_pole(model.find(image()), within_px=4.0)


def test_mask2former_of_mapillary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poles, utility poles and street lights are poles; fronts of traffic signs alone are signs."""
    import torch

    def answer(tensor: Any) -> Any:
        height, width = (side // 4 for side in tensor.shape[2:])
        masks = torch.full((1, 3, height, width), -9.0)
        masks[0, 1] = planted(height, width)
        masks[0, 2] = -masks[0, 1]  # the road is elsewhere
        queries = torch.full((1, 3, len(MAPILLARY) + 1), -9.0)
        queries[0, [0, 1, 2], [len(MAPILLARY), MAPILLARY.index("Utility Pole"), 0]] = 9.0
        return Output(masks_queries_logits=masks, class_queries_logits=queries)

    folder = folder_of(
        tmp_path / "mask2former", MAPILLARY, image_processor_type="Mask2FormerImageProcessor",
        size={"shortest_edge": 800, "longest_edge": 1333}, size_divisor=32, ignore_index=65,
        num_labels=65, do_reduce_labels=False,
    )  # fmt: skip
    model = loaded(folder, MAPILLARY, answer, monkeypatch)
    target = dict(zip(MAPILLARY, model.classes.target.tolist(), strict=True))
    assert {label: id_ for label, id_ in target.items() if id_ != IGNORED} == {
        "Street Light": POLE,
        "Pole": POLE,
        "Utility Pole": POLE,
        "Traffic Sign (Front)": SIGN,
    }
    placement = model.input.placement(image())
    assert all(side % 32 == 0 for side in placement.input_size)
    across, down = placement.scale
    assert down == pytest.approx(across, rel=0.03)  # stretched to whole multiples of 32
    assert_is_the_pole(model.find(image()), within_px=4.0)


def test_the_export_of_espnet_is_exact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bins of unequal size: torch alone refuses to export them; the script's graph is the same."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnxruntime")
    monkeypatch.syspath_prepend(str(REPOSITORY / "bench"))
    import export_espnetv2  # type: ignore[import-not-found]

    class Pooling(torch.nn.Module):  # type: ignore[misc, name-defined]
        def forward(self, image: Any) -> Any:
            pool = torch.nn.functional.adaptive_avg_pool2d
            height, width = (int(side * 0.3) for side in image.shape[2:])
            few = pool(image, (height, width))
            return torch.cat([few, pool(image, output_size=(height, width)) * 2.0], dim=1)

    with pytest.raises(torch.onnx.errors.SymbolicValueError, match="factor of input size"):
        torch.onnx.export(
            Pooling(), (torch.zeros(1, 3, 37, 53),), str(tmp_path / "plain.onnx"), dynamo=False
        )
    path = tmp_path / "pooling.onnx"
    assert export_espnetv2.export(Pooling().eval(), path, width=53, height=37) < 1e-6
    assert path.stat().st_size < 20_000  # constants, not the steps that fill them
    sys.modules.pop("export_espnetv2")
