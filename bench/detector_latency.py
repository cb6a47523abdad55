"""Latency of detection in an image of 1241 x 376 on one core: semviz and common architectures.

    OMP_NUM_THREADS=1 python bench/detector_latency.py [WEIGHTS]

semviz uses the shipped weights, or ``WEIGHTS``. The others are off-the-shelf architectures with
random weights, which do not change the time of a network; their detections are noise, so the time
from regions to elements is left out. Figures are processor time, best of ``REPEATED``. Needs
semviz[test].
"""

import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any

import onnxruntime
import tomli_w
import torch
import transformers

from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.common.arrays import ByteImage
from semviz_core.detection.detector import Detector, RegionModel, load_region_model
from semviz_core.detection.foreign_models import OnnxModel
from semviz_core.simulation.street import Street

SIZE = (1248, 384)
"""What the networks look at: the image, to the next 32."""
REPEATED = 10
LABELS = {0: "road", 1: "pole", 2: "traffic sign"} | {
    index: f"other {index}" for index in range(3, 19)
}


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    transformers.utils.logging.disable_progress_bar()
    image = Street(0).image(0, "left")
    assert image.shape == (376, 1241, 3)
    print(f"{'':34}{'parameters M':>14}{'ms an image':>14}")
    finder = load_region_model(*sys.argv[1:])
    _print("our own, regions", None, finder.find, image)
    _print("our own, regions and elements", None, Detector(finder).detect, image)
    with tempfile.TemporaryDirectory() as name:
        for label, network, outputs in (
            ("SegFormer-b0", _segformer(), ["logits"]),
            ("D-FINE-N", _d_fine(), ["logits", "pred_boxes"]),
        ):
            folder = Path(name) / label
            millions = sum(parameter.numel() for parameter in network.parameters()) / 1e6
            ours = _by_transformers(network, folder)
            _print(f"{label}, transformers", millions, ours.find, image)
            ours = _by_onnx_runtime(network, folder, outputs)
            _print(f"{label}, ONNX Runtime", millions, ours.find, image)


def _print(
    name: str, millions: float | None, look: Callable[[ByteImage], object], image: ByteImage
) -> None:
    times = []
    look(image)
    for _ in range(REPEATED):
        began = process_time()
        look(image)
        times.append(process_time() - began)
    told = "" if millions is None else f"{millions:.1f}"
    print(f"{name:34}{told:>14}{1e3 * min(times):14.0f}", flush=True)


def _segformer() -> Any:
    config = transformers.SegformerConfig(id2label=LABELS)  # its defaults are b0
    return transformers.SegformerForSemanticSegmentation(config).eval()


def _d_fine() -> Any:
    """As ``ustc-community/dfine-nano-coco`` is built."""
    backbone = transformers.HGNetV2Config(
        stem_channels=[3, 16, 16],
        stage_in_channels=[16, 64, 256, 512],
        stage_mid_channels=[16, 32, 64, 128],
        stage_out_channels=[64, 256, 512, 1024],
        stage_num_blocks=[1, 1, 2, 1],
        stage_numb_of_layers=[3] * 4,
        hidden_sizes=[64, 256, 512, 1024],
        use_learnable_affine_block=True,
        out_features=["stage3", "stage4"],
    )
    config = transformers.DFineConfig(
        backbone_config=backbone,
        d_model=128,
        encoder_hidden_dim=128,
        encoder_in_channels=[512, 1024],
        decoder_in_channels=[128, 128],
        encoder_ffn_dim=512,
        decoder_ffn_dim=512,
        feat_strides=[16, 32],
        num_feature_levels=2,
        encode_proj_layers=[1],
        decoder_n_points=[6, 6],
        decoder_layers=3,
        hidden_expansion=0.34,
        depth_mult=0.5,
        id2label=LABELS,
    )
    return transformers.DFineForObjectDetection(config).eval()


def _by_transformers(network: Any, folder: Path) -> RegionModel:
    network.save_pretrained(folder)
    rules = {"size": {"width": SIZE[0], "height": SIZE[1]}}
    (folder / "preprocessor_config.json").write_text(json.dumps(rules))
    return load_region_model(str(folder))


def _by_onnx_runtime(network: Any, folder: Path, outputs: list[str]) -> RegionModel:
    """On one core: ONNX Runtime would take all."""
    model = folder / "model.onnx"
    torch.onnx.export(
        _Outputs(network, outputs),
        (torch.zeros(1, 3, SIZE[1], SIZE[0]),),
        model,
        input_names=["image"],
        output_names=outputs,
        opset_version=17,
        dynamo=False,
    )
    settings = {
        "model": model.name,
        "kind": "detr" if "pred_boxes" in outputs else "segmentation",
        "labels": list(LABELS.values()),
        "outputs": outputs,
        "input": {"width": SIZE[0], "height": SIZE[1]},
        "classes": {"pole": "pole", "traffic sign": "sign"},
    }
    told = model.with_suffix(".toml")
    told.write_text(tomli_w.dumps(settings))
    finder = OnnxModel.load(told, DEFAULT_CLASSES)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return replace(finder, session=onnxruntime.InferenceSession(model, options))


class _Outputs(torch.nn.Module):
    """A network of transformers that gives tensors, as ONNX has it."""

    def __init__(self, network: Any, outputs: list[str]) -> None:
        super().__init__()
        self.network, self.outputs = network, outputs

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        told = self.network(pixel_values=image)
        return tuple(told[name] for name in self.outputs)


if __name__ == "__main__":
    main()
