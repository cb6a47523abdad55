"""Models of transformers: they see what transformers' own code reads from them, and nothing that
comes with a model is ever run.

The models are tiny ones with random weights.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz_core.base.classes import POLE, TRIANGULAR
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError
from semviz_core.detection.detector import load_region_model
from semviz_core.detection.foreign_models import TransformersModel
from semviz_core.detection.model_config import ProcessorInput, default_classes

IMAGE_SIZE = (310, 94)
LABELS_OF_PIXELS = {0: "road", 1: "object--sign--store", 2: "Traffic Sign (Front)"}
MODEL_SIZE = (224, 96)
"""What the tiny models of transformers look at."""


def saved(network: Any, folder: Path, **told: object) -> Path:
    network.eval().save_pretrained(folder)
    rules = {
        "do_resize": True,
        "size": {"width": MODEL_SIZE[0], "height": MODEL_SIZE[1]},
        "do_normalize": True,
        "image_mean": [0.4, 0.5, 0.6],
        "image_std": [0.2, 0.3, 0.2],
        **told,
    }
    (folder / "preprocessor_config.json").write_text(json.dumps(rules))
    return folder


@pytest.fixture(scope="module")
def transformers() -> Any:
    module = pytest.importorskip("transformers", reason="pip install 'semviz[transformers]'")
    import torch

    torch.set_num_threads(1)
    torch.manual_seed(3)
    return module


@pytest.fixture(scope="module")
def segmenter(transformers: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny SegFormer."""
    config = transformers.SegformerConfig(
        depths=[1] * 4,
        hidden_sizes=[8, 8, 16, 16],
        num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=16,
        id2label=LABELS_OF_PIXELS,
    )
    network = transformers.SegformerForSemanticSegmentation(config)
    return saved(network, tmp_path_factory.mktemp("segmenter"))


