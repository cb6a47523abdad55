"""Export ESPNetv2, trained on Cityscapes, to ONNX with the TOML that semviz reads.

    git clone https://github.com/sacmehta/EdgeNets
    python bench/export_espnetv2.py EdgeNets models/espnet.onnx [1248x384]

The network's code and weights are those of the cloned repository (MIT licence; Cityscapes allows
non-commercial use only). Its size is fixed at the export: give about that of your images, each side
a multiple of 32. torch cannot export adaptive average pooling to sizes that do not divide the
input's; here it is replaced by an equal product with two matrices. Needs torch, onnx and
onnxruntime.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor

from semviz_core.common.errors import SemvizError

SCALE = 2.0
WEIGHTS = f"model/segmentation/model_zoo/espnetv2/espnetv2_s_{SCALE}_city_1024x512.pth"
LARGEST_DIFFERENCE = 1e-3
"""Largest difference of a logit between torch and ONNX Runtime."""
TOML = """\
model = "{name}"
kind = "segmentation"
labels = ["road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign",
          "vegetation", "terrain", "sky", "person", "rider", "car", "truck", "bus", "train",
          "motorcycle", "bicycle", "background"]
outputs = ["logits"]

[input]
width = {width}
height = {height}
resize = "stretch"
mean = [0.485, 0.456, 0.406]
std = [0.229, 0.224, 0.225]

[classes]
pole = "pole"
"traffic sign" = "sign"
"""


def pooled(image: Tensor, output_size: int | tuple[int, int]) -> Tensor:
    """Return the adaptive average pooling of (b, c, h, w), as products with matrices of means."""
    sides = (output_size, output_size) if isinstance(output_size, int) else output_size
    rows, columns = map(int, sides)
    height, width = map(int, image.shape[-2:])
    return means(height, rows) @ image @ means(width, columns).T


def means(size: int, bins: int) -> Tensor:
    """Return (bins, size): each row averages the pixels of one bin; bins may overlap.

    numpy fills it, so that the graph holds a constant; torch would trace the filling itself.
    """
    matrix = np.zeros((bins, size), np.float32)
    for row in range(bins):
        first, end = row * size // bins, -(-(row + 1) * size // bins)
        matrix[row, first:end] = 1.0 / (end - first)
    return torch.from_numpy(matrix)


def espnet(folder: Path) -> torch.nn.Module:
    """Return the network of a clone of EdgeNets, with its Cityscapes weights."""
    if not (folder / WEIGHTS).is_file():
        raise SemvizError(f"{folder / WEIGHTS}: not found; name a clone of EdgeNets")
    sys.path.insert(0, str(folder.resolve()))
    from model.segmentation.espnetv2 import (  # type: ignore[import-not-found]
        ESPNetv2Segmentation,
    )

    settings = argparse.Namespace(
        s=SCALE, channels=3, num_classes=1000, weights="", model_width=224, model_height=224
    )
    network: torch.nn.Module = ESPNetv2Segmentation(settings, classes=20, dataset="city")
    network.load_state_dict(torch.load(folder / WEIGHTS, map_location="cpu", weights_only=True))
    return network.eval()


def export(network: torch.nn.Module, path: Path, width: int, height: int) -> float:
    """Write the ONNX file, and return the largest difference from torch on a random image."""
    import onnxruntime

    image = torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(0))
    torch_functions: Any = functional
    original = torch_functions.adaptive_avg_pool2d
    with torch.inference_mode():
        wanted = network(image).numpy()
    torch_functions.adaptive_avg_pool2d = pooled
    try:
        torch.onnx.export(
            network, (image,), str(path), input_names=["image"], output_names=["logits"],
            opset_version=17, dynamo=False,
        )  # fmt: skip
    finally:
        torch_functions.adaptive_avg_pool2d = original
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    (answer,) = session.run(["logits"], {"image": image.numpy()})
    return float(np.abs(answer - wanted).max())


def main() -> None:
    folder, path = Path(sys.argv[1]), Path(sys.argv[2])
    width, height = map(int, (sys.argv[3] if len(sys.argv) > 3 else "1248x384").split("x"))
    path.parent.mkdir(parents=True, exist_ok=True)
    difference = export(espnet(folder), path, width, height)
    path.with_suffix(".toml").write_text(TOML.format(name=path.name, width=width, height=height))
    print(f"{path} and {path.with_suffix('.toml')}: logits differ by {difference:.1e} at most")
    if difference > LARGEST_DIFFERENCE:
        raise SystemExit("that is too much; use another version of torch")


if __name__ == "__main__":
    main()