@pytest.fixture(scope="module")
def universal(transformers: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny Mask2Former."""
    import torch

    config = transformers.Mask2FormerConfig(
        backbone_config=transformers.SwinConfig(
            embed_dim=8,
            depths=[1] * 4,
            num_heads=[1, 1, 2, 2],
            window_size=4,
            out_features=["stage1", "stage2", "stage3", "stage4"],
        ),
        feature_size=32,
        mask_feature_size=32,
        hidden_dim=32,
        encoder_feedforward_dim=32,
        dim_feedforward=32,
        encoder_layers=1,
        decoder_layers=2,
        num_attention_heads=2,
        num_queries=6,
        id2label=LABELS_OF_PIXELS,
    )
    torch.manual_seed(12)
    network = transformers.Mask2FormerForUniversalSegmentation(config)
    for name, parameter in network.named_parameters():
        if "class_predictor" in name or "mask_embedder" in name:  # else all pixels look the same
            parameter.data.normal_(std=0.6)
    return saved(network, tmp_path_factory.mktemp("universal"))


BOX_CLASSES = {0: "person", 1: "stop sign", 2: "pole"}


def tiny_detr(transformers: Any) -> Any:
    """Its scores are a softmax with one more for nothing."""
    return transformers.DetrForObjectDetection(
        transformers.DetrConfig(
            use_timm_backbone=False,
            use_pretrained_backbone=False,
            backbone=None,
            backbone_config=transformers.ResNetConfig(
                embedding_size=8, hidden_sizes=[8, 8, 8, 16], depths=[1] * 4, layer_type="basic"
            ),
            d_model=32,
            num_queries=12,
            encoder_layers=1,
            decoder_layers=1,
            encoder_attention_heads=2,
            decoder_attention_heads=2,
            encoder_ffn_dim=32,
            decoder_ffn_dim=32,
            id2label=BOX_CLASSES,
        )
    )


def tiny_d_fine(transformers: Any) -> Any:
    """Its scores are sigmoids."""
    return transformers.DFineForObjectDetection(
        transformers.DFineConfig(
            backbone_config=transformers.HGNetV2Config(
                stem_channels=[3, 8, 8],
                stage_in_channels=[8, 16, 16, 32],
                stage_mid_channels=[8, 8, 8, 16],
                stage_out_channels=[16, 16, 32, 32],
                stage_num_blocks=[1] * 4,
                stage_numb_of_layers=[1] * 4,
                embedding_size=8,
                hidden_sizes=[16, 16, 32, 32],
                depths=[1] * 4,
                out_features=["stage2", "stage3", "stage4"],
            ),
            d_model=32,
            num_queries=12,
            num_denoising=0,
            encoder_hidden_dim=32,
            encoder_in_channels=[16, 32, 32],
            decoder_in_channels=[32] * 3,
            encoder_ffn_dim=32,
            decoder_ffn_dim=32,
            encoder_attention_heads=2,
            decoder_attention_heads=2,
            decoder_layers=2,
            id2label=BOX_CLASSES,
        )
    )


def blobs(size: tuple[int, int] = IMAGE_SIZE) -> ByteImage:
    coarse = np.random.default_rng(1).integers(0, 256, (5, 12, 3), np.uint8)
    return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC))


def read_by_transformers(
    transformers: Any, folder: Path, processor: str, image: ByteImage
) -> tuple[Any, Any]:
    """Its processor, and what the model says of an image."""
    import torch

    reader = getattr(transformers, processor).from_pretrained(folder)
    tensor = reader(image, return_tensors="pt")["pixel_values"]
    heads = {"Seg": "SemanticSegmentation", "Mas": "UniversalSegmentation"}
    loader = heads.get(processor[:3], "ObjectDetection")
    network = getattr(transformers, f"AutoModelFor{loader}").from_pretrained(folder)
    with torch.inference_mode():
        return reader, network(pixel_values=tensor)


@pytest.mark.parametrize(
    ("model", "processor", "size", "least"),
    [
        ("segmenter", "SegformerImageProcessorPil", IMAGE_SIZE, 0.97),
        ("universal", "Mask2FormerImageProcessorPil", MODEL_SIZE, 0.94),  # resizes masks twice
    ],
)
def test_a_segmenter_sees_what_transformers_sees(
    transformers: Any,
    request: pytest.FixtureRequest,
    model: str,
    processor: str,
    size: tuple[int, int],
    least: float,
) -> None:
    folder, image = request.getfixturevalue(model), blobs(size)
    reader, output = read_by_transformers(transformers, folder, processor, image)
    told = reader.post_process_semantic_segmentation(output, target_sizes=[size[::-1]])
    wanted = told[0] == 2
    painted_in = np.zeros(size[::-1], bool)
    regions = load_region_model(str(folder)).find(image)
    for region in regions:
        assert region.class_id is None
        assert region.mask is not None
        (left, top), (rows, columns) = region.corner_px, region.mask.shape
        painted_in[top : top + rows, left : left + columns] |= region.mask
    both, either = wanted.numpy() & painted_in, wanted.numpy() | painted_in
    assert 0.02 < painted_in.mean() < 0.98
    assert both.sum() > least * either.sum()


@pytest.mark.parametrize(
    ("make", "processor"),
    [(tiny_detr, "DetrImageProcessorPil"), (tiny_d_fine, "RTDetrImageProcessorPil")],
)
def test_a_detector_sees_what_transformers_sees(
    transformers: Any, tmp_path: Path, make: Callable[[Any], Any], processor: str
) -> None:
    import torch

    network = make(transformers)
    for name, parameter in network.named_parameters():
        if "bbox" in name or "class" in name:  # else all boxes would be the same
            torch.nn.init.normal_(parameter, std=0.3)
    folder = saved(network, tmp_path, image_processor_type=processor.removesuffix("Pil"))
    (folder / "classes.toml").write_text(
        "least_score = 0.01\n[classes]\nperson = 'triangular sign'\n'stop sign' = 'sign'\n"
        "pole = 'pole'\n"
    )
    image = blobs(MODEL_SIZE)  # resized by others a random network would say something else
    reader, output = read_by_transformers(transformers, folder, processor, image)
    told = reader.post_process_object_detection(
        output, threshold=0.01, target_sizes=[MODEL_SIZE[::-1]]
    )[0]
    best: dict[tuple[float, ...], tuple[float, int]] = {}
    for score, label, box in zip(told["scores"], told["labels"], told["boxes"], strict=True):
        key = tuple(box.tolist())  # a sigmoid gives a box for every class: the best counts
        best[key] = max(best.get(key, (0.0, 0)), (float(score), int(label)))
    regions = load_region_model(str(folder)).find(image)
    assert len(best) > 8
    for box_px, (score, label) in best.items():
        wanted = np.clip(np.array(box_px) - 0.5, 0.0, np.tile(MODEL_SIZE, 2) - 1.0)
        nearest = min(regions, key=lambda region: float(np.abs(region.box_px - wanted).sum()))
        assert np.allclose(nearest.box_px, wanted, atol=0.01)
        assert nearest.score == pytest.approx(score, abs=1e-3)
        assert nearest.class_id == (TRIANGULAR, None, POLE)[label]


def test_usual_words_for_poles_and_signs_are_known() -> None:
    labels = ("traffic light", "pole", "object--support--utility-pole", "traffic sign", "Stop Sign")
    assert default_classes(labels) == {
        "pole": "pole",
        "object--support--utility-pole": "pole",
        "traffic sign": "sign",
        "Stop Sign": "sign",
    }


def test_a_model_of_the_hub_is_fetched_without_pickles_or_code(
    segmenter: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = pytest.importorskip("huggingface_hub")

    def fetch(name: str, allow_patterns: list[str]) -> str:
        if name != "some/model":
            raise OSError("no network\nat all")
        assert set(allow_patterns) == {"*.json", "*.safetensors"}
        return str(segmenter)

    monkeypatch.setattr(hub, "snapshot_download", fetch)
    model = load_region_model("hf:some/model")
    assert model.name == "hf:some/model"
    assert model.find(blobs())
    with pytest.raises(SemvizError, match=r"hf:other: cannot be fetched \(no network at all\)"):
        load_region_model("hf:other")


def copied(segmenter: Path, folder: Path) -> Path:
    shutil.copytree(segmenter, folder)
    return folder


def test_a_size_of_ones_own_and_proportions_that_are_kept(segmenter: Path, tmp_path: Path) -> None:
    folder = copied(segmenter, tmp_path / "model")
    model = load_region_model(str(folder))
    assert isinstance(model, TransformersModel)
    (folder / "classes.toml").write_text("size = [640, 192]\n")
    image = blobs((1241, 376))
    assert model.input.placement(image).input_size == (224, 96)
    other = load_region_model(str(folder))
    assert isinstance(other, TransformersModel)
    assert other.input.placement(image).input_size == (640, 192)
    rules = {"image_processor_type": "DetrImageProcessor", **KEEPING_PROPORTIONS}
    (folder / "preprocessor_config.json").write_text(json.dumps(rules))
    (folder / "classes.toml").unlink()
    kept = ProcessorInput.load(folder)
    for size, becomes in (((1241, 376), (1333, 404)), ((640, 480), (1066, 800))):
        placement = kept.placement(blobs(size))
        assert placement.input_size == becomes
        assert np.allclose(placement.scale, np.divide(becomes, size))
        assert not placement.offset.any()


KEEPING_PROPORTIONS = {"size": {"shortest_edge": 800, "longest_edge": 1333}}
CROPPING: dict[str, object] = {
    "image_processor_type": "MobileViTImageProcessor",
    "size": {"shortest_edge": 160},
    "do_center_crop": True,
    "crop_size": {"height": 128, "width": 256},
    "do_flip_channel_order": True,
}


def test_images_become_what_the_library_makes_of_them(transformers: Any, tmp_path: Path) -> None:
    """Resized, cropped, blue first: a red image and a blue one are told apart."""
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(CROPPING))
    taken, image = ProcessorInput.load(tmp_path), blobs()
    reader = transformers.AutoImageProcessor.from_pretrained(tmp_path, backend="pil")
    wanted = reader(image, return_tensors="np")["pixel_values"]
    assert wanted.shape == (1, 3, 128, 256)
    np.testing.assert_array_equal(taken.tensor(image), wanted)
    red = np.zeros_like(image)
    red[..., 0] = 255
    assert (taken.tensor(red)[0].mean(axis=(1, 2)) == [0.0, 0.0, 1.0]).all()
    width = 160 * IMAGE_SIZE[0] // IMAGE_SIZE[1]
    placement = taken.placement(image)
    assert np.allclose(placement.scale * IMAGE_SIZE, (width, 160))
    assert np.allclose(placement.offset, (-((width - 256) // 2), -16))


@given(
    image_size=st.tuples(st.integers(100, 400), st.integers(100, 400)),
    size=st.tuples(st.integers(60, 500), st.integers(60, 500)),
    crop=st.tuples(st.integers(50, 560), st.integers(50, 560)),
    resample=st.sampled_from([1, 2, 3]),  # Lanczos, bilinear, bicubic
)
@settings(max_examples=25)
def test_where_an_image_lies_in_the_input_is_measured_to_a_fraction_of_a_pixel(
    transformers: Any,
    tmp_path_factory: pytest.TempPathFactory,
    image_size: tuple[int, int],
    size: tuple[int, int],
    crop: tuple[int, int],
    resample: int,
) -> None:
    """Also what is cut off, and what is padded where the crop is larger."""
    folder = tmp_path_factory.mktemp("rules")
    (folder / "preprocessor_config.json").write_text(
        json.dumps(
            {
                "image_processor_type": "BeitImageProcessor",
                "size": {"width": size[0], "height": size[1]},
                "resample": resample,
                "do_center_crop": True,
                "crop_size": {"width": crop[0], "height": crop[1]},
            }
        )
    )
    placement = ProcessorInput.load(folder).placement(blobs(image_size))
    assert placement.input_size == crop
    offset = np.subtract(crop, size) // 2 + (np.subtract(crop, size) % 2)
    for at in (0.0, 0.5, 1.0):  # of the part of the image that the input shows
        shown = np.clip(np.array(crop) * at, offset, np.add(offset, size))
        in_image = (shown - offset) / np.divide(size, image_size)
        assert np.allclose(placement.scale * in_image + placement.offset, shown, atol=0.3)


def test_nothing_is_found_where_a_model_does_not_look(segmenter: Path, tmp_path: Path) -> None:
    folder = copied(segmenter, tmp_path / "model")
    edit("preprocessor_config.json", **CROPPING, do_normalize=False)(folder)
    (folder / "classes.toml").write_text("least_score = 0.0\n")
    model, image = load_region_model(str(folder)), blobs()
    assert isinstance(model, TransformersModel)
    placement = model.input.placement(image)
    low = (0.0 - placement.offset) / placement.scale - 1.0
    high = (placement.input_size - placement.offset) / placement.scale
    regions = model.find(image)
    assert regions
    for region in regions:
        assert (region.box_px[:2] >= low).all()
        assert (region.box_px[2:] <= high).all()


def test_an_image_that_is_mirrored_cannot_be_followed(
    segmenter: Path,
) -> None:
    taken = ProcessorInput.load(segmenter)

    def mirror(image: ByteImage, **more: object) -> Any:
        return taken.processor(image[:, ::-1], **more)

    mirrored = replace(taken, processor=mirror)
    with pytest.raises(SemvizError, match="does more than resize, crop and pad images"):
        mirrored.placement(blobs())


class Trap:
    """Unpickled, it writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def test_pickles_and_code_that_come_with_a_model_are_never_run(
    segmenter: Path, tmp_path: Path
) -> None:
    import torch

    folder, sprung = copied(segmenter, tmp_path / "model"), tmp_path / "sprung"
    (folder / "model.safetensors").unlink()
    torch.save({"weight": Trap(sprung)}, folder / "pytorch_model.bin")
    with pytest.raises(SemvizError, match=r"model: cannot be loaded: .*safetensors"):
        load_region_model(str(folder))
    config = json.loads((folder / "config.json").read_text())
    config |= {"model_type": "mine", "auto_map": {"AutoConfig": "mine.Config"}}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "mine.py").write_text(f"import pathlib; pathlib.Path({str(sprung)!r}).touch()")
    with pytest.raises(SemvizError, match="model: cannot be loaded"):
        load_region_model(str(folder))
    assert not sprung.exists()


def drop_a_tensor(folder: Path) -> None:
    tensors = safetensors.numpy.load_file(folder / "model.safetensors")
    tensors.pop("decode_head.classifier.bias")
    safetensors.numpy.save_file(tensors, folder / "model.safetensors", {"format": "pt"})


def spoil_a_tensor(folder: Path) -> None:
    tensors = safetensors.numpy.load_file(folder / "model.safetensors")
    tensors["decode_head.classifier.bias"][:] = np.nan
    safetensors.numpy.save_file(tensors, folder / "model.safetensors", {"format": "pt"})


def edit(name: str, **told: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        raw = json.loads((folder / name).read_text())
        (folder / name).write_text(json.dumps(raw | told))

    return change


def write(name: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text) and None


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (drop_a_tensor, "its weights are incomplete, without decode_head.classifier.bias"),
        (spoil_a_tensor, "its output holds numbers that are not finite"),
        (write("model.safetensors", "broken"), "cannot be loaded"),
        (write("config.json", "{"), "cannot be loaded"),
        (edit("config.json", architectures=["SegformerModel"]), "architecture SegformerModel"),
        (edit("config.json", id2label={"0": "a", "1": "b", "2": "c"}), "is a pole or a sign"),
        (lambda folder: (folder / "preprocessor_config.json").unlink(), "cannot be read"),
        (edit("preprocessor_config.json", size={"height": "high"}), "preprocessor_config.json: "),
        (
            edit("preprocessor_config.json", size={"height": 4, "width": 4}),
            r"become \(1, 3, 4, 4\)",
        ),
        (write("classes.toml", "[classes]\ntree = 'pole'"), "the model has no class 'tree'"),
        (write("classes.toml", "least = 0.5"), r"classes\.toml: least: "),
    ],
)
def test_a_folder_that_does_not_fit_is_one_line(
    segmenter: Path, tmp_path: Path, harm: Callable[[Path], None], message: str
) -> None:
    folder = copied(segmenter, tmp_path / "model")
    harm(folder)
    with pytest.raises(SemvizError, match=message) as raised:
        load_region_model(str(folder)).find(blobs())
    assert str(folder) in str(raised.value)
    assert "\n" not in str(raised.value)
